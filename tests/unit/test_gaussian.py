import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from jaxsafe.nn.gaussian import Gaussian, entropy, kl, log_prob, sample

P = Gaussian(jnp.array([0.5, -1.0]), jnp.array([0.2, -0.7]))
Q = Gaussian(jnp.array([0.1, -0.4]), jnp.array([-0.3, 0.4]))


def test_log_probability_and_entropy_agree_with_scipy():
    x = jnp.array([0.3, 0.9])
    cov: Any = np.diag(np.exp(2 * np.array(P.log_std)))
    reference = stats.multivariate_normal(np.array(P.mean), cov)
    np.testing.assert_allclose(log_prob(P, x), reference.logpdf(np.array(x)), rtol=1e-5)
    np.testing.assert_allclose(entropy(P), reference.entropy(), rtol=1e-6)


def test_kl_by_hand():
    # stds 1 and 2, means 0 and 1: log 2 + (1 + 1) / 8 - 1 / 2
    p, q = Gaussian(jnp.zeros(1), jnp.zeros(1)), Gaussian(jnp.ones(1), jnp.log(2 * jnp.ones(1)))
    np.testing.assert_allclose(kl(p, q), math.log(2) - 0.25, rtol=1e-6)


def test_kl_is_the_mean_log_ratio():
    x = sample(Gaussian(*(jnp.broadcast_to(v, (200_000, 2)) for v in P)), jax.random.key(0))
    np.testing.assert_allclose(kl(P, Q), jnp.mean(log_prob(P, x) - log_prob(Q, x)), rtol=0.02)


def test_kl_is_not_negative_and_keeps_its_digits_close_to_zero():
    assert kl(P, P) == 0
    for step in (1e-2, 1e-4, 1e-6):
        near = Gaussian(P.mean, P.log_std + step)
        np.testing.assert_allclose(kl(P, near), 2 * step**2, rtol=0.02, atol=1e-9)
        assert kl(P, near) >= 0

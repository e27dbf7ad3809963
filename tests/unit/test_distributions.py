import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsafe.nn.gaussian import Gaussian
from jaxsafe.nn.squashed import squashed_mean, squashed_sample


@pytest.mark.parametrize("mean, log_std", [(0.0, 0.0), (1.5, -1.0), (-0.7, 0.3)])
def test_the_density_is_that_of_the_gaussian_over_the_slope_of_tanh(mean, log_std):
    dist = Gaussian(jnp.full((1000, 2), mean), jnp.full((1000, 2), log_std))
    action, log_prob = squashed_sample(dist, jax.random.key(0))
    a = np.asarray(action, np.float64)
    close = (np.abs(a) < 0.99).all(-1)  # where atanh keeps its digits
    z = (np.arctanh(a[close]) - mean) / np.exp(log_std)
    gaussian = -0.5 * z**2 - log_std - 0.5 * np.log(2 * np.pi)
    expected = (gaussian - np.log(1 - a[close] ** 2)).sum(-1)
    np.testing.assert_allclose(log_prob[close], expected, rtol=1e-4, atol=1e-3)
    assert close.sum() > 300 and np.abs(action).max() <= 1


def test_the_log_density_and_its_slope_stay_exact_where_tanh_saturates():
    def log_prob(mean):
        return squashed_sample(Gaussian(mean[None], jnp.zeros(1)), jax.random.key(0))[1]

    z = np.float64(jax.random.normal(jax.random.key(0), (1,))[0])
    gaussian = -0.5 * z**2 - 0.5 * np.log(2 * np.pi)
    slope = np.log(4) - 2 * (20 + z)  # log(1 - tanh(u)^2) tends to log 4 - 2 u
    np.testing.assert_allclose(log_prob(jnp.float32(20)), gaussian - slope, rtol=1e-5)
    np.testing.assert_allclose(jax.grad(log_prob)(jnp.float32(20)), 2.0, rtol=1e-5)


def test_the_mean_action_is_the_median_of_the_samples():
    dist = Gaussian(jnp.full((20_000, 2), jnp.array([0.3, -2.0])), jnp.full((20_000, 2), -0.5))
    draws = squashed_sample(dist, jax.random.key(0))[0]
    np.testing.assert_allclose(np.median(draws, axis=0), squashed_mean(dist)[0], atol=0.02)

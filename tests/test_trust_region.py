import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxsafe.algos.cpo import CPOConfig
from jaxsafe.gaussian import kl
from jaxsafe.networks import init_params, policy
from jaxsafe.trust_region import conjugate_gradient, fisher_product, line_search


def spd(rng, n):
    root = rng.standard_normal((n, n))
    return root @ root.T / n + 0.1 * np.eye(n)


@pytest.mark.parametrize("n", [1, 4, 12])
@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e6])
def test_conjugate_gradients_solve_as_numpy_does(n, scale):
    rng = np.random.default_rng(n)
    a, b = spd(rng, n), scale * rng.standard_normal(n)
    matrix = jnp.array(a, jnp.float32)
    x, residual = conjugate_gradient(lambda v: matrix @ v, jnp.array(b, jnp.float32), 40)
    np.testing.assert_allclose(x / scale, np.linalg.solve(a, b) / scale, rtol=2e-3, atol=1e-4)
    assert residual < 1e-4


def test_the_residual_reported_is_the_residual_left():
    rng = np.random.default_rng(0)
    a, b = jnp.array(spd(rng, 30), jnp.float32), jnp.array(rng.standard_normal(30), jnp.float32)
    for iterations in (0, 3, 8):
        x, residual = conjugate_gradient(lambda v: a @ v, b, iterations)
        left = jnp.linalg.norm(b - a @ x) / jnp.linalg.norm(b)
        np.testing.assert_allclose(residual, left, rtol=1e-2)


def test_no_gradient_gives_no_direction():
    x, residual = conjugate_gradient(lambda v: 2 * v, jnp.zeros(3), 15)
    assert not x.any() and residual == 0


def test_the_fisher_product_is_that_of_the_kls_hessian():
    cfg = CPOConfig(hidden=(3,), init="torch")
    actor = init_params(jax.random.key(0), 2, 2, cfg)["actor"]
    obs = jax.random.normal(jax.random.key(1), (16, 2))
    params, unravel = ravel_pytree(actor)

    def dist(params):
        return policy(unravel(params), obs, cfg)

    old = dist(params)
    hessian = jax.hessian(lambda p: jnp.mean(kl(old, dist(p))))(params)
    product = fisher_product(dist, params, old, 0.1, None)
    v = jax.random.normal(jax.random.key(2), params.shape)
    np.testing.assert_allclose(product(v), hessian @ v + 0.1 * v, rtol=1e-4, atol=1e-5)
    assert (
        np.linalg.eigvalsh(np.array(hessian)).min() > -1e-5
    )  # at the old policy it is a Fisher matrix


@pytest.mark.parametrize("bound, index", [(1.0, 0), (0.5, 1), (0.2, 3), (0.0, 5)])
def test_the_line_search_takes_the_first_step_that_is_accepted(bound, index):
    start, step = jnp.array([2.0]), jnp.array([1.0])
    x, accepted, i = line_search(lambda x: x[0] - 2.0 <= bound, start, step, 5, 0.5)
    assert i == index and accepted == (index < 5)
    assert x[0] == 2.0 + (0.5**index if accepted else 0.0)


def test_the_line_search_stays_where_it_is_when_nothing_is_finite():
    x, accepted, _ = line_search(lambda x: x[0] < jnp.inf, jnp.ones(1), jnp.full(1, jnp.nan), 5, 0.5)
    assert not accepted and x[0] == 1.0

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import FAST
from jax.flatten_util import ravel_pytree
from toys import context

from jaxsafe.algos.cpo import CPOConfig
from jaxsafe.algos.trpo import TRPOConfig
from jaxsafe.learn.estimates import Batch
from jaxsafe.learn.surrogates import plain
from jaxsafe.learn.trust_region import (
    conjugate_gradient,
    fisher_product,
    line_search,
    natural_gradient,
    trust_region,
)
from jaxsafe.nn.gaussian import kl, log_prob, sample
from jaxsafe.nn.networks import action_dist, init_params


def spd(rng, n):
    root = rng.standard_normal((n, n))
    return root @ root.T / n + 0.1 * np.eye(n)


@partial(jax.jit, static_argnums=2)
def solve(a, b, iterations):
    return conjugate_gradient(lambda v: a @ v, b, iterations)


@pytest.mark.parametrize("n", [1, 4, 12])
@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e6])
def test_conjugate_gradients_solve_as_numpy_does(n, scale):
    rng = np.random.default_rng(n)
    a, b = spd(rng, n), scale * rng.standard_normal(n)
    x, residual = solve(jnp.array(a, jnp.float32), jnp.array(b, jnp.float32), 40)
    np.testing.assert_allclose(x / scale, np.linalg.solve(a, b) / scale, rtol=2e-3, atol=1e-4)
    assert residual < 1e-4


def test_the_residual_reported_is_the_residual_left():
    rng = np.random.default_rng(0)
    a, b = jnp.array(spd(rng, 30), jnp.float32), jnp.array(rng.standard_normal(30), jnp.float32)
    for iterations in (0, 3, 8):
        x, residual = solve(a, b, iterations)
        left = jnp.linalg.norm(b - a @ x) / jnp.linalg.norm(b)
        np.testing.assert_allclose(residual, left, rtol=1e-2)


def test_no_gradient_gives_no_direction():
    x, residual = solve(2 * jnp.eye(3), jnp.zeros(3), 15)
    assert not x.any() and residual == 0


def test_the_fisher_product_is_that_of_the_kls_hessian():
    cfg = CPOConfig(hidden=(3,), init="torch")
    actor = init_params(jax.random.key(0), jnp.zeros(2), 2, cfg)["actor"]
    obs = jax.random.normal(jax.random.key(1), (16, 2))
    params, unravel = ravel_pytree(actor)

    def dist(params):
        return action_dist(unravel(params), obs, cfg)

    old = dist(params)
    hessian = jax.hessian(lambda p: jnp.mean(kl(old, dist(p))))(params)
    product = fisher_product(dist, params, old, cfg, None)  # its damping is 0.1
    v = jax.random.normal(jax.random.key(2), params.shape)
    np.testing.assert_allclose(product(v), hessian @ v + 0.1 * v, rtol=1e-4, atol=1e-5)
    assert (
        np.linalg.eigvalsh(np.array(hessian)).min() > -1e-5
    )  # at the old policy it is a Fisher matrix


def test_a_kl_per_action_is_half_the_kl_of_two_actions():
    def step(**options):
        cfg = TRPOConfig(hidden=(8,), init="torch", **options)
        keys = jax.random.split(jax.random.key(0), 3)
        actor = init_params(keys[0], jnp.zeros(3), 2, cfg)["actor"]
        obs = jax.random.normal(keys[1], (64, 3))
        old = action_dist(actor, obs, cfg)
        action = sample(old, keys[2])
        adv = action[:, 0] - action[:, 0].mean()
        batch = Batch(obs, action, log_prob(old, action), old, adv, adv, adv, adv)

        def objective(actor, batch):
            return plain(action_dist(actor, batch.obs, cfg), batch, batch.adv_r, cfg)

        update = jax.jit(trust_region.update, static_argnums=2, compiler_options=FAST)
        return update(actor, (), objective, batch, context(cfg))

    mean, _, metrics = step(target_kl=0.01, damping=0.1, kl_per_action=True)
    total, _, twice = step(target_kl=0.02, damping=0.2)
    for a, b in zip(jax.tree.leaves(mean), jax.tree.leaves(total), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)
    assert metrics["train/kl"] > 0.005
    np.testing.assert_allclose(twice["train/kl"], 2 * metrics["train/kl"], rtol=1e-3)


@jax.jit
def search_below(bound):
    start, step = jnp.array([2.0]), jnp.array([1.0])
    return line_search(lambda x: x[0] - 2.0 <= bound, start, step, 5, 0.5)


@pytest.mark.parametrize("bound, index", [(1.0, 0), (0.5, 1), (0.2, 3), (0.0, 5)])
def test_the_line_search_takes_the_first_step_that_is_accepted(bound, index):
    x, accepted, i = search_below(bound)
    assert i == index and accepted == (index < 5)
    assert x[0] == 2.0 + (0.5**index if accepted else 0.0)


def test_the_line_search_stays_where_it_is_when_nothing_is_finite():
    x, accepted, _ = line_search(lambda x: x[0] < jnp.inf, jnp.ones(1), jnp.full(1, jnp.nan), 5, 0.5)
    assert not accepted and x[0] == 1.0


def natural(step, bend=0.0, sunk=0.0, **options):
    """The flat step taken, its gradient and Fisher matrix (dense), the metrics, and the config.

    bend: of the objective, which loses so much times the square of the step.
    sunk: nats by which the learned deviations have fallen since the start.
    """
    cfg = TRPOConfig(hidden=(4,), cg_iterations=60, **options)
    return *taken(step, cfg, bend, sunk), cfg


@partial(jax.jit, static_argnums=0, compiler_options=FAST)
def taken(step, cfg, bend, sunk):
    keys = jax.random.split(jax.random.key(0), 3)
    actor = init_params(keys[0], jnp.zeros(3), 2, cfg)["actor"]
    actor |= {"log_std": actor["log_std"] - sunk}
    obs = jax.random.normal(keys[1], (256, 3))
    old = action_dist(actor, obs, cfg)
    action = sample(old, keys[2])
    adv = action.sum(-1) - action.sum(-1).mean()
    batch = Batch(obs, action, log_prob(old, action), old, adv, adv, adv, adv)

    start, unravel = ravel_pytree(actor)

    def objective(actor, batch):
        gain, found = plain(action_dist(actor, batch.obs, cfg), batch, batch.adv_r, cfg)
        return 1 + gain - bend * jnp.square(ravel_pytree(actor)[0] - start).sum(), found

    after, _, metrics = step.update(actor, (), objective, batch, context(cfg))
    metrics["gained"] = objective(after, batch)[0] - objective(actor, batch)[0]
    g = jax.grad(lambda x: objective(unravel(x), batch)[0])(start)
    hessian = jax.hessian(lambda x: kl(old, action_dist(unravel(x), obs, cfg)).mean())(start)
    metrics["from old to new"] = kl(old, action_dist(after, obs, cfg)).mean()
    return ravel_pytree(after)[0] - start, g, hessian + cfg.damping * jnp.eye(len(g)), metrics


def test_the_natural_gradient_is_numpys_and_as_long_as_the_trust_region():
    step, g, h, metrics, cfg = natural(natural_gradient, target_kl=1e-3)
    exact = np.linalg.solve(np.asarray(h, np.float64), np.asarray(g, np.float64))
    exact *= np.sqrt(2 * cfg.target_kl / (g @ exact))
    np.testing.assert_allclose(step, exact, rtol=2e-2, atol=2e-4)
    np.testing.assert_allclose(step @ h @ step / 2, cfg.target_kl, rtol=1e-2)
    # less than the model's: it has the damping besides
    assert 0.1 * cfg.target_kl < metrics["train/kl"] < 1.1 * cfg.target_kl


def test_a_trust_region_step_is_the_natural_one_shortened_until_it_holds():
    long, *_ = natural(natural_gradient, target_kl=0.5, damping=1e-3)
    step, _, _, metrics, cfg = natural(trust_region, target_kl=0.5, damping=1e-3)
    assert metrics["train/accepted"] == 1 and metrics["train/objective"] > 0
    assert metrics["train/kl"] <= cfg.target_kl
    np.testing.assert_allclose(metrics["train/kl"], metrics["from old to new"], rtol=1e-4)
    shrunk = cfg.line_search_shrink ** float(metrics["train/line_search"])
    np.testing.assert_allclose(step, shrunk * long, rtol=1e-3, atol=1e-5)
    _, _, _, unsearched, _ = natural(natural_gradient, target_kl=0.5, damping=1e-3)
    assert (unsearched["train/kl"] > cfg.target_kl) == (metrics["train/line_search"] > 0)


def test_a_trust_region_step_never_lowers_its_objective():
    long, *_ = natural(natural_gradient, bend=20.0, target_kl=0.01)
    step, _, _, metrics, _ = natural(trust_region, bend=20.0, target_kl=0.01)
    assert metrics["train/accepted"] == 1 and 0 <= metrics["gained"] < 1
    np.testing.assert_allclose(metrics["train/objective"], metrics["gained"], rtol=1e-3, atol=1e-6)
    assert metrics["train/kl"] < 0.01 and jnp.linalg.norm(step) < 0.95 * jnp.linalg.norm(long)


@pytest.mark.parametrize("damping", [0.1, 0.0])
@pytest.mark.parametrize("sunk", [3.0, 20.0, 200.0])
def test_a_trust_region_step_is_finite_where_the_deviation_has_sunk_to_its_floor(sunk, damping):
    """Of its Fisher information 1% is left, then 1e-16, then none: without damping H is singular."""
    step, g, h, metrics, cfg = natural(trust_region, min_std=0.3, sunk=sunk, damping=damping)
    assert jnp.isfinite(step).all() and metrics["train/nonfinite"] == 0
    assert metrics["train/accepted"] == 1 and 0.1 * cfg.target_kl < metrics["train/kl"] <= cfg.target_kl
    np.testing.assert_allclose(metrics["train/kl"], metrics["from old to new"], rtol=1e-4)
    if damping:
        exact = np.linalg.solve(np.asarray(h, np.float64), np.asarray(g, np.float64))
        exact *= np.sqrt(2 * cfg.target_kl / (g @ exact))
        shrunk = cfg.line_search_shrink ** float(metrics["train/line_search"])
        np.testing.assert_allclose(step, shrunk * exact, rtol=2e-2, atol=2e-4)

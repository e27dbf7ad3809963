"""What single algorithms add: surrogates, projections and penalties, by hand or by oracle."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import FAST
from jax.flatten_util import ravel_pytree
from learners import TINY
from scipy.optimize import minimize
from toys import START, Ticker, context

from jaxsafe.algos import cpo, cup, focops, p3o, pcpo
from jaxsafe.learn.estimates import Batch
from jaxsafe.learn.steps import Pair, adam_epochs
from jaxsafe.learn.surrogates import clipped, near_old, pessimistic, plain
from jaxsafe.nn.gaussian import Gaussian, kl, log_prob, sample
from jaxsafe.nn.networks import action_dist, init_params


def batch_of(old, action, adv):
    return Batch(action, action, log_prob(old, action), old, adv, adv, adv, adv)


def gaussian(mean):
    mean = jnp.asarray(mean, jnp.float32)[:, None]
    return Gaussian(mean, jnp.zeros_like(mean))


def test_focops_weighs_states_by_their_own_kl():
    old, new = gaussian([0.0, 0.0, 0.0]), gaussian([0.0, 0.1, 1.0])  # KL 0, 0.005, 0.5
    action, adv = jnp.array([[0.3], [0.5], [0.7]]), jnp.array([1.0, 2.0, 4.0])
    cfg = focops.FOCOPSConfig(temperature=2.0, near_kl=0.02)
    value, metrics = near_old(new, batch_of(old, action, adv), adv, cfg)
    w = np.exp(0.5 * 0.1 - 0.1**2 / 2)
    np.testing.assert_allclose(value, (1 / 2 + (2 * w / 2 - 0.005) + 0) / 3, rtol=1e-5)
    np.testing.assert_allclose(metrics["train/inside"], 2 / 3, rtol=1e-6)


def test_omnisafes_focops_multiplies_the_mean_gain_by_the_share_of_states_inside():
    old, new = gaussian([0.0, 0.0, 0.0]), gaussian([0.0, 0.1, 1.0])
    action, adv = jnp.array([[0.3], [0.5], [0.7]]), jnp.array([1.0, 2.0, 4.0])
    cfg = focops.FOCOPSConfig(temperature=2.0, near_kl=0.02, per_state=False)
    value, metrics = near_old(new, batch_of(old, action, adv), adv, cfg)
    kls = np.array([0.0, 0.005, 0.5])[:, None]  # [3, 1], as there, so that the loss is [3, 3]
    w = np.exp(log_prob(new, action) - log_prob(old, action))
    loss = (kls - w * np.array([1.0, 2.0, 4.0]) / 2.0) * (kls <= 0.02)
    assert loss.shape == (3, 3)
    np.testing.assert_allclose(value, -loss.mean(), rtol=1e-5)
    np.testing.assert_allclose(metrics["train/inside"], 2 / 3, rtol=1e-6)


def test_focops_has_a_gradient_where_a_state_is_far_off():
    old, action, adv = gaussian([0.0, 0.0]), jnp.array([[0.3], [60.0]]), jnp.array([1.0, 1.0])
    cfg = focops.FOCOPSConfig()

    def value(mean):
        return near_old(gaussian(mean), batch_of(old, action, adv), adv, cfg)[0]

    slope = jax.grad(value)(jnp.array([0.0, 50.0]))  # there w is e^1750
    np.testing.assert_allclose(slope, [0.3 / cfg.temperature / 2, 0.0], rtol=1e-5)


def test_focops_kl_is_from_the_new_policy_to_the_old():
    old = Gaussian(jnp.zeros((1, 1)), jnp.zeros((1, 1)))
    new = Gaussian(jnp.zeros((1, 1)), jnp.full((1, 1), 0.1))
    cfg = focops.FOCOPSConfig(temperature=1e9, near_kl=1.0)
    value, _ = near_old(new, batch_of(old, jnp.zeros((1, 1)), jnp.zeros(1)), jnp.zeros(1), cfg)
    np.testing.assert_allclose(-value, np.exp(0.2) / 2 - 0.5 - 0.1, rtol=1e-3)


def test_the_pessimistic_surrogate_by_hand():
    old, new = gaussian([0.0, 0.0]), gaussian([1.0, 1.0])
    action, cost = jnp.array([[1.0], [0.0]]), jnp.array([1.0, 1.0])
    cfg = p3o.P3OConfig(clip=0.2)
    value, _ = pessimistic(new, batch_of(old, action, cost), cost, cfg)
    # w is e^0.5, which is not clipped down, and e^-0.5, which is clipped up to 0.8
    np.testing.assert_allclose(value, (np.exp(0.5) + 0.8) / 2, rtol=1e-5)
    optimistic, _ = clipped(new, batch_of(old, action, cost), cost, cfg)
    np.testing.assert_allclose(optimistic, (1.2 + np.exp(-0.5)) / 2, rtol=1e-5)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("c", [-0.3, 0.0, 0.3])
def test_the_projection_is_scipys(seed, c):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((4, 4))
    h, g, b = root @ root.T + np.eye(4), rng.standard_normal(4), rng.standard_normal(4)
    h_g, h_b = np.linalg.solve(h, g), np.linalg.solve(h, b)
    delta = 0.02
    arrays = (g, h_g, h_b, g @ h_g, g @ h_b, b @ h_b, c, delta)
    step = pcpo.projected_step(cpo.Problem(*map(jnp.float32, arrays)), pcpo.PCPOConfig()).step
    reward = np.sqrt(2 * delta / (g @ h_g)) * h_g
    oracle = minimize(
        lambda x: (x - reward) @ h @ (x - reward),
        reward,
        jac=lambda x: 2 * h @ (x - reward),
        constraints={"type": "ineq", "fun": lambda x: -(b @ x + c), "jac": lambda x: -b},
        options={"ftol": 1e-14},
    )
    np.testing.assert_allclose(step, oracle.x, atol=2e-4)


def test_omnisafes_pcpo_steps_along_the_plain_gradient():
    h_g, h_b = jnp.array([1.0, 2.0]), jnp.array([0.5, 0.0])
    p = cpo.Problem(jnp.array([2.0, 8.0]), h_g, h_b, *map(jnp.float32, (18.0, 1.0, 0.25, 0.3, 0.04)))
    found = pcpo.projected_step(p, pcpo.PCPOConfig(natural=False))
    scale = (2 * 0.04 / 18) ** 0.5
    assert not found.earns  # what is projected may earn less than the present policy
    np.testing.assert_allclose(found.step, scale * p.g - (scale * 1.0 + 0.3) / 0.25 * h_b, rtol=1e-6)


def problem(cfg):
    keys = jax.random.split(jax.random.key(0), 3)
    actor = init_params(keys[0], jnp.zeros(3), 2, cfg)["actor"]
    obs = jax.random.normal(keys[1], (64, 3))
    old = action_dist(actor, obs, cfg)
    action = sample(old, keys[2])
    adv_r, adv_c = action[:, 0], action[:, 0] + action[:, 1]
    adv_r, adv_c = adv_r - adv_r.mean(), adv_c - adv_c.mean()
    return actor, Batch(obs, action, log_prob(old, action), old, adv_r, adv_c, adv_r, adv_c)


@pytest.mark.parametrize("omnisafe", [False, True])
@pytest.mark.parametrize("excess, price", [(-1.0, 0.0), (1.0, 3.0)])
def test_the_penalty_is_felt_beyond_the_limit_alone(excess, price, omnisafe):
    sizes: dict[str, Any] = {"hidden": (8,), "minibatches": 1, "epochs": 1, "kappa": 3.0, "lr": 1e-3}
    ours = not omnisafe
    cfg = p3o.P3OConfig(**sizes, per_step=ours, clip_cost=ours)
    of_cost = plain if omnisafe else pessimistic
    actor, batch = problem(cfg)

    def objective(surrogate, field):
        def value(actor, batch):
            return surrogate(action_dist(actor, batch.obs, cfg), batch, getattr(batch, field), cfg)

        return value

    def mixed(actor, batch):
        dist = action_dist(actor, batch.obs, cfg)
        reward, _ = clipped(dist, batch, batch.adv_r, cfg)
        return reward - price * of_cost(dist, batch, batch.adv_c, cfg)[0], {}

    pair = Pair(objective(clipped, "adv_r"), objective(p3o.surrogate_c, "adv_c"))
    state, told = adam_epochs.init(actor, cfg), context(cfg, violation=excess, episode_length=10.0)
    after, _, metrics = p3o.update(actor, state, pair, batch, told)
    cost = p3o.surrogate_c(action_dist(after, batch.obs, cfg), batch, batch.adv_c, cfg)[0]
    violation = 1.0 if omnisafe else 1.0 / 10  # per episode, or per step of an episode of 10
    paid = price * (cost + violation)
    np.testing.assert_allclose(metrics["train/penalty"], paid, rtol=1e-5)
    same, _, _ = adam_epochs.update(actor, state, mixed, batch, told)
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(same), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7)


def penalty_of(cfg, noise, violation, axis_name=None):
    """What a policy pays that has not moved, for a minibatch whose A_c has the mean `noise`."""
    actor, batch = problem(cfg)
    batch = dataclasses.replace(batch, adv_c=batch.adv_c + noise)

    def of_reward(actor, batch):
        return jnp.zeros(()), {}

    def of_cost(actor, batch):
        return p3o.surrogate_c(action_dist(actor, batch.obs, cfg), batch, batch.adv_c, cfg)

    told = context(cfg, violation=violation, axis_name=axis_name)
    return p3o.penalised(Pair(of_reward, of_cost), told)(actor, batch)[1]["train/penalty"]


@pytest.mark.parametrize("noise", [-1.0, 1.0])
@pytest.mark.parametrize("violation", [-0.2, 0.2])
@pytest.mark.parametrize("centred", [False, True])
def test_noise_of_a_minibatch_is_a_violation_unless_it_is_centred(centred, violation, noise):
    """The mean of A_c over a minibatch depends on the states that it happens to hold."""
    cfg = p3o.P3OConfig(hidden=(8,), kappa=3.0, centre_cost=centred)
    penalty = 3.0 * max(0.0, violation + (0.0 if centred else noise))
    np.testing.assert_allclose(penalty_of(cfg, noise, violation), penalty, atol=1e-5)


@pytest.mark.parametrize("violation", [-0.2, 0.2])
def test_the_penalty_is_on_the_mean_of_all_devices(violation):
    cfg = p3o.P3OConfig(hidden=(8,), kappa=3.0)

    def on_one(noise):
        return penalty_of(cfg, noise, violation, "devices")

    paid = jax.vmap(on_one, axis_name="devices")(jnp.array([-1.0, 1.0]))
    np.testing.assert_allclose(paid.mean(), 3.0 * max(0.0, violation), atol=1e-5)


def test_cups_projection_is_a_step_down_the_papers_loss():
    cfg = cup.CUPConfig(hidden=(8,), cost_discount=0.9, cost_gae_lambda=0.5)
    actor, batch = problem(cfg)
    lam, scale = 1.5, (1 - 0.9 * 0.5) / (1 - 0.9)
    start, unravel = ravel_pytree(actor)

    def paper(x):
        dist = action_dist(unravel(x), batch.obs, cfg)
        w = jnp.exp(log_prob(dist, batch.action) - batch.log_prob)
        return jnp.mean(lam * scale * w * batch.adv_c + kl(dist, batch.old))

    away = start + 0.1  # where the KL has a gradient
    ours = jax.grad(lambda x: -cup.projection(unravel(x), batch, lam, cfg)[0])(away)
    np.testing.assert_allclose(ours, jax.grad(paper)(away), rtol=1e-4, atol=1e-5)
    assert jnp.abs(ours).max() > 0


def test_cups_steps_are_up_the_papers_objectives(monkeypatch):
    """In place of each step all parameters rise by 0.1; it tells what it maximises there, and what it
    should."""
    collected = []

    def rise(actor, opt_state, objective, batch, context):
        cfg, actor = context.cfg, jax.tree.map(lambda x: x + 0.1, actor)
        collected.append(batch)
        dist, acted = action_dist(actor, batch.obs, cfg), collected[0]
        if len(collected) == 1:
            expected = clipped(dist, acted, acted.adv_r, cfg)[0]
        else:
            scale = (1 - cfg.cost_discount * cfg.cost_gae_lambda) / (1 - cfg.cost_discount)
            w = jnp.exp(log_prob(dist, acted.action) - acted.log_prob)  # with the policy that acted
            before = action_dist(jax.tree.map(lambda x: x - 0.1, actor), batch.obs, cfg)
            expected = -jnp.mean(1.1 * scale * w * acted.adv_c + kl(dist, before))
        told = {"train/kl": objective(actor, batch)[0], "train/passes": expected}
        return actor, opt_state, told | {"train/nonfinite": jnp.ones(())}

    monkeypatch.setattr(cup, "adam_epochs", cup.adam_epochs._replace(update=rise))
    algo, cfg = cup.make(Ticker(episode_length=5)), cup.CUPConfig(**TINY, lam_init=1.0, cost_limit=9.0)
    ts = algo.init(jax.random.key(0), cfg, START)
    after, m = jax.jit(algo.update, compiler_options=FAST)(ts, START)
    np.testing.assert_allclose(after.dual.lam, 1.1, rtol=1e-6)  # J_c is 10: Adam's step of 0.1
    assert jnp.abs(m["train/passes"]) > 1e-4 and jnp.abs(m["train/passes_projection"]) > 1e-4
    np.testing.assert_allclose(m["train/kl_reward"], m["train/passes"], rtol=1e-3)
    np.testing.assert_allclose(m["train/kl_projection"], m["train/passes_projection"], rtol=1e-3)
    assert m["train/nonfinite"] == 2

"""What every offline algorithm must do, on toys, and BC's equation by hand."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import FAST
from toys import Corridor

from jaxsafe.algos import ALGOS, bc
from jaxsafe.config import ConfigError
from jaxsafe.learn.learner import GradientStep, Learner
from jaxsafe.learn.offline import (
    DataSet,
    OfflineConfig,
    batch_at,
    data_of,
    data_set,
    data_set_like,
    offline,
)
from jaxsafe.learn.steps import Trainable
from jaxsafe.types import Shared

NAMES = [name for name, row in ALGOS.items() if issubclass(row.config, OfflineConfig)]
TINY: dict[str, Any] = {"updates": 5, "batch_size": 16, "hidden": (8,)}
COMPILED = ["bc_safe", "bcq_lag", "coptidice"]  # among them every part of the loop; the others by shape
GAIN = np.array([[-1.0, 0.2, -0.5, 0.0], [0.0, -1.0, 0.0, -0.5]], np.float32)


def linear_data(n: int = 400) -> DataSet:
    """Transitions of Corridor's sizes, whose actions are a linear function of the observations."""
    rng = np.random.default_rng(0)
    obs = rng.normal(0.3, [0.5, 1.0, 2.0, 1.0], (n, 4)).astype(np.float32)
    action = np.clip(obs @ GAIN.T, -0.9, 0.9)
    number = np.zeros(n, np.float32)
    never = np.zeros(n, bool)
    late = np.arange(n) % 20 == 19
    return data_set(obs, action, number, number, obs, never, late, {"wall": number})


def shared(iteration: int = 0) -> Shared:
    return Shared(np.int32(iteration), data=linear_data())


def settings_of(name, **settings):
    vae = {"vae_hidden": (8,)} if hasattr(ALGOS[name].config, "vae_hidden") else {}
    return ALGOS[name].config(**TINY | vae | settings)


def start(name, seed=0, **settings):
    algo, cfg = ALGOS[name].make(Corridor()), settings_of(name, **settings)
    ts = jax.jit(lambda key: algo.init(key, cfg, shared()), compiler_options=FAST)(jax.random.key(seed))
    return algo, ts


@pytest.mark.parametrize("name", NAMES)
def test_an_update_has_float_metrics_and_keeps_the_structure(name):
    algo, cfg = ALGOS[name].make(Corridor()), settings_of(name)
    assert algo.clocks(cfg) == (0, 5)
    before = jax.eval_shape(lambda: algo.init(jax.random.key(0), cfg, shared()))
    after, metrics = jax.eval_shape(algo.update, before, shared())
    assert all(x.dtype == jnp.float32 and x.shape == () for x in metrics.values())
    assert "train/nonfinite" in metrics
    assert jax.tree.structure(before) == jax.tree.structure(after)
    assert jax.tree.leaves(before) == jax.tree.leaves(after)
    action = jax.eval_shape(
        lambda ts: algo.policy.act(algo.learned(ts), (), jnp.zeros(4), None)[0], before
    )
    assert action.shape == (2,)
    if ALGOS[name].holds != "nothing" and name != "bc_safe":
        assert {"train/lam", "train/cost_estimate"} <= {*metrics}


@pytest.mark.parametrize("name", [x for x in NAMES if hasattr(ALGOS[x].config, "cost_limits")])
def test_each_of_several_constraints_has_a_price(name):
    algo = ALGOS[name].make(Corridor())
    cfg = settings_of(name, cost_limits={"wall": 1.0})
    ts = jax.eval_shape(lambda: algo.init(jax.random.key(0), cfg, shared()))
    metrics = jax.eval_shape(algo.update, ts, shared())[1]
    assert {"train/lam_wall", "train/cost_estimate_wall"} <= {*metrics}
    wrong = settings_of(name, cost_limits={"wal": 1.0})
    with pytest.raises(ConfigError, match="has no cost 'wal'; did you mean 'wall'"):
        jax.eval_shape(lambda: algo.init(jax.random.key(0), wrong, shared()))


@pytest.mark.parametrize("name", COMPILED)
def test_an_update_moves_every_parameter(name):
    algo, before = start(name)
    after, metrics = jax.jit(algo.update, compiler_options=FAST)(before, shared())
    assert metrics["train/nonfinite"] == 0
    assert [x.aval for x in jax.tree.leaves(before)] == [x.aval for x in jax.tree.leaves(after)]
    moved = jax.tree.map(lambda x, y: bool((x != y).any()), before.params, after.params)
    assert all(jax.tree.leaves(moved))


@pytest.mark.parametrize("name", COMPILED)
def test_seeds_by_vmap_share_the_data_and_equal_lone_ones(name):
    algo, _ = start(name)
    lone = [start(name, seed)[1] for seed in range(2)]
    ts = jax.tree.map(lambda *x: jnp.stack(x), *lone)
    update = jax.jit(algo.update, compiler_options=FAST)
    together = jax.jit(jax.vmap(algo.update, in_axes=(0, None)), compiler_options=FAST)
    for iteration in range(3):
        ts, _ = together(ts, shared(iteration))
        for i in range(2):
            lone[i], _ = update(lone[i], shared(iteration))
            for x, y in zip(*(jax.tree.leaves(t.params) for t in (ts, lone[i])), strict=True):
                np.testing.assert_allclose(x[i], y, rtol=1e-4, atol=1e-5)
    assert any(bool((x[0] != x[1]).any()) for x in jax.tree.leaves(ts.params))


@pytest.mark.parametrize("name", COMPILED)
def test_the_data_set_is_one_of_the_environment(name):
    algo, ts = start(name)
    with pytest.raises(ConfigError, match="give dataset=PATH"):
        jax.eval_shape(algo.update, ts, Shared(np.int32(0)))
    good = data_set_like(Corridor())
    assert data_of(Shared(0, data=good), Corridor()) is good
    wide = good._replace(action=np.zeros((1, 3), np.float32))
    with pytest.raises(ConfigError, match="actions have 3 numbers, those of the environment 2"):
        data_of(Shared(0, data=wide), Corridor())
    for wrong in ("updates", "batch_size"):
        with pytest.raises(ConfigError, match=f"{wrong}=0: expected a whole number between 1 and"):
            algo.clocks(ALGOS[name].config(**{wrong: 0}))


def test_learning_goes_on_after_any_number_of_gradient_steps():
    """The optimisers count them in 32 bits, whose square has no room from 46,341 on."""
    algo, ts = start("bc_safe")
    late = jax.tree.map(lambda x: x + 10**6 if x.dtype == jnp.int32 else x, ts.opt_state)
    ts = ts.replace(opt_state=late)
    after, metrics = jax.jit(algo.update, compiler_options=FAST)(ts, shared())
    assert metrics["train/nonfinite"] == 0
    pairs = zip(jax.tree.leaves(ts.params), jax.tree.leaves(after.params), strict=True)
    assert all((a != b).any() for a, b in pairs)


@pytest.mark.parametrize("name", COMPILED)
def test_steps_on_transitions_that_are_not_finite_are_left_out_and_counted(name):
    """Of 400 transitions 10 have a NaN: about every third batch of 16."""
    algo, before = start(name, updates=40)
    action = linear_data().action.copy()
    action[::40] = np.nan
    holed = Shared(np.int32(0), data=linear_data()._replace(action=action))
    update = jax.jit(algo.update, compiler_options=FAST)
    after, metrics = update(before, holed)
    assert 5 <= metrics["train/nonfinite"] <= 25
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves((after.params, after.dual)))
    moved = jax.tree.map(lambda x, y: bool((x != y).any()), before.params, after.params)
    assert all(jax.tree.leaves(moved))
    action[:] = np.nan
    still, metrics = update(before, holed)
    assert metrics["train/nonfinite"] == 40
    nets = before.params, still.params
    assert all(bool((x == y).all()) for x, y in zip(*map(jax.tree.leaves, nets), strict=True))


def test_learners_are_told_between_what_values_lie():
    def step(nets, batch, at, cfg, axis_name):
        (_, high), (_, high_c) = at.ranges
        return nets, {"train/high": high, "train/high_c": high_c}

    cfg = settings_of("crr", discount=0.9, cost_discount=0.5)
    learner = Learner(init=lambda *_: Trainable({}, {}), step=step, act=lambda *_: jnp.zeros(2))
    algo = offline(Corridor(), learner)
    data = linear_data()._replace(reward=np.full(400, 2, np.float32), cost=np.full(400, 3, np.float32))
    told = Shared(np.int32(0), data=data)
    metrics = algo.update(algo.init(jax.random.key(0), cfg, told), told)[1]
    np.testing.assert_allclose([metrics["train/high"], metrics["train/high_c"]], [20, 6], rtol=1e-5)


@pytest.mark.parametrize("name", COMPILED)
def test_observations_are_normalised_by_the_data(name):
    _, ts = start(name)
    np.testing.assert_allclose(ts.normaliser.mean, linear_data().obs.mean(0), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(ts.normaliser.var, linear_data().obs.var(0), rtol=1e-4)
    assert start(name, obs_normalize=False)[1].normaliser == ()


def test_a_gradient_step_of_bc_by_hand():
    """One linear layer, Adam's first step: lr in the direction of the sign of the gradient."""
    cfg = bc.BCConfig(hidden=(), lr=0.01, obs_normalize=False, max_grad_norm=1e9)
    learner = bc.learner(Corridor())
    fit: Any = learner.init(jax.random.key(0), 4, 2, cfg)
    data = linear_data()._replace(action=np.float32(3.0) * linear_data().action)  # clipped to [-1, 1]
    rows = np.array([0, 3, 5])
    batch = batch_at(data, jnp.array(rows), cfg, ())
    at = GradientStep(jnp.int32(0), jnp.ones(()), jax.random.key(1))
    new, metrics = learner.step(fit, batch, at, cfg, None)
    assert isinstance(new, Trainable)
    (bias, weights), (new_bias, new_weights) = (jax.tree.leaves(f.params["actor"]) for f in (fit, new))
    obs, wanted = data.obs[rows], np.clip(data.action[rows], -1, 1)
    mu = np.tanh(obs @ np.asarray(weights) + np.asarray(bias))
    np.testing.assert_allclose(metrics["train/actor_loss"], ((mu - wanted) ** 2).sum() / 3, rtol=1e-5)
    slope = 2 * (mu - wanted) * (1 - mu**2) / 3
    for old, moved, grad in (
        (weights, new_weights, obs.T @ slope),
        (bias, new_bias, slope.sum(0)),
    ):
        np.testing.assert_allclose(moved, old - 0.01 * grad / (np.abs(grad) + 1e-8), atol=1e-6)


def test_bc_recovers_the_actions_of_a_linear_policy():
    algo, ts = start("bc", updates=300, batch_size=64, hidden=(32,), lr=1e-2, lr_decay=True,
                     total_iterations=2.0)  # fmt: skip
    update = jax.jit(algo.update)
    for iteration in range(2):
        ts, metrics = update(ts, shared(iteration))
    assert metrics["train/actor_loss"] < 0.01
    rng = np.random.default_rng(1)
    obs = rng.normal(0.3, [0.5, 1.0, 2.0, 1.0], (200, 4)).astype(np.float32)
    action = jax.vmap(lambda x: algo.policy.act(algo.learned(ts), (), x, None)[0])(obs)
    assert np.abs(action - np.clip(obs @ GAIN.T, -0.9, 0.9)).mean() < 0.05

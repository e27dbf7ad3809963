"""CRABS on toys: what it does before its first certificate, and after it."""

import dataclasses
import operator
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import FAST
from toys import START, Corridor, Ticker

from jaxsafe.algos import ALGOS
from jaxsafe.config import ConfigError
from jaxsafe.learn.acting import Player
from jaxsafe.learn.barrier import interval_barrier
from jaxsafe.types import Shared

ROW = ALGOS["crabs"]
TINY: dict[str, Any] = {
    "num_envs": 6, "horizon": 4, "learn_every": 2, "batch_size": 16, "replay_ratio": 4,
    "replay_size": 6 * 12, "learning_starts": 6 * 5, "refit_every": 6 * 8, "hidden": (8,), "models": 2,
    "model_hidden": (8,), "model_batch": 8, "epoch_steps": 4, "barrier_hidden": (8,), "chains": 16,
    "barrier_steps": 12, "quiet_steps": 2, "check_steps": 3, "candidates": 5,
}  # fmt: skip


@cache
def together():
    """Two members at first, and the compiled update, which uses up its argument. No check of the second
    member's certificates can succeed, because its margin is too wide; the first one's all do."""
    algo, cfg = ROW.make(Corridor()), ROW.config(**TINY)

    def init(key, margin):
        return algo.init(key, dataclasses.replace(cfg, margin=margin), START)

    keys, margins = jax.random.split(jax.random.key(3), 2), jnp.array([-1e5, 1e5])
    ts = jax.jit(jax.vmap(init), compiler_options=FAST)(keys, margins)
    update = jax.jit(jax.vmap(algo.update, in_axes=(0, None)), donate_argnums=0)
    return algo, ts, update.lower(ts, START).compile(FAST)


def at(iteration: int, since: int = 0) -> Shared:
    return Shared(np.int32(iteration), np.int32(since))


def row(tree, i):
    return jax.tree.map(operator.itemgetter(i), tree)


def differ(a, b):
    return [bool((x != y).any()) for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True)]


@pytest.mark.parametrize("settings", [{}, *ROW.published.values()])
def test_an_update_keeps_the_structure(settings):
    algo, cfg = ROW.make(Corridor()), ROW.config(**settings)
    before = jax.eval_shape(lambda: algo.init(jax.random.key(0), cfg, START))
    after, metrics = jax.eval_shape(algo.update, before, START)
    assert jax.tree.structure(before) == jax.tree.structure(after)
    assert jax.tree.leaves(before) == jax.tree.leaves(after)
    assert all(x.dtype == jnp.float32 and x.shape == () for x in metrics.values())
    assert {"train/certified", "train/violating", "train/refused", "train/nonfinite"} <= metrics.keys()
    learned = jax.eval_shape(algo.learned, before)
    assert {*learned.params} >= {"actor", "model", "barrier", "safe", "certified"}
    assert "search" not in learned.params


@pytest.mark.parametrize(
    "env, settings, message",
    [
        (Ticker(), {}, r"which observations are safe, by a method `barrier\(obs\)`"),
        (Corridor(), {"obs_normalize": True}, "a certificate is for observations as they are"),
    ],
)
def test_what_cannot_have_a_certificate_is_refused(env, settings, message):
    algo, cfg = ROW.make(env), ROW.config(**TINY | settings)
    with pytest.raises(ConfigError, match=message):
        jax.eval_shape(lambda: algo.init(jax.random.key(0), cfg, START))


def test_certificates_come_by_the_clock_and_are_the_networks_of_that_moment():
    _, before, update = together()
    ts = jax.tree.map(jnp.copy, before)
    for iteration in range(6):  # the warm-up is two updates, refits are two updates apart
        params = jax.tree.map(jnp.copy, ts.params)
        ts, metrics = update(ts, at(iteration))
        due = iteration in (1, 3, 5)
        assert (jnp.isnan(metrics["train/certified"]) == (not due)).all()
        assert all(differ(params["model"].ensemble, ts.params["model"].ensemble)) == due
        assert (metrics["train/nonfinite"] == 0).all()
        if due:
            assert metrics["train/certified"].tolist() == [1, 0]
            safe, now = row(ts.params["safe"], 0), row(ts.params, 0)
            same = (now["barrier"], now["actor"], now["model"])
            assert not any(differ((safe.barrier, safe.actor, safe.model), same))
    assert ts.params["certified"].tolist() == [1, 0]
    assert not any(differ(row(before.params["safe"], 1), row(ts.params["safe"], 1)))
    # with every certificate the steps against violations become fewer, with every failure more
    assert ts.opt_state["pressure"][0] < 2 < ts.opt_state["pressure"][1] == 10
    learned = (ts.params, ts.opt_state, ts.replay)
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(learned))


def test_the_compiled_update_writes_into_the_ring_in_place():
    _, ts, compiled = together()
    text: Any = compiled.as_text()
    shape = f"[{','.join(map(str, ts.replay.obs.shape))}]"
    made = [line for line in text.splitlines() if shape in line.partition("(")[0]]
    assert any(" dynamic-update-slice(" in line for line in made)
    assert not any(" copy(" in line for line in made)


def test_it_acts_by_its_policy_until_there_is_a_certificate_and_then_within_it():
    """Of a corridor whose certificate knows that y' = y + 0.02 vy, and whose policy stands still."""
    algo, ts, _ = together()
    learned = row(algo.learned(ts), 0)
    state = Corridor().reset(jax.random.key(0))
    act = jax.jit(lambda learned: Player(algo.policy, learned, Corridor()).act((), state)[0])
    free = act(learned)
    np.testing.assert_allclose(free, act(learned))
    zeros = jax.tree.map(jnp.zeros_like, learned.params["safe"])
    # all weights are 0: h = log 2 + B - 1, models say that nothing moves, the certified policy is 0
    certified = learned.params | {"safe": zeros, "certified": jnp.ones(())}
    assert interval_barrier(state.obs[1], 0.5) + np.log(2) < 1
    scale = zeros.model.scale.replace(std=jnp.ones(6))
    zeros = zeros.replace(model=zeros.model.replace(scale=scale))
    inside = dataclasses.replace(learned, params=certified | {"safe": zeros})
    np.testing.assert_allclose(act(inside), free)
    state = state.replace(obs=state.obs.at[1].set(0.49))
    act = jax.jit(lambda learned: Player(algo.policy, learned, Corridor()).act((), state)[0])
    np.testing.assert_allclose(act(inside), 0.0)
    assert (jnp.abs(act(learned)) > 0).all()

"""CRABS on toys: what it does before its first certificate, and after it."""

import dataclasses
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import FAST
from learners import at
from toys import START, Corridor, Ticker

from jaxsafe.algos import ALGOS
from jaxsafe.config import ConfigError
from jaxsafe.learn.acting import Player
from jaxsafe.learn.certificate import interval_barrier

ROW = ALGOS["crabs"]
TINY: dict[str, Any] = {
    "num_envs": 6, "horizon": 4, "learn_every": 2, "batch_size": 16, "replay_ratio": 4,
    "replay_size": 6 * 12, "learning_starts": 6 * 5, "refit_every": 6 * 8, "hidden": (8,), "models": 2,
    "model_hidden": (8,), "model_batch": 8, "epoch_steps": 4, "barrier_hidden": (8,), "chains": 16,
    "barrier_steps": 12, "quiet_steps": 2, "check_steps": 3, "candidates": 5,
}  # fmt: skip


@cache
def begun():
    """The algorithm, and how it begins at a given margin."""
    algo, cfg = ROW.make(Corridor()), ROW.config(**TINY)

    def init(margin):
        return algo.init(jax.random.key(3), dataclasses.replace(cfg, margin=margin), START)

    return algo, jax.jit(init, compiler_options=FAST)


@cache
def compiled():
    """The update, which uses up its argument."""
    algo, start = begun()
    like = jax.eval_shape(start, jnp.zeros(()))
    return jax.jit(algo.update, donate_argnums=0).lower(like, START).compile(FAST)


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


@pytest.mark.slow
@pytest.mark.parametrize("margin, succeeds", [(-1e5, True), (1e5, False)])
def test_certificates_come_by_the_clock_and_are_the_networks_of_that_moment(margin, succeeds):
    """With a margin so wide that nothing violates the condition, or so that everything does."""
    (_, start), update = begun(), compiled()
    before = start(jnp.float32(margin))
    ts = jax.tree.map(jnp.copy, before)
    for iteration in range(6):  # the warm-up is two updates, refits are two updates apart
        models = jax.tree.map(jnp.copy, ts.params["model"].ensemble)
        ts, metrics = update(ts, at(iteration))
        due = iteration in (1, 3, 5)
        assert jnp.isnan(metrics["train/certified"]) == (not due)
        assert all(differ(models, ts.params["model"].ensemble)) == due
        assert metrics["train/nonfinite"] == 0
        if due:
            safe, now = ts.params["safe"], ts.params
            found = (now["barrier"], now["actor"], now["model"])
            assert metrics["train/certified"] == ts.params["certified"] == succeeds
            assert any(differ((safe.barrier, safe.actor, safe.model), found)) == (not succeeds)
    assert any(differ(before.params["safe"], ts.params["safe"])) == succeeds
    # with every certificate the steps against violations become fewer, with every failure more
    assert ts.opt_state["pressure"] < 2 if succeeds else ts.opt_state["pressure"] == 10
    learned = (ts.params, ts.opt_state, ts.replay)
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(learned))


@pytest.mark.slow
def test_the_compiled_update_writes_into_the_ring_in_place():
    (_, start), update = begun(), compiled()
    ring = jax.eval_shape(start, jnp.zeros(())).replay
    text: Any = update.as_text()
    shape = f"[{','.join(map(str, ring.obs.shape))}]"
    made = [line for line in text.splitlines() if shape in line.partition("(")[0]]
    assert any(" dynamic-update-slice(" in line for line in made)
    assert not any(" copy(" in line for line in made)


def test_it_acts_by_its_policy_until_there_is_a_certificate_and_then_within_it():
    """All weights of the certificate are 0. So h = log 2 + B - 1, its models say that nothing moves,
    and its policy stands still."""
    algo, start = begun()
    free = algo.learned(start(jnp.zeros(())))
    safe = jax.tree.map(jnp.zeros_like, free.params["safe"])
    scale = safe.model.scale.replace(std=jnp.ones(6))
    safe = safe.replace(model=safe.model.replace(scale=scale))
    bound = dataclasses.replace(free, params=free.params | {"safe": safe, "certified": jnp.ones(())})
    within = Corridor().reset(jax.random.key(0))
    beyond = dataclasses.replace(within, obs=within.obs.at[1].set(0.49))
    h = [interval_barrier(state.obs[1], 0.5) + np.log(2) - 1 for state in (within, beyond)]
    assert h[0] < 0 < h[1]

    @jax.jit
    def act(learned, state):
        return Player(algo.policy, learned, Corridor()).act((), state)[0]

    np.testing.assert_allclose(act(bound, within), act(free, within))
    np.testing.assert_allclose(act(bound, beyond), 0.0)
    assert (jnp.abs(act(free, beyond)) > 0).all() and (jnp.abs(act(free, within)) > 0).all()

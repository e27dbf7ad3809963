"""What an update does to numbers: one program of three members for each method and option."""

import dataclasses
from functools import cache
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learners import begin, compiled, covering, every_option, member, members, numbers, others_slowly

from jaxsafe.types import Metrics, PyTree

COMPILED = others_slowly(covering())
LIMITS = {"cost_limit": jnp.array([25.0, 1.0, 5.0]), "entropy_coef": jnp.zeros(3)}


class Update(NamedTuple):
    before: PyTree  # three members, whose limits are LIMITS
    after: PyTree
    metrics: Metrics


@cache
def first_update(name: str) -> Update:
    before = members(name, [0, 1, 2], **LIMITS)
    return Update(before, *compiled(name).together(before))


def same(a: Any, b: Any) -> None:
    for x, y in zip(numbers(a), numbers(b), strict=True):
        np.testing.assert_array_equal(x, y)


def broken(ts: PyTree, *where: int) -> PyTree:
    """`ts` with a world that is not finite: of a lone member, or of member i."""
    state = ts.rollout.state
    at = (*where, 0)
    state = dataclasses.replace(
        state, physics=state.physics.at[at].set(jnp.nan), obs=state.obs.at[at].set(jnp.nan)
    )
    return dataclasses.replace(ts, rollout=dataclasses.replace(ts.rollout, state=state))


def senseless(ts: PyTree, *where: int) -> PyTree:
    """`ts` whose advantages will not be finite: of a lone member, or of member i."""
    discounts = {k: getattr(ts.config, k).at[where].set(jnp.nan) for k in ("discount", "cost_discount")}
    return dataclasses.replace(ts, config=dataclasses.replace(ts.config, **discounts))


@pytest.mark.parametrize("name", COMPILED)
def test_an_update_moves_every_parameter_and_stays_finite(name):
    before, after, metrics = first_update(name)
    chex.assert_trees_all_equal_structs(before, after)
    assert [x.aval for x in jax.tree.leaves(before)] == [x.aval for x in jax.tree.leaves(after)]
    chex.assert_tree_all_finite((after.params, metrics))
    assert (metrics["train/nonfinite"] == 0).all()
    for a, b in zip(*map(jax.tree.leaves, (before.params, after.params)), strict=True):
        assert (a != b).reshape(3, -1).any(1).all()


@pytest.mark.parametrize("name", COMPILED)
def test_the_same_key_gives_the_same_run(name):
    same(first_update(name)[1:], compiled(name).together(members(name, [0, 1, 2], **LIMITS)))


@pytest.mark.parametrize("name", COMPILED)
def test_a_batch_that_is_not_finite_changes_nothing_that_is_learned_and_is_counted(name):
    ts = first_update(name).after
    # so that an update moves what is remembered, in a task without failures and costs too
    past, lost = ts.past_costs, ts.lost_time
    past, lost = past._replace(values=past.values + 1), lost._replace(taken=lost.taken / 2)
    ts = dataclasses.replace(ts, past_costs=past, lost_time=lost)
    whole, _ = compiled(name).together(ts)
    after, metrics = compiled(name).together(senseless(ts, 1))
    assert metrics["train/nonfinite"][1] > 0
    for field in ("params", "dual", "normaliser", "lost_time", "past_costs"):
        same(member(getattr(ts, field), 1), member(getattr(after, field), 1))
    for other in (0, 2):  # the members beside it learn on
        assert metrics["train/nonfinite"][other] == 0
        same(member(whole, other), member(after, other))


@pytest.mark.parametrize("name", COMPILED)
def test_a_world_that_is_not_finite_is_reset_and_counted_and_the_others_are_learned_from(name):
    ts = first_update(name).after
    whole, _ = compiled(name).together(ts)
    after, metrics = compiled(name).together(broken(ts, 1))
    assert metrics["train/nonfinite"].tolist() == [0, 0, 0]
    assert metrics["train/bad_worlds"].tolist() == metrics["train/bad_obs"].tolist() == [0, 1, 0]
    learned = [member(getattr(after, k), 1) for k in ("params", "dual", "normaliser", "lost_time")]
    assert all(np.isfinite(x).all() for x in numbers(learned))
    assert all(np.isfinite(x).all() for x in numbers(after.rollout.state))
    old, new = (jax.tree.leaves(member(x.params, 1)) for x in (ts, after))
    assert all((a != b).any() for a, b in zip(old, new, strict=True))
    for other in (0, 2):
        same(member(whole, other), member(after, other))


@pytest.mark.parametrize("name", COMPILED)
def test_acting_normalises_and_is_the_mean_without_a_key(name):
    algo, ts = compiled(name).algo, member(first_update(name).after, 0)
    size = ts.rollout.state.obs.shape[-1]  # with what an augmentation appends
    obs = jax.random.normal(jax.random.key(1), (500, size))

    def act(ts, obs, key=None):
        return algo.policy.act(algo.learned(ts), (), obs, key)[0]

    mean = act(ts, obs[0])
    assert mean.shape == (2,)
    draws = jax.vmap(lambda key: act(ts, obs[0], key))(jax.random.split(jax.random.key(0), 4000))
    np.testing.assert_allclose(draws.mean(0), mean, atol=0.05)
    np.testing.assert_allclose(draws.std(0), jnp.exp(ts.params["actor"]["log_std"]), rtol=0.05)
    normaliser = dataclasses.replace(ts.normaliser, mean=ts.normaliser.mean + 1)
    shifted = dataclasses.replace(ts, normaliser=normaliser)
    np.testing.assert_allclose(act(shifted, obs.at[:, :4].add(1.0)), act(ts, obs), rtol=2e-4, atol=1e-4)


@pytest.mark.parametrize("name", COMPILED)
def test_an_entropy_bonus_raises_the_entropy_and_a_malus_lowers_it(name):
    coefs = jnp.array([-100.0, 0.0, 100.0])
    ts = members(name, [0, 0, 0], cost_limit=jnp.full(3, 25.0), entropy_coef=coefs)
    low, none, high = map(float, compiled(name).together(ts)[1]["train/entropy"])
    assert low < none - 1e-3 < none + 1e-3 < high  # by steps of 3e-4, or within 0.02 nats


@pytest.mark.parametrize("name", COMPILED)
def test_a_deviation_that_sank_acts_at_its_floor_and_can_rise_and_fall_from_there(name):
    floor, coefs = jnp.full(3, 0.3), jnp.array([-100.0, 0.0, 100.0])
    ts = members(name, [0, 0, 0], cost_limit=jnp.full(3, 25.0), entropy_coef=coefs, min_std=floor)
    actor = ts.params["actor"]
    sunk = actor | {"log_std": jnp.full_like(actor["log_std"], np.log(0.3) - 3)}  # to 5% of it
    ts = dataclasses.replace(ts, params=ts.params | {"actor": sunk})
    after, metrics = compiled(name).together(ts)
    assert metrics["train/nonfinite"].tolist() == [0, 0, 0]
    assert (metrics["train/entropy"] > 2 * (np.log(0.3) + 1.41894)).all()
    acts_by = 0.3 + np.exp(after.params["actor"]["log_std"]).mean(-1)
    np.testing.assert_allclose(metrics["train/std"], acts_by, rtol=1e-5)
    learned = after.params["actor"]["log_std"]
    assert (learned[0] < sunk["log_std"][0]).all() and (learned[2] > sunk["log_std"][2]).all()
    algo, one = compiled(name).algo, member(ts, 0)
    obs, keys = one.rollout.state.obs[0], jax.random.split(jax.random.key(0), 4000)
    draws = jax.vmap(lambda key: algo.policy.act(algo.learned(one), (), obs, key)[0])(keys)
    np.testing.assert_allclose(draws.std(0), 0.3 * (1 + np.exp(-3)), rtol=0.05)


def test_a_step_of_a_trust_region_stays_within_it_however_large_it_is():
    sizes = jnp.array([1e-3, 0.1, 5.0])
    _, m = compiled("trpo_pid").together(members("trpo_pid", [0, 0, 0], target_kl=sizes))
    assert (m["train/accepted"] == 1).all() and (m["train/kl"] > sizes / 10).all()
    assert (m["train/kl"] <= sizes).all() and m["train/line_search"][2] > 0


ESTIMATORS = {"cpo": "plain", "focops": "vtrace", "ppo_saute": "gae_rtg"}


@pytest.mark.parametrize("name", others_slowly([*ESTIMATORS]))
def test_two_updates_with_every_option_at_once_are_finite(name):
    ts = begin(name, **every_option(name, ESTIMATORS.get(name, "vtrace")))
    ts, _ = compiled(name).update(ts)
    ts, metrics = compiled(name).update(ts)
    chex.assert_tree_all_finite((ts.params, ts.signal_normaliser, metrics))
    assert metrics["train/nonfinite"] == 0 and ts.signal_normaliser.count == 2 * 8 * 25
    after, metrics = compiled(name).update(senseless(ts))  # leaves the statistics of rewards alone, too
    assert metrics["train/nonfinite"] > 0
    same(ts.signal_normaliser, after.signal_normaliser)


def test_without_normalisation_nothing_is_kept():
    assert begin("ppo", obs_normalize=False).normaliser == ()

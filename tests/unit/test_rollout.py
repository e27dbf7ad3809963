import dataclasses
import operator
from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Arriving, Corridor, Ticker

from jaxsafe.learn.rollout import collect, init_rollout, memoryless


def idle(obs, key):
    return jnp.zeros((obs.shape[0], 1)), jnp.zeros(obs.shape[0])


def run(env, num_envs, horizon, stagger=False, seed=0, chunks=1):
    """The trajectories of `chunks` rollouts, end to end."""
    rollout = init_rollout(env, jax.random.key(seed), num_envs, stagger)
    step = jax.jit(partial(collect, env, memoryless(idle), horizon=horizon))
    trajs = []
    for i in range(chunks):
        rollout, traj = step(rollout, key=jax.random.fold_in(jax.random.key(seed + 1), i))
        trajs.append(traj)
    return rollout, jax.tree.map(lambda *x: np.concatenate(x), *trajs)


def test_time_limits_truncate_and_failures_terminate():
    _, traj = run(Ticker(episode_length=5, lives=(3, 3)), 2, 9)
    np.testing.assert_array_equal(np.flatnonzero(traj.terminated[:, 0]), [2, 5, 8])
    assert not traj.truncated.any()
    _, traj = run(Ticker(episode_length=5), 2, 11)
    np.testing.assert_array_equal(np.flatnonzero(traj.truncated[:, 0]), [4, 9])
    assert not traj.terminated.any()
    _, traj = run(Arriving(episode_length=5, lives=(3, 3)), 2, 9)
    np.testing.assert_array_equal(np.flatnonzero(traj.truncated[:, 0]), [2, 5, 8])
    assert not traj.terminated.any()


@dataclass(frozen=True)
class Fragile(Ticker):
    """A ticker that breaks with step `at` where the action is positive: what `which` names is NaN."""

    which: str = "reward"
    at: int = 3

    def step(self, state, action):
        after = super().step(state, action)
        bad = (after.obs[1] >= self.at) & (action[0] > 0)
        return dataclasses.replace(
            after,
            **{k: jnp.where(bad, jnp.nan, getattr(after, k)) for k in self.which.split()},
        )


def first_world(obs, key):
    return jnp.zeros((obs.shape[0], 1)).at[0].set(1.0), jnp.zeros(obs.shape[0])


@pytest.mark.parametrize("which", ["reward", "cost", "costs", "obs", "obs reward"])
def test_a_step_that_is_not_finite_does_not_count_and_its_world_begins_anew(which):
    env = Fragile(episode_length=5, which=which)
    rollout = init_rollout(env, jax.random.key(0), 3, False)
    rollout, traj = collect(env, memoryless(first_world), rollout, jax.random.key(1), 7)
    np.testing.assert_array_equal(np.flatnonzero(traj.bad.any[:, 0]), [2, 5])
    np.testing.assert_array_equal(np.flatnonzero(traj.done[:, 0]), [2, 5])
    np.testing.assert_array_equal(traj.length[:, 0], [1, 2, 3, 1, 2, 3, 1])
    assert not traj.bad.any[:, 1:].any() and not traj.ended[:, 0].any() and traj.ended[4, 1:].all()
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((traj, rollout.state.obs)))
    kinds = {"obs": traj.bad.obs, "reward": traj.bad.reward, "cost": traj.bad.cost}
    named = {k.removesuffix("s") if k == "costs" else k for k in which.split()}
    assert {k for k, x in kinds.items() if x.any()} == named
    assert (traj.reward[2, 0], traj.cost[2, 0], traj.reward[2, 1]) == (0, 0, 1)


@pytest.mark.parametrize("env", [Ticker(episode_length=5), Corridor()])
def test_a_reset_that_is_not_finite_is_followed_by_another(env):
    """Whether or not the step makes its observation of it, which a corridor does not."""
    rollout = init_rollout(env, jax.random.key(0), 2, False)
    state = dataclasses.replace(rollout.state, obs=rollout.state.obs.at[0].set(jnp.nan))
    rollout = dataclasses.replace(rollout, state=state)
    _, traj = collect(env, memoryless(idle), rollout, jax.random.key(1), 3)
    np.testing.assert_array_equal(traj.bad.obs[:, 0], [True, False, False])
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(traj))


def test_a_failure_on_the_last_step_is_not_a_time_limit():
    _, traj = run(Ticker(episode_length=5, lives=(5, 5)), 2, 5)
    assert traj.terminated[-1].all() and traj.done[-1].all() and not traj.truncated.any()


def test_next_obs_is_before_the_reset_and_obs_after_it():
    _, traj = run(Ticker(episode_length=3), 4, 7)
    np.testing.assert_array_equal(traj.obs[:, 0, 1], [0, 1, 2, 0, 1, 2, 0])
    np.testing.assert_array_equal(traj.next_obs[:, 0, 1], [1, 2, 3, 1, 2, 3, 1])
    same = traj.obs[..., 0] == traj.next_obs[..., 0]  # the name of the episode
    assert same.all()
    changed = traj.obs[1:, :, 0] != traj.next_obs[:-1, :, 0]
    np.testing.assert_array_equal(changed, traj.done[:-1])


@pytest.mark.parametrize("length, lives", [(1, (9, 9)), (2, (9, 9)), (7, (1, 3)), (3, (1, 9))])
@pytest.mark.parametrize("stagger", [False, True])
def test_no_layout_is_handed_out_twice(length, lives, stagger):
    rollout, traj = run(Ticker(length, lives), 5, 17, stagger, chunks=3)
    starts = np.concatenate(
        [traj.obs[..., 0][traj.obs[..., 1] == 0], rollout.state.obs[traj.done[-1], 0]]
    )
    assert len(np.unique(starts)) == len(starts) == 5 + traj.done.sum()


def test_the_pool_is_drawn_anew_only_when_it_has_run_out():
    env = Ticker(episode_length=4)
    first, _ = run(env, 6, 4)
    assert first.used == 6  # all ended at once and took the whole pool
    before = init_rollout(env, jax.random.key(0), 6, False)
    np.testing.assert_array_equal(first.pool.obs, before.pool.obs)
    second, _ = run(env, 6, 4, chunks=2)
    assert second.used == 6 and not np.isin(second.pool.obs[:, 0], before.pool.obs[:, 0]).any()


@dataclass(frozen=True)
class Counted(Ticker):
    """A clock whose resets are counted on the host, by a callback that XLA may move as it likes."""

    resets: list[int] = field(default_factory=list, hash=False, compare=False)

    def reset(self, key):
        def count(name):
            self.resets.append(1)
            return name

        state = super().reset(key)
        name = jax.pure_callback(count, state.obs[0], state.obs[0], vmap_method="sequential")
        return dataclasses.replace(state, obs=state.obs.at[0].set(name))


@pytest.mark.parametrize("seeds", [None, 2])
def test_no_reset_runs_until_the_pool_runs_out(seeds):
    """XLA once hoisted the draw, the same on every turn, out of its loop: it ran on each step."""
    env = Counted(episode_length=30)

    def begin(key):
        return init_rollout(env, key, 4, False)

    def go_on(rollout, key):
        return collect(env, memoryless(idle), rollout, key, 20)[0]

    keys = jax.random.key(0)
    if seeds:
        begin, go_on, keys = jax.vmap(begin), jax.vmap(go_on), jax.random.split(keys, seeds)
    begin, go_on = jax.jit(begin), jax.jit(go_on)
    rollout, counts = begin(keys), []
    for _ in range(4):  # episodes end on steps 30 and 60: the second time the pool is empty
        jax.block_until_ready(rollout)
        env.resets.clear()
        rollout = jax.block_until_ready(go_on(rollout, keys))
        counts.append(len(env.resets))
    assert counts == [0, 0, 4 * (seeds or 1), 0]


def test_staggered_ends_are_spread_evenly_and_cut_episodes_do_not_count():
    _, traj = run(Ticker(episode_length=8), 8, 24, stagger=True)
    np.testing.assert_array_equal(traj.done.sum(1), 1)  # one a step
    assert traj.ended[:8].sum() == 1  # only the one that began at step 0
    np.testing.assert_array_equal(traj.ended[8:], traj.done[8:])
    np.testing.assert_array_equal(traj.length[traj.ended], 8)


def test_episode_sums_are_of_one_whole_episode():
    _, traj = run(Ticker(episode_length=6, lives=(2, 9)), 16, 10, chunks=4)
    length, end = traj.length[traj.ended], traj.ended
    assert set(length) == {2, 3, 4, 5, 6}
    np.testing.assert_array_equal(traj.episode.ret[end], length)
    np.testing.assert_array_equal(traj.episode.cost[end], 2 * length)
    np.testing.assert_array_equal(traj.episode.costs[end], np.outer(length, [0.5, 1.5]))
    np.testing.assert_array_equal(traj.episode.info["ticks"][end], length)


def test_a_rollout_goes_on_where_the_last_one_stopped():
    env = Ticker(episode_length=7)
    np.testing.assert_array_equal(
        run(env, 3, 4, chunks=5)[1].obs[..., 1], run(env, 3, 20)[1].obs[..., 1]
    )


def test_seeds_side_by_side_are_the_lone_seeds():
    env = Ticker(episode_length=6, lives=(1, 9))

    def one(key):
        rollout = init_rollout(env, key, 5, True)
        return collect(env, memoryless(idle), rollout, jax.random.fold_in(key, 1), 40)

    keys = jax.random.split(jax.random.key(3), 3)
    together = jax.jit(jax.vmap(one))(keys)[1]
    for i in range(3):
        here = jax.tree.map(operator.itemgetter(i), together)
        jax.tree.map(np.testing.assert_array_equal, here, jax.jit(one)(keys[i])[1])


def test_the_policy_sees_the_observations_it_is_recorded_with():
    env = Corridor()

    def copy(obs, key):
        return obs[:, :2], obs.sum(-1)

    rollout = init_rollout(env, jax.random.key(0), 3, False)
    _, traj = collect(env, memoryless(copy), rollout, jax.random.key(1), 30)
    np.testing.assert_array_equal(traj.action, traj.obs[..., :2])
    np.testing.assert_array_equal(traj.log_prob, traj.obs.sum(-1))

"""Vectorised rollouts: time limits, episode sums, and resets that come from a pool.

An environment that is done takes the next unused entry of a pool of N fresh resets, so that every
episode has a layout of its own and a step never pays for a reset. The pool is drawn anew when it
holds fewer entries than there are environments done.

A world whose step is not finite is bad. The step does not count, and the world is reset.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.config import ConfigError
from jaxsafe.learn.acting import Acted, ActInAll
from jaxsafe.learn.batch import select_rows
from jaxsafe.types import Env, PyTree, State

MOST_STEPS = 2**31 - 1  # environment steps of an update, which int32 counts


def check_steps(num_envs: int, horizon: int) -> None:
    if num_envs * horizon > MOST_STEPS:
        raise ConfigError(
            f"num_envs={num_envs} x horizon={horizon}: expected at most {MOST_STEPS:,} steps together"
        )


@flax.struct.dataclass
class Episode:
    """Sums over an episode so far: float [N]; costs [N, K]; info a dict of [N].

    kept_cost is like cost, but only an episode that `stop` ends sets it back to 0. OmniSafe's early
    termination counts cost so (`keep_cost`).
    """

    ret: jax.Array
    cost: jax.Array
    costs: jax.Array
    info: dict[str, jax.Array]
    kept_cost: jax.Array


@flax.struct.dataclass
class RolloutState:
    """What passes from one rollout to the next.

    state: State of N environments.
    steps: int32 [N], since the episode began; with `stagger` the first ones begin above 0.
    episode: sums over the running episodes.
    complete: bool [N], the episode began at step 0, so that its sums count in the statistics.
    pool: State of N fresh resets.
    used: int32 [], entries of the pool handed out.
    carry: what the policy remembers of each environment, [N, ...]; () if it remembers nothing.
    """

    state: State
    steps: jax.Array
    episode: Episode
    complete: jax.Array
    pool: State
    used: jax.Array
    carry: PyTree = ()


class Bad(NamedTuple):
    """What was not finite in a step, of the state before or after it: bool [..., N] each."""

    obs: jax.Array
    reward: jax.Array
    cost: jax.Array

    @property
    def any(self) -> jax.Array:
        return self.obs | self.reward | self.cost


@flax.struct.dataclass
class Trajectory:
    """T steps of N environments; every field is [T, N, ...].

    obs is before the step and next_obs after it, before any reset; first marks the first step of an
    episode; truncated means out of time, or ended by the environment, and not terminated; done is
    either. episode and length (int32, steps) are sums so far, this step included; ended marks complete
    episodes that end with it. Where a step is bad, rewards, costs and next_obs are 0, and it is
    truncated.
    """

    obs: PyTree
    first: jax.Array
    action: jax.Array
    log_prob: jax.Array
    reward: jax.Array
    cost: jax.Array
    costs: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    done: jax.Array
    next_obs: PyTree
    ended: jax.Array
    episode: Episode
    length: jax.Array
    bad: Bad


def init_rollout(env: Env, key: jax.Array, num_envs: int, stagger: bool) -> RolloutState:
    """N fresh environments and a full pool.

    With `stagger` the first episodes start at ages spaced evenly over [0, episode_length), so that
    episodes do not all end at once. Those that start above 0 are not complete. Only the rollout's
    count of steps is staggered: what an environment itself observes of the time starts at 0.
    """
    state_key, pool_key = jax.random.split(key)
    state = reset_all(env, state_key, num_envs)
    ages = np.arange(num_envs, dtype=np.int64) * env.episode_length // num_envs  # int32 may overflow
    steps = jnp.asarray(ages if stagger else 0 * ages, jnp.int32)
    episode = jax.tree.map(jnp.zeros_like, sums(state))
    pool = reset_all(env, pool_key, num_envs)
    return RolloutState(state, steps, episode, steps == 0, pool, jnp.int32(0))


def reset_all(env: Env, key: jax.Array, num_envs: int) -> State:
    return jax.vmap(env.reset)(jax.random.split(key, num_envs))


def sums(state: State) -> Episode:
    return Episode(state.reward, state.cost, state.costs, state.info, state.cost)


def never(episode: Episode) -> jax.Array:
    return jnp.bool_(False)


def memoryless(act: Callable[[PyTree, jax.Array], tuple[jax.Array, jax.Array]]) -> ActInAll:
    """What acts by (obs [N, ...], key) -> action, log_prob, and remembers nothing."""

    def act_in_all(carry: PyTree, state: State, first: jax.Array, key: jax.Array) -> Acted:
        action, log_prob = act(state.obs, key)
        return action, carry, {"log_prob": log_prob}

    return act_in_all


def collect(
    env: Env,
    act: ActInAll,
    rollout: RolloutState,
    key: jax.Array,
    horizon: int,
    stop: Callable[[Episode], jax.Array] = never,
) -> tuple[RolloutState, Trajectory]:
    """Step all environments `horizon` times.

    Args:
        act: says its `log_prob`; see `memoryless`.
        stop: sums so far -> bool [N], where a step terminates its episode besides the environment.
    """

    def step(rollout: RolloutState, key: jax.Array) -> tuple[RolloutState, Trajectory]:
        action_key, reset_key = jax.random.split(key)
        lost = ~finite(rollout.state.obs)  # by its reset
        seen = dataclasses.replace(rollout.state, obs=cleared(lost, rollout.state.obs))
        first = rollout.steps == 0
        action, carry, said = act(rollout.carry, seen, first, action_key)
        state = jax.vmap(env.step)(rollout.state, action)
        bad = bad_of(state)
        bad = bad._replace(obs=bad.obs | lost)
        state = mended(state, bad)
        steps = rollout.steps + 1
        episode = jax.tree.map(jnp.add, rollout.episode, sums(state))
        stopped = stop(episode)
        terminated = (state.terminated | stopped) & ~bad.any
        truncated = ((steps >= env.episode_length) | state.truncated | bad.any) & ~terminated
        done = terminated | truncated
        record = Trajectory(
            obs=seen.obs,
            first=first,
            action=action,
            log_prob=said["log_prob"],
            reward=state.reward,
            cost=state.cost,
            costs=state.costs,
            terminated=terminated,
            truncated=truncated,
            done=done,
            next_obs=state.obs,
            ended=done & rollout.complete & ~bad.any,
            episode=episode,
            length=steps,
            bad=bad,
        )
        rollout = dataclasses.replace(rollout, state=state, steps=steps, episode=episode, carry=carry)
        rollout = restart(env, rollout, done, reset_key)
        kept_cost = jnp.where(stopped, 0.0, episode.kept_cost)
        episode = dataclasses.replace(rollout.episode, kept_cost=kept_cost)
        return dataclasses.replace(rollout, episode=episode), record

    return jax.lax.scan(step, rollout, jax.random.split(key, horizon))


class Pool(NamedTuple):
    """Fresh resets, State of N, and how many of them are used, int32 []."""

    resets: State
    used: jax.Array


def restart(env: Env, rollout: RolloutState, done: jax.Array, key: jax.Array) -> RolloutState:
    """Put fresh resets where `done` [N] holds."""
    num_envs, ends = done.shape[0], done.sum()

    def refill(now: Pool) -> Pool:  # the draw must depend on `used`, or XLA hoists it out of the loop
        fresh = reset_all(env, jax.random.fold_in(key, now.used), num_envs)
        return Pool(fresh, jnp.zeros_like(now.used))

    # runs at most once; a cond would turn into a select under vmap over seeds and pay at every step
    pool, used = jax.lax.while_loop(
        lambda now: now.used + ends > num_envs, refill, Pool(rollout.pool, rollout.used)
    )
    entry = used + jnp.cumsum(done) - 1
    return dataclasses.replace(
        rollout,
        state=select_rows(done, jax.tree.map(lambda x: x[entry], pool), rollout.state),
        steps=jnp.where(done, 0, rollout.steps),
        episode=select_rows(done, jax.tree.map(jnp.zeros_like, rollout.episode), rollout.episode),
        complete=rollout.complete | done,
        pool=pool,
        used=used + ends,
    )


def finite(tree: PyTree) -> jax.Array:
    """Whether all of each environment is, bool [N], of leaves [N, ...]."""
    rows = [jnp.isfinite(x).reshape(x.shape[0], -1).all(1) for x in jax.tree.leaves(tree)]
    return jnp.stack(rows).all(0)


def bad_of(state: State) -> Bad:
    """Where a State of N environments is not finite, bool [N] each."""
    costs = finite(state.costs) & jnp.isfinite(state.cost)
    return Bad(~finite(state.obs), ~jnp.isfinite(state.reward), ~costs)


def mended(state: State, bad: Bad) -> State:
    """`state` with zeros for what a learner sees of bad worlds. Their physics waits for a reset."""
    seen = (state.obs, state.reward, state.cost, state.costs, state.info)
    obs, reward, cost, costs, info = cleared(bad.any, seen)
    return dataclasses.replace(state, obs=obs, reward=reward, cost=cost, costs=costs, info=info)


def cleared(mask: jax.Array, tree: PyTree) -> PyTree:
    """`tree` with zeros where `mask` [N] holds, in leaves of shape [N, ...]."""
    return select_rows(mask, jax.tree.map(jnp.zeros_like, tree), tree)

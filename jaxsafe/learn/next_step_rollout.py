"""Rollouts for a replay: environments that reset on the step after an episode's last one.

The last observation of an episode so gets a record of its own, whose action is ignored, and the next
record is the first of the next episode: see `jaxsafe.learn.replay`.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from jaxsafe.learn.acting import ActInAll
from jaxsafe.learn.batch import select_rows
from jaxsafe.learn.replay import Record
from jaxsafe.learn.rollout import Bad, Episode, RolloutState, bad_of, mended, restart, sums
from jaxsafe.types import Env, PyTree, State


@flax.struct.dataclass
class Stepping:
    """N environments, and how each arrived where it is: bool [N]."""

    rollout: RolloutState
    first: jax.Array
    terminated: jax.Array
    truncated: jax.Array


class StepRecord(NamedTuple):
    """What T steps of N environments came to, [T, N], costs [T, N, K].

    `real` is false of a reset and of a bad step, which do not count as steps. terminated marks episodes
    that fail with the step. ended marks complete episodes that end with it; episode and length are
    their sums. said: what the policy reported beside the action, float [T, N] by name.
    """

    real: jax.Array
    reward: jax.Array
    cost: jax.Array
    costs: jax.Array
    terminated: jax.Array
    ended: jax.Array
    episode: Episode
    length: jax.Array
    bad: Bad
    said: dict[str, jax.Array]


def started(rollout: RolloutState) -> Stepping:
    """Environments that have just been reset."""
    no = jnp.zeros(rollout.steps.shape, bool)
    return Stepping(rollout, first=~no, terminated=no, truncated=no)


def arrival_record(stepping: Stepping, action: jax.Array) -> Record:
    """The records [N, ...] of where the environments are, with the actions that they take there."""
    state = stepping.rollout.state
    return Record(
        obs=state.obs,
        action=action,
        reward=state.reward,
        cost=state.cost,
        costs=state.costs,
        first=stepping.first,
        terminated=stepping.terminated,
        truncated=stepping.truncated,
    )


def collect_records(
    env: Env,
    act: ActInAll,
    stepping: Stepping,
    keys: jax.Array,
    describe: Callable[[Stepping, jax.Array], Record] = arrival_record,
) -> tuple[Stepping, tuple[Record, StepRecord]]:
    """One step of every environment for each of `keys` [T], or a reset where its episode has ended.

    Args:
        describe: what is recorded of where the environments are, and of the actions that they take.
    Returns:
        The environments afterwards, and the records, [T, N, ...].
    """

    def step(now: Stepping, key: jax.Array) -> tuple[Stepping, tuple[Record, StepRecord]]:
        act_key, reset_key = jax.random.split(key)
        action, carry, said = act(now.rollout.carry, now.rollout.state, now.first, act_key)
        record = describe(now, action)
        state = jax.vmap(env.step)(now.rollout.state, record.action)
        rollout = dataclasses.replace(
            now.rollout,
            state=state,
            carry=carry,
            steps=now.rollout.steps + 1,
            episode=jax.tree.map(jnp.add, now.rollout.episode, sums(state)),
        )
        rollout = restart(env, rollout, record.last, reset_key)
        bad = bad_of(rollout.state)
        rollout = dataclasses.replace(rollout, state=marked(rollout.state, bad, record.obs))
        terminated = rollout.state.terminated & ~bad.any
        out_of_time = (rollout.steps >= env.episode_length) | rollout.state.truncated
        truncated = (out_of_time | bad.any) & ~terminated
        came_to = StepRecord(
            real=~record.last & ~bad.any,
            reward=rollout.state.reward,
            cost=rollout.state.cost,
            costs=rollout.state.costs,
            terminated=terminated,
            ended=(terminated | truncated) & rollout.complete & ~bad.any,
            episode=rollout.episode,
            length=rollout.steps,
            bad=bad,
            said=said,
        )
        return Stepping(rollout, record.last, terminated, truncated), (record, came_to)

    return jax.lax.scan(step, stepping, keys)


def marked(state: State, bad: Bad, before: PyTree) -> State:
    """`state` with a reward of NaN in bad worlds, so that no transition that leads there counts.

    In these worlds obs is the last one, `before` [N, ...].
    """
    state = dataclasses.replace(mended(state, bad), obs=select_rows(bad.any, before, state.obs))
    return dataclasses.replace(state, reward=jnp.where(bad.any, jnp.nan, state.reward))

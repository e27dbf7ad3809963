"""Metrics of environment steps, which all loops that take some report."""

from collections.abc import Callable
from functools import partial
from typing import Protocol

import jax
import jax.numpy as jnp

from jaxsafe.learn.batch import batch_mean, centre, masked_mean, psum
from jaxsafe.learn.rollout import Bad, Episode
from jaxsafe.types import Env, Metrics

# columns of metrics.csv: worlds with a step that was not finite, and of what
BAD = ("train/bad_worlds", "train/bad_obs", "train/bad_reward", "train/bad_cost")


class Ends(Protocol):
    """Where complete episodes ended, bool [T, N], with their sums and lengths so far, [T, N]."""

    @property
    def ended(self) -> jax.Array: ...

    @property
    def episode(self) -> Episode: ...

    @property
    def length(self) -> jax.Array: ...


class Steps(Ends, Protocol):
    """What steps earned and cost, float [T, N], and which were bad."""

    @property
    def reward(self) -> jax.Array: ...

    @property
    def cost(self) -> jax.Array: ...

    @property
    def bad(self) -> Bad: ...


def step_metrics(
    env: Env,
    steps: Steps,
    rate: Callable[[jax.Array], jax.Array],
    length: jax.Array,
    axis_name: str | None,
) -> Metrics:
    """What steps earned and cost.

    Args:
        rate: x [T, N] -> the mean of x over the steps that count, on all devices, float [].
        length: mean length of an episode, in steps.
    """
    cost_rate = rate(steps.cost)
    return {
        **episode_metrics(env, steps, axis_name),
        **world_metrics(steps.bad, axis_name),
        "train/cost_rate": cost_rate,  # per step of the policy
        "train/cost_estimate": cost_rate * length,  # of an episode, this iteration's
        "train/return_estimate": rate(steps.reward) * length,  # likewise
    }


def explained_variance(error: jax.Array, target: jax.Array, axis_name: str | None) -> jax.Array:
    """1 - var(target - value) / var(target): 1 is a perfect critic, 0 one that knows the mean only."""
    total = batch_mean(centre(target, axis_name) ** 2, axis_name)
    return 1 - batch_mean(centre(error, axis_name) ** 2, axis_name) / jnp.maximum(total, 1e-8)


def episode_metrics(env: Env, ends: Ends, axis_name: str | None) -> Metrics:
    """Means over the complete episodes that ended in the batch; NaN where there are none."""
    over = partial(masked_mean, mask=ends.ended, axis_name=axis_name)
    episode = ends.episode
    return {
        "train/episodes": psum(ends.ended.sum(), axis_name),
        "train/return": over(episode.ret),
        "train/cost": over(episode.cost),
        "train/episode_length": over(ends.length),
        **{f"train/cost_{name}": over(episode.costs[..., k]) for k, name in enumerate(env.cost_names)},
        **{f"train/{name}": over(x) for name, x in episode.info.items()},
    }


def world_metrics(bad: Bad, axis_name: str | None) -> Metrics:
    """How many worlds had a step that was not finite, and of what; `bad` is [T, N]."""

    def worlds(where: jax.Array) -> jax.Array:
        return psum(where.any(0).sum(), axis_name)

    return dict(zip(BAD, map(worlds, (bad.any, *bad)), strict=True))

"""Fresh episodes of a trained policy, and what Safety Gym reports about them."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.learn.acting import Player
from jaxsafe.report import scores, stats
from jaxsafe.report.stats import Estimate
from jaxsafe.types import Algorithm, PyTree


class Episodes(NamedTuple):
    """Sums over episodes: `costs` is [S, N, K], the others are [S, N]."""

    ret: np.ndarray
    cost: np.ndarray
    costs: np.ndarray
    length: np.ndarray
    discounted_ret: np.ndarray
    discounted_cost: np.ndarray


def episode(
    player: Player,
    key: jax.Array,
    discount: jax.Array | float = 1.0,
    cost_discount: jax.Array | float = 1.0,
) -> Episodes:
    """One whole episode of mean actions, pure: rewards and costs count until termination or the limit.

    The discounted sums, sum_t discount^t r_t and likewise of costs, begin with the first step.
    """
    reset_key, _ = jax.random.split(key)
    env = player.task

    def step(now, t):
        state, carry, alive = now
        action, carry = player.act(carry, state)
        state = env.step(state, action)
        reward, cost = alive * state.reward, alive * state.cost
        later = discount**t * reward, cost_discount**t * cost
        sums = Episodes(reward, cost, alive * state.costs, alive, *later)
        return (state, carry, alive * (1.0 - state.terminated)), sums

    start = env.reset(reset_key), player.begin(), jnp.float32(1)
    _, sums = jax.lax.scan(step, start, jnp.arange(env.episode_length))
    return jax.tree.map(lambda x: x.sum(0), sums)


def run_episodes(algo: Algorithm, params: PyTree, num_episodes: int, seed: int) -> Episodes:
    """`num_episodes` fresh episodes for each of the S policies in `params` (leading axis), compiled.

    Actions are the mean ones. Every policy meets the same episodes, so that seeds differ by their
    policy alone.
    """
    keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), 0x6576616C), num_episodes)

    def one_seed(params: PyTree) -> Episodes:
        player = Player(algo.policy, params, algo.task(params))
        discounts = params.config.discount, params.config.cost_discount
        return jax.vmap(lambda key: episode(player, key, *discounts))(keys)

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one_seed))(params))


def estimate(values: np.ndarray) -> Estimate:
    """Mean of `values` [S, N] and its interval over seeds, whose means hold the spread of episodes too.

    With one seed the interval covers the episodes alone, not what another seed would give.
    """
    return stats.estimate(values.mean(1) if len(values) > 1 else values[0])


def cost_rate(metrics: dict[str, np.ndarray]) -> np.ndarray | None:
    """Safety Gym's cost rate, [S]: total training cost over total training steps; None if unknown.

    `metrics` are the columns of metrics.csv.
    """
    if "train/cost_rate" not in metrics or not len(metrics["seed"]):
        return None
    rates = metrics["train/cost_rate"]  # of one iteration; all have the same number of steps
    return np.array([np.nanmean(rates[metrics["seed"] == seed]) for seed in np.unique(metrics["seed"])])


def measures(
    episodes: Episodes, cost_names: Sequence[str], limits: Mapping[str, float]
) -> dict[str, np.ndarray]:
    """What is reported of each episode, float or bool [S, N] by name.

    Args:
        episodes: their sums.
        cost_names: of the environment, the last axis of `episodes.costs`.
        limits: what is held under them; '' is the cost, other names are those of `cost_names`.
    """
    costs = {name: episodes.costs[..., k] for k, name in enumerate(cost_names)}
    over = {name: (costs[name] if name else episodes.cost) > most for name, most in limits.items()}
    named = costs if len(costs) > 1 else {}
    return {
        "return": episodes.ret,
        "cost": episodes.cost,
        "violation rate": np.any([*over.values()], axis=0),
        **{f"cost {name}": x for name, x in named.items()},
        **{f"{name} over {limits[name]:g}": x for name, x in over.items() if name},
        "discounted return": episodes.discounted_ret,
        "discounted cost": episodes.discounted_cost,
        "episode length": episodes.length,
    }


def summary(
    env_name: str,
    found: Mapping[str, np.ndarray],
    cost_limit: float,
    metrics: dict[str, np.ndarray],
) -> dict[str, Estimate]:
    """The rows of the table: `measures`, then the cost rate of training and normalised scores."""
    rows = {name: estimate(values) for name, values in found.items()}
    rate = cost_rate(metrics)
    if rate is not None:
        rows["cost rate (training)"] = stats.estimate(rate)
    if env_name in scores.CHARACTERISTIC:

        def scaled(score: Callable, of: Estimate, *args: float) -> Estimate:
            return Estimate(*(float(score(env_name, x, *args)) for x in of))

        rows["normalised return"] = scaled(scores.normalized_return, rows["return"])
        rows["normalised violation"] = scaled(scores.normalized_violation, rows["cost"], cost_limit)
        if rate is not None:
            rows["normalised cost rate"] = scaled(
                scores.normalized_cost_rate, rows["cost rate (training)"]
            )
    return rows


def table(rows: dict[str, Estimate]) -> str:
    """Aligned plain text: a row each, mean and interval. A single number has no interval."""

    def line(name: str, e: Estimate) -> str:
        interval = "" if e.low == e.high == e.mean else f"[{e.low:10.4g}, {e.high:10.4g} ]"
        return f"{name:<22}{e.mean:>10.4g}   {interval}".rstrip()

    return "\n".join([f"{'':<22}{'mean':>10}   95 % interval", *(line(n, e) for n, e in rows.items())])


def as_json(rows: dict[str, Estimate]) -> dict[str, list[float | None]]:
    return {name: [x if math.isfinite(x) else None for x in e] for name, e in rows.items()}

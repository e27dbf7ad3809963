"""Fresh episodes of a trained policy, and what is measured of each."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.learn.acting import Course, Player, course
from jaxsafe.types import Algorithm, PyTree

# the seed of the episodes that training plays, on the way and at its end: the same of every run
TRAINING = 0
# columns of metrics.csv where training is evaluated, of mean and of sampled actions
COLUMNS = ("eval/return", "eval/cost", "eval/return_sampled", "eval/cost_sampled")


class Episodes(NamedTuple):
    """Sums over episodes: `costs` is [S, N, K], the others are [S, N]. `goals` is NaN where the
    environment counts none."""

    ret: np.ndarray
    cost: np.ndarray
    costs: np.ndarray
    length: np.ndarray
    discounted_ret: np.ndarray
    discounted_cost: np.ndarray
    goals: np.ndarray


def totals(
    steps: Course, discount: jax.Array | float = 1.0, cost_discount: jax.Array | float = 1.0
) -> Episodes:
    """The sums of one episode. The discounted ones, sum_t discount^t r_t and likewise of costs, begin
    with the first step."""
    t = jnp.arange(len(steps.alive))
    summed: Any = Episodes  # of jax.Array while it is traced
    return summed(
        ret=steps.reward.sum(),
        cost=steps.cost.sum(),
        costs=steps.costs.sum(0),
        length=jnp.float32(steps.alive).sum(),
        discounted_ret=(discount**t * steps.reward).sum(),
        discounted_cost=(cost_discount**t * steps.cost).sum(),
        goals=steps.goal_met.sum(),
    )


def keys_of_episodes(
    seed: int, num_episodes: int, seeds: Sequence[int], settings: int = 1
) -> jax.Array:
    """Keys [S, N] of N episodes of each of S policies: every one of `seeds` in every setting.

    Seeds meet episodes of their own, so that an interval over seeds is one over layouts, too. Settings
    meet the same ones, and so do other algorithms, so that they differ by their policies alone. A seed
    meets the same ones whichever seeds are trained beside it.

    Args:
        seed: of the episodes.
        num_episodes: N.
        seeds: of the policies of one setting, as they were trained.
        settings: how many.
    """
    key = jax.random.fold_in(jax.random.key(seed), 0x6576616C)
    each = jax.vmap(lambda i: jax.random.split(jax.random.fold_in(key, i), num_episodes))
    return each(jnp.array([*seeds] * settings))


def make_evaluation(
    algo: Algorithm, keys: jax.Array, sampled: bool = False
) -> Callable[[PyTree], tuple[Episodes, Course]]:
    """What plays the episodes of `keys` [S, N] with S policies: learned [S, ...] -> their sums, and
    their steps, [S, N, T, ...], on the device.

    Actions are the mean ones, or `sampled`. It compiles once.
    """

    def one_seed(learned: PyTree, keys: jax.Array) -> tuple[Episodes, Course]:
        player = Player(algo.policy, learned, algo.task(learned))
        discounts = learned.config.discount, learned.config.cost_discount
        played = jax.vmap(lambda key: course(player, key, sampled))(keys)
        return jax.vmap(lambda x: totals(x, *discounts))(played), played

    play = jax.jit(jax.vmap(one_seed))

    def evaluate(learned: PyTree) -> tuple[Episodes, Course]:
        episodes, played = play(learned, keys)
        return jax.tree.map(np.asarray, episodes), played

    return evaluate


def make_training_evaluation(
    algo: Algorithm, keys: jax.Array
) -> Callable[[PyTree], dict[str, np.ndarray]]:
    """What evaluates S policies during training in the episodes of `keys` [S, N]: learned [S, ...] ->
    {name of a column: means [S]}.

    The programs with mean and with sampled actions run one after the other, as two that call the host
    at once can wait for each other.
    """
    players = [make_evaluation(algo, keys, sampled) for sampled in (False, True)]

    def evaluate(learned: PyTree) -> dict[str, np.ndarray]:
        played = [play(learned)[0] for play in players]
        means = [x.mean(1) for episodes in played for x in (episodes.ret, episodes.cost)]
        return dict(zip(COLUMNS, means, strict=True))

    return evaluate


def measures(
    episodes: Episodes, cost_names: Sequence[str], limits: Mapping[str, float]
) -> dict[str, np.ndarray]:
    """What is reported of each episode, float [S, N] by name.

    Args:
        episodes: their sums.
        cost_names: of the environment, the last axis of `episodes.costs`.
        limits: what is held under them; '' is the cost, other names are those of `cost_names`.
    """
    costs = {name: episodes.costs[..., k] for k, name in enumerate(cost_names)}
    over = {name: above(costs[name] if name else episodes.cost, most) for name, most in limits.items()}
    shown = {name: x for name, x in costs.items() if len(costs) > 1 or name in limits}
    goals = {} if np.isnan(episodes.goals).all() else {"goals": episodes.goals}
    return {
        "return": episodes.ret,
        "cost": episodes.cost,
        "violation rate": np.max([*over.values()], axis=0),
        **{f"cost {name}": x for name, x in shown.items()},
        **{f"{name} over {limits[name]:g}": x for name, x in over.items() if name},
        "discounted return": episodes.discounted_ret,
        "discounted cost": episodes.discounted_cost,
        "episode length": episodes.length,
        **goals,
    }


def above(cost: np.ndarray, limit: float) -> np.ndarray:
    """1 where a cost is above its limit, else 0; NaN where the cost is not known."""
    return np.where(np.isnan(cost), np.nan, cost > limit)

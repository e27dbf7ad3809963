"""Fresh episodes of a trained policy, and what is measured of each."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.learn.acting import Course, Play, Player, Playing, begun, of_course, played_on
from jaxsafe.run.devices import jit_once
from jaxsafe.types import Algorithm, PyTree

# the seed of the episodes that training plays, on the way and at its end: the same of every run
TRAINING = 0
# columns of metrics.csv where training is evaluated, of mean and of sampled actions
COLUMNS = ("eval/return", "eval/cost", "eval/return_sampled", "eval/cost_sampled")
PARTS = 10  # of an episode, after each of which progress is told and Ctrl-C is seen

# told(about, share): how much of the steps of these episodes is done, from 0 to 1
Told = Callable[[str, float], None]


def quiet(about: str, share: float) -> None:
    """Says nothing."""


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


def make_play(algo: Algorithm, keys: jax.Array, told: Told = quiet) -> Play:
    """What plays the episodes of `keys` [S, N] with S policies, in `PARTS` calls one after the other.

    It compiles once for mean and once for sampled actions, and anew for other settings that are not
    numbers.
    """

    def player_of(learned: PyTree) -> Player:
        return Player(algo.policy, learned, algo.task(learned))

    def begin(learned: PyTree, keys: jax.Array) -> Playing:
        return jax.vmap(lambda key: begun(player_of(learned), key))(keys)

    def go_on(
        learned: PyTree, keys: jax.Array, now: Playing, times: jax.Array, sampled: bool
    ) -> tuple[Playing, Course]:
        def one(key: jax.Array, now: Playing) -> tuple[Playing, Course]:
            return played_on(player_of(learned), key, of_course, now, times, sampled)

        return jax.vmap(one)(keys, now)

    begin_all = jit_once(jax.vmap(begin))
    go_on_all = jax.jit(jax.vmap(go_on, (0, 0, 0, None, None)), static_argnums=4)

    def play(learned: PyTree, sampled: bool, about: str = "") -> Course:
        length = algo.task(jax.tree.map(lambda x: x[0], learned)).episode_length
        each = math.ceil(length / PARTS)
        told(about, 0.0)
        now, parts = begin_all(learned, keys), []
        for first in range(0, length, each):
            times = first + jnp.arange(each)  # the last may go beyond the end
            now, part = jax.block_until_ready(go_on_all(learned, keys, now, times, sampled))
            parts.append(part)
            told(about, min(first + each, length) / length)
        return jax.tree.map(lambda *x: jnp.concatenate(x, 2)[:, :, :length], *parts)

    return play


@jax.jit
def totals_of_all(learned: PyTree, played: Course) -> Episodes:
    """The sums of the episodes `played` [S, N, T, ...] by the S policies in `learned`."""

    def of_one(learned: PyTree, played: Course) -> Episodes:
        discounts = learned.config.discount, learned.config.cost_discount
        return jax.vmap(lambda x: totals(x, *discounts))(played)

    return jax.vmap(of_one)(learned, played)


def evaluated(play: Play, learned: PyTree, sampled: bool = False) -> tuple[Episodes, Course]:
    """The sums of the episodes that `play` plays with S policies, learned [S, ...], and their steps,
    [S, N, T, ...], on the device. Actions are the mean ones, or `sampled`."""
    played = play(learned, sampled, "evaluating")
    return jax.tree.map(np.asarray, totals_of_all(learned, played)), played


def make_training_evaluation(
    algo: Algorithm, keys: jax.Array
) -> Callable[[PyTree], dict[str, np.ndarray]]:
    """What evaluates S policies during training in the episodes of `keys` [S, N]: learned [S, ...] ->
    {name of a column: means [S]}.

    The programs with mean and with sampled actions run one after the other, as two that call the host
    at once can wait for each other.
    """
    play = make_play(algo, keys)

    def evaluate(learned: PyTree) -> dict[str, np.ndarray]:
        both = [evaluated(play, learned, sampled)[0] for sampled in (False, True)]
        means = [x.mean(1) for episodes in both for x in (episodes.ret, episodes.cost)]
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

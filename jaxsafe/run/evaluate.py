"""Fresh episodes of a trained policy, and what is measured of each."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.learn.acting import Player, Playing
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


def episode(
    player: Player,
    key: jax.Array,
    discount: jax.Array | float = 1.0,
    cost_discount: jax.Array | float = 1.0,
    sampled: bool = False,
) -> Episodes:
    """One whole episode, pure: rewards and costs count until termination or the limit.

    Actions are the mean ones, or `sampled`; both begin with the same reset. The discounted sums,
    sum_t discount^t r_t and likewise of costs, begin with the first step.
    """
    reset_key, act_key = jax.random.split(key)
    env = player.task
    summed: Any = Episodes  # of jax.Array while it is traced

    def step(now: Playing, t: jax.Array) -> tuple[Playing, Episodes]:
        sample_key = jax.random.fold_in(act_key, t) if sampled else None
        action, carry = player.act(now.carry, now.state, sample_key)
        state = env.step(now.state, action)
        # what comes after the end may be anything, NaN included
        reward, cost, costs = (
            jnp.where(now.alive, x, 0.0) for x in (state.reward, state.cost, state.costs)
        )
        later = discount**t * reward, cost_discount**t * cost
        goals = jnp.where(now.alive, state.info.get("goal_met", jnp.nan), 0.0)
        sums = summed(reward, cost, costs, jnp.float32(now.alive), *later, goals)
        return Playing(state, carry, now.alive & ~state.ended), sums

    _, sums = jax.lax.scan(step, player.start(reset_key), jnp.arange(env.episode_length))
    return jax.tree.map(lambda x: x.sum(0), sums)


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
) -> Callable[[PyTree], Episodes]:
    """What plays the episodes of `keys` [S, N] with S policies: learned [S, ...] -> Episodes.

    It compiles once.
    """

    def one_seed(learned: PyTree, keys: jax.Array) -> Episodes:
        player = Player(algo.policy, learned, algo.task(learned))
        discounts = learned.config.discount, learned.config.cost_discount
        return jax.vmap(lambda key: episode(player, key, *discounts, sampled))(keys)

    play = jax.jit(jax.vmap(one_seed))
    return lambda learned: jax.tree.map(np.asarray, play(learned, keys))


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
        played = [play(learned) for play in players]
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

"""Fresh episodes of a trained policy, and what is measured of each."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.learn.acting import Player
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

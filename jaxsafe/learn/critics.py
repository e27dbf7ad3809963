"""Critics of reward and of cost: their targets and their loss, for every learner that has both.

    y_r = r + discount^n (1 - terminated) V_r(s'),   y_c = c + cost_discount^n (1 - terminated) V_c(s')
    minimise_Q  E[sum_i (Q_i(s, a) - y_r)^2 + sum_j (Q_cj(s, a) - y_c)^2]

A method says what it takes for V, the values of the next state. Its critics are a dict: 'critic_r' for
reward and, under a treatment of the constraint, 'critic_c' for cost. What belongs to cost is float [B]
or, of several constraints, [B, K].
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxsafe.learn.batch import select_rows
from jaxsafe.learn.constraints import Names, each
from jaxsafe.learn.replay import Transitions
from jaxsafe.learn.treatments import Treatment, no_treatment
from jaxsafe.nn.critics import init_critics, largest, q_values
from jaxsafe.types import Metrics, PyTree


class Values(NamedTuple):
    """Of B states or actions: in reward, float [B], and in cost; [critics, B] of several critics."""

    reward: jax.Array
    cost: jax.Array


def init_all_critics(
    key: jax.Array, sizes: tuple[int, int], count: int, treatment: Treatment, cfg: Any
) -> dict[str, PyTree]:
    """`count` critics of reward and, unless there is no treatment, those of cost.

    sizes: of an observation and of an action.
    """
    critics = {"critic_r": init_critics(key, *sizes, count, cfg)}
    if treatment is not no_treatment:
        names = treatment.constrained_costs(cfg)
        critics["critic_c"] = init_cost_critics(jax.random.fold_in(key, 1), *sizes, names, cfg)
    return critics


def init_cost_critics(
    key: jax.Array, obs_size: int, action_size: int, names: Names, cfg: Any
) -> PyTree:
    """Stacked, leaves [J, ...]; of several constraints [K, J, ...]."""
    count = 1 if cfg.cost_reduce == "one" else 2

    def of_one(key: jax.Array) -> PyTree:
        return init_critics(key, obs_size, action_size, count, cfg)

    return jax.vmap(of_one)(jax.random.split(key, len(names))) if names else of_one(key)


def critics_among(params: dict[str, PyTree]) -> dict[str, PyTree]:
    """The critics of a learner with these parameters."""
    return {name: params[name] for name in ("critic_r", "critic_c") if name in params}


def values_of_each(
    critics: dict[str, PyTree], obs: jax.Array, action: jax.Array, names: Names, cfg: Any
) -> Values:
    """What each critic says: of reward, float [I, B], and of cost, [J, B] or [J, B, K].

    They are evaluated together, as one stack of networks. Without critics of cost it is 0, [1, B].
    """
    of_reward = critics["critic_r"]
    if "critic_c" not in critics:
        q = q_values(of_reward, obs, action, cfg)
        return Values(q, jnp.zeros_like(q[:1]))

    def stacked(of_reward: jax.Array, of_cost: jax.Array) -> jax.Array:
        return jnp.concatenate([of_reward, of_cost.reshape(-1, *of_reward.shape[1:])])

    q = q_values(jax.tree.map(stacked, of_reward, critics["critic_c"]), obs, action, cfg)
    count = len(jax.tree.leaves(of_reward)[0])
    q_r, q_c = q[:count], q[count:]
    if names:
        q_c = jnp.moveaxis(q_c.reshape(len(names), -1, *q_c.shape[1:]), 0, -1)
    return Values(q_r, q_c)


def with_reduced_cost(
    critics: dict[str, PyTree], obs: jax.Array, action: jax.Array, names: Names, cfg: Any
) -> Values:
    """As `values_of_each`, with one Q_c, [B] or [B, K], made of those of cost."""
    q_r, q_c = values_of_each(critics, obs, action, names, cfg)
    most = "critic_c" in critics and cfg.cost_reduce == "max"
    return Values(q_r, largest(q_c) if most else q_c.mean(0))


def while_it_lasts(batch: Transitions, values: jax.Array) -> jax.Array:
    """`values` [B, ...] of the next states, which are 0 where an episode terminated."""
    return select_rows(batch.terminated, 0.0, values)


def targets_of(batch: Transitions, charged: jax.Array, after: Values, names: Names, cfg: Any) -> Values:
    """y_r and y_c.

    Args:
        charged: what is held under the limit, float [B] or [B, K].
        after: V of the next states.
    """
    y_r = batch.reward + cfg.discount**batch.steps * while_it_lasts(batch, after.reward)

    def of_one(charged: jax.Array, after: jax.Array) -> jax.Array:
        return charged + cfg.cost_discount**batch.steps * while_it_lasts(batch, after)

    return Values(y_r, each(of_one, names)(charged, after.cost))


def critic_loss(
    critics: dict[str, PyTree], batch: Transitions, targets: Values, names: Names, cfg: Any
) -> tuple[jax.Array, Metrics]:
    """This device's share of the loss, and metrics."""
    q, q_c = values_of_each(critics, batch.obs, batch.action, names, cfg)
    loss = batch.mean(((q - targets.reward) ** 2).sum(0))
    metrics = {"train/critic_loss": loss, "train/q": batch.mean(q.mean(0))}
    if "critic_c" in critics:
        loss_c = batch.mean(((q_c - targets.cost) ** 2).sum(0))
        metrics |= {"train/critic_loss_c": loss_c, "train/q_c": batch.mean(q_c.mean(0))}
        loss += loss_c.sum()
    return loss, metrics

"""When a price on cost moves, and what it is told: the cost of the steps since it last moved.

The clock is environment steps. So a price moves as often, however many environments, rounds and
gradient steps there are.
"""

from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxsafe.config import Bounds, config
from jaxsafe.learn.batch import aligned, all_finite, psum, select
from jaxsafe.learn.constraints import Names, limit
from jaxsafe.learn.treatments import Treatment
from jaxsafe.types import Count, PyTree


@config
class PriceClockConfig:
    """For algorithms with a treatment: when its price on cost moves."""

    # Environment steps between two moves of the price. OmniSafe moves it at every gradient step.
    dual_every: Annotated[int, Bounds(1, 2**30)] = 20_000
    # Environment steps before cost counts. The price first moves `dual_every` steps later. OmniSafe has
    # 100 epochs, which are 200,000 steps.
    dual_starts: Annotated[int, Bounds(0, 2**31 - 1)] = 0


class Bill(NamedTuple):
    """What the environments of all devices were charged since the price last moved.

    cost: float [], or [K] of several constraints: the sum over the real steps. steps: float [], how
    many these are. age: int32 [], all environment steps since then, resets included; below 0 before
    `dual_starts`.
    """

    cost: jax.Array
    steps: jax.Array
    age: jax.Array


def empty_bill(cfg: Any, names: Names) -> Bill:
    return Bill(jnp.zeros(jnp.shape(limit(cfg, names))), jnp.float32(0), jnp.int32(-cfg.dual_starts))


def charge(bill: Bill, cost: jax.Array, real: jax.Array, axis_name: str | None) -> Bill:
    """`bill` with `cost`, float [T, N] or [T, N, K], of the steps that are `real`, bool [T, N]."""
    charged = jnp.where(aligned(real, cost), cost, 0.0).sum((0, 1))
    more, steps, age = psum((charged, real.sum(), jnp.int32(real.size)), axis_name)
    return Bill(bill.cost + more, bill.steps + steps, bill.age + age)


def settle(
    treatment: Treatment, dual: PyTree, bill: Bill, length: jax.Array, cfg: Any, iteration: Count
) -> tuple[PyTree, Bill, jax.Array]:
    """The price after the moves that are due, what remains of the bill, and whether a move failed.

    J_c is what a step has cost since the last move, times the mean `length` of an episode. After an
    iteration of more than `dual_every` steps several moves may be due; they see the same J_c. If all
    steps were bad there is no J_c, and the moves that are due lapse.
    """
    episode_cost = bill.cost / jnp.maximum(bill.steps, 1) * length
    due = jnp.maximum(bill.age, 0) // cfg.dual_every

    def move(_: jax.Array, dual: PyTree) -> PyTree:
        return treatment.update(dual, episode_cost, cfg, iteration)

    moved = jax.lax.fori_loop(0, jnp.where(bill.steps > 0, due, 0), move, dual)
    finite = all_finite(moved)
    paid = Bill(jnp.zeros_like(bill.cost), jnp.float32(0), bill.age - due * cfg.dual_every)
    emptied = (due > 0) | (bill.age <= 0)  # what is charged before `dual_starts` is dropped
    bill = select(emptied, paid, bill)
    return select(finite, moved, dual), bill, ~finite

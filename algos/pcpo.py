"""PCPO: CPO's trust-region step with another rule for where it goes."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from jaxsafe.algos import cpo, trpo
from jaxsafe.config import Iterations, Weight, config
from jaxsafe.learn.constraints import constrained_costs
from jaxsafe.learn.conventions import Convention
from jaxsafe.learn.halfspaces import cosines, dot, nearest_point
from jaxsafe.learn.on_policy import on_policy_pair, presets
from jaxsafe.learn.row import Row
from jaxsafe.learn.surrogates import plain
from jaxsafe.types import Algorithm, Env


@config
class PCPOConfig(cpo.CPOConfig):
    """PCPO: a trust-region step on the reward, then a projection onto the linearised constraint.

        x = sqrt(2 delta / q) H^-1 g - max(0, (sqrt(2 delta / q) r + c) / s) H^-1 b

    g, b, H, q, r, s and c are as in CPO. The projection is in the metric of H, which is the KL's. With
    several constraints it is onto the steps that satisfy them all.

    Source: Yang et al. (2020), "Projection-based Constrained Policy Optimization", arXiv:2010.03152,
    equation 9.
    Differs from it, as CPO does: c has a margin, and a line search keeps the step within delta and the
    cost within max(-c, 0). The paper has no line search, and OmniSafe has CPO's. OmniSafe also leaves
    H^-1 out of the first term (`natural=False`).
    """

    SUITS: ClassVar = {"fast": ("hopper_velocity",)}  # CPO's preset there was not tried
    CONVENTIONS: ClassVar = (
        Convention(
            {"natural": False},
            "the reward's step is sqrt(2 delta / q) g",
            "sqrt(2 delta / q) H^-1 g, the paper's",
        ),
    )

    line_search_tries: Iterations = 200  # Steps that the line search tries at most, as in OmniSafe.
    # Whether the reward's step is along H^-1 g. OmniSafe's is along g.
    natural: bool = True
    # Bound of the margin, as a multiple of the most that a step can promise. It is larger than CPO's,
    # because the reward's step is taken first, whatever c is.
    margin_max: Weight = 5.0


def projected_step(p: cpo.Problem, cfg: Any) -> cpo.Direction:
    """The reward's step, moved back along H^-1 b to where b'x + c = 0, if it lies beyond."""
    scale = jnp.sqrt(2 * p.delta / jnp.maximum(p.q, 1e-20))
    back = (projection_multipliers if p.c.ndim else projection_multiplier)(scale * p.r + p.c, p.s)
    step = scale * (p.h_g if cfg.natural else p.g) - dot(back, p.h_b)
    return cpo.Direction(step, jnp.bool_(False), {"train/nu": back})


def projection_multiplier(overshoot: jax.Array, s: jax.Array) -> jax.Array:
    """How far to go back along H^-1 b, float [], >= 0."""
    return jnp.maximum(0.0, overshoot / jnp.maximum(s, 1e-20))


def projection_multipliers(overshoot: jax.Array, s: jax.Array) -> jax.Array:
    """`projection_multiplier` of several constraints: overshoot [K], s [K, K]."""
    size = jnp.sqrt(jnp.maximum(jnp.diag(s), 1e-20))
    unit = jnp.maximum(jnp.abs(overshoot / size).max(), 1e-20)
    return nearest_point(cosines(s), overshoot / size / unit) * unit / size


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy_pair(
        env, plain, cpo.step_by(projected_step), axis_name, constrained_costs=constrained_costs
    )


ROWS = {
    "pcpo": Row(
        PCPOConfig,
        make,
        "trust-region step projected onto a linearised constraint",
        presets(trpo.PUBLISHED),
        omnisafe="PCPO",
    ),
}

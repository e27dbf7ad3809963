"""PCPO: a trust-region step on the reward, then a projection onto the linearised constraint.

    x = sqrt(2 delta / q) H^-1 g - max(0, (sqrt(2 delta / q) r + c) / s) H^-1 b

g, b, H, q, r, s, c as in CPO; the projection is in the metric of H, the KL's. Of several constraints it
is onto what satisfies them all.

Source: Yang et al. (2020), "Projection-based Constrained Policy Optimization", arXiv:2010.03152,
equation 9.
Differs from it, as CPO does: c with its margin, and the line search, which keeps the step within
delta (the paper has none; OmniSafe has CPO's, and x without H^-1 in the first term, `natural=False`).
"""

from typing import Any

import jax
import jax.numpy as jnp

from jaxsafe.algos import cpo
from jaxsafe.config import config
from jaxsafe.learn.constraints import named
from jaxsafe.learn.halfspaces import dot, nearest_point
from jaxsafe.learn.on_policy import on_policy_pair
from jaxsafe.learn.surrogates import plain
from jaxsafe.types import Algorithm, Env


@config
class PCPOConfig(cpo.CPOConfig):
    line_search_tries: int = 200  # OmniSafe
    natural: bool = True  # the reward's step is along H^-1 g; OmniSafe: along g
    margin_max: float = 5.0  # more than CPO's, for the reward's step is taken first, whatever c is


PUBLISHED: dict[str, dict[str, Any]] = cpo.PUBLISHED


def projection(p: cpo.Problem, cfg: Any) -> cpo.Direction:
    """The reward's step, moved back along H^-1 b to where b'x + c = 0, if it lies beyond."""
    scale = jnp.sqrt(2 * p.delta / jnp.maximum(p.q, 1e-20))
    back = (backs if p.c.ndim else back_to)(scale * p.r + p.c, p.s)
    step = scale * (p.h_g if cfg.natural else p.g) - dot(back, p.h_b)
    return cpo.Direction(step, jnp.bool_(False), {"train/nu": back})


def back_to(excess: jax.Array, s: jax.Array) -> jax.Array:
    return jnp.maximum(0.0, excess / jnp.maximum(s, 1e-20))


def backs(excess: jax.Array, s: jax.Array) -> jax.Array:
    """`back_to` of several constraints: excess [K], s [K, K]."""
    size = jnp.sqrt(jnp.maximum(jnp.diag(s), 1e-20))
    unit = jnp.maximum(jnp.abs(excess / size).max(), 1e-20)
    return nearest_point(cpo.cosines(s), excess / size / unit) * unit / size


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return on_policy_pair(env, plain, cpo.step_by(projection), axis_name, named=named)

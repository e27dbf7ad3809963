"""Treatments of the constraint: how the cost advantage joins the reward's in one objective."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxsafe.types import Metrics, PyTree


class Treatment(NamedTuple):
    """init(cfg) -> dual; update(dual, episode_cost, cfg) -> dual, once an iteration, before the
    policy's step; advantage(dual, adv_r, adv_c) -> float [B], what the policy maximises;
    metrics(dual).
    """

    init: Callable[[Any], PyTree]
    update: Callable[[PyTree, jax.Array, Any], PyTree]
    advantage: Callable[[PyTree, jax.Array, jax.Array], jax.Array]
    metrics: Callable[[PyTree], Metrics]


none = Treatment(
    init=lambda cfg: (),
    update=lambda dual, episode_cost, cfg: (),
    advantage=lambda dual, adv_r, adv_c: adv_r,
    metrics=lambda dual: {},
)


class Multiplier(NamedTuple):
    lam: jax.Array  # float [], reward per unit of cost, >= 0
    opt_state: PyTree


def init_multiplier(cfg: Any) -> Multiplier:
    lam = jnp.asarray(cfg.lam_init, jnp.float32)
    return Multiplier(lam, optax.adam(cfg.dual_lr).init(lam))


def adam_ascent(dual: Multiplier, episode_cost: jax.Array, cfg: Any) -> Multiplier:
    """One Adam step on the loss -lam (J_c - cost_limit), then lam in [0, lam_max]."""
    grad = -(episode_cost - cfg.cost_limit)
    change, opt_state = optax.adam(cfg.dual_lr).update(grad, dual.opt_state)
    lam: Any = optax.apply_updates(dual.lam, change)
    return Multiplier(jnp.clip(lam, 0.0, cfg.lam_max), opt_state)


# A = (A_r - lam A_c) / (1 + lam): Ray, Achiam and Amodei (2019), and the scale from their code
lagrangian = Treatment(
    init=init_multiplier,
    update=adam_ascent,
    advantage=lambda dual, adv_r, adv_c: (adv_r - dual.lam * adv_c) / (1.0 + dual.lam),
    metrics=lambda dual: {"train/lam": dual.lam},
)

"""Treatments of the constraint: how reward and cost are mixed in one objective, at which price.

What is mixed are advantages in on-policy algorithms, and values of actions in the others.
"""

from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxsafe.config import Bounds, Cap, Iterations, Rate, Share, Weight, config
from jaxsafe.learn.constraints import LimitsConfig, Names, constrained_costs, limit, total_cost_alone
from jaxsafe.types import Count, Metrics, PyTree


class Treatment(NamedTuple):
    """How the constraint enters the objective, and what is remembered of it: `dual`.

    init(cfg) -> dual.
    update(dual, episode_cost, cfg, iteration) -> dual. The loop says when. On-policy: once an
        iteration, before the policy's step. Off-policy: every `dual_every` environment steps, see
        `learn.bill`. Offline: after each gradient step.
    advantage(dual, adv_r, adv_c) -> float [B], what the policy maximises, of advantages or of values.
    metrics(dual) -> metrics.
    constrained_costs(cfg) -> names of the costs that have a limit each; () for `cost` alone.
    """

    init: Callable[[Any], PyTree]
    update: Callable[[PyTree, jax.Array, Any, Count], PyTree]
    advantage: Callable[[PyTree, jax.Array, jax.Array], jax.Array]
    metrics: Callable[[PyTree], Metrics]
    constrained_costs: Callable[[Any], Names] = total_cost_alone


no_treatment = Treatment(
    init=lambda cfg: (),
    update=lambda dual, episode_cost, cfg, iteration: (),
    advantage=lambda dual, adv_r, adv_c: adv_r,
    metrics=lambda dual: {},
)


@config
class LagrangianConfig(LimitsConfig):
    """For `lagrangian`."""

    lam_init: Weight = 0.001  # The price on cost at the start, as in OmniSafe.
    lam_max: Cap = float("inf")  # The highest price. As in OmniSafe there is no bound.
    # Adam's step of the price, whatever the size of the violation. OmniSafe's is 0.035.
    dual_lr: Rate = 0.1


class Multiplier(NamedTuple):
    lam: jax.Array  # float [] or [K], standard deviations of A_r per unit of cost, >= 0
    opt_state: PyTree


def initial_price(cfg: Any) -> jax.Array:
    return jnp.full(jnp.shape(limit(cfg, constrained_costs(cfg))), cfg.lam_init, jnp.float32)


def init_multiplier(cfg: Any) -> Multiplier:
    lam = jnp.minimum(initial_price(cfg), cfg.lam_max)
    return Multiplier(lam, optax.adam(cfg.dual_lr).init(lam))


def adam_ascent(dual: Multiplier, episode_cost: jax.Array, cfg: Any, iteration: Count) -> Multiplier:
    """One Adam step on the loss -lam (J_c - cost_limit), then lam in [0, lam_max]."""
    return ascended(dual, episode_cost, cfg, eps=1e-8)


def ascended(dual: Multiplier, episode_cost: jax.Array, cfg: Any, eps: float | jax.Array) -> Multiplier:
    grad = -(episode_cost - limit(cfg, constrained_costs(cfg)))
    change, opt_state = optax.adam(cfg.dual_lr, eps=eps).update(grad, dual.opt_state)
    lam: Any = optax.apply_updates(dual.lam, change)
    return Multiplier(jnp.clip(lam, 0.0, cfg.lam_max), opt_state)


def price_of(costs: jax.Array, dual: Any) -> jax.Array:
    """sum_i lam_i C_i over the constraints, float [B]; `costs` are [B], or [B, K] of several."""
    return jnp.dot(costs, dual.lam, precision=jax.lax.Precision.HIGHEST)  # of one, their product


def mixed(dual: Any, adv_r: jax.Array, adv_c: jax.Array) -> jax.Array:
    """A = (A_r - sum_i lam_i A_ci) / (1 + sum_i lam_i), over the constraints."""
    return (adv_r - price_of(adv_c, dual)) / (1.0 + dual.lam.sum())


# Ray, Achiam and Amodei (2019), and the scale from their code
lagrangian = Treatment(
    init=init_multiplier,
    update=adam_ascent,
    advantage=mixed,
    metrics=lambda dual: {"train/lam": dual.lam},
    constrained_costs=constrained_costs,
)


@config
class DampedConfig(LagrangianConfig):
    """For `damped_lagrangian`."""

    # Price for each unit by which J_c exceeds its limit, beside the multiplier; below the limit it is
    # taken off. A multiplier alone overshoots, because it goes on to rise until J_c has fallen.
    dual_damping: Weight = 0.02
    # What Adam adds to the size of recent violations, by which it divides. Where these are smaller, a
    # unit of them moves the multiplier by dual_lr / dual_eps. With Adam's usual 1e-8, as in OmniSafe,
    # it moves by dual_lr even there, so that a price that came to rest swings again.
    dual_eps: Annotated[float, Bounds(1e-12, 1e6)] = 10.0


class Damped(NamedTuple):
    lam: jax.Array  # float [] or [K], the price, >= 0
    multiplier: Multiplier


def init_damped(cfg: Any) -> Damped:
    multiplier = init_multiplier(cfg)
    return Damped(multiplier.lam, multiplier)


def damped_ascent(dual: Damped, episode_cost: jax.Array, cfg: Any, iteration: Count) -> Damped:
    """lam = l + dual_damping (J_c - cost_limit), clipped to [0, lam_max], with the multiplier l."""
    multiplier = ascended(dual.multiplier, episode_cost, cfg, cfg.dual_eps)
    over = episode_cost - limit(cfg, constrained_costs(cfg))
    lam = jnp.clip(multiplier.lam + cfg.dual_damping * over, 0.0, cfg.lam_max)
    return Damped(lam, multiplier)


# Platt and Barr (1987), "Constrained Differential Optimization", section 3.1, whose damping is the
# gradient of a quadratic penalty
damped_lagrangian = Treatment(
    init=init_damped,
    update=damped_ascent,
    advantage=mixed,
    metrics=lambda dual: {"train/lam": dual.lam, "train/multiplier": dual.multiplier.lam},
    constrained_costs=constrained_costs,
)


@config
class PIDConfig(LimitsConfig):
    """For `pid`."""

    lam_init: Weight = 0.001  # The price on cost at the start, as in OmniSafe.
    pid_kp: Weight = 0.1  # Price for each unit of the smoothed violation, as in OmniSafe.
    # Price that each unit of violation adds in each iteration, as in OmniSafe.
    pid_ki: Weight = 0.01
    pid_kd: Weight = 0.01  # Price for each unit that the smoothed cost rose, as in OmniSafe.
    # Share of the past in the smoothed violation and the smoothed cost, as in OmniSafe.
    pid_smoothing: Share = 0.95
    # Moves of the price over which the rise is measured, one an iteration on-policy. As in OmniSafe.
    pid_delay: Iterations = 10


class PID(NamedTuple):
    """What the controller remembers: lam and integral are prices, the others costs per episode.

    Of several constraints all have a last axis K. `error`, `cost` and `past` start at 0, as in the code
    of Stooke et al. and in OmniSafe: the first `pid_delay` moves see the whole smoothed cost as a rise.
    """

    lam: jax.Array  # float [], standard deviations of A_r per unit of cost, >= 0
    integral: jax.Array  # float [], K_i times the sum of errors, >= 0
    error: jax.Array  # float [], smoothed J_c - cost_limit
    cost: jax.Array  # float [], smoothed J_c
    past: jax.Array  # float [pid_delay], earlier smoothed costs, oldest first


def init_pid(cfg: Any) -> PID:
    lam = initial_price(cfg)
    zero = jnp.zeros_like(lam)
    return PID(lam, lam, zero, zero, jnp.zeros((cfg.pid_delay, *lam.shape)))


def control(dual: PID, episode_cost: jax.Array, cfg: Any, iteration: Count) -> PID:
    """lam = (K_p P + I + K_d D)+, from the error's smoothed value, its sum, and the cost's rise."""
    error = episode_cost - limit(cfg, constrained_costs(cfg))
    integral = jnp.maximum(0.0, dual.integral + cfg.pid_ki * error)
    smooth = cfg.pid_smoothing * dual.error + (1 - cfg.pid_smoothing) * error
    cost = cfg.pid_smoothing * dual.cost + (1 - cfg.pid_smoothing) * episode_cost
    rise = jnp.maximum(0.0, cost - dual.past[0])
    lam = jnp.maximum(0.0, cfg.pid_kp * smooth + integral + cfg.pid_kd * rise)
    past = jnp.concatenate([dual.past[1:], cost[None]])
    return PID(lam, integral, smooth, cost, past)


# Stooke, Achiam and Abbeel (2020), "Responsive Safety in Reinforcement Learning by PID Lagrangian
# Methods", arXiv:2007.03964, algorithm 2; the smoothing and the scale are from their code
pid = Treatment(
    init=init_pid,
    update=control,
    advantage=lagrangian.advantage,
    metrics=lambda dual: {"train/lam": dual.lam, "train/integral": dual.integral},
    constrained_costs=constrained_costs,
)


@config
class CappedPIDConfig:
    """For `capped_pid`."""

    pid_kp: Weight = 0.1  # Price for each unit of violation, as in SafeDreamer's code.
    # Price that each unit of violation adds at each move, as in SafeDreamer's code.
    pid_ki: Weight = 0.01
    pid_kd: Weight = 0.01  # Price for each unit that the cost rose, as in SafeDreamer's code.
    # Share of the past in the smoothed cost of an episode, as in SafeDreamer's code.
    pid_smoothing: Share = 0.99
    price_max: Cap = 0.1  # The highest price, as in SafeDreamer's code.


class CappedPID(NamedTuple):
    """What the controller remembers, float [] each.

    lam: the price.
    integral: `pid_ki` times the sum of violations, within [0, price_max].
    cost: the smoothed cost of an episode, 0 at first.
    """

    lam: jax.Array
    integral: jax.Array
    cost: jax.Array


def control_capped(price: CappedPID, episode_cost: jax.Array, cfg: Any, iteration: Count) -> CappedPID:
    cost = cfg.pid_smoothing * price.cost + (1 - cfg.pid_smoothing) * episode_cost
    error = cost - cfg.cost_limit
    integral = jnp.clip(price.integral + cfg.pid_ki * error, 0.0, cfg.price_max)
    rise = jnp.maximum(0.0, cost - price.cost)
    lam = jnp.clip(cfg.pid_kp * error + integral + cfg.pid_kd * rise, 0.0, cfg.price_max)
    return CappedPID(lam, integral, cost)


# Huang et al. (2024), "SafeDreamer: Safe Reinforcement Learning with World Models", arXiv:2307.07176,
# from their code
capped_pid = Treatment(
    init=lambda cfg: CappedPID(*jnp.zeros(3)),
    update=control_capped,
    advantage=lambda price, adv_r, adv_c: adv_r - price.lam * adv_c,
    metrics=lambda price: {"train/lam": price.lam},
)


@config
class BarrierConfig:
    """For `barrier`."""

    barrier: Weight = 0.01  # Height of the barrier, 1 / t in the paper, as in OmniSafe.
    # The highest price, in standard deviations of A_r per unit of cost, as in OmniSafe.
    price_max: Weight = 1.0


def barrier_price(dual: jax.Array, episode_cost: jax.Array, cfg: Any, iteration: Count) -> jax.Array:
    """The slope of the barrier -barrier log(cost_limit - J_c), or price_max where there is none."""
    slack = cfg.cost_limit - episode_cost
    price = cfg.barrier / jnp.where(slack > 0, slack, 1.0)
    return jnp.where((slack > 0) & (price < cfg.price_max), price, cfg.price_max)


# Liu, Ding and Liu (2020), "IPO: Interior-point Policy Optimization under Constraints",
# arXiv:1910.09615, equation 6, whose barrier enters here by its gradient
barrier = Treatment(
    init=lambda cfg: jnp.zeros(()),
    update=barrier_price,
    advantage=lambda price, adv_r, adv_c: (adv_r - price * adv_c) / (1.0 + price),
    metrics=lambda price: {"train/lam": price},
)


@config
class PenaltyConfig:
    """For `penalty`."""

    # Standard deviations of A_r that a unit of cost costs. The number is ours; nobody published one.
    price: Weight = 0.5


penalty = Treatment(
    init=lambda cfg: jnp.asarray(cfg.price, jnp.float32),
    update=lambda price, episode_cost, cfg, iteration: price,
    advantage=lambda price, adv_r, adv_c: adv_r - price * adv_c,
    metrics=lambda price: {"train/lam": price},
)


@config
class SwitchConfig:
    """For `switch`."""

    # Cost per episode by which the limit may be exceeded before a step lowers cost, as in OmniSafe.
    tolerance: Weight = 2.0


# Xu, Liang and Lan (2021), "CRPO: A New Approach for Safe Reinforcement Learning with Convergence
# Guarantee", arXiv:2011.05869, algorithm 1
switch = Treatment(
    init=lambda cfg: jnp.bool_(False),
    update=lambda over_limit, episode_cost, cfg, iteration: (
        episode_cost > cfg.cost_limit + cfg.tolerance
    ),
    advantage=lambda over_limit, adv_r, adv_c: jnp.where(over_limit, -adv_c, adv_r),
    metrics=lambda over_limit: {"train/over_limit": over_limit},
)

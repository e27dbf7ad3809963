"""What is constrained: `cost` under cost_limit or, with cost_limits, named costs, each under its own.

What belongs to the constraint (a limit, a multiplier, J_c) is then float [K] instead of float [], and
what belongs to it at each step (A_c, the critic's targets) has a last axis K, in the order of
`constrained_costs`.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from jaxsafe.config import ConfigError, Weight, config, nearest
from jaxsafe.types import Env, Metrics

Names = tuple[str, ...]


@config
class LimitsConfig:
    """For algorithms that take several constraints."""

    # Limits of named costs, per episode, in place of `cost_limit`. null: only `cost_limit`.
    cost_limits: dict[str, Weight] | None = None


def total_cost_alone(cfg: Any) -> Names:
    return ()


def constrained_costs(cfg: Any) -> Names:
    """The costs under limits of their own, in the order of the alphabet; () for `cost` under one."""
    if cfg.cost_limits is None:
        return ()
    if not cfg.cost_limits:
        raise ConfigError("cost_limits={}: expected a limit for one cost at least")
    return tuple(sorted(cfg.cost_limits))


def limit(cfg: Any, names: Names) -> jax.Array:
    return jnp.stack([cfg.cost_limits[name] for name in names]) if names else cfg.cost_limit


def limits_by_name(cfg: Any) -> dict[str, float]:
    """The limits by name, of the config of any algorithm; empty where there is only cost_limit."""
    return dict(sorted((dataclasses.asdict(cfg).get("cost_limits") or {}).items()))


def limits_of(cfg: Any) -> dict[str, float]:
    """Every limit in force, by name; '' is the name of `cost`."""
    return limits_by_name(cfg) or {"": float(cfg.cost_limit)}


def cost_title(name: str) -> str:
    """What tables call a cost; '' is the name of `cost`."""
    return f"cost {name}" if name else "cost"


def limits_in_words(limits: dict[str, float]) -> str:
    """'25', or 'hazards 10, vases_contact 5'; '-' of none."""
    return ", ".join(f"{name} {most:.9g}".lstrip() for name, most in limits.items()) or "-"


def check_cost_names(option: str, names: Iterable[str], env: Env) -> None:
    """Raise ConfigError for a cost, named by an option, that the environment does not have."""
    for name in names:
        if name not in env.cost_names:
            hint = nearest(name, env.cost_names) if env.cost_names else "; the environment has none"
            raise ConfigError(f"{option}: unknown cost {name!r}{hint}")


class Costs(Protocol):
    """What steps cost, float [...], and the parts of it, float [..., len(env.cost_names)]."""

    @property
    def cost(self) -> jax.Array: ...

    @property
    def costs(self) -> jax.Array: ...


def signal(env: Env, steps: Costs, names: Names) -> jax.Array:
    """What is held under the limit: float [...] or, of several, [..., K]."""
    return steps.costs[..., [env.cost_names.index(n) for n in names]] if names else steps.cost


def each(fn: Callable, names: Names) -> Callable:
    """`fn` of one constraint for all of them, along the last axis of what it takes and gives."""
    return jax.vmap(fn, in_axes=-1, out_axes=-1) if names else fn


def metrics_by_constraint(metrics: Metrics, names: Sequence[str]) -> Metrics:
    """`metrics` with an entry for each constraint in place of those of [K]: train/lam_hazards, ..."""
    out = {}
    for metric, x in metrics.items():
        several = {f"{metric}_{name}": x[k] for k, name in enumerate(names)} if jnp.ndim(x) else {}
        out |= several or {metric: x}
    return out

"""Safety Gym's environments by name: `make("car_push1")` or `make("Safexp-CarPush1-v0")`."""

import dataclasses
from typing import Any

from jaxsafe.config import ConfigError, convert, nearest
from jaxsafe.envs import layout, suite
from jaxsafe.envs.config import SafetyGymConfig, defaults, read
from jaxsafe.envs.safety_gym import SafetyGym

ENVS: dict[str, dict[str, Any]] = suite.suite()  # name -> options that differ from the defaults
ALIASES: dict[str, str] = {suite.alias(name): name for name in ENVS}


def canonical(name: str) -> str:
    """The registered name of an environment given by name or by Safety Gym's id.

    Raises:
        ConfigError: no such environment; the message has the nearest name.
    """
    if name in ENVS:
        return name
    if name in ALIASES:
        return ALIASES[name]
    raise ConfigError(f"unknown environment {name!r}{nearest(name, [*ENVS, *ALIASES])}")


def env_defaults(name: str) -> dict[str, Any]:
    """Every option of an environment as a plain value, and `engine`."""
    options = defaults(**ENVS[canonical(name)])
    return {"engine": "auto"} | options


def make(env: str | SafetyGymConfig, **overrides: Any) -> SafetyGym:
    """Build an environment.

    Args:
        env: a name ('car_push1', 'Safexp-CarPush1-v0') or a config.
        overrides: engine options by name, and `engine`: 'auto', 'c', 'warp' or 'jax'.
    Raises:
        ConfigError: an unknown name or option (with the nearest valid one), a value of the wrong
            type, or a task that cannot be built or has no valid layout.
    """
    engine = convert(overrides.pop("engine", "auto"), str, "env.engine")
    if isinstance(env, SafetyGymConfig):
        made = SafetyGym(read(dataclasses.asdict(env) | overrides), engine)
    else:
        name = canonical(env)
        made = SafetyGym(read(defaults(**ENVS[name]) | overrides), engine, name)
        if not overrides:  # as registered: known to have layouts
            return made
    if not layout.feasible(made.place):
        raise ConfigError(
            f"env: no valid layout in {layout.LAYOUTS:,} tries: fewer or smaller objects, smaller "
            "keepouts or larger placements_extents"
        )
    return made


__all__ = ["ALIASES", "ENVS", "SafetyGym", "SafetyGymConfig", "canonical", "env_defaults", "make"]

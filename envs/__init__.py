"""Environments by name: Safety Gym's, `make("car_push1")` or `make("Safexp-CarPush1-v0")`, and those
that `register` adds."""

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any

from jaxsafe.config import ConfigError, convert, named_object, nearest
from jaxsafe.envs.check import check_env
from jaxsafe.envs.safety_gym import layout, suite
from jaxsafe.envs.safety_gym.config import SafetyGymConfig, defaults, read
from jaxsafe.envs.safety_gym.task import SafetyGym
from jaxsafe.types import Env

# name -> options that differ from Safety Gym's defaults, or what makes an environment of another kind
ENVS: dict[str, Any] = {**suite.suite()}
PLAIN = (type(None), bool, int, float, str, list, tuple, dict)
ALIASES: dict[str, str] = {suite.alias(name): name for name in ENVS}


def register(name: str, env: Any) -> None:
    """Add an environment of your own, for `make` and the command line.

    Args:
        name: what to call it; a name that is there already is replaced.
        env: one of
            a dict of Safety Gym's options, such as `TASKS["goal1"] | ROBOTS["car"]` of suite.py;
            a `SafetyGymConfig`, or an environment that `make` made of one;
            any other `Env`;
            a function or a class that makes one, whose arguments with defaults are its options.
    Raises:
        ConfigError: an unknown option, or nothing of these.
    """
    if isinstance(env, SafetyGym):
        env = env.config
    if isinstance(env, SafetyGymConfig):
        env = dataclasses.asdict(env)
    if isinstance(env, dict):
        read({k: v for k, v in defaults(**env).items() if k != "engine"})
        ENVS[name] = dict(env)
    elif callable(env):
        ENVS[name] = env
    else:
        checked = check_env(env, name)
        ENVS[name] = lambda: checked


def load(address: str) -> None:
    """Import 'module:name', from the working directory too, and register it under that address.

    This executes the module, so an address comes from the user, never from a file.

    Raises:
        ConfigError: no such module, or nothing of that name in it.
    """
    register(address, named_object("env", address))


def canonical(name: str) -> str:
    """The registered name of an environment given by name or by Safety Gym's id.

    Raises:
        ConfigError: no such environment; the message has the nearest name.
    """
    if name in ENVS:
        return name
    if name in ALIASES:
        return ALIASES[name]
    if ":" in name:
        raise ConfigError(
            f"{name} is code, which is not imported because a file names it; if you trust it, add "
            f"env={name}"
        )
    if ours := suite.safety_gymnasium(name):
        raise ConfigError(f"{name} is env={ours} env.rules=safety_gymnasium")
    raise ConfigError(f"unknown environment {name!r}{nearest(name, [*ENVS, *ALIASES])}")


def env_defaults(name: str) -> dict[str, Any]:
    """Every option of an environment as a plain value; of Safety Gym's, `engine` too."""
    entry = ENVS[canonical(name)]
    if isinstance(entry, dict):
        return {"engine": "auto"} | defaults(**entry)
    return {p.name: p.default for p in arguments(entry, name)}


def arguments(factory: Callable[..., Env], name: str) -> list[inspect.Parameter]:
    """Those that are options: with a plain value as default.

    Raises:
        ConfigError: one has no default.
    """
    given = inspect.signature(factory, eval_str=True).parameters.values()
    named = [p for p in given if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    for p in named:
        if p.default is p.empty:
            raise ConfigError(f"{name}: argument {p.name!r} has no default, so nobody would give it")
    return [p for p in named if isinstance(p.default, PLAIN)]


def make(env: str | SafetyGymConfig, **overrides: Any) -> SafetyGym:
    """Build an environment.

    Args:
        env: a name ('car_push1', 'Safexp-CarPush1-v0', what `register` was given) or a config.
        overrides: engine options by name, and `engine`: 'auto', 'c', 'warp' or 'jax'; or the options
            of what was registered.
    Returns:
        A `SafetyGym`, or the `Env` that was registered.
    Raises:
        ConfigError: an unknown name or option (with the nearest valid one), a value of the wrong
            type, or a task that cannot be built or has no valid layout.
    """
    name = "custom" if isinstance(env, SafetyGymConfig) else canonical(env)
    options = dataclasses.asdict(env) if isinstance(env, SafetyGymConfig) else ENVS[name]
    if not isinstance(options, dict):
        return own(name, options, overrides)  # type: ignore[return-value]
    options = {"engine": "auto"} | defaults(**options) | overrides
    engine = convert(options.pop("engine"), str, "env.engine")
    made = SafetyGym(read(options), engine, name)
    if name in ALIASES.values() and overrides.keys() <= {"engine"}:  # known to have layouts
        return made
    if not layout.feasible(made.place):
        raise ConfigError(
            f"env: no valid layout in {layout.LAYOUTS:,} tries: fewer or smaller objects, smaller "
            "keepouts or larger placements_extents"
        )
    return made


def own(name: str, factory: Callable[..., Env], overrides: dict[str, Any]) -> Env:
    kinds = {p.name: p.annotation for p in arguments(factory, name)}
    for option in overrides:
        if option not in kinds:
            raise ConfigError(f"unknown option env.{option}{nearest(option, kinds)}")
    typed = {
        k: v if kinds[k] is inspect.Parameter.empty else convert(v, kinds[k], f"env.{k}")
        for k, v in overrides.items()
    }
    return check_env(factory(**typed), name)


__all__ = [
    "ALIASES",
    "ENVS",
    "SafetyGym",
    "SafetyGymConfig",
    "canonical",
    "env_defaults",
    "make",
    "register",
]

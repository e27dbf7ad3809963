"""Environments by name: Safety Gym's, velocity tasks, racing, pendulums, and what `register` adds.

`make("car_push1")` and `make("Safexp-CarPush1-v0")` are the same environment.
"""

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any, Literal

from jaxsafe.config import (
    OWN_CODE,
    ConfigError,
    UnnamedCode,
    convert,
    from_dict,
    import_object,
    nearest,
    shown,
)
from jaxsafe.envs import pendulum
from jaxsafe.envs.check import check_env
from jaxsafe.envs.engines.choose import ENGINES
from jaxsafe.envs.racing import task as racing
from jaxsafe.envs.safety_gym import layout, suite
from jaxsafe.envs.safety_gym.config import SafetyGymConfig, config_from_plain, defaults
from jaxsafe.envs.safety_gym.task import SafetyGym
from jaxsafe.envs.velocity import config as velocity
from jaxsafe.envs.velocity import suite as velocities
from jaxsafe.envs.velocity.config import VelocityConfig
from jaxsafe.envs.velocity.task import Velocity
from jaxsafe.envs.wrap import WrapConfig, wrapped
from jaxsafe.types import Env

SUITE = suite.suite()
OURS: dict[str, Any] = {**SUITE, **suite.circles_and_runs(), **suite.seditor()}
# name -> options that differ from Safety Gym's defaults, the config of a velocity task, or a function
# that makes another environment
ENVS: dict[str, Any] = {**OURS, **velocities.suite(), **racing.ROWS, **pendulum.ROWS}
Config = SafetyGymConfig | VelocityConfig
PLAIN = (type(None), bool, int, float, str, list, tuple, dict)  # types of what a config file keeps
ANY_ENV = "wrap"  # the option that every environment has
OF_MAKE = ("engine", ANY_ENV)  # options of our environments that are no field of their config
OF_ENGINE = ("engine", "awake", "contact_room")  # options that leave a task what it is
ALIASES: dict[str, str] = {suite.alias(name): name for name in SUITE}
ALIASES |= {suite.their_id(name): name for name in [*suite.circles_and_runs(), *suite.ruled()]}
ALIASES |= {alias: name for alias, (name, _) in velocities.aliases().items()}
ALIASES |= racing.ALIASES | pendulum.ALIASES
# options that an alias stands for, beside a name
IMPLIED: dict[str, dict[str, Any]] = {a: options for a, (_, options) in velocities.aliases().items()}
IMPLIED |= {suite.their_id(name): {"rules": "safety_gymnasium"} for name in suite.ruled()}
for their, name in suite.seeing(ALIASES).items():
    IMPLIED[their] = IMPLIED.get(suite.blind(their), {}) | suite.picture(their)
    ALIASES[their] = name


def register(name: str, env: Any) -> None:
    """Add an environment of your own, for `make` and the command line.

    Args:
        name: what to call it. A name that is there already is replaced.
        env: one of
            a dict of Safety Gym's options, such as `TASKS["goal1"] | ROBOTS["car"]` of suite.py;
            a `SafetyGymConfig` or a `VelocityConfig`, or an environment that `make` made of one, whose
            engine is an option again;
            any other `Env`, also of a class derived from these;
            a function or a class that makes one. Its arguments with defaults become options.
    Raises:
        ConfigError: an unknown option, or something that is none of these.
    """
    if type(env) in (SafetyGym, Velocity):
        env = env.config
    if isinstance(env, SafetyGymConfig):
        env = dataclasses.asdict(env)
    if isinstance(env, dict):
        config_from_plain({k: v for k, v in defaults(**env).items() if k not in OF_MAKE})
        wrap_config(env.get(ANY_ENV, {}))
        ENVS[name] = dict(env)
    elif isinstance(env, VelocityConfig) or callable(env):
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
    register(address, import_object("env", address))


def canonical(name: str) -> str:
    """The registered name of an environment given by name, or by Safety Gym's or Safety-Gymnasium's id.

    Raises:
        ConfigError: no such environment; the message has the nearest name.
    """
    if name in ENVS:
        return name
    if name in ALIASES:
        return ALIASES[name]
    if ":" in name:
        raise UnnamedCode("env", name)
    raise ConfigError(f"unknown environment {name!r}{nearest(name, [*ENVS, *ALIASES], OWN_CODE)}")


def implied_by(name: str) -> dict[str, Any]:
    """The options that an id stands for, beside an environment; none where it was registered anew."""
    return {} if name in ENVS else IMPLIED.get(name, {})


def env_defaults(name: str) -> dict[str, Any]:
    """Every option of an environment as a plain value. `wrap` is a dict: the fields of `WrapConfig`."""
    entry, implied = ENVS[canonical(name)], implied_by(name)
    wrap = dataclasses.asdict(WrapConfig())
    if isinstance(entry, dict):
        wrap |= entry.get(ANY_ENV, {})
        return {"engine": "auto"} | defaults(**entry) | implied | {ANY_ENV: wrap}
    if isinstance(entry, VelocityConfig):
        return {"engine": "auto"} | dataclasses.asdict(entry) | implied | {ANY_ENV: wrap}
    return {p.name: p.default for p in arguments(entry, name)} | {ANY_ENV: wrap}


def wrap_config(values: dict[str, Any]) -> WrapConfig:
    if not isinstance(values, dict):
        raise ConfigError(f"env.wrap={values!r}: set its parts, such as env.wrap.action_repeat=2")
    return from_dict(WrapConfig, values, "env.wrap.")


def arguments(factory: Callable[..., Env], name: str) -> list[inspect.Parameter]:
    """The arguments that are options: those with a plain value as default.

    Raises:
        ConfigError: an argument has no default, or the name of an option that every environment has.
    """
    given = inspect.signature(factory, eval_str=True).parameters.values()
    named = [p for p in given if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    for p in named:
        if p.default is p.empty:
            raise ConfigError(f"{name}: argument {p.name!r} has no default, so nobody would give it")
        if p.name in ("name", ANY_ENV):
            raise ConfigError(f"{name}: argument {p.name!r} is what every environment has: rename it")
    return [p for p in named if isinstance(p.default, PLAIN)]


def make(env: str | Config, **overrides: Any) -> Any:
    """Build an environment.

    Args:
        env: a name ('car_push1', 'Safexp-CarPush1-v0', what `register` was given) or a config.
        overrides: options by name. Safety Gym's are those of `SafetyGymConfig`, those of velocity tasks
            are in `VelocityConfig`. Both have `engine`: 'auto', 'c', 'warp' or 'jax'. Every environment
            has `wrap`, a dict of `WrapConfig`'s fields.
    Returns:
        A `SafetyGym`, a `Velocity`, or the `Env` that was registered; in its wrappers, if `wrap` asks
        for any. Only the name decides which, so that type checkers see `Any`.
    Raises:
        ConfigError: an unknown name or option (with the nearest valid one), a value of the wrong
            type, or a task that cannot be built or has no valid layout.
    """
    return planned(env, overrides)()  # type: ignore[return-value]


def check_options(env: str, **overrides: Any) -> None:
    """Raise ConfigError for what `make` would not take, as far as it shows before anything is built."""
    planned(env, overrides)


def planned(env: str | Config, overrides: dict[str, Any]) -> Callable[[], Env]:
    """What builds the environment. Names, types and bounds are checked by now."""
    if not isinstance(env, str | Config):
        raise ConfigError(f"env={shown(env)}: expected a name, a SafetyGymConfig or a VelocityConfig")
    name, entry = ("custom", env) if isinstance(env, Config) else (canonical(env), ENVS[canonical(env)])
    options = dataclasses.asdict(entry) if isinstance(entry, SafetyGymConfig) else entry
    implied = implied_by(env) if isinstance(env, str) else {}
    given = implied | {k: v for k, v in overrides.items() if k != ANY_ENV}
    wrap = overrides.get(ANY_ENV, {})
    if isinstance(options, dict):
        wrap = {**options.get(ANY_ENV, {}), **wrap} if isinstance(wrap, dict) else wrap
        plan = safety_gym(name, {k: v for k, v in options.items() if k != ANY_ENV}, given)
    elif isinstance(options, VelocityConfig):
        plan = velocity_task(name, options, given)
    else:
        plan = registered(name, options, given)
    wrappers = wrap_config(wrap)
    return lambda: wrapped(plan(), wrappers)


def safety_gym(name: str, options: dict[str, Any], overrides: dict[str, Any]) -> Callable[[], Env]:
    options = defaults(**options) | overrides
    engine = engine_of(options)
    cfg = config_from_plain(options)

    def build() -> Env:
        made = SafetyGym(cfg, engine, name)
        # our own tasks are known to have layouts
        if name in OURS and ENVS[name] is OURS[name] and overrides.keys() <= {"engine"}:
            return made
        if not layout.feasible(made.place):
            raise ConfigError(
                f"env: no valid layout in {made.place.search.layouts:,} tries: fewer or smaller "
                "objects, smaller keepouts or larger placements_extents"
            )
        return made

    if not layout.has_room(layout.placement(cfg)):
        raise ConfigError(
            "env: the objects do not fit into the area: fewer of them, smaller keepouts or larger "
            "placements_extents"
        )
    return build


def velocity_task(name: str, base: VelocityConfig, overrides: dict[str, Any]) -> Callable[[], Env]:
    options = dataclasses.asdict(base) | overrides
    engine = engine_of(options)
    cfg = velocity.config_from_plain(options)
    return lambda: Velocity(cfg, engine, name)


def engine_of(options: dict[str, Any]) -> str:
    """The option `engine`, which is taken out of `options`."""
    return convert(options.pop("engine", "auto"), Literal["auto", *ENGINES], "env.engine")  # type: ignore


def registered(name: str, factory: Callable[..., Env], overrides: dict[str, Any]) -> Callable[[], Env]:
    kinds = {p.name: p.annotation for p in arguments(factory, name)}
    for option in overrides:
        if option not in kinds:
            raise ConfigError(f"unknown option env.{option}{nearest(option, kinds)}")
    typed = {
        k: v if kinds[k] is inspect.Parameter.empty else convert(v, kinds[k], f"env.{k}")
        for k, v in overrides.items()
    }
    return lambda: check_env(factory(**typed), name)

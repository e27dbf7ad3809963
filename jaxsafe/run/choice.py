"""What a caller from Python chose: names, or objects in place of them, and options."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np

from jaxsafe import algos, envs
from jaxsafe.algos import Row
from jaxsafe.config import ConfigError, flat, nearest
from jaxsafe.envs import SafetyGym, Velocity, VelocityConfig
from jaxsafe.envs.check import check_env
from jaxsafe.envs.engines import default_engine
from jaxsafe.envs.registry import PLAIN
from jaxsafe.envs.wrap import Wrapper, innermost, wrap_config_of
from jaxsafe.run.plain import to_plain
from jaxsafe.run.progress import Reporter
from jaxsafe.run.settings import DEFAULT, EnvEntry, Extras, TrainConfig, find_env, having, load, nested
from jaxsafe.types import Algorithm, Env

RUN_OPTIONS = [f.name for f in dataclasses.fields(TrainConfig)]
BY_OPTIONS = (dict, VelocityConfig)  # entries whose name and options say it all


class Chosen(NamedTuple):
    """An environment and an algorithm, as the arguments of `train` name them."""

    given: dict[str, Any]  # the options that choose them, as 'env' and 'env.hazards_num'
    extras: Extras  # the caller's objects
    objects: dict[str, str]  # 'env', 'algo': what the caller's objects are called

    def say_whose(self, report: Reporter) -> None:
        if self.objects:
            report.line(
                f"only this program knows {' and '.join(self.objects.values())}: the run continues and "
                "opens from Python with the same object, not from the command line"
            )


def chosen(env: Any, algo: Any) -> Chosen:
    env_given, entries = choose_env(env)
    algo_given, rows = choose_algo(algo)
    objects = {"env": ", ".join(entries), "algo": ", ".join(rows)}
    objects = {kind: names for kind, names in objects.items() if names}
    return Chosen(env_given | algo_given, Extras(entries, rows), objects)


def choose_env(env: Any) -> tuple[dict[str, Any], dict[str, EnvEntry]]:
    """The options that choose `env`, and its entry if it is the caller's."""
    if env is None:
        return {}, {}
    if isinstance(env, str):
        load("env", env)
        return {"env": env}, {}
    if isinstance(env, list | tuple):
        if not env or not all(isinstance(e, str) for e in env):
            raise ConfigError("env: expected names in a list; an object of yours stands alone")
        for name in env:
            load("env", name)
        return {"env": list(env)}, {}
    if isinstance(env, type):
        raise ConfigError(
            f"env: {env.__name__} is a class; expected an environment, as {env.__name__}() makes one"
        )
    inner = innermost(env)
    gym = isinstance(inner, SafetyGym | Velocity)
    fields = to_plain(plain_fields(env))
    wrap = wrap_config_of(env) if type(inner) in (SafetyGym, Velocity) else None  # no derived class
    if gym and isinstance(envs.ENVS.get(inner.name), BY_OPTIONS) and wrap:
        defaults = flat(find_env(inner.name)[1].defaults)
        fields = to_plain(plain_fields(inner)) | {"wrap": to_plain(dataclasses.asdict(wrap))}
        fields["engine"] = "auto" if inner.engine == default_engine() else inner.engine
        options = {f"env.{k}": v for k, v in flat(fields).items() if v != defaults[k]}
        return {"env": inner.name} | options, {}
    name = inner.name if gym else type(env).__name__
    env = check_env(env, name)

    def made(**options: Any) -> Env:
        if options:
            raise ConfigError(
                f"{', '.join(f'env.{k}={v}' for k, v in options.items())}: this {name} has another "
                "value; set it where you make the environment"
            )
        return env

    drawn = {} if gym else {"video": False}  # there is a picture of our own alone
    return {"env": name, **drawn}, {name: EnvEntry(fields, made, made)}


def plain_fields(env: Any) -> dict[str, Any]:
    """What config.yaml keeps of an environment: the plain fields of a dataclass."""
    fields = env.config if isinstance(env, SafetyGym | Velocity) else env
    if not dataclasses.is_dataclass(fields):
        return {}
    values = {f.name: getattr(fields, f.name) for f in dataclasses.fields(fields)}
    plain = {name: value for name, value in values.items() if isinstance(value, PLAIN)}
    return plain | ({"inner": plain_fields(env.env)} if isinstance(env, Wrapper) else {})


@runtime_checkable
class LikeRow(Protocol):
    """An algorithm of the caller's own: a `Row`, or another object with these two."""

    config: type[Any]
    make: Callable[..., Algorithm]


def choose_algo(algo: Any) -> tuple[dict[str, Any], dict[str, Row]]:
    """As `choose_env`, for one algorithm or a list."""
    if algo is None:
        return {}, {}
    several = type(algo) in (list, tuple)  # a Row is a tuple too
    names, rows = [], {}
    for one in algo if several else [algo]:
        if isinstance(one, str):
            load("algo", one)
            names.append(one)
            continue
        if not (isinstance(one, LikeRow) and isinstance(one.config, type)) or not (
            dataclasses.is_dataclass(one.config)
        ):
            raise ConfigError(
                f"algo: expected a name or an object with a config class and make, not {one!r}"
            )
        name = one.config.__name__.removesuffix("Config")
        rows[name] = Row(one.config, one.make)
        names.append(name)
    return {"algo": names if several else names[0]}, rows


def full_names(choice: Chosen, options: dict[str, Any], *more: str) -> dict[str, Any]:
    """Options by their full names: 'total_steps' stays, 'cost_limit' is 'algo.cost_limit'.

    Raises:
        ConfigError: no run and no algorithm has such an option.
    """
    rows = {**algos.ALGOS, **choice.extras.algos}.values()
    fields = {f.name for row in rows for f in dataclasses.fields(row.config)}

    def full(name: str) -> str:
        head = name.partition(".")[0]
        if head in DEFAULT or name in (*RUN_OPTIONS, *more):
            return name
        if head not in fields:
            if having("env", name):
                raise ConfigError(f"unknown option {name}; did you mean 'env.{name}'?")
            raise ConfigError(f"unknown option {name}{nearest(name, [*RUN_OPTIONS, *more, *fields])}")
        return f"algo.{name}"

    return {full(name): value for name, value in options.items()}


def asked_for(choice: Chosen, options: dict[str, Any]) -> tuple[dict[str, Any], dict[str, list[Any]]]:
    """What to sweep, as `run.sweep_plan.plan` takes it: a list holds the values of an option.

    Raises:
        ConfigError: a list is empty, or there is no such option.
    """
    given, several = {}, {}
    for name, value in {**choice.given, **full_names(choice, flat(options), "max_parallel")}.items():
        values = as_list(value)
        if not isinstance(values, list):
            given[name] = value
        elif values:
            several[name] = [to_plain(v, name) for v in values]
        else:
            raise ConfigError(f"{name.removeprefix('algo.')}=[]: expected values to sweep")
    return to_plain(nested(given)), several


def as_list(value: Any) -> Any:
    """What holds several values, as a list of them."""
    if isinstance(value, np.ndarray | jax.Array):
        return value.tolist()
    return list(value) if isinstance(value, range) else value

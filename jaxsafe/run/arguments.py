"""The command line: `key=value` arguments as plain values, and Hydra around a training command.

This is the only module that knows Hydra and its grammar. Arguments are checked before Hydra sees them,
because its own errors are long.
"""

import os
import sys
from collections.abc import Callable
from typing import Any, NamedTuple, NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType, ValueType
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from jaxsafe import algos, envs
from jaxsafe.config import ConfigError
from jaxsafe.run import distributed
from jaxsafe.run.settings import (
    DEFAULT,
    NAMED,
    Settings,
    algo_options,
    ask,
    check_option,
    defaults_of,
    find_env,
    load,
    nested,
    to_plain,
)

ERRORS = (HydraException, OmegaConfBaseException)  # of arguments that only Hydra can judge
ONE_VALUE = ("preset", "compat", "resume")


class Request(NamedTuple):
    """What the arguments of train.py say before Hydra composes them."""

    argv: list[str]  # for Hydra: aliases replaced
    base: dict[str, Any]  # top-level defaults, or those of the run to continue
    groups: dict[str, dict[str, dict[str, Any]]]  # 'env' and 'algo': name -> options, if chosen


class Given(NamedTuple):
    """What the arguments of a sweep say."""

    options: dict[str, Any]  # those with one value, as `settings.ask` takes them
    several: dict[str, list[Any]]  # those with several, by name: 'seed', 'env', 'algo.clip'


# ---- without Hydra's composition -------------------------------------------------------------


def compose(texts: list[str]) -> Settings:
    """The settings that train.py would have from these arguments."""
    given = read_values(texts)
    for name in given.several:
        raise ConfigError(f"{name}: expected one value")
    return ask(given.options)


def read_values(texts: list[str]) -> Given:
    """The values of `key=value` and `key=value,value,...`, with environments and algorithms that are
    the user's code imported.

    Raises:
        ConfigError: an argument that cannot be read, or that is no `key=value`.
    """
    overrides = [parse(text) for text in texts]
    for override in overrides:
        check_kind(override)
        load_named(override)
    several = {o.key_or_group: choices(o) for o in overrides if o.is_sweep_override()}
    options = nested({o.key_or_group: o.value() for o in overrides if not o.is_sweep_override()})
    resolved: Any = OmegaConf.to_container(OmegaConf.create(options), resolve=True)
    return Given(resolved, several)


def parse(text: str) -> Override:
    try:
        return OverridesParser.create().parse_override(text)
    except HydraException as error:
        raise ConfigError(f"cannot read {text!r}: {' '.join(str(error).split())}") from error


def choices(override: Override) -> list[Any]:
    """The values of an option that has several."""
    key = override.key_or_group
    if override.value_type is ValueType.GLOB_CHOICE_SWEEP:
        raise ConfigError(f"{override.input_line}: name the values, a pattern has none")
    found = [parse(f"{key}={text}").value() for text in override.sweep_string_iterator()]
    for value in found:
        if found.count(value) > 1:
            raise ConfigError(f"{key}={value} occurs twice")
    return found


def names_in(override: Override) -> list[str]:
    """The values of env= or algo=."""
    several = override.is_sweep_override()
    return [str(v) for v in (override.sweep_iterator() if several else [override.value()])]


def load_named(override: Override) -> None:
    if override.key_or_group in DEFAULT and not override.is_delete():
        for name in names_in(override):
            load(override.key_or_group, name)


def check_kind(override: Override) -> None:
    if override.type is not OverrideType.CHANGE or override.package is not None:
        text = override.input_line
        raise ConfigError(f"{text}: options are set with key=value, without '+', '~' or '@'")


# ---- with it: scripts/train.py ---------------------------------------------------------------


def each_job(argv: list[str], job: Callable[[dict[str, Any], int | None], None]) -> None:
    """Let Hydra compose the arguments and call `job(config, number)`: once, or for each run of a
    --multirun with its number. --help and --cfg print instead.

    Raises:
        ConfigError: something that no run could use, with the nearest valid name.
    """

    def called(config: Any) -> None:
        several = HydraConfig.get().mode == RunMode.MULTIRUN
        plain: Any = OmegaConf.to_container(config, resolve=True)
        job(plain, HydraConfig.get().job.num if several else None)

    request = read(argv)
    register(request)
    sys.argv[1:] = request.argv
    os.environ["HYDRA_FULL_ERROR"] = "1"  # raise, do not print
    try:
        hydra.main(version_base="1.3", config_path=None, config_name="train")(called)()
    except ValueError as error:
        if not str(error).startswith("Only one of --run"):  # Hydra's, of its own flags
            raise
        fail(str(error))


def read(argv: list[str]) -> Request:
    """Check every argument of train.py against the registries.

    Raises:
        ConfigError: something that no run could use, with the nearest valid name.
    """
    parser = get_args_parser()
    parser.error = fail  # type: ignore[method-assign]
    args, unknown = parser.parse_known_args(argv)
    if unknown:
        raise ConfigError(f"unknown flag {unknown[0]}; options are written key=value, see --help")
    if args.experimental_rerun:
        raise ConfigError("--experimental-rerun reads a pickle; use resume=RUN_DIR")
    flags = list(argv)
    for text in args.overrides:
        flags.remove(text)
    overrides = [parse(text) for text in args.overrides]
    given = {o.key_or_group: o for o in overrides}
    for override in overrides:
        load_named(override)
    if args.multirun and given.keys() & {*distributed.OPTIONS}:
        raise ConfigError(f"{', '.join(distributed.OPTIONS)} are for one run, without --multirun")
    for name in ONE_VALUE:
        if name in given and given[name].is_sweep_override():
            raise ConfigError(f"{name} takes one value, not a sweep")
    top = {name: given[name].value() for name in ONE_VALUE if name in given}
    names: dict[str, list[Any]] = {
        kind: names_in(given[kind]) if kind in given else [None] for kind in DEFAULT
    }
    known = [defaults_of(top, {"env": e, "algo": a}) for e in names["env"] for a in names["algo"]]
    chosen = {kind: {each[kind]["name"]: each[kind] for each in known} for kind in DEFAULT}
    texts = []
    for override in overrides:
        text = override.input_line or ""
        if not override.is_hydra_override():
            check_kind(override)
            for each in known:
                check_option(override.key_or_group, each)
            if override.is_sweep_override() and not args.multirun:
                raise ConfigError(
                    f"{text}: several values need --multirun (-m); a list is written [a,b]"
                )
            if override.key_or_group in DEFAULT:
                text = f"{override.key_or_group}={','.join(chosen[override.key_or_group])}"
        texts.append(text)
    # Hydra adds a name to a dict, or to what was null, only if told to, and after the dict itself
    alone = [text for text in texts if text.startswith(f"algo.{NAMED}.")]
    texts = [text for text in texts if text not in alone] + [f"++{text}" for text in alone]
    base = {k: v for k, v in known[0].items() if k not in DEFAULT}
    base |= {k: v for k, v in top.items() if k != "resume" or isinstance(v, str)}
    if isinstance(top.get("resume"), str):
        return Request([*flags, *texts], base, chosen)
    # Hydra copies every entry again and again, so one that nobody chooses is known by its name only
    sweeper = any(o.key_or_group.startswith(("hydra.sweeper", "hydra/sweeper")) for o in overrides)
    entries = {
        "env": {name: env_options(name) if sweeper else {} for name in envs.ENVS},
        "algo": {
            name: {"name": name, **algo_options(row, base["preset"], base["compat"])} if sweeper else {}
            for name, row in algos.ALGOS.items()
        },
    }
    return Request([*flags, *texts], base, {kind: entries[kind] | chosen[kind] for kind in DEFAULT})


def env_options(name: str) -> dict[str, Any]:
    return {"name": name, **find_env(name)[1].defaults}


def register(request: Request) -> None:
    """Give Hydra the groups and their defaults, so that --help and --cfg show every option."""
    store = ConfigStore.instance()
    for group, options in request.groups.items():
        for name, node in options.items():
            store.store(group=group, name=name, node=OmegaConf.create(to_plain(node)))
    first = {
        group: DEFAULT[group] if DEFAULT[group] in g else next(iter(g))
        for group, g in request.groups.items()
    }
    node = {
        "defaults": [
            *({group: name} for group, name in first.items()),
            "_self_",
            {"override hydra/job_logging": "none"},
            {"override hydra/hydra_logging": "none"},
        ],
        **to_plain(request.base),
        "hydra": {
            "run": {"dir": "."},
            "sweep": {"dir": "runs/.multirun", "subdir": "."},
            "output_subdir": None,
            "job": {"name": "train", "chdir": False},
            "help": {
                "header": "python scripts/train.py env=car_push1 algo=cpo [key=value ...]",
                "footer": "Several values with -m: seed=0,1,2. A list is written [a,b].",
            },
        },
    }
    store.store(name="train", node=OmegaConf.create(node))


def fail(message: str) -> NoReturn:
    """What an argparse parser does with an error here."""
    raise ConfigError(message)

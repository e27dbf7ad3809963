"""The command line: `key=value` arguments as plain values, and Hydra around a training command.

This is the only module that knows Hydra and its grammar. Arguments are checked before Hydra sees them,
because its own errors are long.
"""

import argparse
import contextlib
import math
import os
import re
import sys
from collections.abc import Callable
from typing import Any, NamedTuple, NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override, OverrideType, RangeSweep
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from jaxsafe import algos, envs
from jaxsafe.config import ConfigError, convert, kind_in_words
from jaxsafe.run import distributed
from jaxsafe.run.plain import repeated, to_plain
from jaxsafe.run.settings import (
    COST_LIMITS,
    DEFAULT,
    MOST,
    Settings,
    algo_options,
    check_agreement,
    check_option,
    defaults_of,
    find_env,
    load,
    nested,
    settings_from_config,
    settings_from_options,
)

ERRORS = (HydraException, OmegaConfBaseException)  # of arguments that only Hydra can judge
ONE_VALUE = ("preset", "compat", "resume")


class Request(NamedTuple):
    """What the arguments of train.py say before Hydra composes them."""

    argv: list[str]  # for Hydra: aliases replaced
    base: dict[str, Any]  # top-level defaults, or those of the run to continue
    groups: dict[str, dict[str, dict[str, Any]]]  # 'env' and 'algo': name -> options, if chosen
    texts: list[str]  # the overrides in argv
    printed: bool  # --cfg: the config is printed, and no job is called


class JobFailed(Exception):
    """A job of a --multirun, in a process of its own, ended with this exit status."""


class Given(NamedTuple):
    """What the arguments of a sweep say."""

    options: dict[str, Any]  # those with one value, as `settings_from_options` takes them
    several: dict[str, list[Any]]  # those with several, by name: 'seed', 'env', 'algo.clip'


# ---- without Hydra's composition -------------------------------------------------------------


def compose(texts: list[str]) -> Settings:
    """The settings that train.py would have from these arguments."""
    given = read_values(texts)
    for name in given.several:
        raise ConfigError(f"{name}: expected one value")
    return settings_from_options(given.options)


def read_values(texts: list[str]) -> Given:
    """The values of `key=value` and `key=value,value,...`, with environments and algorithms that are
    the user's code imported.

    Raises:
        ConfigError: an argument that cannot be read, or that is no `key=value`.
    """
    overrides = [parse(text) for text in texts]
    check_grid(overrides)
    for override in overrides:
        check_kind(override)
        import_named_code(override)
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
    found = [parse(f"{key}={text}").value() for text in override.sweep_string_iterator()]
    if (value := repeated(found)) is not None:
        raise ConfigError(f"{key}={value} occurs twice")
    return found


def check_grid(overrides: list[Override]) -> None:
    """Refuse more settings than anybody trains, before they are listed."""
    count = math.prod(count_of(o) for o in overrides if o.is_sweep_override())
    if count > MOST:
        raise ConfigError(f"{count:,} settings: expected at most {MOST:,} in a sweep")


def count_of(override: Override) -> int:
    """How many values an option has, at least 1."""
    value, text = override.value(), override.input_line
    if isinstance(value, RangeSweep):
        ends = [float(x) for x in (value.start, value.stop, value.step) if x is not None]
        if len(ends) < 3 or not all(map(math.isfinite, ends)) or not ends[2]:
            raise ConfigError(f"{text}: expected range(start,stop,step) of finite numbers, step not 0")
        count = math.ceil((ends[1] - ends[0]) / ends[2])
    elif isinstance(value, ChoiceSweep):
        count = len(value.list)
    else:
        raise ConfigError(f"{text}: name the values; a pattern or an interval has none")
    if count < 1:
        raise ConfigError(f"{text} holds no value")
    return count


def names_in(override: Override) -> list[str]:
    """The values of env= or algo=."""
    several = override.is_sweep_override()
    values = override.sweep_iterator() if several else [override.value()]
    return [convert(value, str, override.key_or_group) for value in values]


def import_named_code(override: Override) -> None:
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
    --multirun with its number. --cfg prints instead. A launcher of Hydra's may call `job` in
    another process or on another host, to which `called` is pickled.

    Raises:
        ConfigError: something that no run could use, with the nearest valid name.
        SystemExit: `job` raised it, here or there.
    """
    home = os.getpid()

    def called(config: Any) -> None:
        hydra_config = HydraConfig.get()
        several = hydra_config.mode == RunMode.MULTIRUN
        for text in hydra_config.overrides.task:  # as typed; a process of its own has yet to import
            import_named_code(parse(text))
        plain: Any = OmegaConf.to_container(config, resolve=True)
        try:
            job(plain, hydra_config.job.num if several else None)
        except SystemExit as end:  # no launcher can bring this back from a process of its own
            if os.getpid() == home:
                raise
            raise JobFailed(end.code) from None

    request = check_arguments(argv)
    register(request)
    if request.printed and not {"-m", "--multirun"} & {*request.argv}:
        with hydra.initialize(version_base="1.3", config_path=None):
            config: Any = hydra.compose("train", request.texts)
        settings_from_config(OmegaConf.to_container(config, resolve=True))  # type: ignore[arg-type]
    sys.argv[1:] = request.argv
    os.environ["HYDRA_FULL_ERROR"] = "1"  # raise, do not print
    try:
        hydra.main(version_base="1.3", config_path=None, config_name="train")(called)()
    except JobFailed as failed:  # the job's own output says why, Hydra's line which one
        raise SystemExit(*failed.args) from None
    except ValueError as error:
        if not str(error).startswith("Only one of --run"):  # Hydra's, of its own flags
            raise
        fail(str(error))


def check_arguments(argv: list[str]) -> Request:
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
    check_grid(overrides)
    given = {o.key_or_group: o for o in overrides}
    for override in overrides:
        import_named_code(override)
    if args.multirun and given.keys() & {*distributed.OPTIONS}:
        raise ConfigError(f"{', '.join(distributed.OPTIONS)} are for one run, without --multirun")
    for name in ONE_VALUE:
        if name in given and given[name].is_sweep_override():
            raise ConfigError(f"{name} takes one value, not a sweep")
    top = {name: given[name].value() for name in ONE_VALUE if name in given}
    names: dict[str, list[Any]] = {
        kind: names_in(given[kind]) if kind in given else [None] for kind in DEFAULT
    }
    known = [
        defaults_of(top, {"env": e, "algo": a}, given=given)
        for e in names["env"]
        for a in names["algo"]
    ]
    chosen = {kind: {each[kind]["name"]: each[kind] for each in known} for kind in DEFAULT}
    for override in overrides:
        check_override(override, known, args.multirun)
    texts = [as_hydra_reads(override, chosen) for override in overrides]
    values = {name: o.value() for name, o in given.items() if not o.is_sweep_override()}
    check_agreement(values)
    # Hydra adds a name to a dict, or to what was null, only if told to, and after the dict itself
    alone = [text for text in texts if text.startswith(f"algo.{COST_LIMITS}.")]
    texts = [text for text in texts if text not in alone] + [f"++{text}" for text in alone]
    base = {k: v for k, v in known[0].items() if k not in DEFAULT}
    base |= {k: v for k, v in top.items() if k != "resume" or isinstance(v, str)}
    if isinstance(top.get("resume"), str):
        return Request([*flags, *texts], base, chosen, texts, bool(args.cfg))
    # Hydra copies every entry again and again, so one that nobody chooses is known by its name only
    sweeper = any(o.key_or_group.startswith(("hydra.sweeper", "hydra/sweeper")) for o in overrides)
    bare = {"env": {name: {} for name in envs.ENVS}, "algo": {name: {} for name in algos.ALGOS}}
    entries = every_entry(base) if sweeper else bare
    groups = {kind: entries[kind] | chosen[kind] for kind in DEFAULT}
    return Request([*flags, *texts], base, groups, texts, bool(args.cfg))


def check_override(override: Override, known: list[dict[str, Any]], multirun: bool) -> None:
    """Raise ConfigError for an option that one of the `known` defaults lacks, or that Hydra would read
    otherwise than it is meant."""
    text = override.input_line or ""
    if text.startswith("hydra/") and not isinstance(override.value(), str):
        raise ConfigError(f"{text}: expected a name")
    if override.is_hydra_override():
        return
    check_kind(override)
    for each in known:
        check_option(override.key_or_group, each)
    if override.is_sweep_override() and not multirun:
        raise ConfigError(f"{text}: several values need --multirun (-m); a list is written [a,b]")


def as_hydra_reads(override: Override, chosen: dict[str, dict[str, dict[str, Any]]]) -> str:
    """An argument as Hydra takes it, with the registered names of environments and algorithms."""
    kind = override.key_or_group
    if kind in DEFAULT and not override.is_hydra_override():
        return f"{kind}={','.join(chosen[kind])}"
    return override.input_line or ""


def every_entry(base: dict[str, Any]) -> dict[str, dict[str, dict[str, Any]]]:
    """Every environment and algorithm with its options, for a sweeper that chooses among them."""
    rows = {
        name: {"name": name, **algo_options(row, base["preset"], base["compat"])}
        for name, row in algos.ALGOS.items()
    }
    return {"env": {name: env_options(name) for name in envs.ENVS}, "algo": rows}


def env_options(name: str) -> dict[str, Any]:
    return {"name": name, **find_env(name)[1].defaults}


def register(request: Request) -> None:
    """Give Hydra the groups and their defaults, so that --cfg shows every option."""
    store = ConfigStore.instance()
    for group, options in request.groups.items():
        for name, node in options.items():
            store.store(group=group, name=name, node=OmegaConf.create(as_it_is(to_plain(node))))
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
        **as_it_is(to_plain(request.base)),
        "hydra": {
            "run": {"dir": "."},
            "sweep": {"dir": "runs/.multirun", "subdir": "."},
            "output_subdir": None,
            "job": {"name": "train", "chdir": False},
        },
    }
    store.store(name="train", node=OmegaConf.create(node))


def as_it_is(value: Any) -> Any:
    """Plain values that OmegaConf gives back as they are: a file may hold '${oc.env:HOME}' as text."""
    if isinstance(value, dict):
        return {k: as_it_is(v) for k, v in value.items()}
    if isinstance(value, list):
        return [as_it_is(v) for v in value]
    return re.sub(r"(\\*)\$\{", r"\1\1\\${", value) if isinstance(value, str) else value


def number(kind: Any) -> Callable[[str], Any]:
    """What argparse calls for an option that is a number within the bounds of the annotated `kind`."""

    def read(text: str) -> Any:
        value: Any = text
        with contextlib.suppress(ValueError):
            value = float(text)
            value = int(text)
        try:
            return convert(value, kind, "")
        except ConfigError as error:
            raise argparse.ArgumentTypeError(f"{text}: expected {kind_in_words(kind)}") from error

    return read


def fail(message: str) -> NoReturn:
    """What an argparse parser does with an error here."""
    raise ConfigError(message)

"""Hydra around a training command: it composes the arguments of train.py, and calls a job for each run.

each_job
  check_arguments    what was typed is checked against the registries, and put as Hydra reads it
    read_arguments
  register           Hydra is told the options of environments and algorithms
  as_hydra_calls     what Hydra then calls
"""

import os
import re
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override
from hydra.errors import MissingConfigException
from hydra.types import RunMode
from omegaconf import OmegaConf

from jaxsafe import algos, envs
from jaxsafe.config import ConfigError
from jaxsafe.run import distributed
from jaxsafe.run.arguments import check_grid, check_kind, choices, import_named_code, names_in, parse
from jaxsafe.run.flags import Parser
from jaxsafe.run.plain import to_plain
from jaxsafe.run.settings import (
    COST_LIMITS,
    DEFAULT,
    algo_options,
    check_agreement,
    check_length,
    check_option,
    defaults_of,
    find_env,
    settings_from_config,
)

ONE_VALUE = ("preset", "compat", "resume")  # they choose the defaults of all other options
LENGTHS = ("total_steps", "total_updates", "dataset")  # they say when a run ends
Job = Callable[[dict[str, Any], int | None], None]
Groups = dict[str, dict[str, dict[str, Any]]]  # 'env' and 'algo': name -> options


class Typed(NamedTuple):
    """The arguments of train.py as they were typed."""

    flags: list[str]  # Hydra's own
    overrides: list[Override]
    multirun: bool
    printed: bool  # --cfg: the config is printed, and no job is called
    files: bool  # --config-dir or --config-path: Hydra reads files of the user's

    @property
    def by_name(self) -> dict[str, Override]:
        return {o.key_or_group: o for o in self.overrides}


class Request(NamedTuple):
    """What Hydra is asked to compose."""

    typed: Typed
    texts: list[str]  # the overrides, as Hydra reads them
    base: dict[str, Any]  # the options beside env and algo: defaults, or those of the run to continue
    groups: Groups  # only what was chosen has its options

    @property
    def argv(self) -> list[str]:
        return [*self.typed.flags, *self.texts]


class JobFailed(Exception):
    """A job of a --multirun, in a process of its own, ended with this exit status."""


# ---- jobs --------------------------------------------------------------------------------------


def each_job(argv: list[str], job: Job) -> None:
    """Let Hydra compose the arguments and call `job(config, number)`: once, or for each run of a
    --multirun with its number. --cfg prints instead. A launcher of Hydra's may call `job` in
    another process or on another host.

    Raises:
        ConfigError: something that no run could use, with the nearest valid name.
        SystemExit: `job` raised it, here or there.
    """
    request = check_arguments(argv)
    register(request)
    if request.typed.printed and not request.typed.multirun:
        with hydra.initialize(version_base="1.3", config_path=None):
            config: Any = hydra.compose("train", request.texts)
        plain: Any = OmegaConf.to_container(config, resolve=True)
        settings_from_config(plain)
    sys.argv[1:] = request.argv
    os.environ["HYDRA_FULL_ERROR"] = "1"  # raise, do not print
    try:
        hydra.main(version_base="1.3", config_path=None, config_name="train")(as_hydra_calls(job))()
    except JobFailed as failed:  # the job's own output says why, Hydra's line which one
        raise SystemExit(*failed.args) from None
    except MissingConfigException as error:
        group, _, name = (error.missing_cfg_file or "").rpartition("/")
        if group != "hydra/launcher":
            raise
        raise ConfigError(
            f"hydra/launcher={name}: it is not installed; pip install 'jaxsafe[launchers]' brings "
            "joblib, submitit_local and submitit_slurm"
        ) from None
    except ValueError as error:
        if not str(error).startswith("Only one of --run"):  # Hydra's, of its own flags
            raise
        raise ConfigError(str(error)) from None


def as_hydra_calls(job: Job) -> Callable[[Any], None]:
    """`job` with the config alone. Launchers pickle it to other processes."""
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

    return called


# ---- arguments ---------------------------------------------------------------------------------


def read_arguments(argv: list[str]) -> Typed:
    """Hydra's flags apart from `key=value`, with environments and algorithms that are the user's code
    imported."""
    parser = get_args_parser()
    parser.error = Parser().error  # type: ignore[method-assign] (the parser is Hydra's own)
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
    for override in overrides:
        import_named_code(override)
    files = bool(args.config_dir or args.config_path)
    return Typed(flags, overrides, args.multirun, bool(args.cfg), files)


def check_arguments(argv: list[str]) -> Request:
    """Check every argument of train.py against the registries.

    Raises:
        ConfigError: something that no run could use, with the nearest valid name.
    """
    typed = read_arguments(argv)
    given = typed.by_name
    if typed.multirun and given.keys() & {*distributed.OPTIONS}:
        raise ConfigError(f"{', '.join(distributed.OPTIONS)} are for one run, without --multirun")
    check_sweeper(typed)
    for name in ONE_VALUE:
        if name in given and given[name].is_sweep_override():
            raise ConfigError(f"{name} takes one value, not a sweep")
    top = {name: given[name].value() for name in ONE_VALUE if name in given}
    general = {"preset": "fast"} if swept_otherwise(typed) else {}  # what it will choose is not known
    if general and top.get("preset") == "auto":
        raise ConfigError("preset=auto: a sweeper may choose any task; name one, such as preset=fast")
    known = every_default(typed, general | top)
    check_presets(known)
    if not given.keys() & {*LENGTHS}:
        check_lengths(known)
    chosen = {kind: {each[kind]["name"]: each[kind] for each in known} for kind in DEFAULT}
    for override in typed.overrides:
        check_override(override, known, typed.multirun)
    check_agreement({name: o.value() for name, o in given.items() if not o.is_sweep_override()})
    base = {k: v for k, v in known[0].items() if k not in DEFAULT}
    base |= {"preset": "auto"} if several(known) else {}  # each job has its own
    base |= {k: v for k, v in top.items() if v is not True}  # resume=true names no folder
    lengths = {name: given[name] for name in LENGTHS if name in given}
    firsts = {k: choices(o)[0] if o.is_sweep_override() else o.value() for k, o in lengths.items()}
    check_length(firsts, base)
    texts = as_hydra_reads(typed.overrides, chosen)
    return Request(typed, texts, base, groups_of(typed, chosen, base))


def every_default(typed: Typed, top: dict[str, Any]) -> list[dict[str, Any]]:
    """The defaults of each environment with each algorithm that was chosen, as of `defaults_of`."""
    given = typed.by_name
    names: dict[str, list[Any]] = {
        kind: names_in(given[kind]) if kind in given else [None] for kind in DEFAULT
    }
    return [
        defaults_of(top, {"env": env, "algo": algo}, given=given)
        for env in names["env"]
        for algo in names["algo"]
    ]


def check_lengths(known: list[dict[str, Any]]) -> None:
    """Raise ConfigError where algorithms of a sweep have different lengths: Hydra composes one."""
    steps = {each["algo"]["name"]: each["total_steps"] for each in known}
    if len({*steps.values()}) > 1:
        each = ", ".join(f"{count:,} of {algo}" for algo, count in steps.items())
        raise ConfigError(f"total_steps are {each} by default; give one, such as total_steps=1e7")


def check_sweeper(typed: Typed) -> None:
    """Raise ConfigError for `hydra.sweeper.params`, unless it changes those of a sweeper in the user's
    files. Hydra's own sweepers have none that an argument could change, and Hydra fails on it."""
    if typed.files and "hydra/sweeper" in typed.by_name:
        return
    for name, override in typed.by_name.items():
        if name.startswith("hydra.sweeper.params"):
            raise ConfigError(
                f"{override.input_line}: an option takes its values itself, as in -m algo.lr=1,2"
            )


def swept_otherwise(typed: Typed) -> bool:
    """Whether a sweeper may pick environments and algorithms itself: its options name env or algo, or
    files of the user's may."""
    set_in = [
        o for o in typed.overrides if o.key_or_group.startswith(("hydra.sweeper", "hydra/sweeper"))
    ]
    names = {name for o in set_in for name in (*o.key_or_group.split("."), *names_within(o.value()))}
    return bool(set_in) and (typed.files or not names.isdisjoint(DEFAULT))


def names_within(value: Any) -> set[str]:
    """The names in dicts in dicts."""
    return {*value}.union(*map(names_within, value.values())) if isinstance(value, dict) else set()


def several(known: list[dict[str, Any]]) -> bool:
    """Whether the `known` defaults are of several presets."""
    return len({each["preset"] for each in known}) > 1


def check_presets(known: list[dict[str, Any]]) -> None:
    """Raise ConfigError where tasks of a sweep have different defaults of an algorithm: Hydra composes
    one set of options for each."""
    first: dict[str, dict[str, Any]] = {}
    for each in known:
        before = first.setdefault(each["algo"]["name"], each)
        if several([before, each]):
            tasks = ", ".join(f"{x['preset']} on {x['env']['name']}" for x in (before, each))
            raise ConfigError(
                f"the defaults of {each['algo']['name']} are {tasks}; give one, such as preset=fast"
            )


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


def as_hydra_reads(overrides: list[Override], chosen: Groups) -> list[str]:
    """Overrides as Hydra takes them.

    Environments and algorithms have their registered names. Hydra adds a name to a dict, as to
    `cost_limits`, or to what was null, only with '++', and after the dict itself.
    """
    texts, named_limits = [], []
    for override in overrides:
        kind, text = override.key_or_group, override.input_line or ""
        if text.startswith(f"algo.{COST_LIMITS}."):
            named_limits.append(f"++{text}")
        elif kind in DEFAULT and not override.is_hydra_override():
            texts.append(f"{kind}={','.join(chosen[kind])}")
        else:
            texts.append(text)
    return [*texts, *named_limits]


# ---- what Hydra knows --------------------------------------------------------------------------


def groups_of(typed: Typed, chosen: Groups, base: dict[str, Any]) -> Groups:
    """The environments and algorithms that Hydra can choose from.

    Hydra copies every entry again and again, so one that nobody chooses is known by its name only,
    unless a sweeper may choose it.
    """
    if isinstance(base["resume"], str):
        return chosen
    if swept_otherwise(typed):
        entries = every_entry(base["preset"], base["compat"])
    else:
        entries = {"env": {name: {} for name in envs.ENVS}, "algo": {name: {} for name in algos.ALGOS}}
    return {kind: entries[kind] | chosen[kind] for kind in DEFAULT}


def every_entry(preset: str, compat: str) -> Groups:
    """Every environment and algorithm with its options."""
    return {
        "env": {name: {"name": name, **find_env(name)[1].defaults} for name in envs.ENVS},
        "algo": {
            name: {"name": name, **algo_options(row, preset, compat)}
            for name, row in algos.ALGOS.items()
        },
    }


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

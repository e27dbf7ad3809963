"""What a run is made of: plain values in, checked settings out.

`settings_from_config` is the only way from plain values to `Settings`, whether they come from a
config.yaml, from the command line or from Python. `settings_from_options` first fills in what its
caller left out. The names of a run's environment and algorithm are resolved here alone, by `find_env`
and `find_algo`.
"""

import contextlib
import dataclasses
import difflib
import functools
import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from jaxsafe import algos, envs
from jaxsafe.algos import Row
from jaxsafe.config import (
    OWN_CODE,
    Amount,
    Bounds,
    ConfigError,
    Devices,
    MissingObject,
    Period,
    RunSteps,
    Seed,
    UnnamedCode,
    check_values,
    convert,
    flat,
    from_dict,
    is_float,
    nearest,
    shown,
)
from jaxsafe.envs.safety_gym import scene
from jaxsafe.learn.constraints import check_cost_names, limits_by_name
from jaxsafe.run import run_folder
from jaxsafe.run.compat import COMPAT, overrides
from jaxsafe.run.plain import as_text, differences, merged, repeated, replaced, to_plain, together
from jaxsafe.types import Env

DEFAULT = {"env": "point_goal1", "algo": "ppo_lag"}
# options that may change when a run is resumed
ON_RESUME = (
    "total_steps",
    "total_updates",
    "checkpoint_every",
    "checkpoint_iterations",
    "checkpoint_replay",
    "eval_every",
    "eval_episodes",
    "video",
)
# options that do not tell two runs apart
NOT_COMPARED = ("run_dir", "resume", "logger", *ON_RESUME)
OFFLINE_UPDATES = 100_000  # total_updates with a data set, unless the user says otherwise
READ_FROM = ("dataset", "init_from", "env.robot_base")  # options that name a file or folder to read
MOST_MEMBERS = 2**16  # settings x seeds of one run
MOST = 10_000  # settings of a sweep
PATHS = ("run_dir", "resume", "dataset", "init_from")  # options that are paths, if they are strings
COST_LIMITS = "cost_limits"  # an option of algorithms: floats by name, as {hazards: 10}


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """The settings beside `env` and `algo`."""

    # environment steps of each seed, rounded up to whole updates; the default is the algorithm's
    total_steps: RunSteps = 10_000_000
    # gradient steps of each seed; if given, they end the run. null: total_steps, or 100,000 with a data
    # set
    total_updates: RunSteps | None = None
    num_envs: Amount | None = None  # environments of each seed; null: algo.num_envs
    # how many seeds are trained at once: seed, seed + 1, ...
    num_seeds: Annotated[int, Bounds(1, 2**16)] = 1
    seed: Seed = 0  # the first seed
    # devices over which the seeds are split or, of a lone seed, its environments
    devices: Devices = 1
    # host:port of process 0, for one run in several processes; SLURM tells this and the next two
    coordinator: str | None = None
    num_processes: Devices | None = None  # how many processes there are
    process_index: Period | None = None  # which of them this is, from 0
    # the algorithm's defaults: fast, published, or another of docs/choosing.md. auto: those that were
    # found to suit the task, fast where none were
    preset: str = "auto"
    compat: str = "none"  # whose departures from the papers to follow: none, or omnisafe
    run_dir: str | None = None  # the run folder; null: runs/ENV-ALGO/TIME-seedN
    # true: go on in run_dir or, without it, with the newest unfinished run of these settings; or the
    # folder of a run
    resume: bool | str = False
    dataset: str | None = None  # the file that an offline algorithm learns from
    init_from: str | None = None  # a run folder whose policy to start from
    checkpoint_every: Annotated[float, Bounds(0, 1e9)] = 60.0  # seconds between checkpoints
    # also a checkpoint after so many iterations; 0: by time alone
    checkpoint_iterations: Period = 0
    # whether checkpoints keep the replay, to resume bit for bit; null: up to 2 GB
    checkpoint_replay: bool | None = None
    # also evaluate after so many environment steps or, offline, gradient steps; 0: at the end alone
    eval_every: Period = 0
    # episodes of an evaluation, for each seed; 0: no evaluation, also not at the end
    eval_episodes: Annotated[int, Bounds(0, 10**6)] = 20
    video: bool = True  # film the first seed's policy at the end
    logger: Literal["none", "wandb"] = "none"  # where metrics go beside the run folder

    def __post_init__(self) -> None:
        check_values(self)
        for name in PATHS:
            value = getattr(self, name)
            if isinstance(value, str) and (not value or "\0" in value):
                raise ConfigError(f"{name}={value!r}: expected a path")
        if self.eval_every and not self.eval_episodes:
            raise ConfigError(f"eval_every={self.eval_every}: expected eval_episodes of at least 1")
        if self.seed + self.num_seeds > 2**31:
            raise ConfigError(f"seed={self.seed}: expected less than {2**31 - self.num_seeds + 1}")

    @property
    def seeds(self) -> range:
        """Every seed of a setting."""
        return range(self.seed, self.seed + self.num_seeds)


class EnvEntry(NamedTuple):
    """What the name of an environment stands for."""

    defaults: dict[str, Any]  # every option, as plain values
    make: Callable[..., Env]  # make(**options): those that differ from the defaults
    check: Callable[..., object]  # check(**options) refuses what `make` would, and builds nothing


class Extras(NamedTuple):
    """Environments and algorithms by name, beside the registered ones: a caller's own objects."""

    envs: Mapping[str, EnvEntry] = {}
    algos: Mapping[str, Row] = {}


NO_EXTRAS = Extras()


class Settings(NamedTuple):
    """Everything a run is made of, checked, with the extras that its names were resolved to."""

    env_name: str
    env_entry: EnvEntry
    env_options: dict[str, Any]  # all of them
    algo_name: str
    row: Row
    configs: tuple[Any, ...]  # the algorithm's, one a setting; they differ in floats alone
    train: TrainConfig

    @property
    def label(self) -> str:
        """What folders of such runs are called."""
        return f"{self.env_name}-{self.algo_name}".replace(":", ".")

    @property
    def algo(self) -> Any:
        """The config of the first setting, for what all settings have in common."""
        return self.configs[0]

    @property
    def num_members(self) -> int:
        """Policies that the run trains: each seed of each setting."""
        return len(self.configs) * self.train.num_seeds

    @property
    def extras(self) -> Extras:
        """What another run folder with the same names is resolved with."""
        return Extras({self.env_name: self.env_entry}, {self.algo_name: self.row})

    def plain(self) -> dict[str, Any]:
        """As config.yaml has it: a float in which the settings differ is a list of one a setting."""
        algo = together([dataclasses.asdict(cfg) for cfg in self.configs])
        train = dataclasses.asdict(self.train)
        return to_plain(
            {
                "env": {"name": self.env_name, **self.env_options},
                "algo": {"name": self.algo_name, **algo},
                **{k: v for k, v in train.items() if k not in run_folder.COMMAND_ONLY},
            }
        )


# ---- from plain values to settings -----------------------------------------------------------


def settings_from_config(config: dict[str, Any], extras: Extras = NO_EXTRAS) -> Settings:
    """Plain values as checked settings.

    Args:
        config: as config.yaml has it: {'env': {'name': ...}, 'algo': {'name': ...}, 'seed': 0, ...}.
            An option that is missing has the default of the code, whatever the preset. A missing
            preset is fast, whatever the task.
        extras: environments and algorithms beside the registered ones.
    Raises:
        ConfigError: an unknown name, a wrong type, or a value out of bounds.
    """
    top, groups = parted(config)
    env, algo = groups["env"], groups["algo"]
    env_name, entry = find_env(env.pop("name", None), extras)
    algo_name = algo.pop("name", None)
    row = find_algo(algo_name, extras)
    train = from_dict(TrainConfig, {"preset": "fast", **top})
    train = dataclasses.replace(train, preset=preset_for(env_name, row, train.preset))
    if train.dataset is not None and train.total_updates is None:
        train = dataclasses.replace(train, total_updates=OFFLINE_UPDATES)
    if train.num_envs is not None:
        if "num_envs" not in {f.name for f in dataclasses.fields(row.config)}:
            raise ConfigError(f"num_envs={train.num_envs}: {algo_name} trains without environments")
        default = algo_options(row, train.preset, train.compat)["num_envs"]
        if algo.get("num_envs", default) != default:
            check_agreement({"num_envs": train.num_envs, "algo.num_envs": algo["num_envs"]})
        algo["num_envs"] = train.num_envs
    for name in env:
        if name not in entry.defaults:
            raise ConfigError(f"unknown option env.{name}{nearest(name, entry.defaults)}")
    configs = tuple(from_dict(row.config, one, "algo.") for one in settings_in(algo, row.config))
    if (members := len(configs) * train.num_seeds) > MOST_MEMBERS:
        raise ConfigError(
            f"num_seeds={train.num_seeds}: expected at most {MOST_MEMBERS:,} settings x seeds in a "
            f"run, not {members:,}"
        )
    options = to_plain({**entry.defaults, **env})
    entry.check(**changed_options(options, entry))
    return Settings(env_name, entry, options, algo_name, row, configs, train)


def settings_of_run(config: dict[str, Any], extras: Extras) -> Settings:
    """`settings_from_config` of what `run_folder.read_config` finds in a run folder.

    Raises:
        MissingObject: the run was trained with an object that `extras` lacks.
        ConfigError: as of `settings_from_config`.
    """
    environments = {*envs.ENVS, *envs.ALIASES, *extras.envs}
    for kind, known in ("env", environments), ("algo", {*algos.ALGOS, *extras.algos}):
        name = config[kind]["name"]
        if name not in known and ":" not in name:
            raise MissingObject(kind, name)
    return settings_from_config(config, extras)


def settings_from_options(given: dict[str, Any], extras: Extras = NO_EXTRAS) -> Settings:
    """Settings from the options that somebody gives, which are checked by name.

    Args:
        given: as of `settings_from_config`, with any option left out. NumPy's numbers, arrays, tuples
            and paths are taken as the plain values that they stand for. What is left out has the
            defaults of the preset and of compat or, where `resume` is a folder, the settings of the
            run in it.
        extras: as of `settings_from_config`.
    Raises:
        ConfigError: as of `settings_from_config`, with the nearest valid name.
    """
    top, groups = parted(to_plain(given))
    names = {kind: group.get("name") for kind, group in groups.items()}
    base = defaults_of(top, names, extras, flat({**top, **groups}))
    for group in groups.values():
        group.pop("name", None)  # `base` has it, as it is registered
    for name in (given := flat({**top, **groups})):
        check_option(name, base)
    check_agreement(given)
    check_length(given, base)
    return settings_from_config(merged(base, {**top, **groups}), extras)


def defaults_of(
    top: dict[str, Any],
    names: Mapping[str, str | None],
    extras: Extras = NO_EXTRAS,
    given: Collection[str] = (),
) -> dict[str, Any]:
    """Every option with its default, as config.yaml has it.

    Args:
        top: the options beside env and algo that are given.
        names: of 'env' and 'algo'; None is the default one.
        extras: as of `settings_from_config`.
        given: the names of all options that the user gives, as `flat` has them.
    Raises:
        ConfigError: an unknown name, preset or compat, or no run in `resume`.
    """
    if isinstance(resume := top.get("resume"), str):
        return resumed(Path(resume).expanduser(), names, extras, given)
    base = {**dataclasses.asdict(TrainConfig()), **top}
    preset, compat = str(base["preset"]), check_compat(str(base["compat"]))
    env_name, entry = find_env(names["env"] or DEFAULT["env"], extras)
    algo_name = names["algo"] or DEFAULT["algo"]
    row = find_algo(algo_name, extras)
    check_preset(algo_name, row, preset)
    preset = preset_for(env_name, row, preset)
    return dataclasses.asdict(TrainConfig(total_steps=row.total_steps, preset=preset)) | {
        "env": {"name": env_name, **entry.defaults},
        "algo": {"name": algo_name, **algo_options(row, preset, compat)},
    }


def resumed(
    folder: Path, names: Mapping[str, str | None], extras: Extras, given: Collection[str]
) -> dict[str, Any]:
    """Every option of the run in `folder`, which must be of this environment and algorithm."""
    saved = settings_of_run(run_folder.read_config(folder), extras)
    asked = names["env"] and find_env(names["env"], extras)[0]
    for kind, name, there in (
        ("env", asked, saved.env_name),
        ("algo", names["algo"], saved.algo_name),
    ):
        if name not in (None, there):
            raise ConfigError(f"{kind}={name}: {folder} was trained with {there}")
    begun = run_folder.newest_progress(folder) is not None  # then it starts from no other run
    check_read_from(saved, folder, {*given, "init_from"} if begun else given)
    options = dataclasses.asdict(TrainConfig()) | saved.plain()
    if "algo.num_envs" in given:  # what is typed replaces the number by both of its names
        options["num_envs"] = None
    elif "num_envs" in given and "num_envs" in options["algo"]:
        train = saved.train
        options["algo"]["num_envs"] = algo_options(saved.row, train.preset, train.compat)["num_envs"]
    return options


def acts_by(row: Row) -> list[str]:
    """The settings that a trained policy acts by, of which it may have other values."""
    return [name for cls in row.config.__mro__ for name in vars(cls).get("ACTS_BY", ())]


def acting(settings: Settings, given: Mapping[str, Any]) -> Settings:
    """Settings of a run, with other values of those that its policies act by.

    Args:
        given: by name, without 'algo.'.
    Raises:
        ConfigError: a setting by which they do not act, one in which the run's settings differ, or a
            wrong value.
    """
    known, whose = acts_by(settings.row), settings.algo_name
    for name in given:
        if not known:
            raise ConfigError(f"algo.{name}: no setting of {whose} may change after training")
        if name not in known:
            raise ConfigError(
                f"algo.{name}: expected a setting of {whose} that may change after training"
                f"{nearest(name, known)}"
            )
        if len({getattr(cfg, name) for cfg in settings.configs}) > 1:
            raise ConfigError(f"algo.{name}: the run has several; expected a run of one")
    return settings_from_config(merged(settings.plain(), {"algo": {**given}}), settings.extras)


def check_read_from(saved: Settings, folder: Path, given: Collection[str]) -> None:
    """Raise ConfigError where the config of a run folder names a file or folder to read. It is read
    only if the user gives the option, too.

    Args:
        saved: the run's settings.
        folder: where they were read.
        given: the names of the options that the user gives.
    """
    for name, path in files_named(saved).items():
        if name not in given:
            raise ConfigError(
                f"{folder} names {name}={path}, which is not read because a file names it; if you "
                f"trust it, add {name}={path}"
            )


def files_named(settings: Settings) -> dict[str, Any]:
    """The options that name a file or folder to read, beside our own robots."""
    plain = flat(settings.plain())
    robot = plain.get("env.robot_base")
    if robot == settings.env_entry.defaults.get("robot_base") or scene.built_in(str(robot)):
        plain["env.robot_base"] = None
    return {name: plain[name] for name in READ_FROM if plain.get(name) is not None}


def yours(settings: Settings) -> dict[str, Any]:
    """The options that no run folder may set: the user's code and files, and the logger. A command that
    continues the run gives them again. Only a fresh run reads `init_from`."""
    names = {"env": settings.env_name, "algo": settings.algo_name}
    named = {k: v for k, v in files_named(settings).items() if k != "init_from"}
    logger = settings.train.logger
    named |= {"logger": logger} if logger != "none" else {}
    return {kind: name for kind, name in names.items() if ":" in name} | named


def find_env(name: str, extras: Extras = NO_EXTRAS) -> tuple[str, EnvEntry]:
    """The name under which an environment is registered, and its entry."""
    if convert(name, str, "env") in extras.envs:
        return name, extras.envs[name]
    make, check = functools.partial(envs.make, name), functools.partial(envs.check_options, name)
    return envs.canonical(name), EnvEntry(to_plain(envs.env_defaults(name)), make, check)


def find_algo(name: str, extras: Extras = NO_EXTRAS) -> Row:
    known = {**algos.ALGOS, **extras.algos}
    if convert(name, str, "algo") in known:
        return known[name]
    if ":" in name:
        raise UnnamedCode("algo", name)
    raise ConfigError(f"unknown algo {name!r}{nearest(name, known, OWN_CODE)}")


def load(kind: str, name: str) -> None:
    """Import the 'env' or 'algo' called `name` if it is 'module:name'. Only for a name that the user
    gave: what a run folder names is never imported."""
    if ":" in name:
        {"env": envs.load, "algo": algos.load}[kind](name)


def algo_options(row: Row, preset: str = "fast", compat: str = "none") -> dict[str, Any]:
    """The defaults of an algorithm; those of `preset` if it has that one."""
    options = {**presets(row).get(preset, {}), **overrides(compat, row.config)}
    return dataclasses.asdict(row.config(**options))


def preset_for(env_name: str, row: Row, preset: str = "auto") -> str:
    """`preset`, or what auto stands for on a task: the preset that a class of the algorithm's config
    names for it in `SUITS`, if the row has that one; else fast."""
    if preset != "auto":
        return preset
    suits = {}
    for cls in reversed(row.config.__mro__):
        suits |= {task: name for name, tasks in vars(cls).get("SUITS", {}).items() for task in tasks}
    found = suits.get(env_name, "fast")
    return found if found in presets(row) else "fast"


def first_published(row: Row) -> str:
    """The name of the setting that `preset=published` stands for; '' if none was published. `cpu` and
    `pixels` are ours."""
    return next((name for name in row.published if name not in ("cpu", "pixels")), "")


def presets(row: Row) -> dict[str, Mapping[str, Any]]:
    """Overrides by name: 'fast' has none, 'published' is the first of the published settings."""
    first = first_published(row)
    named = {"published": row.published[first]} if first else {}
    return {name: dict(options) for name, options in ({"fast": {}} | named | {**row.published}).items()}


def changed_options(options: dict[str, Any], entry: EnvEntry) -> dict[str, Any]:
    return {k: v for k, v in options.items() if v != entry.defaults[k]}


def make_env(settings: Settings) -> Env:
    env = settings.env_entry.make(**changed_options(settings.env_options, settings.env_entry))
    check_cost_names("algo.cost_limits", limits_by_name(settings.algo), env)
    return env


@contextlib.contextmanager
def as_options(row: Row) -> Iterator[None]:
    """Where a ConfigError in the block says NAME=VALUE or NAME: of a setting of the algorithm, it says
    algo.NAME, as the user does. Algorithms name their settings without it."""
    try:
        yield
    except ConfigError as error:
        names = "|".join(field.name for field in dataclasses.fields(row.config))
        error.args = (re.sub(rf"(?<![\w.])({names})(?=:| ?[=*])", r"algo.\1", str(error)),)
        raise


# ---- options by group --------------------------------------------------------------------------


def nested(options: Mapping[str, Any]) -> dict[str, Any]:
    """{'env': 'car_push1', 'algo.clip': 0.1} as config.yaml has it, {'env': {'name': ...}, ...}.

    Of an option that is there twice the later one counts; dicts are merged.
    """
    out: dict[str, Any] = {}
    for name, value in options.items():
        for part in reversed(f"{name}.name".split(".") if name in DEFAULT else name.split(".")):
            value = {part: value}
        out = merged(out, value)
    return out


def parted(config: dict[str, Any]) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """The options beside 'env' and 'algo', and a copy of those two groups; a missing one is empty."""
    for kind in DEFAULT:
        if not isinstance(config.get(kind) or {}, Mapping):
            raise ConfigError(f"{kind}={shown(config[kind])}: expected options by name")
    groups = {kind: dict(config.get(kind) or {}) for kind in DEFAULT}
    return {k: v for k, v in config.items() if k not in DEFAULT}, groups


# ---- checks ----------------------------------------------------------------------------------


def check_option(name: str, known: dict[str, Any]) -> None:
    """Raise ConfigError unless `known`, as of `defaults_of`, has the option 'seed' or 'algo.clip'."""
    groups = {kind: known[kind] for kind in ("env", "algo")}
    head, _, option = name.partition(".")
    if not option:
        if name not in known:
            whole = {n: f"{kind}.{n}" for kind in ("algo", "env") for n in groups[kind]}
            whole |= {n: n for n in known}
            close = difflib.get_close_matches(name, whole, 1, cutoff=0.8)
            hint = f"; did you mean {whole[close[0]]!r}?" if close else nearest(name, known)
            raise ConfigError(f"unknown option {name}{hint}")
        return
    if head not in groups:
        raise ConfigError(f"unknown option {name}{nearest(head, groups)}")
    options = {**groups[head], **flat(groups[head])}
    whose = options.pop("name")
    named = head == "algo" and option.startswith(f"{COST_LIMITS}.") and option.count(".") == 1
    asked = COST_LIMITS if named else option
    if asked in options:
        return
    if option == "name":
        hint = f"; choose with {head}="
    elif others := having(head, asked):
        close = difflib.get_close_matches(asked, options, 1, cutoff=0.8)
        hint = f"; did you mean {close[0]!r}? " if close else "; "
        hint += f"{some_of(others)} {'has' if len(others) == 1 else 'have'} {asked}"
    else:
        hint = nearest(option, options)
    raise ConfigError(f"unknown option {name} of {whose}{hint}")


def having(kind: str, option: str) -> list[str]:
    """The registered environments ('env') or algorithms ('algo') that have this option."""
    if kind == "env":
        groups = {name: to_plain(envs.env_defaults(name)) for name in envs.ENVS}
    else:
        groups = {name: algo_options(row) for name, row in algos.ALGOS.items()}
    return [name for name, options in groups.items() if option in {**options, **flat(options)}]


def some_of(names: list[str]) -> str:
    """'a, b, c and 4 more', or all where no more than 4 are."""
    if len(names) > 4:
        return f"{', '.join(names[:3])} and {len(names) - 3} more"
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last


def check_agreement(given: Mapping[str, Any]) -> None:
    """Refuse two values for the number that `num_envs` and `algo.num_envs` both set."""
    values = [given[name] for name in ("num_envs", "algo.num_envs") if given.get(name) is not None]
    if len(values) > 1 and values[0] != values[1]:
        raise ConfigError(
            f"num_envs={shown(values[0])} and algo.num_envs={shown(values[1])}: they are one number"
        )


def check_length(given: Mapping[str, Any], base: Mapping[str, Any]) -> None:
    """Refuse `total_steps` where gradient steps end the run. `base` has what is not given."""
    options = {**base, **given}
    updates = options["total_updates"]
    if updates is None and options["dataset"] is not None:
        updates = OFFLINE_UPDATES
    if "total_steps" in given and updates is not None:
        raise ConfigError(
            f"total_steps={shown(given['total_steps'])}: this run ends at "
            f"total_updates={shown(updates)}; give that instead"
        )


def check_compat(name: str) -> str:
    if name not in COMPAT:
        raise ConfigError(f"compat={name}{nearest(name, COMPAT)}")
    return name


def check_preset(algo: str, row: Row, preset: str) -> None:
    if preset not in (valid := ["auto", *presets(row)]):
        raise ConfigError(f"preset={preset} of {algo}{nearest(preset, valid)}")


# ---- settings side by side -------------------------------------------------------------------


def settings_in(algo: dict[str, Any], kind: type) -> list[dict[str, Any]]:
    """One set of options a setting, where lists stand for floats: the first of each, the second, ..."""
    lists = {
        name: value
        for name, value in flat(algo).items()
        if is_float(kind, name) and isinstance(value, list | tuple)
    }
    lengths = {name: len(values) for name, values in lists.items()}
    if len({*lengths.values()}) > 1 or 0 in lengths.values():
        raise ConfigError(
            "lists of numbers stand for settings, one from each: expected equal lengths, not "
            + ", ".join(f"{n} of algo.{name}" for name, n in lengths.items())
        )
    rows = list(zip(*lists.values(), strict=True)) or [()]
    if (row := repeated(rows)) is not None:
        same = ", ".join(f"algo.{name}={v}" for name, v in zip(lists, row, strict=True))
        raise ConfigError(f"{same} occurs twice")
    return [replaced(algo, dict(zip(lists, row, strict=True))) for row in rows]


# ---- in words ----------------------------------------------------------------------------------


def unusual_in_words(settings: Settings) -> str:
    """Up to four settings of environment and algorithm that are not the defaults, the most unusual
    first, and how many others there are."""
    names = {"env": {"name": settings.env_name}, "algo": {"name": settings.algo_name}}
    chosen = {"preset": settings.train.preset, "compat": settings.train.compat}
    usual = flat(settings_from_options({**names, **chosen}, settings.extras).plain())
    other = differences(flat(settings.plain()), usual)
    other = {k: pair for k, pair in other.items() if k.startswith(("env.", "algo."))}

    def oddness(name: str) -> float:
        """How many times a number is larger or smaller than usual, as a logarithm."""
        here, there = other[name]
        numbers = all(isinstance(x, int | float) and x for x in other[name])
        if not numbers or math.isinf(there):  # a finite number is not odd where inf is the default
            return 0.0
        return abs(math.log(abs(here / there))) if math.isfinite(here) else math.inf

    ranked = sorted(other, key=oddness, reverse=True)
    told = [f"{k}={as_text(other[k][0])} (default {as_text(other[k][1])})" for k in ranked[:4]]
    more = [f"and {len(ranked) - 4} more"] if len(ranked) > 4 else []
    return f"unusual: {', '.join([*told, *more])}" if told else "all its settings are the defaults"

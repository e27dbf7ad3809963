"""What a run is made of: plain values in, checked settings out.

`settle` is the only way from plain values to `Settings`, whether they come from a config.yaml, from the
command line or from Python. Only this module looks up the names of environments and algorithms. `ask`
first fills in what its caller left out.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxsafe import algos, envs
from jaxsafe.algos import Row
from jaxsafe.config import ConfigError, flat, from_dict, is_float, nearest
from jaxsafe.learn.constraints import check_names, own_limits
from jaxsafe.run import distributed, run_folder
from jaxsafe.run.compat import COMPAT, overrides
from jaxsafe.types import Env

DEFAULT = {"env": "point_goal1", "algo": "ppo_lag"}
ON_RESUME = (
    "total_steps",
    "total_updates",
    "checkpoint_every",
    "checkpoint_iterations",
    "checkpoint_replay",
    "eval_every",
    "eval_episodes",
    "video",
)  # may change
NOT_COMPARED = ("run_dir", "resume", *ON_RESUME)
OFFLINE_UPDATES = 100_000  # total_updates with a data set, unless the user says otherwise
NAMED = "cost_limits"  # an option of algorithms: floats by name, as {hazards: 10}
# Bounds of the hyperparameters that have one wherever they occur.
BOUNDS = {
    "cost_limit": (0.0, math.inf),
    "cost_limits": (0.0, math.inf),
    "horizon": (1, math.inf),
    "num_envs": (1, math.inf),
    "minibatches": (1, math.inf),
    "critic_epochs": (1, math.inf),
    "discount": (0.0, 1.0),
    "cost_discount": (0.0, 1.0),
    "gae_lambda": (0.0, 1.0),
    "cost_gae_lambda": (0.0, 1.0),
    "saute_discount": (0.01, 1.0),
    "budget_init": (0.0, 1.0),
    "simmer_window": (1, math.inf),
    "value_coef": (0.0, math.inf),
    "tau": (0.0, 1.0),
    "alpha_init": (1e-10, math.inf),
    "alpha_lr": (0.0, math.inf),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """The settings beside `env` and `algo`."""

    total_steps: int = 10_000_000  # environment steps of one seed, rounded up to whole updates
    # gradient steps of one seed, which then end the run; null: total_steps, or 100,000 with a data set
    total_updates: int | None = None
    num_envs: int | None = None  # of one seed; null: algo.num_envs
    num_seeds: int = 1  # trained at once: seed, seed + 1, ...
    seed: int = 0
    devices: int = 1  # the seeds are split over them or, for a lone one, its environments
    coordinator: str | None = None  # host:port of process 0 where several train one run together
    num_processes: int | None = None  # of them; under SLURM all three are known
    process_index: int | None = None  # 0 .. num_processes - 1
    preset: str = "fast"  # the algorithm's defaults: fast, published, or one of its published settings
    compat: str = "none"  # whose departures from the papers to follow: none, or omnisafe
    run_dir: str | None = None  # null: runs/<env>-<algo>/<time>-seed<seed>
    resume: bool | str = False  # true: run_dir, or the newest unfinished run like this one; or a folder
    dataset: str | None = None  # an .npz to learn from, for offline algorithms
    init_from: str | None = None  # a run folder whose policy to start from
    checkpoint_every: float = 60.0  # s between checkpoints
    checkpoint_iterations: int = 0  # also after this many iterations; 0: by time alone
    checkpoint_replay: bool | None = None  # keep the replay, to resume bit for bit; null: up to 2 GB
    eval_every: int = 0  # evaluate after so many environment steps, or updates without any; 0: never
    eval_episodes: int = 20  # of an evaluation, for each seed; 0: none, at the end either
    video: bool = True  # of the first seed's policy, at the end

    def __post_init__(self) -> None:
        for name in ("total_steps", "total_updates", "num_envs", "num_seeds", "devices"):
            if (value := getattr(self, name)) is not None and value < 1:
                raise ConfigError(f"{name}={value}: expected at least 1")
        for name in (
            "seed",
            "checkpoint_every",
            "checkpoint_iterations",
            "eval_every",
            "eval_episodes",
        ):
            if not (value := getattr(self, name)) >= 0:
                raise ConfigError(f"{name}={value}: expected at least 0")
        if self.eval_every and not self.eval_episodes:
            raise ConfigError(f"eval_every={self.eval_every}: expected eval_episodes of at least 1")
        if self.seed + self.num_seeds > 2**31:
            raise ConfigError(f"seed={self.seed}: expected less than {2**31 - self.num_seeds + 1}")


class EnvEntry(NamedTuple):
    """What the name of an environment stands for."""

    defaults: dict[str, Any]  # every option, as plain values
    make: Callable[..., Env]  # make(**options): those that differ from the defaults


class Entries(NamedTuple):
    """Environments and algorithms by name, beside the registered ones: a caller's own objects."""

    envs: Mapping[str, EnvEntry] = {}
    algos: Mapping[str, Row] = {}


REGISTERED = Entries()  # nothing beside them


class Settings(NamedTuple):
    """Everything a run is made of, checked, with the entries that its names were resolved to."""

    env_name: str
    env: EnvEntry
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
    def entries(self) -> Entries:
        """What another run folder with the same names is settled with."""
        return Entries({self.env_name: self.env}, {self.algo_name: self.row})

    def plain(self) -> dict[str, Any]:
        """As config.yaml has it: a float in which the settings differ is a list of one a setting."""
        algo = together([dataclasses.asdict(cfg) for cfg in self.configs])
        train = dataclasses.asdict(self.train)
        return to_plain(
            {
                "env": {"name": self.env_name, **self.env_options},
                "algo": {"name": self.algo_name, **algo},
                **{k: v for k, v in train.items() if k not in distributed.OPTIONS},
            }
        )


# ---- from plain values to settings -----------------------------------------------------------


def settle(config: dict[str, Any], entries: Entries = REGISTERED) -> Settings:
    """Plain values as checked settings.

    Args:
        config: as config.yaml has it: {'env': {'name': ...}, 'algo': {'name': ...}, 'seed': 0, ...}.
            An option that is missing has the default of the code, whatever the preset.
        entries: environments and algorithms beside the registered ones.
    Raises:
        ConfigError: an unknown name, a wrong type, or a value out of bounds.
    """
    top, groups = parted(config)
    env, algo = groups["env"], groups["algo"]
    env_name, entry = find_env(env.pop("name"), entries)
    algo_name = algo.pop("name")
    row = find_algo(algo_name, entries)
    train = from_dict(TrainConfig, top)
    if train.dataset is not None and train.total_updates is None:
        train = dataclasses.replace(train, total_updates=OFFLINE_UPDATES)
    if train.num_envs is not None:
        if "num_envs" not in {f.name for f in dataclasses.fields(row.config)}:
            raise ConfigError(f"num_envs={train.num_envs}: {algo_name} trains without environments")
        algo["num_envs"] = train.num_envs
    for name in env:
        if name not in entry.defaults:
            raise ConfigError(f"unknown option env.{name}{nearest(name, entry.defaults)}")
    configs = tuple(from_dict(row.config, one, "algo.") for one in settings_in(algo, row.config))
    for cfg in configs:
        check_bounds(cfg)
    options = to_plain({**entry.defaults, **env})
    return Settings(env_name, entry, options, algo_name, row, configs, train)


def ask(given: dict[str, Any], entries: Entries = REGISTERED) -> Settings:
    """Settings from the options that somebody gives, which are checked by name.

    Args:
        given: as of `settle`, with any option left out. NumPy's numbers, arrays, tuples and paths are
            taken as the plain values that they stand for. What is left out has the defaults of the
            preset and of compat or, where `resume` is a folder, the settings of the run in it.
        entries: as of `settle`.
    Raises:
        ConfigError: as of `settle`, with the nearest valid name.
    """
    top, groups = parted(to_plain(given))
    base = defaults_of(top, {kind: group.get("name") for kind, group in groups.items()}, entries)
    for group in groups.values():
        group.pop("name", None)  # `base` has it, as it is registered
    for name in flat({**top, **groups}):
        check_option(name, base)
    return settle(merged(base, {**top, **groups}), entries)


def defaults_of(
    top: dict[str, Any], names: Mapping[str, str | None], entries: Entries = REGISTERED
) -> dict[str, Any]:
    """Every option with its default, as config.yaml has it.

    Args:
        top: the options beside env and algo that are given.
        names: of 'env' and 'algo'; None is the default one.
    Raises:
        ConfigError: an unknown name, preset or compat, or no run in `resume`.
    """
    if isinstance(resume := top.get("resume"), str):
        return resumed(Path(resume).expanduser(), names, entries)
    base = {**dataclasses.asdict(TrainConfig()), **top}
    preset, compat = str(base["preset"]), check_compat(str(base["compat"]))
    env_name, entry = find_env(names["env"] or DEFAULT["env"], entries)
    algo_name = names["algo"] or DEFAULT["algo"]
    row = find_algo(algo_name, entries)
    check_preset(algo_name, row, preset)
    return dataclasses.asdict(TrainConfig()) | {
        "env": {"name": env_name, **entry.defaults},
        "algo": {"name": algo_name, **algo_options(row, preset, compat)},
    }


def resumed(
    folder: Path, names: Mapping[str, str | None], entries: Entries = REGISTERED
) -> dict[str, Any]:
    """Every option of the run in `folder`, which must be of this environment and algorithm."""
    saved = run_folder.read_config(folder)
    top, groups = parted(saved)
    env_name, entry = find_env(groups["env"]["name"], entries)
    row = find_algo(groups["algo"]["name"], entries)
    given = names["env"] and find_env(names["env"], entries)[0]
    for kind, name, there in (
        ("env", given, env_name),
        ("algo", names["algo"], groups["algo"]["name"]),
    ):
        if name not in (None, there):
            raise ConfigError(f"{kind}={name}: {folder} was trained with {there}")
    return {
        **dataclasses.asdict(TrainConfig()),
        **top,
        "env": {**entry.defaults, **groups["env"], "name": env_name},
        "algo": {**algo_options(row), **groups["algo"]},
    }


def find_env(name: str, entries: Entries = REGISTERED) -> tuple[str, EnvEntry]:
    """The name under which an environment is registered, and its entry."""
    if name in entries.envs:
        return name, entries.envs[name]
    name = envs.canonical(name)
    return name, EnvEntry(to_plain(envs.env_defaults(name)), functools.partial(envs.make, name))


def find_algo(name: str, entries: Entries = REGISTERED) -> Row:
    known = {**algos.ALGOS, **entries.algos}
    if name in known:
        return known[name]
    if ":" in name:
        raise ConfigError(
            f"{name} is code, which is not imported because a file names it; if you trust it, add "
            f"algo={name}"
        )
    raise ConfigError(f"unknown algo {name!r}{nearest(name, known)}")


def load(kind: str, name: str) -> None:
    """Import the 'env' or 'algo' called `name` if it is 'module:name'. Only for a name that the user
    gave: what a run folder names is never imported."""
    if ":" in name:
        {"env": envs.load, "algo": algos.load}[kind](name)


def algo_options(row: Row, preset: str = "fast", compat: str = "none") -> dict[str, Any]:
    """The defaults of an algorithm; those of `preset` if it has that one."""
    options = {**presets(row).get(preset, {}), **overrides(compat, row.config)}
    return dataclasses.asdict(row.config(**options))


def presets(row: Row) -> dict[str, Mapping[str, Any]]:
    """Overrides by name: 'fast' has none, 'published' is the first of the published settings."""
    first = next(iter(row.published.values()), None)
    named = {} if first is None else {"published": first}
    return {name: dict(options) for name, options in ({"fast": {}} | named | {**row.published}).items()}


def make_env(settings: Settings) -> Env:
    options, defaults = settings.env_options, settings.env.defaults
    env = settings.env.make(**{k: v for k, v in options.items() if v != defaults[k]})
    check_names(own_limits(settings.algo), env)
    return env


# ---- checks ----------------------------------------------------------------------------------


def check_option(name: str, known: dict[str, Any]) -> None:
    """Raise ConfigError unless `known`, as of `defaults_of`, has the option 'seed' or 'algo.clip'."""
    groups = {kind: known[kind] for kind in ("env", "algo")}
    head, _, option = name.partition(".")
    if not option:
        if name not in known:
            inside = [f"{kind}.{name}" for kind, group in groups.items() if name in group]
            hint = f"; did you mean {inside[0]!r}?" if inside else nearest(name, known)
            raise ConfigError(f"unknown option {name}{hint}")
        return
    if head not in groups:
        raise ConfigError(f"unknown option {name}{nearest(head, groups)}")
    options = {**groups[head], **flat(groups[head])}
    whose = options.pop("name")
    named = head == "algo" and option.startswith(f"{NAMED}.") and option.count(".") == 1
    if (NAMED if named else option) in options:
        return
    takers = [n for n, row in algos.ALGOS.items() if NAMED in algo_options(row)]
    if head == "algo" and (named or option == NAMED) and takers:
        raise ConfigError(
            f"{name}: {whose} takes one limit, algo.cost_limit; several are for {', '.join(takers)}"
        )
    hint = f"; choose with {head}=" if option == "name" else nearest(option, options)
    raise ConfigError(f"unknown option {name} of {whose}{hint}")


def check_bounds(cfg: Any) -> None:
    for name, value in flat(dataclasses.asdict(cfg)).items():
        field = name.partition(".")[0]
        low, high = BOUNDS.get(field, (-math.inf, math.inf))
        if isinstance(value, int | float) and not low <= value <= high:  # NaN is in no interval
            expected = f"at least {low:g}" if high == math.inf else f"between {low:g} and {high:g}"
            raise ConfigError(
                f"algo.{name}={value}: expected {expected if field in BOUNDS else 'a number'}"
            )


def check_compat(name: str) -> str:
    if name not in COMPAT:
        raise ConfigError(f"compat={name}{nearest(name, COMPAT)}")
    return name


def check_preset(algo: str, row: Row, preset: str) -> None:
    if preset not in (valid := presets(row)):
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
    for row in rows:
        if rows.count(row) > 1:
            same = ", ".join(f"algo.{name}={v}" for name, v in zip(lists, row, strict=True))
            raise ConfigError(f"{same} occurs twice")
    return [replaced(algo, dict(zip(lists, row, strict=True))) for row in rows]


def replaced(options: dict[str, Any], new: dict[str, Any], where: str = "") -> dict[str, Any]:
    """`options` with some values, by their names in `flat`, replaced."""
    return {
        k: replaced(v, new, f"{where}{k}.") if isinstance(v, dict) else new.get(f"{where}{k}", v)
        for k, v in options.items()
    }


def together(settings: list[Any]) -> Any:
    """The inverse of `settings_in`: a list stands where the settings differ."""
    first = settings[0]
    if isinstance(first, dict):
        return {name: together([each[name] for each in settings]) for name in first}
    return first if all(each == first for each in settings) else settings


# ---- plain values ----------------------------------------------------------------------------


def to_plain(value: Any, name: str = "") -> Any:
    """Dicts, lists and scalars of Python only, as YAML writes and reads them.

    Raises:
        ConfigError: a value that has no such form.
    """
    if isinstance(value, Mapping):
        return {str(k): to_plain(v, f"{name}.{k}" if name else str(k)) for k, v in value.items()}
    if isinstance(value, list | tuple | range):
        return [to_plain(v, f"{name}[{i}]") for i, v in enumerate(value)]
    if isinstance(value, np.generic | np.ndarray | jax.Array):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ConfigError(
        f"{name}={value!r}: expected a number, a string, true or false, None, a list or a dict"
    )


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


def merged(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """`old` with the values of `new`, dicts in dicts likewise."""
    out = dict(old)
    for name, value in new.items():
        inside = isinstance(value, dict) and isinstance(out.get(name), dict)
        out[name] = merged(out[name], value) if inside else value
    return out


def parted(config: dict[str, Any]) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """The options beside 'env' and 'algo', and a copy of those two groups; a missing one is empty."""
    groups = {kind: dict(config.get(kind) or {}) for kind in DEFAULT}
    return {k: v for k, v in config.items() if k not in DEFAULT}, groups


def differences(a: dict[str, Any], b: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """The names that have not the same value in both, with both values."""
    pairs = {name: (a.get(name), b.get(name)) for name in {**a, **b}}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


def as_text(value: Any) -> str:
    """A plain value as it is typed on the command line: [a,b], {a:1}, true, null."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(as_text, value))}]"
    if isinstance(value, dict):
        return f"{{{','.join(f'{k}:{as_text(v)}' for k, v in value.items())}}}"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return str(value)

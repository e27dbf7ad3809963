"""From a command line to a finished run folder: settings, checks, training, and what follows it.

Hydra composes the settings; the overrides are checked before it sees them, because its own errors
are long. `envs` and `algos` are the two registries, handed in as modules: `envs` has `ENVS`,
`canonical`, `load`, `env_defaults`, `make` and the submodules
`render` and `watch`; `algos` has `ALGOS`.
"""

import argparse
import dataclasses
import datetime
import errno
import functools
import importlib
import json
import math
import os
import shlex
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import hydra
import jax
import numpy as np
from hydra._internal.utils import get_args_parser
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

import jaxsafe
from jaxsafe.config import ConfigError, flat, from_dict, is_float, nearest
from jaxsafe.learn.acting import Player
from jaxsafe.learn.constraints import check_names, in_words, limits_of, own_limits
from jaxsafe.report import plots, stats
from jaxsafe.run import checkpoint, distributed, evaluation, run_folder, runner
from jaxsafe.run.compat import COMPAT, overrides
from jaxsafe.run.interrupts import Interrupts
from jaxsafe.run.progress import Report
from jaxsafe.types import Algorithm, Env, PyTree, Shared

ON_RESUME = (
    "total_steps",
    "checkpoint_every",
    "checkpoint_iterations",
    "eval_episodes",
    "video",
)  # may change
NOT_COMPARED = ("run_dir", "resume", *ON_RESUME)
NAMED = "algo.cost_limits"  # floats by name: {hazards: 10}, or each as algo.cost_limits.hazards=10
DEFAULT = {"env": "point_goal1", "algo": "ppo_lag"}
BAD_DISK = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO)
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
}


class NoVideo(RuntimeError):
    """Nothing to render with. The message is one line for the user."""


class Settings(NamedTuple):
    """Everything a run is made of, checked."""

    env_name: str
    env_options: dict[str, Any]  # all of them
    algo_name: str
    configs: tuple[Any, ...]  # the algorithm's, one a setting; they differ in floats alone
    train: runner.TrainConfig

    @property
    def label(self) -> str:
        """What folders of such runs are called."""
        return f"{self.env_name}-{self.algo_name}".replace(":", ".")

    @property
    def algo(self) -> Any:
        """The first setting, for what all have in common."""
        return self.configs[0]

    def plain(self) -> dict[str, Any]:
        """As config.yaml has it: a float in which the settings differ is a list of one a setting."""
        algo = together([dataclasses.asdict(cfg) for cfg in self.configs])
        return to_plain(
            {
                "env": {"name": self.env_name, **self.env_options},
                "algo": {"name": self.algo_name, **algo},
                **{
                    k: v
                    for k, v in dataclasses.asdict(self.train).items()
                    if k not in distributed.OPTIONS
                },
            }
        )


class Request(NamedTuple):
    """What the arguments say before Hydra composes them."""

    argv: list[str]  # for Hydra: aliases replaced
    base: dict[str, Any]  # top-level defaults, or those of the run to continue
    groups: dict[str, dict[str, dict[str, Any]]]  # 'env' and 'algo': name -> options, if chosen


# ---- arguments -------------------------------------------------------------------------------


def read_arguments(argv: list[str], envs: Any, algos: Any) -> Request:
    """Check every `key=value` against the registries.

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
    for name in values(given["env"]) if "env" in given else ():
        load_own(str(name), envs)
    base = dataclasses.asdict(runner.TrainConfig())
    if args.multirun and given.keys() & {*distributed.OPTIONS}:
        raise ConfigError(f"{', '.join(distributed.OPTIONS)} are for one run, without --multirun")
    for name in ("preset", "compat", "resume"):
        if name in given and given[name].is_sweep_override():
            raise ConfigError(f"{name} takes one value, not a sweep")
    resume = given["resume"].value() if "resume" in given else False
    if isinstance(resume, str):
        saved = run_folder.read_config(Path(resume).expanduser())
        base |= {k: v for k, v in saved.items() if k not in ("env", "algo")} | {"resume": resume}
        groups = {"env": env_group(envs, saved["env"]), "algo": algo_group(algos, saved["algo"])}
    else:
        preset, compat = (
            str(given[name].value()) if name in given else base[name] for name in ("preset", "compat")
        )
        if compat not in COMPAT:
            raise ConfigError(f"compat={compat}{nearest(compat, COMPAT)}")
        groups = {
            "env": {name: {"name": name, **envs.env_defaults(name)} for name in envs.ENVS},
            "algo": {name: algo_options(algos, name, preset, compat) for name in algos.ALGOS},
        }
    texts = list(args.overrides)
    chosen = {
        group: [next(iter(g)) if isinstance(resume, str) else DEFAULT[group]]
        for group, g in groups.items()
    }
    for i, override in enumerate(overrides):
        if override.key_or_group in groups and not override.is_delete():
            group = override.key_or_group
            names = [str(v) for v in values(override)]
            if group == "env":
                names = [envs.canonical(name) for name in names]
            for name in names:
                if name not in (envs.ENVS if group == "env" else algos.ALGOS):
                    raise ConfigError(f"unknown algo {name!r}{nearest(name, algos.ALGOS)}")
                if name not in groups[group]:
                    raise ConfigError(
                        f"{group}={name}: {resume} was trained with {next(iter(groups[group]))}"
                    )
            chosen[group] = names
            texts[i] = f"{group}={','.join(names)}"
    if not isinstance(resume, str):
        for name in chosen["algo"]:
            if preset not in (valid := presets(algos.ALGOS[name])):
                raise ConfigError(f"preset={preset} of {name}{nearest(preset, valid)}")
    for override, text in zip(overrides, args.overrides, strict=True):
        check_key(override, text, base, groups, chosen)
        if override.is_sweep_override() and not args.multirun and not override.is_hydra_override():
            raise ConfigError(f"{text}: several values need --multirun (-m); a list is written [a,b]")
    # Hydra adds a name to a dict, or to what was null, only if told to, and after the dict itself
    alone = [text for text in texts if text.startswith(f"{NAMED}.")]
    texts = [text for text in texts if text not in alone] + [f"++{text}" for text in alone]
    # Hydra copies them all again and again, so those that nobody chooses are known by name only
    if not any(o.key_or_group.startswith(("hydra.sweeper", "hydra/sweeper")) for o in overrides):
        for group, names in chosen.items():
            groups[group] = {k: node if k in names else {} for k, node in groups[group].items()}
    return Request([*flags, *texts], base, groups)


def parse(text: str) -> Override:
    try:
        return OverridesParser.create().parse_override(text)
    except HydraException as error:
        raise ConfigError(f"cannot read {text!r}: {one_line(error)}") from error


def values(override: Override) -> list[Any]:
    return list(override.sweep_iterator()) if override.is_sweep_override() else [override.value()]


def load_own(name: str, envs: Any) -> None:
    """Import the environment `name` if it is 'module:name'. Only for a name that the user gave: what a
    run folder names is never imported."""
    if ":" in name:
        envs.load(name)


def check_key(
    override: Override, text: str, base: dict, groups: dict, chosen: dict[str, list[str]]
) -> None:
    key = override.key_or_group
    if override.is_hydra_override():
        return
    if override.type is not OverrideType.CHANGE or override.package is not None:
        raise ConfigError(f"{text}: options are set with key=value, without '+', '~' or '@'")
    head, _, option = key.partition(".")
    if not option:
        if key not in base and key not in groups:
            dotted = [
                f"{group}.{o}" for group, names in chosen.items() for o in groups[group][names[0]]
            ]
            inside = [d for d in dotted if d.split(".")[1] == key]
            hint = f"; did you mean {inside[0]!r}?" if inside else nearest(key, [*base, *groups])
            raise ConfigError(f"unknown option {key}{hint}")
    elif head not in groups:
        raise ConfigError(f"unknown option {key}{nearest(head, groups)}")
    else:
        option = NAMED.partition(".")[2] if key.rpartition(".")[0] == NAMED else option
        for name in chosen[head]:
            known = groups[head][name]
            options = [o for o in {**known, **flat(known)} if o != "name"]  # 'wrap', 'wrap.time_limit'
            if option not in options:
                if f"{head}.{option}" == NAMED and (
                    takers := [n for n, o in groups[head].items() if option in o]
                ):
                    raise ConfigError(
                        f"{text}: {name} takes one limit, algo.cost_limit; "
                        f"several are for {', '.join(takers)}"
                    )
                hint = f"; choose with {head}=" if option == "name" else nearest(option, options)
                raise ConfigError(f"unknown option {head}.{option} of {name}{hint}")


def env_group(envs: Any, saved: dict[str, Any]) -> dict[str, dict[str, Any]]:
    name = envs.canonical(saved["name"])
    return {
        name: {
            "name": name,
            **envs.env_defaults(name),
            **{k: v for k, v in saved.items() if k != "name"},
        }
    }


def algo_group(algos: Any, saved: dict[str, Any]) -> dict[str, dict[str, Any]]:
    name = saved["name"]
    if name not in algos.ALGOS:
        raise ConfigError(f"unknown algo {name!r}{nearest(name, algos.ALGOS)}")
    return {name: {**algo_options(algos, name, "fast"), **saved}}


def algo_options(algos: Any, name: str, preset: str, compat: str = "none") -> dict[str, Any]:
    """The defaults of an algorithm; those of `preset` if it has that one."""
    entry = algos.ALGOS[name]
    options = presets(entry).get(preset, {}) | overrides(compat, entry.config)
    return {"name": name, **dataclasses.asdict(entry.config(**options))}


def presets(entry: Any) -> dict[str, dict[str, Any]]:
    """Overrides by name: 'fast' has none, 'published' is the first of the published settings."""
    first = next(iter(entry.published.values()), None)
    return {"fast": {}, **({} if first is None else {"published": first}), **entry.published}


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


# ---- settings --------------------------------------------------------------------------------


def settle(config: dict[str, Any], envs: Any, algos: Any) -> Settings:
    """Plain values, from Hydra or a config.yaml, as checked settings.

    Raises:
        ConfigError: an unknown name, a wrong type, or a value out of bounds.
    """
    top = {k: v for k, v in config.items() if k not in ("env", "algo")}
    env, algo = dict(config["env"]), dict(config["algo"])
    env_name, algo_name = envs.canonical(env.pop("name")), algo.pop("name")
    if algo_name not in algos.ALGOS:
        raise ConfigError(f"unknown algo {algo_name!r}{nearest(algo_name, algos.ALGOS)}")
    train = from_dict(runner.TrainConfig, top)
    if train.num_envs is not None:
        algo["num_envs"] = train.num_envs
    defaults = envs.env_defaults(env_name)
    for name in env:
        if name not in defaults:
            raise ConfigError(f"unknown option env.{name}{nearest(name, defaults)}")
    kind = algos.ALGOS[algo_name].config
    configs = tuple(from_dict(kind, setting, "algo.") for setting in settings_in(algo, kind))
    for name, value in (pair for cfg in configs for pair in flat(dataclasses.asdict(cfg)).items()):
        field = name.partition(".")[0]
        low, high = BOUNDS.get(field, (-math.inf, math.inf))
        if isinstance(value, int | float) and not low <= value <= high:  # NaN is in no interval
            expected = f"at least {low:g}" if high == math.inf else f"between {low:g} and {high:g}"
            raise ConfigError(
                f"algo.{name}={value}: expected {expected if field in BOUNDS else 'a number'}"
            )
    return Settings(env_name, to_plain({**defaults, **env}), algo_name, configs, train)


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


def differences(a: dict[str, Any], b: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """The names that have not the same value in both, with both values."""
    pairs = {name: (a.get(name), b.get(name)) for name in {**a, **b}}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


def make_env(settings: Settings, envs: Any) -> Env:
    defaults = to_plain(envs.env_defaults(settings.env_name))
    changed = {k: v for k, v in settings.env_options.items() if v != defaults[k]}
    env = envs.make(settings.env_name, **changed)
    check_names(own_limits(settings.algo), env)
    return env


def choose_folder(
    settings: Settings, envs: Any, algos: Any, job: int | None, say: Callable[[str], None]
) -> Path:
    """The folder to train in. `job` is the number of a multirun's job.

    Raises:
        ConfigError: it holds another run, or this one and `resume` is not set.
    """
    train = settings.train
    if isinstance(train.resume, str):
        folder = Path(train.resume).expanduser()
        compare(settings, folder, envs, algos)
        return folder
    home = Path("runs") / settings.label
    if train.run_dir is None:
        if train.resume:
            for folder in sorted((p.parent for p in home.glob("*/config.yaml")), reverse=True):
                done = run_folder.progress(folder)
                if (done is None or done[1] < train.total_steps) and same(
                    settings, folder, envs, algos
                ):
                    return folder
            say(f"no unfinished run of this command in {home}: starting one")
        name = f"{datetime.datetime.now():%Y%m%d-%H%M%S}-seed{train.seed}"
        taken = (home / (f"{name}-{i}" if i else name) for i in range(10**6))
        return next(path for path in taken if not path.exists())
    folder = Path(train.run_dir).expanduser()
    if job is not None:
        folder = folder / str(job)
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"run_dir={folder} is not a folder")
    if (folder / "config.yaml").exists() and train.resume:
        compare(settings, folder, envs, algos)
    elif checkpoint.checkpoints(folder / "checkpoints"):
        raise ConfigError(
            f"{folder} already holds a run: continue it with resume=true, or choose another run_dir"
        )
    elif train.resume:
        say(f"nothing to resume in {folder}: starting there")
    return folder


def agree_on_folder(
    settings: Settings, envs: Any, algos: Any, job: int | None, say: Callable[[str], None]
) -> Path:
    """`choose_folder` of process 0, for all processes.

    Raises:
        ConfigError: as there, or this process has other settings than process 0.
    """
    if jax.process_count() == 1:
        return choose_folder(settings, envs, algos, job, say)
    mine = flat(settings.plain())
    folder = choose_folder(settings, envs, algos, job, say) if distributed.leads() else ""
    folder, theirs = json.loads(distributed.first_text(json.dumps([str(folder), mine])))
    for name, (here, there) in differences(mine, theirs).items():
        raise ConfigError(f"{name}={here} in this process, {there} in process 0")
    return Path(folder)


def compare(settings: Settings, folder: Path, envs: Any, algos: Any) -> None:
    """Raise ConfigError if the run in `folder` has other settings than these."""
    saved = flat(settle(run_folder.read_config(folder), envs, algos).plain())
    free = {*NOT_COMPARED}
    if len(settings.configs) * settings.train.num_seeds > 1:
        free.add("devices")  # each member is whole on one of them
    for name, (here, there) in differences(flat(settings.plain()), saved).items():
        if name not in free:
            raise ConfigError(
                f"{name}={here} but {folder} was trained with {there}; "
                f"for a new run from its policy use init_from={folder}"
            )


def same(settings: Settings, folder: Path, envs: Any, algos: Any) -> bool:
    try:
        compare(settings, folder, envs, algos)
    except ConfigError:
        return False
    return True


# ---- a run -----------------------------------------------------------------------------------


def prepare(settings: Settings, envs: Any, algos: Any) -> tuple[Env, runner.Program]:
    """The environment and the program to train, not yet compiled.

    Raises:
        ConfigError: sizes that do not fit each other, the devices or, as runner.TooLarge, the memory.
    """
    train = settings.train
    runner.use_compilation_cache()
    runner.check_devices(train)
    env = make_env(settings, envs)
    runner.check_memory(env, settings.algo, len(settings.configs) * train.num_seeds, train.devices)
    program = runner.build(env, algos.ALGOS[settings.algo_name].make, settings.configs, train)
    runner.check_state_memory(program, train)
    return env, program


def run(
    settings: Settings,
    env: Env,
    program: runner.Program,
    folder: Path,
    envs: Any,
    algos: Any,
    report: Report,
    again: str,
) -> int:
    """Train in `folder`, then draw, evaluate and film. `again` is the command that continues this.

    Returns the exit status.
    """
    train, cfg = settings.train, settings.algo
    adapt = None
    begun = distributed.first(np.array(run_folder.progress(folder) is not None))
    if train.init_from is not None and not begun:
        adapt = warm_start(settings, program, envs, algos, report.line)
    engine = getattr(env, "engine", None)  # Safety Gym's environments have one
    try:
        if distributed.leads():
            folder.mkdir(parents=True, exist_ok=True)
            run_folder.write_config(folder, settings.plain())
            run_folder.append_versions(folder, runner.device_name(), engine)
    except OSError as error:
        raise checkpoint.CheckpointError(f"cannot write to {folder}: {error.strerror}") from error
    several = f"{len(settings.configs)} settings x " if len(settings.configs) > 1 else ""
    seeds = f"{train.num_seeds} seed{'s' if train.num_seeds > 1 else ''} x {cfg.num_envs} envs"
    where = runner.device_name() + (f" x {train.devices}" if train.devices > 1 else "")
    if jax.process_count() > 1:
        where += f" in {jax.process_count()} processes"
    where += f", engine {engine}" if engine else ""
    kernels = ", and a minute of Warp's kernels the first time" * (engine == "warp")
    report.line(
        f"jaxsafe {jaxsafe.__version__} | {settings.env_name} | {settings.algo_name} | "
        f"{several}{seeds} | {where} | compiling rollout and update{kernels} ..."
    )
    outcome = runner.train(program, train, folder, report, again, adapt)
    distributed.leave()
    if outcome.interrupted:
        return 130
    if not distributed.leads():
        return 0
    with Interrupts(report.line, report.hosted) as stop:
        if not report.hosted:
            stop.nothing_to_save = f"stopped; the training is saved, and for what is left {again}"
        finish(settings, env, envs, algos, folder, report, stop)
    report.line(f"run folder: {folder}")
    return 0


def warm_start(
    settings: Settings, program: runner.Program, envs: Any, algos: Any, say: Callable[[str], None]
) -> Callable[[PyTree], PyTree]:
    """What gives a fresh train state the parameters and normalisers of the run `init_from`.

    A seed starts from the same seed there, or, where there is none, from the one it equals modulo
    their number; of settings trained side by side there, the first counts.

    Raises:
        ConfigError: no run, or one whose networks have other shapes.
    """
    source = Path(settings.train.init_from or "").expanduser()
    saved = settle(run_folder.read_config(source), envs, algos)
    if not checkpoint.checkpoints(runner.policy_folder(source)):
        raise ConfigError(f"init_from={source} holds no checkpoint")
    first, count = saved.train.seed, saved.train.num_seeds
    policy = runner.read_policy(source, count, say)
    there, here = flat(saved.plain()), flat(settings.plain())
    options = [k for k in here if k.startswith("env.") and saved.env_name == settings.env_name]
    differ = [
        f"{name} is {there.get(name)} there, {here[name]} here"
        for name in (
            "env.name",
            "algo.hidden",
            "algo.trunk",
            "algo.std",
            "algo.obs_normalize",
            *options,
        )
        if there.get(name) != here[name]
    ]
    like = jax.eval_shape(program.init, program.start, Shared(np.int32(0)))
    runner.check_policy(like, policy, source, why="; ".join(["", *differ[:3]]))
    units = [plain.get("algo.activation") for plain in (there, here)]  # no shape tells them apart
    if units[0] != units[1]:
        raise ConfigError(
            f"the policy of {source} does not fit: "
            f"algo.activation is {units[0]} there, {units[1]} here; expected the same"
        )
    rows = [(m.seed - first) % count for m in program.members]
    pairs = {m.seed: first + row for m, row in zip(program.members, rows, strict=True)}
    of = f" of its setting {runner.members(saved.configs, saved.train)[0].setting}"
    say(
        f"starting from {source}: seed "
        + ", ".join(f"{seed} from its seed {old}" for seed, old in pairs.items())
        + of * (len(saved.configs) > 1)
    )
    return lambda ts: runner.with_policy(ts, policy, rows)


class Scores(NamedTuple):
    """What evaluation found for one setting."""

    name: str  # '' where there is but one
    limits: dict[str, float]  # of named costs, where those have their own; else of '', the cost
    episodes: int  # of all its seeds
    rows: dict[str, stats.Estimate]
    seeds: dict[str, list[float]]  # the mean over the episodes of each

    def __str__(self) -> str:
        return evaluation.table(self.rows)


def evaluate(
    settings: Settings, algo: Algorithm, params: PyTree, num: int, seed: int, folder: Path
) -> list[Scores]:
    """`num` fresh episodes of each seed in each setting."""
    episodes = evaluation.run_episodes(algo, params, num, seed)
    tables = list(run_folder.by_setting(run_folder.read_metrics(folder)).values())
    cost_names = algo.task(jax.tree.map(lambda x: x[0], params)).cost_names
    seeds, scores = settings.train.num_seeds, []
    for i, member in enumerate(runner.members(settings.configs, settings.train)[::seeds]):
        own = evaluation.Episodes(*(x[i * seeds : (i + 1) * seeds] for x in episodes))
        limits, metrics = limits_of(member.algo), tables[i] if i < len(tables) else {}
        found = evaluation.measures(own, cost_names, limits)
        rows = evaluation.summary(settings.env_name, found, float(member.algo.cost_limit), metrics)
        by_seed = {name: values.mean(1).tolist() for name, values in found.items()}
        scores.append(Scores(member.setting, limits, own.ret.size, rows, by_seed))
    return scores


def finish(
    settings: Settings,
    env: Env,
    envs: Any,
    algos: Any,
    folder: Path,
    report: Report,
    stop: Interrupts,
) -> None:
    """Curves, evaluation and video. What fails costs one line, never the training.

    Raises:
        KeyboardInterrupt: `stop` was requested while one of them went on.
    """
    train = settings.train
    title = f"{settings.env_name}, {settings.algo_name}"
    policy = functools.cache(lambda: policy_of(settings, env, algos, folder))

    def curves() -> None:
        limit = float(settings.algo.cost_limit)
        metrics, own = run_folder.read_metrics(folder), own_limits(settings.algo)
        plots.curves(metrics, folder / "curves.png", title, limit, own)

    def scores() -> None:
        found = evaluate(settings, *policy(), train.eval_episodes, train.seed, folder)
        tables = {s.name: evaluation.as_json(s.rows) | {"seeds": s.seeds} for s in found}
        text = json.dumps({"episodes": train.eval_episodes, **tables.get("", tables)}, indent=1)
        run_folder.replace_text(folder / "evaluation.json", text)
        for name, limits, episodes, rows, _ in found:
            ret, cost, rate = rows["return"], rows["cost"], rows["violation rate"]
            report.line(
                f"final policy{name and ', ' + name}: return {ret.mean:.4g} [{ret.low:.4g}, "
                f"{ret.high:.4g}], cost {cost.mean:.4g} [{cost.low:.4g}, {cost.high:.4g}] "
                f"(limit {in_words(limits)}), "
                f"{100 * rate.mean:.0f}% of {episodes} episodes over it"
            )

    def video() -> None:
        algo, params = policy()
        first = jax.tree.map(lambda x: x[0], params)
        film(envs, [Actor(settings, env, algo, first)], folder / "video.mp4", train.seed)

    wanted = {
        "curves": (curves, True),
        "evaluation": (scores, train.eval_episodes > 0),
        "video": (video, train.video),
    }
    for name, (task, yes) in wanted.items():
        try:
            if yes:
                task()
        except Exception as error:  # training is done and saved; this is an extra
            report.line(f"no {name}: {one_line(error)}")
        if stop.requested:
            raise KeyboardInterrupt


class Actor(NamedTuple):
    """One policy of a run, ready to act. `params` is what acts of that member alone."""

    settings: Settings
    env: Env
    algo: Algorithm
    params: PyTree

    @property
    def player(self) -> Player:
        return Player(self.algo.policy, self.params, self.algo.task(self.params))


def check_video(path: Path) -> None:
    if path.suffix not in (".mp4", ".gif"):
        raise ConfigError(f"{path}: expected a name that ends in .mp4 or .gif")


def film(
    envs: Any, actors: list[Actor], path: Path, seed: int, labels: list[str] | None = None
) -> None:
    """Write one episode of each deterministic policy as a video, side by side in labelled panels.

    The renderer is imported late: it looks for a display.

    Raises:
        NoVideo: this machine has neither EGL nor OSMesa.
    """
    render = importlib.import_module(f"{envs.__name__}.view.render")
    key = jax.random.fold_in(jax.random.key(seed), 0x66696C6D)
    try:
        films = [
            render.render_episode(a.env, a.player, key, label=label)
            for a, label in zip(actors, labels or [None] * len(actors), strict=True)
        ]
    except render.NoDisplay as error:
        raise NoVideo(one_line(error)) from error
    render.write_video(render.side_by_side(films), path, fps=30)


def policy_of(settings: Settings, env: Env, algos: Any, folder: Path) -> tuple[Algorithm, PyTree]:
    """The algorithm, and what acts of the newest policy of each member, [S, ...]."""
    algo = algos.ALGOS[settings.algo_name].make(env, None)

    def one_step(cfg: Any) -> Any:
        return dataclasses.replace(cfg, num_envs=1, horizon=1, minibatches=1)

    def first(cfg: Any) -> PyTree:
        return algo.params(algo.init(jax.random.key(0), cfg, Shared(np.int32(0))))

    members = runner.members(settings.configs, settings.train)
    floats = jax.tree.map(lambda *x: np.array(x, np.float32), *[one_step(m.algo) for m in members])
    like = jax.eval_shape(first, jax.tree.map(lambda x: x[0], floats))
    arrays = runner.read_policy(folder, len(members))
    return algo, runner.acting(like, arrays, floats, folder)


def compose(texts: list[str], envs: Any, algos: Any) -> Settings:
    """The settings that train.py would have from these arguments."""
    request = read_arguments(texts, envs, algos)
    register(request)
    with hydra.initialize(version_base="1.3", config_path=None):
        config = hydra.compose("train", overrides=request.argv)
    return settle(OmegaConf.to_container(config, resolve=True), envs, algos)  # type: ignore[arg-type]


# ---- entry points ----------------------------------------------------------------------------


def train_main(envs: Any, algos: Any) -> int:
    """scripts/train.py. Exit status: 2 for bad input, 1 for a failed disk, 130 if stopped."""

    def job(config: Any) -> None:
        plain = OmegaConf.to_container(config, resolve=True)
        number = HydraConfig.get().job.num if HydraConfig.get().mode == RunMode.MULTIRUN else None

        def train() -> int:
            settings = settle(plain, envs, algos)  # type: ignore[arg-type]
            options = settings.train
            places = {name: getattr(options, name) for name in distributed.OPTIONS}
            at = None if number is not None else distributed.position(**places, devices=options.devices)
            with distributed.joined(at):
                report = Report(Console(quiet=True) if at and at.index else None)
                folder = agree_on_folder(settings, envs, algos, number, report.line)
                env, program = prepare(settings, envs, algos)
                again = f"python scripts/train.py resume={shlex.quote(str(folder))}"
                again += f" env={settings.env_name}" if ":" in settings.env_name else ""
                again += f" in each of the {at.count} processes" if at else ""
                return run(settings, env, program, folder, envs, algos, report, again)

        status = guarded(train)  # here already: Hydra prints the overrides of a job that raises
        if status:
            distributed.give_up(status)
            raise SystemExit(status)

    def command() -> int:
        request = read_arguments(sys.argv[1:], envs, algos)
        register(request)
        sys.argv[1:] = request.argv
        os.environ["HYDRA_FULL_ERROR"] = "1"  # raise, do not print: `guarded` prints
        try:
            hydra.main(version_base="1.3", config_path=None, config_name="train")(job)()
        except ValueError as error:
            if not str(error).startswith("Only one of --run"):  # Hydra's, of its own flags
                raise
            fail(str(error))
        return 0

    return guarded(command)


def guarded(command: Callable[[], int]) -> int:
    """Run `command`; what the user can mend becomes one line on stderr and an exit status."""
    try:
        return command()
    except (ConfigError, HydraException, OmegaConfBaseException) as error:
        return complain(one_line(error), 2)
    except (checkpoint.CheckpointError, NoVideo) as error:
        return complain(one_line(error), 1)
    except KeyboardInterrupt:
        return complain("stopped; what was saved stays", 130)
    except OSError as error:
        if error.errno not in BAD_DISK:
            raise
        where = f" ({error.filename})" if error.filename else ""
        return complain(f"{error.strerror}{where}; what was saved stays", 1)
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        return complain(
            "the device is out of memory; use fewer num_envs, num_seeds or a shorter horizon", 1
        )


def complain(line: str, status: int) -> int:
    print(f"error: {line}", file=sys.stderr)
    return status


def fail(message: str) -> NoReturn:
    raise ConfigError(message)


def run_parser(description: str) -> argparse.ArgumentParser:
    """Arguments of the scripts that read a run folder; errors are one line too."""
    parser = argparse.ArgumentParser(description=description)
    parser.error = fail  # type: ignore[method-assign]
    parser.add_argument("run", type=Path, metavar="RUN", help="a run folder")
    parser.add_argument(
        "env", nargs="?", metavar="env=MODULE:NAME", help="where the run's environment is code of yours"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the fresh episodes (default 1)")
    return parser


def open_run(
    folder: Path, again: str | None, envs: Any, algos: Any
) -> tuple[Settings, Env, Algorithm, PyTree]:
    """Settings, environment, algorithm and what acts, [S, ...], of a run. Nothing in it is executed.

    Args:
        again: None, or 'env=module:name', the run's environment, which is then imported.
    """
    saved = run_folder.read_config(folder)
    if again is not None:
        name = again.removeprefix("env=")
        if name != saved["env"]["name"]:
            raise ConfigError(f"{again}: {folder} was trained with env={saved['env']['name']}")
        load_own(name, envs)
    settings = settle(saved, envs, algos)
    if not checkpoint.checkpoints(runner.policy_folder(folder)):
        raise ConfigError(f"{folder} holds no checkpoint")
    env = make_env(settings, envs)
    return settings, env, *policy_of(settings, env, algos, folder)


def evaluate_main(envs: Any, algos: Any) -> int:
    """scripts/evaluate.py."""

    def command() -> int:
        parser = run_parser("Evaluate the policy of a run over fresh episodes.")
        parser.add_argument("--episodes", type=int, default=100, help="for each seed (default 100)")
        args = parser.parse_args()
        if args.episodes < 1 or args.seed < 0:
            raise ConfigError("--episodes must be at least 1 and --seed at least 0")
        runner.use_compilation_cache()
        settings, _, algo, params = open_run(args.run, args.env, envs, algos)
        alone = len(settings.configs) == 1
        print(
            f"{settings.env_name} | {settings.algo_name} | "
            f"{settings.train.num_seeds} x {args.episodes} episodes, deterministic policy"
            + f" | cost limit {in_words(limits_of(settings.algo))}"
            * alone,
            flush=True,
        )
        with Interrupts(functools.partial(print, flush=True)) as stop:
            stop.nothing_to_save = "stopped"
            scores = evaluate(settings, algo, params, args.episodes, args.seed, args.run)
        for s in scores:
            if not alone:
                print(f"\n{s.name} | cost limit {in_words(s.limits)}")
            print(s)
        return 0

    return guarded(command)


# ---- plain values ----------------------------------------------------------------------------


def to_plain(value: Any) -> Any:
    """Dicts, lists and scalars of Python only, as YAML writes and reads them."""
    if isinstance(value, dict):
        return {str(k): to_plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(v) for v in value]
    return value.item() if isinstance(value, np.generic) else value


def one_line(error: BaseException) -> str:
    lines: Iterable[str] = (line.strip() for line in str(error).splitlines())
    return next((line for line in lines if line), type(error).__name__)

"""Runs read from their folders, for comparison."""

import functools
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxsafe
from jaxsafe.algos import ALGOS
from jaxsafe.config import ConfigError, MissingObject, UnnamedCode, flat
from jaxsafe.envs import ENVS
from jaxsafe.learn.constraints import cost_title, limits_of
from jaxsafe.report import scores, study_files
from jaxsafe.report.evaluation import cost_rate
from jaxsafe.run import files, run_folder
from jaxsafe.run.divergence import read_lost
from jaxsafe.run.programs import members
from jaxsafe.run.settings import (
    NO_EXTRAS,
    NOT_COMPARED,
    Extras,
    settings_from_options,
    settings_of_run,
)

# Fields that do not make another setting.
NOT_A_SETTING = {"seed", "num_seeds", "num_envs", "devices", *NOT_COMPARED}
NOT_A_SETTING -= {"total_steps", "total_updates"}

NEEDED = ("iteration", "steps", "seed", "train/return", "train/cost")  # columns
KEPT: dict[tuple, tuple] = {}  # what `defaults` found, with the entries of both registries
STAND_IN = {"train/return": "eval/return", "train/cost": "eval/cost"}  # where training has no episodes


class SettingRun(NamedTuple):
    """One setting of a run folder, over the seeds that were trained in it."""

    folder: Path
    env: str
    config: dict[str, Any]  # {'env.name': ..., 'algo.clip': ...}, and the folder as 'run_dir'
    limits: dict[str, float]  # by the name of a cost; '' is the name of `cost`
    table: dict[str, np.ndarray]  # the columns of metrics.csv
    seeds: np.ndarray  # [S]
    values: dict[str, np.ndarray]  # [S] by name; NaN for a seed without complete episodes
    estimated: bool = False  # no episode has ended yet, so return and cost are estimates from all steps
    evaluated: bool = False  # return and costs are the final evaluation's
    diverged: tuple[int, ...] = ()  # the seeds that did

    @property
    def setting(self) -> dict[str, Any]:
        return {k: v for k, v in self.config.items() if k not in NOT_A_SETTING}

    @property
    def clock(self) -> str:
        """What `steps` counts: 'steps' of the environment or, where training takes none, 'updates'."""
        return run_folder.step_column(self.table)

    @property
    def steps(self) -> int:
        """Environment steps, or gradient steps where training takes none."""
        return int(self.table[self.clock].max())

    @property
    def progress(self) -> tuple[int, int, str]:
        """How far training is, the end that its config gives, and what both count."""
        updates = self.config.get("total_updates")  # a study of an older version has none
        if updates is None:
            return self.steps, int(self.config["total_steps"]), "steps"
        column = "updates" if "updates" in self.table else "steps"  # a study has one clock
        return int(self.table[column].max()), int(updates), "updates"

    @property
    def episodes(self) -> float:
        """How many ended in the last 10% of training, of all seeds; NaN where return and costs are not
        known to be theirs."""
        if self.evaluated or "train/episodes" not in self.table:
            return np.nan
        return float(np.nansum(self.table["train/episodes"][run_folder.late_rows(self.table)]))

    @property
    def ended(self) -> bool:
        """Whether training is at the end that its config gives."""
        done, end, _ = self.progress
        return done >= end


def read(paths: Iterable[Path]) -> list[SettingRun]:
    """Every setting that has begun, of run folders, sweeps, studies, and folders that hold them.

    Raises:
        ConfigError: no run; one that this version cannot read; or the same run twice.
    """
    folders = {folder.resolve(): folder for path in paths for folder in run_folders_under(path)}
    runs = [run for folder in folders.values() for run in read_one(folder)]
    if not runs:
        raise ConfigError(f"no run has begun in {', '.join(map(str, folders.values()))}")
    owners: dict[tuple, Path] = {}
    for run in runs:
        for seed in run.seeds:
            key = (json.dumps(run.setting, sort_keys=True), seed)
            if (other := owners.setdefault(key, run.folder)) != run.folder:
                raise ConfigError(
                    f"{other} and {run.folder} are the same run of seed {seed:g}; give one"
                )
    return runs


def run_folders_under(path: Path) -> list[Path]:
    """The run folders and studies at or under `path`."""
    path = path.expanduser()
    if not path.is_dir():
        raise ConfigError(f"{path} is not a folder")
    found = []
    for folder, inside, names in os.walk(path):
        inside.sort()
        if "config.yaml" in names or "final.csv" in names:
            found.append(Path(folder))
            inside.clear()
        inside[:] = [name for name in inside if not name.startswith(".")]
    if not found:
        raise ConfigError(f"{path} holds no run: neither it nor a folder in it has a config.yaml")
    return found


def read_one(folder: Path, extras: Extras = NO_EXTRAS) -> list[SettingRun]:
    """The settings of a run folder, none if it has no iteration yet; or the runs of a study."""
    if study_files.holds_study(folder):
        return read_study(folder)
    plain = run_folder.read_config(folder)
    try:
        saved = settings_of_run(plain, extras)
    except (UnnamedCode, MissingObject) as error:
        raise ConfigError(f"{folder}: {error}") from error
    except ConfigError as error:
        by = run_folder.trained_by(folder)
        raise ConfigError(
            f"{folder}, trained by jaxsafe {by}, does not fit jaxsafe {jaxsafe.__version__}: {error}"
        ) from error
    metrics = run_folder.read_metrics(folder)
    if not len(metrics.get("iteration", ())):
        return []
    if run_folder.step_column(metrics) == "updates":
        nothing = np.full(len(metrics["seed"]), np.nan)
        metrics = {name: metrics.get(other, nothing) for name, other in STAND_IN.items()} | metrics
    for name in NEEDED:
        if name not in metrics:
            raise ConfigError(f"{run_folder.metrics_file(folder)} has no column {name}")
    runs = []
    parts = run_folder.by_setting(metrics).values()
    names = [m.setting for m in members(saved.configs, saved.train)[:: saved.train.num_seeds]]
    lost = read_lost(folder)
    for cfg, name, table in zip(saved.configs, names, parts, strict=False):
        limits = limits_of(cfg)
        fields = flat(saved._replace(configs=(cfg,)).plain()) | {"run_dir": str(folder)}
        values = measured(saved.env_name, table, limits, repeat_of(fields))
        seeds = np.unique(table["seed"])
        for what, final in run_folder.read_evaluation(folder, name).items():
            if len(final) != len(seeds):
                raise ConfigError(
                    f"{folder}: evaluation.json is of {len(final)} seeds, metrics.csv of {len(seeds)}"
                )
            values[f"final {what}"] = final
        run = SettingRun(folder, saved.env_name, fields, limits, table, seeds, values, not_ended(table))
        runs.append(run._replace(diverged=tuple(x.seed for x in lost if x.setting == name)))
    return runs


def or_evaluated(run: SettingRun) -> SettingRun:
    """`with_evaluation` where training has no episodes, else the run. What was evaluated on the way, in
    some runs and not in others, stands in where there is no final evaluation."""
    known = "final return" in run.values
    return run if run.clock == "steps" or not known else with_evaluation(run)


def with_evaluation(run: SettingRun) -> SettingRun:
    """The run, with return and costs of its final evaluation in place of those of training."""
    shown = {"return", "cost", *map(cost_title, run.limits)}
    found = {name: run.values[f"final {name}"] for name in shown if f"final {name}" in run.values}
    values = run.values | found
    scored = normalised(run.env, values, run.limits, repeat_of(run.config))
    return run._replace(values=values | scored, evaluated=True)


def not_ended(table: Mapping[str, np.ndarray]) -> bool:
    """Whether no episode has ended, so that return and cost are only estimated."""
    known = {"train/return_estimate", "train/cost_estimate"} <= table.keys()
    return known and not np.isfinite(table["train/return"]).any()


def read_study(folder: Path) -> list[SettingRun]:
    """The runs of a study. `run_dir` ends in the name of each, and tables hold a hundred points a seed.

    Options that did not exist when a run was trained have their defaults of today.

    Raises:
        ConfigError: the study's files cannot be read.
    """
    with files.reading(folder):
        return runs_of(folder, study_files.read(folder))


def runs_of(folder: Path, study: study_files.Condensed) -> list[SettingRun]:
    rows, curves, settings = study
    runs = []
    for run, options in settings.items():
        of_run = [row for row in rows if row["run"] == run]
        env, algo = options["env.name"], options["algo.name"]
        presets = options.get("preset", "fast"), options.get("compat", "none")
        config = defaults(env, algo, *presets) | options
        config["run_dir"] = str(folder / study_files.name_of(run))
        named = {k: v for k, v in config.items() if k.startswith("algo.cost_limits.") and v is not None}
        limits = {k.removeprefix("algo.cost_limits."): float(v) for k, v in named.items()}
        limits = limits or {"": float(config["algo.cost_limit"])}
        always = ("return", "cost")  # NaN where no episode was whole
        figures = [k for k in study.figures() if k in always or any(row[k] for row in of_run)]
        values = {k: np.array([float(row[k] or "nan") for row in of_run]) for k in figures}
        values |= normalised(env, values, limits, repeat_of(config))
        clock = "updates" if config.get("dataset") else "steps"  # learning from a data set takes none
        table = study_files.table(of_run, [curves[run, row["seed"]] for row in of_run], clock)
        seeds = np.array([float(row["seed"]) for row in of_run])
        diverged = tuple(int(row["seed"]) for row in of_run if row["state"] == "diverged")
        run = SettingRun(folder, env, config, limits, table, seeds, values)
        runs.append(run._replace(diverged=diverged))
    return runs


def defaults(env: str, algo: str, preset: str = "fast", compat: str = "none") -> dict[str, Any]:
    """Today's settings by their names in `flat`; none where this version lacks the names.

    A table of many runs asks for the same ones again and again. They are kept until the environment or
    the algorithm is registered anew.
    """
    key, entries = (env, algo, preset, compat), (ENVS.get(env), ALGOS.get(algo))
    if key in KEPT and all(a is b for a, b in zip(KEPT[key][0], entries, strict=True)):
        return KEPT[key][1]
    named = {"env": {"name": env}, "algo": {"name": algo}, "preset": preset, "compat": compat}
    try:
        found = flat(settings_from_options(named).plain())
    except ConfigError:
        found = {}
    KEPT[key] = entries, found
    return found


def measured(
    env: str, table: Mapping[str, np.ndarray], limits: Mapping[str, float], repeat: int = 1
) -> dict[str, np.ndarray]:
    """What is known of each seed, [S], from the columns of metrics.csv.

    Args:
        env: the task, for its characteristic scores.
        table: the columns.
        limits: by the name of a cost; '' is the name of `cost`.
        repeat: steps of the environment in one of the policy.

    Return and cost are the learner's estimates where no episode has ended. What sampled actions make in
    the end is known of a run with `eval_every`.
    """
    columns = dict(table)
    if not_ended(table):
        columns |= {name: table[run_folder.estimate_of(name)] for name in STAND_IN}
    unknown = np.full(len(table["seed"]), np.nan)  # learning from a data set has no named costs
    over = [
        table.get(f"train/cost_{k}" if k else "train/cost", unknown) - limit
        for k, limit in limits.items()
    ]
    worst = np.max(over, axis=0)
    columns["over"] = np.where(np.isnan(worst), np.nan, worst > 0)
    late = functools.partial(run_folder.last_tenth, columns)
    values = {
        "return": late("train/return"),
        "cost": late("train/cost"),
        "violation rate": late("over"),
    }
    if (rate := cost_rate(columns)) is not None:
        values["cost rate"] = rate
    for name in cost_names(table):
        values[cost_title(name)] = late(f"train/cost_{name}")
    if "train/goal_met" in table:
        values["goals"] = late("train/goal_met")
    for what in ("return", "cost"):
        column = table.get(f"eval/{what}_sampled", unknown)
        if np.isfinite(last := column[table["iteration"] == table["iteration"].max()]).all():
            values[f"final sampled {what}"] = last
    return values | normalised(env, values, limits, repeat)


def repeat_of(config: Mapping[str, Any]) -> int:
    """Steps of the environment in one of the policy."""
    return config.get("env.wrap.action_repeat", 1)


def normalised(
    env: str, values: Mapping[str, np.ndarray], limits: Mapping[str, float], repeat: int
) -> dict[str, np.ndarray]:
    """Safety Gym's normalised scores of each seed, as far as there are any, [S].

    A cost rate is of the policy's steps, and the published one of the environment's. One step of the
    policy has `repeat` of these.
    """
    if env not in scores.CHARACTERISTIC:
        return {}
    found = {"normalised return": scores.normalized_return(env, values["return"])}
    if "" in limits:
        excess = scores.normalized_violation(env, values["cost"], limits[""])
        found["normalised violation"] = excess
    if "cost rate" in values:
        found["normalised cost rate"] = scores.normalized_cost_rate(env, values["cost rate"] / repeat)
    return found


def cost_names(columns: Iterable[str]) -> list[str]:
    """The costs that an environment tells apart, by the columns of metrics.csv."""
    others = ("train/cost_estimate", "train/cost_rate")  # of `cost`, or of each under its own limit
    found = [name for name in columns if name.startswith("train/cost_") and not name.startswith(others)]
    return [name.removeprefix("train/cost_") for name in found]

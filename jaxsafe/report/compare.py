"""Runs and sweeps compared by any field of their configs, in tables and figures.

    python scripts/plot.py RUNS... [--by FIELD ...] [--published CSV] [--out DIR]

    OUT/results.md, .tex    return and cost, a row a setting, a column a task; what else is known
    OUT/results.csv         every estimate, a row each
    OUT/curves.png, .svg    return, cost and cost rate over training, mean and 95 % interval
    OUT/trade_off.png, .svg return against cost, with the limit and the Pareto front
    OUT/scores.png, .svg    Safety Gym's normalised scores over all tasks, mean and IQM
    OUT/profiles.png, .svg  the share of seeds beyond each normalised return and cost

Figures of a seed are those of the last 10 % of its training, but for the cost rate, which is of all of
it. Tasks stand apart; across them only normalised scores, and comparisons within a task, are averaged.
"""

import argparse
import csv
import functools
import io
import json
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxsafe
from jaxsafe.config import ConfigError, flat, nearest
from jaxsafe.learn.constraints import in_words, limits_of, written
from jaxsafe.report import condensed, plots, scores, stats, tables
from jaxsafe.report.stats import Estimate
from jaxsafe.report.tables import Table
from jaxsafe.run import command, evaluation, run_folder, runner

# Fields that do not make another setting.
NOT_A_SETTING = {"seed", "num_seeds", "num_envs", "devices", *command.NOT_COMPARED} - {"total_steps"}
NEEDED = ("iteration", "steps", "seed", "train/return", "train/cost")  # columns
PUBLISHED = ("task", "algo", "source", "return", "return_std", "cost", "cost_std", "cost_limit")
FINAL = (
    "final return", "final cost", "final violation rate", "final discounted return",
    "final discounted cost",
)  # fmt: skip
SCORES = ("normalised return", "normalised violation", "normalised cost rate")


class Run(NamedTuple):
    """One setting of a run folder, over the seeds that were trained in it."""

    folder: Path
    env: str
    config: dict[str, Any]  # {'env.name': ..., 'algo.clip': ...}, and the folder as 'run_dir'
    limits: dict[str, float]  # by the name of a cost; '' is their sum
    table: dict[str, np.ndarray]  # the columns of metrics.csv
    seeds: np.ndarray  # [S]
    values: dict[str, np.ndarray]  # [S] by name; NaN for a seed without complete episodes

    @property
    def setting(self) -> dict[str, Any]:
        return {k: v for k, v in self.config.items() if k not in NOT_A_SETTING}

    @property
    def steps(self) -> int:
        return int(self.table["steps"].max())


class Group(NamedTuple):
    """The runs of one task that agree in some fields, `by`."""

    env: str
    by: dict[str, Any]
    runs: list[Run]

    @property
    def name(self) -> str:
        """The algorithm as it is, other fields with their names, and the task not at all."""
        named = {k: v for k, v in self.by.items() if k not in ("algo.name", "env.name")}
        first = [self.by["algo.name"]] if "algo.name" in self.by else []
        first += [] if first or named else [self.algo or "all"]
        return ", ".join([*first, *([run_folder.setting_name(named)] if named else [])])

    @property
    def algo(self) -> str | None:
        """None of several."""
        names = {run.config["algo.name"] for run in self.runs}
        return names.pop() if len(names) == 1 else None

    @property
    def limits(self) -> dict[str, float]:
        """Empty where runs have different ones."""
        first = self.runs[0].limits
        return first if all(run.limits == first for run in self.runs) else {}

    @property
    def cost_limit(self) -> float:
        """NaN of several, and where named costs have limits of their own."""
        return self.limits.get("", np.nan)

    @property
    def steps(self) -> int:
        """That every run has reached."""
        return min(run.steps for run in self.runs)

    def values(self, name: str) -> np.ndarray:
        """One of `Run.values` of every seed, [S]; NaN where a run does not have it."""
        nothing = (np.full(len(run.seeds), np.nan) for run in self.runs)
        found = (run.values.get(name, none) for run, none in zip(self.runs, nothing, strict=True))
        return np.concatenate([*found])

    @property
    def returns(self) -> np.ndarray:
        return self.values("return")

    @property
    def costs(self) -> np.ndarray:
        return self.values("cost")

    def estimate(self, name: str, statistic: Callable[..., np.ndarray] = stats.mean) -> Estimate:
        return over_seeds(tuple(self.values(name)), statistic)

    @property
    def ret(self) -> Estimate:
        return self.estimate("return")

    @property
    def cost(self) -> Estimate:
        return self.estimate("cost")

    @property
    def held(self) -> str:
        """Whether each limit is: 'unclear' where the mean is above it and its interval is not."""

        def answer(cost: Estimate, limit: float) -> str:
            if np.isnan(cost.mean):
                return "-"
            if cost.mean <= limit:
                return "yes"
            return "unclear" if cost.low <= limit else "no"

        found = {answer(self.estimate(written(name)), most) for name, most in self.limits.items()}
        return next((word for word in ("no", "-", "unclear", "yes") if word in found), "-")


@functools.cache
def over_seeds(values: tuple[float, ...], statistic: Callable[..., np.ndarray]) -> Estimate:
    return stats.estimate(np.array(values), statistic=statistic)


# ---- reading ---------------------------------------------------------------------------------


def read(paths: Iterable[Path], envs: Any, algos: Any) -> list[Run]:
    """Every setting that has begun, of run folders, sweeps, studies, and folders that hold them.

    Raises:
        ConfigError: no run; one that this version cannot read; or the same run twice.
    """
    folders = {folder.resolve(): folder for path in paths for folder in find(path)}
    runs = [run for folder in folders.values() for run in read_one(folder, envs, algos)]
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


def find(path: Path) -> list[Path]:
    """The run folders and studies at or under `path`."""
    path = path.expanduser()
    if not path.is_dir():
        raise ConfigError(f"{path} is not a folder")
    found = []
    for folder, inside, files in os.walk(path):
        inside.sort()
        if "config.yaml" in files or "final.csv" in files:
            found.append(Path(folder))
            inside.clear()
        inside[:] = [name for name in inside if not name.startswith(".")]
    if not found:
        raise ConfigError(f"{path} holds no run: neither it nor a folder in it has a config.yaml")
    return found


def read_one(folder: Path, envs: Any, algos: Any) -> list[Run]:
    """The settings of a run folder, none if it has no iteration yet; or the runs of a study."""
    if condensed.there(folder):
        return read_study(folder, envs, algos)
    plain = run_folder.read_config(folder)
    try:
        saved = command.settle(plain, envs, algos)
    except ConfigError as error:
        by = run_folder.trained_by(folder)
        raise ConfigError(
            f"{folder}, trained by jaxsafe {by}, does not fit jaxsafe {jaxsafe.__version__}: {error}"
        ) from error
    metrics = run_folder.read_metrics(folder)
    if not len(metrics.get("iteration", ())):
        return []
    for name in NEEDED:
        if name not in metrics:
            raise ConfigError(f"{run_folder.metrics_file(folder)} has no column {name}")
    runs = []
    parts = run_folder.by_setting(metrics).values()
    names = [m.setting for m in runner.members(saved.configs, saved.train)[:: saved.train.num_seeds]]
    for cfg, name, table in zip(saved.configs, names, parts, strict=False):
        limits = limits_of(cfg)
        fields = flat(saved._replace(configs=(cfg,)).plain()) | {"run_dir": str(folder)}
        values, seeds = measured(saved.env_name, table, limits), np.unique(table["seed"])
        for what, final in run_folder.read_evaluation(folder, name).items():
            if len(final) != len(seeds):
                raise ConfigError(
                    f"{folder}: evaluation.json is of {len(final)} seeds, metrics.csv of {len(seeds)}"
                )
            values[f"final {what}"] = final
        runs.append(Run(folder, saved.env_name, fields, limits, table, seeds, values))
    return runs


def read_study(folder: Path, envs: Any, algos: Any) -> list[Run]:
    """The runs of a study. `run_dir` ends in the name of each, and tables hold a hundred points a seed.

    Options that did not exist when a run was trained have their defaults of today.
    """
    rows, curves, settings = study = condensed.read(folder)
    runs = []
    for run, options in settings.items():
        own = [row for row in rows if row["run"] == run]
        env, algo = options["env.name"], options["algo.name"]
        config = defaults(env, algo, envs, algos) | options
        config["run_dir"] = str(folder / condensed.name_of(run))
        named = {k: v for k, v in config.items() if k.startswith("algo.cost_limits.") and v is not None}
        limits = {k.removeprefix("algo.cost_limits."): float(v) for k, v in named.items()}
        limits = limits or {"": float(config["algo.cost_limit"])}
        always = ("return", "cost")  # NaN where no episode was whole
        figures = [k for k in study.figures() if k in always or any(row[k] for row in own)]
        values = {k: np.array([float(row[k] or "nan") for row in own]) for k in figures}
        values |= normalised(env, values, limits)
        table = condensed.table(own, [curves[run, row["seed"]] for row in own])
        seeds = np.array([float(row["seed"]) for row in own])
        runs.append(Run(folder, env, config, limits, table, seeds, values))
    return runs


def defaults(
    env: str, algo: str, envs: Any, algos: Any, preset: str = "fast", compat: str = "none"
) -> dict[str, Any]:
    """Today's settings by their names in `flat`; none where this version lacks the names."""
    try:
        named = {"name": algo, **command.algo_options(algos, algo, preset, compat)}
        return flat(command.settle({"env": {"name": env}, "algo": named}, envs, algos).plain())
    except (ConfigError, KeyError):
        return {}


def measured(
    env: str, table: Mapping[str, np.ndarray], limits: Mapping[str, float]
) -> dict[str, np.ndarray]:
    """What is known of each seed, [S], from the columns of metrics.csv.

    Args:
        env: the task, for its characteristic scores.
        table: the columns.
        limits: by the name of a cost; '' is their sum.
    """
    columns = dict(table)
    over = [table[f"train/cost_{k}" if k else "train/cost"] - limit for k, limit in limits.items()]
    worst = np.max(over, axis=0)
    columns["over"] = np.where(np.isnan(worst), np.nan, worst > 0)
    late = functools.partial(run_folder.last_tenth, columns)
    values = {
        "return": late("train/return"),
        "cost": late("train/cost"),
        "violation rate": late("over"),
    }
    if (rate := evaluation.cost_rate(columns)) is not None:
        values["cost rate"] = rate
    for name in cost_names(table):
        values[written(name)] = late(f"train/cost_{name}")
    return values | normalised(env, values, limits)


def normalised(
    env: str, values: Mapping[str, np.ndarray], limits: Mapping[str, float]
) -> dict[str, np.ndarray]:
    """Safety Gym's normalised scores of each seed, as far as there are any, [S]."""
    if env not in scores.CHARACTERISTIC:
        return {}
    found = {"normalised return": scores.normalized_return(env, values["return"])}
    if "" in limits:
        excess = scores.normalized_violation(env, values["cost"], limits[""])
        found["normalised violation"] = excess
    if "cost rate" in values:
        found["normalised cost rate"] = scores.normalized_cost_rate(env, values["cost rate"])
    return found


def cost_names(columns: Iterable[str]) -> list[str]:
    """The costs that an environment tells apart, by the columns of metrics.csv."""
    own = ("train/cost_estimate", "train/cost_rate")  # of the sum, or of each under its own limit
    found = [name for name in columns if name.startswith("train/cost_") and not name.startswith(own)]
    return [name.removeprefix("train/cost_") for name in found]


# ---- grouping --------------------------------------------------------------------------------


def group(runs: Sequence[Run], by: Sequence[str]) -> list[Group]:
    """The runs of each task, told apart by some fields of their configs.

    Raises:
        ConfigError: no run has such a field.
    """
    known = {name for run in runs for name in run.config}
    for name in by:
        if name not in known:
            inside = [k for k in sorted(known) if k.partition(".")[2] == name]
            hint = f"; did you mean {inside[0]!r}?" if inside else nearest(name, known)
            raise ConfigError(f"unknown field {name}{hint}")
    groups: dict[tuple, Group] = {}
    for run in runs:
        values = {name: run.config.get(name, "-") for name in by}
        key = (run.env, *map(str, values.values()))
        groups.setdefault(key, Group(run.env, values, [])).runs.append(run)
    return list(groups.values())


def differing(groups: Iterable[Group]) -> dict[str, list[Any]]:
    """The fields in which runs of one group differ, with their values in one such group."""
    found: dict[str, list[Any]] = {}
    for g in groups:
        for name in dict.fromkeys(k for run in g.runs for k in run.setting):
            values = {str(v): v for v in (run.config.get(name, "-") for run in g.runs)}
            if len(values) > 1:
                found.setdefault(name, list(values.values()))
    return found


def telling(runs: Sequence[Run]) -> list[str]:
    """Fields that tell all settings apart: the algorithm and, where they differ, preset, compat and
    others."""
    by = ["algo.name"]
    while found := differing(group(runs, by)):
        by.append(next((name for name in ("preset", "compat") if name in found), next(iter(found))))
    return by


def ordered(groups: Iterable[Group]) -> list[Group]:
    """By value, numbers by size and words by the alphabet, then by task."""

    def key(g: Group) -> tuple:
        values = g.by.values()
        return (
            *((0, v, "") if isinstance(v, int | float) else (1, 0, str(v)) for v in values),
            g.env,
        )

    return sorted(groups, key=key)


def tasks_of(groups: Iterable[Group]) -> list[str]:
    return sorted({g.env for g in groups})


class Suite(NamedTuple):
    """The tasks that every setting was trained on, and each setting's groups in their order."""

    tasks: list[str]
    groups: dict[str, list[Group]]  # by name

    def samples(self, name: str, metric: str) -> list[np.ndarray]:
        return [g.values(metric) for g in self.groups[name]]


def suite(groups: Sequence[Group]) -> Suite:
    names = list(dict.fromkeys(g.name for g in groups))
    at = {(g.name, g.env): g for g in groups}
    tasks = [env for env in tasks_of(groups) if all((name, env) in at for name in names)]
    return Suite(tasks, {name: [at[name, env] for env in tasks] for name in names})


# ---- published figures -----------------------------------------------------------------------


class Published(NamedTuple):
    """A mean with its spread, of return and of cost."""

    ret: tuple[float, float]
    cost: tuple[float, float]
    cost_limit: float
    source: str
    rules: str  # `env.rules` that it holds for, or '' where all are the same

    def holds_for(self, rules: str) -> bool:
        return self.rules in ("", rules)


def read_published(path: Path) -> dict[tuple[str, str], Published]:
    """Published figures by task and algorithm, from a CSV with the columns of `PUBLISHED`, and `rules`
    where a task has others in `env.rules=safety_gym` and `safety_gymnasium`."""
    try:
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        missing = [name for name in PUBLISHED if not rows or name not in rows[0]]
        if missing:
            raise ConfigError(f"{path} has no column {missing[0]}; expected {', '.join(PUBLISHED)}")
        found = {}
        for row in rows:
            ret, ret_std, cost, cost_std, limit = (float(row[name]) for name in PUBLISHED[3:])
            figures = Published(
                (ret, ret_std), (cost, cost_std), limit, row["source"], row.get("rules") or ""
            )
            found[row["task"], row["algo"]] = figures
    except ConfigError:
        raise
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(f"{path} cannot be read: {command.one_line(error)}") from error
    return found


def beside(g: Group, published: Mapping[tuple[str, str], Published]) -> Published | None:
    """What was published for this task, its rules, algorithm and limit."""
    found = published.get((g.env, g.algo or ""))
    if found is None or found.cost_limit != g.cost_limit:
        return None
    rules = (
        run.config.get("env.rules", "safety_gym") for run in g.runs
    )  # none before they were an option
    return found if all(map(found.holds_for, rules)) else None


# ---- tables ----------------------------------------------------------------------------------


def results(
    groups: Sequence[Group], metric: str, published: Mapping[tuple[str, str], Published]
) -> Table:
    """Return or cost: a row a setting, with what was published below it, and a column a task."""
    envs = tasks_of(groups)
    at = {(g.name, g.env): g for g in groups}
    limits = {in_words(g.limits) for g in groups}
    safe = [g for g in groups if g.held == "yes" and not np.isnan(g.ret.mean) and len(limits) == 1]
    best = {env: max((g.ret.mean for g in safe if g.env == env), default=None) for env in envs}
    rows = []
    for name in dict.fromkeys(g.name for g in groups):
        ours, theirs, source = [f"`{name}`"], [], ""
        for env in envs:
            g = at.get((name, env))
            e = g.estimate(metric) if g else Estimate(np.nan, np.nan, np.nan)
            text, beyond, known = tables.cell(e, ".2f"), "", None
            if g and metric == "return" and g in safe and e.mean == best[env]:
                text = f"**{text}**"
            if g and (known := beside(g, published)):
                mean, spread = known.ret if metric == "return" else known.cost
                beyond = " ↑" * (e.mean > mean + spread) + " ↓" * (e.mean < mean - spread)
                theirs.append(f"{mean:.2f} ± {spread:.2f}")
                source = known.source
            else:
                theirs.append("-")
            ours.append(text + beyond)
        rows.append(ours)
        if source:
            rows.append([source, *theirs])
    what = "Return" if metric == "return" else "Cost"
    caption = f"{what} of an episode, last 10% of training: mean and 95% interval over seeds."
    if len(limits) == 1 and (words := next(iter(limits))) != "-":
        caption += f" Cost limit {words}."
    if metric == "return" and safe:
        caption += " Bold: the highest return of a task whose mean cost is within the limit."
    if published:
        caption += " ↑ ↓: the mean lies above or below the published spread."
    return Table(caption, ["", *envs], rows)


def details(groups: Sequence[Group]) -> list[Table]:
    """What else is known of each setting on each task."""
    groups = sorted(groups, key=lambda g: g.env)
    known = [m for m in ("violation rate", "cost rate") if any(known_of(g, m) for g in groups)]
    header = ["task", "setting", "seeds", "steps", "return, IQM", "cost, IQM", "limit", "held", *known]
    rows = [
        [
            f"`{g.env}`", f"`{g.name}`", str(len(g.costs)), f"{g.steps:,}",
            *(tables.cell(g.estimate(m, stats.iqm)) for m in ("return", "cost")),
            in_words(g.limits), g.held,
            *(tables.cell(g.estimate(m), ".3g") for m in known),
        ]
        for g in groups
    ]  # fmt: skip
    caption = (
        "Each task. IQM: interquartile mean over seeds. Held: whether the mean cost is within the "
        "limit; unclear where it is not but its interval is. Violation rate: the share of iterations, "
        "in the last 10%, whose mean cost of an episode is over the limit. Cost rate: total cost over "
        "total steps of training."
    )
    out = [Table(caption, header, rows, left=2)]
    scored = [g for g in groups if known_of(g, SCORES[0])]
    if scored:
        rows = [
            [f"`{g.env}`", f"`{g.name}`", *(tables.cell(g.estimate(m), ".3g") for m in SCORES)]
            for g in scored
        ]
        caption = "Safety Gym's normalised scores: 1 is unconstrained PPO, a violation of 0 the limit."
        out.append(Table(caption, ["task", "setting", *(m.split(" ", 1)[1] for m in SCORES)], rows, 2))
    every = dict.fromkeys(m for g in groups for run in g.runs for m in run.values)
    costs = [m for m in every if m.startswith("cost ") and m != "cost rate"]
    if len(costs) > 1:
        rows = [
            [f"`{g.env}`", f"`{g.name}`", *(tables.cell(g.estimate(m)) for m in costs)] for g in groups
        ]
        caption = "Each cost of an episode, last 10% of training."
        out.append(Table(caption, ["task", "setting", *(m.split(" ", 1)[1] for m in costs)], rows, 2))
    evaluated = [g for g in groups if known_of(g, "final return")]
    if evaluated:
        header = ["task", "setting", *(m.removeprefix("final ") for m in FINAL)]
        rows = [
            [f"`{g.env}`", f"`{g.name}`", *(tables.cell(g.estimate(m)) for m in FINAL)]
            for g in evaluated
        ]
        caption = (
            "The final policy: the mean action, over fresh episodes of each seed. Violation rate: the "
            "share of episodes whose cost is over the limit. Discounted: by the learner's factors."
        )
        out.append(Table(caption, header, rows, 2))
    return out


def known_of(g: Group, metric: str) -> bool:
    return any(metric in run.values for run in g.runs)


def aggregates(s: Suite) -> dict[tuple[str, str, str], Estimate]:
    """Mean and IQM of each score over tasks and seeds, by setting, score and statistic."""
    return {
        (name, metric, kind): stats.estimate(*s.samples(name, metric), statistic=statistic)
        for name in s.groups
        for metric in SCORES
        for kind, statistic in (("mean", stats.mean), ("IQM", stats.iqm))
    }


def improvements(s: Suite) -> dict[tuple[str, str, str], Estimate]:
    """P(a seed of one setting beats one of another), in return (higher) and in cost (lower)."""
    names, found = list(s.groups), {}
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            more = [s.samples(name, "return") for name in (a, b)]
            less = [s.samples(name, "cost") for name in (b, a)]
            found[a, b, "return"] = stats.probability_of_improvement(more[0], more[1])
            found[a, b, "cost"] = stats.probability_of_improvement(less[0], less[1])
    return found


def across(s: Suite, found: Mapping, pairs: Mapping) -> list[Table]:
    out = []
    of = f"{len(s.tasks)} tasks ({', '.join(s.tasks)})" if len(s.tasks) > 1 else s.tasks[0]
    if found:
        header = [
            "setting",
            *(f"{m.split(' ', 1)[1]}, {kind}" for m in SCORES for kind in ("mean", "IQM")),
        ]
        rows = [
            [
                f"`{n}`",
                *(tables.cell(found[n, m, kind], ".3g") for m in SCORES for kind in ("mean", "IQM")),
            ]
            for n in s.groups
        ]
        caption = f"Normalised scores over {of}: mean and interquartile mean, stratified 95% intervals."
        out.append(Table(caption, header, rows))
    if pairs:
        rows = [
            [f"`{a}`", f"`{b}`", *(tables.cell(pairs[a, b, m], ".2f") for m in ("return", "cost"))]
            for a, b, metric in pairs
            if metric == "return"
        ]
        caption = (
            f"Probability of improvement over {of}: that a seed of X has the higher return, or the "
            "lower cost, than one of Y."
        )
        out.append(Table(caption, ["X", "Y", "higher return", "lower cost"], rows, 2))
    return out


def notes(groups: Sequence[Group]) -> list[str]:
    """What a reader of the figures should know."""
    lines = []
    for name, values in differing(groups).items():
        lines.append(f"averaged over {name} ({', '.join(map(str, values))})")
    for run in (run for g in groups for run in g.runs):
        if run.steps < run.config["total_steps"]:
            total = run.config["total_steps"]
            lines.append(f"unfinished: {run.config['run_dir']}, at {run.steps:,} of {total:,} steps")
    envs = tasks_of(groups)
    if left := [env for env in envs if env not in suite(groups).tasks]:
        lines.append(f"not in comparisons across tasks, as a setting lacks them: {', '.join(left)}")
    if unscored := [env for env in envs if env not in scores.CHARACTERISTIC]:
        lines.append(
            f"without normalised scores, as there are no published ones: {', '.join(unscored)}"
        )
    return list(dict.fromkeys(lines))


def as_csv(groups: Sequence[Group], s: Suite, found: Mapping, pairs: Mapping) -> str:
    """Every estimate, a row each."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    by = list(groups[0].by)
    writer.writerow(["task", *by, "seeds", "metric", "statistic", "value", "low", "high"])
    kinds = (("mean", stats.mean), ("IQM", stats.iqm))
    for g in groups:
        for metric in dict.fromkeys(m for run in g.runs for m in run.values):
            for kind, statistic in kinds:
                e = g.estimate(metric, statistic)
                writer.writerow([g.env, *g.by.values(), len(g.costs), metric, kind, *e])
    tasks = " ".join(s.tasks)
    for (name, metric, kind), e in found.items():
        values = s.groups[name][0].by.values()
        seeds = sum(len(g.costs) for g in s.groups[name])
        writer.writerow([tasks, *values, seeds, metric, kind, *e])
    for (a, b, metric), e in pairs.items():
        values = s.groups[a][0].by.values()
        seeds = sum(len(g.costs) for g in s.groups[a])
        writer.writerow([tasks, *values, seeds, metric, f"P(better than {b})", *e])
    return out.getvalue()


# ---- everything ------------------------------------------------------------------------------


def write(
    groups: Sequence[Group], out: Path, published: Mapping[tuple[str, str], Published] | None = None
) -> str:
    """Write every table and figure into `out`; returns the tables of return and of cost as text."""
    published = published or {}
    both = suite(groups)
    scored = suite([g for g in groups if g.env in both.tasks and known_of(g, SCORES[0])])
    found = aggregates(scored) if scored.tasks else {}
    pairs = improvements(both) if both.tasks else {}
    main = [results(groups, metric, published) for metric in ("return", "cost")]
    rest = [*details(groups), *(across(scored, found, {}) if len(scored.tasks) > 1 else [])]
    rest += across(both, {}, pairs) if pairs else []
    remarks = notes(groups)
    parts = [f"{t.caption}\n\n{tables.markdown(t)}" for t in (*main, *rest)]
    text = "\n".join([*parts, *([f"Notes: {'; '.join(remarks)}.\n"] if remarks else [])])
    out.mkdir(parents=True, exist_ok=True)
    run_folder.replace_text(out / "results.md", text)
    latex = [f"% {line}\n" for line in remarks] + [tables.latex(t) for t in (*main, *rest)]
    run_folder.replace_text(out / "results.tex", "\n".join(latex))
    run_folder.replace_text(out / "results.csv", as_csv(groups, both, found, pairs))
    plots.save(plots.learning(groups), out / "curves")
    known = {(g.env, g.name): beside(g, published) for g in groups}
    plots.save(plots.trade_off(groups, "last 10 % of training", known), out / "trade_off")
    for name in ("scores", "profiles"):
        for suffix in plots.FORMATS:
            (out / f"{name}.{suffix}").unlink(missing_ok=True)
    if found:
        plots.save(plots.normalised(list(scored.groups), SCORES, found), out / "scores")
        plots.save(plots.profiles(scored), out / "profiles")
    return "\n".join([*parts[:2], *(f"{line}\n" for line in remarks)])


def main(envs: Any, algos: Any) -> int:
    """scripts/plot.py. Exit status: 2 for bad input, 1 for a failed disk."""

    def draw() -> int:
        parser = argparse.ArgumentParser(
            description=(__doc__ or "").partition("\n")[0],
            epilog=(__doc__ or "").partition("\n\n")[2],
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        parser.error = command.fail  # type: ignore[method-assign]
        parser.add_argument("runs", nargs="+", type=Path, metavar="RUNS")
        parser.add_argument(
            "--by", nargs="+", metavar="FIELD", default=[],
            help="what tells settings apart, as algo.name or algo.cost_limit; runs that agree in it "
            "are averaged (default: the algorithm, and whatever else they differ in)",
        )  # fmt: skip
        parser.add_argument("--published", type=Path, metavar="CSV", help="figures to set beside")
        parser.add_argument("--out", type=Path, default=Path("comparison"), metavar="DIR")
        args = parser.parse_args()
        published = read_published(args.published) if args.published else {}
        runs = read(args.runs, envs, algos)
        by = [name for name in args.by if name != "env.name"] or telling(runs)
        groups = ordered(group(runs, by))
        try:
            args.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"--out {args.out}: {error.strerror}") from error
        print(f"{len(runs)} run{'s' * (len(runs) > 1)} by {', '.join(by)}", file=sys.stderr)
        print(write(groups, args.out, published) + f"written: {args.out}")
        return 0

    return command.guarded(draw)

"""Runs in groups that a table or a figure has a row or a line for."""

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxsafe.algos import ALGOS
from jaxsafe.config import ConfigError, nearest
from jaxsafe.learn.constraints import cost_title
from jaxsafe.report import stats
from jaxsafe.report.read import SettingRun
from jaxsafe.report.stats import Estimate
from jaxsafe.run import run_folder

LATE, EVALUATED = "last 10% of training", "final evaluation"  # what figures are of
FEW = 10  # episodes; the mean of fewer says little of a limit


class Group(NamedTuple):
    """The runs of one task that agree in some fields, `by`."""

    env: str
    by: dict[str, Any]
    runs: list[SettingRun]

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
        return over_seeds(name, tuple(self.values(name)), statistic)

    @property
    def ret(self) -> Estimate:
        return self.estimate("return")

    @property
    def cost(self) -> Estimate:
        return self.estimate("cost")

    @property
    def estimated(self) -> bool:
        """Whether no episode has ended in any run, so that return and cost are estimates."""
        return all(run.estimated for run in self.runs)

    @property
    def evaluated(self) -> bool:
        """Whether return and costs of every run are of its final evaluation."""
        return all(run.evaluated for run in self.runs)

    @property
    def few_episodes(self) -> int:
        """On how many episodes return and costs rest, where these are few; else 0."""
        count = sum(run.episodes for run in self.runs)
        return int(count) if count < FEW else 0

    @property
    def diverged(self) -> list[int]:
        """The seeds that did, in any run."""
        return sorted({seed for run in self.runs for seed in run.diverged})

    @property
    def held(self) -> str:
        """Whether each limit is: 'unclear' where the mean is above it and its interval is not, or, of
        two seeds, which have none, one is not, and where few episodes ended; 'diverged' where a seed
        did, whatever it cost."""
        if self.diverged:
            return "diverged"

        def answer(name: str, limit: float) -> str:
            cost, values = self.estimate(name), self.values(name)
            if np.isnan(cost.mean):
                return "-"
            if cost.mean <= limit:
                return "yes"
            low = cost.low if stats.has_interval(values) else values.min()
            return "unclear" if low <= limit else "no"

        found = {answer(cost_title(name), most) for name, most in self.limits.items()}
        word = next((word for word in ("no", "-", "unclear", "yes") if word in found), "-")
        return word if word == "-" or not (self.estimated or self.few_episodes) else "unclear"


@functools.cache
def over_seeds(name: str, values: tuple[float, ...], statistic: Callable[..., np.ndarray]) -> Estimate:
    return stats.of_measure(name, np.array(values), statistic=statistic)


def has_limit(algo: str | None) -> bool:
    """Whether an algorithm keeps to a limit of cost. One that is not known here is taken to."""
    row = ALGOS.get(algo or "")
    return row is None or row.holds != "nothing"


def clock(groups: Iterable[Group]) -> str:
    """What the steps of settings count, 'steps' or 'updates'."""
    return " or ".join(sorted({run.clock for g in groups for run in g.runs})) or "steps"


def period(groups: Iterable[Group]) -> str:
    """What the figures of settings are of."""
    known = {g.evaluated for g in groups} or {False}
    return " or ".join(EVALUATED if found else LATE for found in sorted(known))


def group(runs: Sequence[SettingRun], by: Sequence[str]) -> list[Group]:
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


def telling(runs: Sequence[SettingRun]) -> list[str]:
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

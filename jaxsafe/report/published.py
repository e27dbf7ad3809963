"""Published figures, to set beside one's own."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from jaxsafe.config import ConfigError
from jaxsafe.report.group import Group
from jaxsafe.run import files

PUBLISHED = ("task", "algo", "source", "return", "return_std", "cost", "cost_std", "cost_limit")


class Published(NamedTuple):
    """A mean with its spread, of return and of cost."""

    ret: tuple[float, float]
    cost: tuple[float, float]
    cost_limit: float
    source: str
    rules: str  # `env.rules` that it holds for, or '' where all are the same

    def holds_for(self, rules: str) -> bool:
        return self.rules in ("", rules)


class CurveEnd(NamedTuple):
    """Where a published curve ends; NaN where it cannot be read."""

    steps: float
    ret: float
    cost: float


def read_published(path: Path) -> dict[tuple[str, str], Published]:
    """Published figures by task and algorithm, from a CSV with the columns of `PUBLISHED`, and `rules`
    where a task has others in `env.rules=safety_gym` and `safety_gymnasium`."""
    found: dict[tuple[str, str], Published] = {}
    with files.reading(path), path.open(newline="") as file:
        rows = list(csv.DictReader(file))
        missing = [name for name in PUBLISHED if not rows or name not in rows[0]]
        if missing:
            raise ConfigError(f"{path} has no column {missing[0]}; expected {', '.join(PUBLISHED)}")
        for row in rows:
            ret, ret_std, cost, cost_std, limit = (float(row[name]) for name in PUBLISHED[3:])
            key = row["task"], row["algo"]
            if key in found:
                raise ConfigError(f"{path}: {' '.join(key)} occurs twice")
            found[key] = Published(
                (ret, ret_std), (cost, cost_std), limit, row["source"], row.get("rules") or ""
            )
    return found


def read_ends(path: Path) -> dict[tuple[str, str], CurveEnd]:
    """Where published curves end, by task and algorithm, from a CSV with the columns env, algo, steps,
    return and cost."""
    with files.reading(path), path.open(newline="") as file:
        return {
            (row["env"], row["algo"]): CurveEnd(
                *(float(row[name] or "nan") for name in ("steps", "return", "cost"))
            )
            for row in csv.DictReader(file)
        }


def end_beside(
    g: Group,
    published: Mapping[tuple[str, str], Published],
    ends: Mapping[tuple[str, str], CurveEnd],
) -> CurveEnd | None:
    """Where the published curve ends of what `beside` finds, if training was as long."""
    end = ends.get((g.env, g.algo or ""))
    if end is None or beside(g, published) is None or abs(g.steps / end.steps - 1) > 0.01:
        return None
    return end


def beside(g: Group, published: Mapping[tuple[str, str], Published]) -> Published | None:
    """What was published for this task, its rules, algorithm and limit."""
    found = published.get((g.env, g.algo or ""))
    if found is None or found.cost_limit != g.cost_limit:
        return None
    # runs from before `rules` was an option have none
    rules = (run.config.get("env.rules", "safety_gym") for run in g.runs)
    return found if all(map(found.holds_for, rules)) else None

"""The cells of the off-policy and velocity studies beside OmniSafe's: docs/results/cells.md

A cell is an algorithm on a task after a number of steps. It counts if ours, evaluated by mean actions,
earns at least OmniSafe's mean less its spread and, where it has a limit, costs at most that, 25.
"""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsafe.report.group import has_limit
from jaxsafe.report.published import Published

RESULTS = Path(__file__).parent / "results"
FIVE = ("sac", "sac_lag", "sac_pid", "td3_lag", "ddpg_lag")
SIX = ("ppo", "ppo_lag", "cpo", "trpo_lag", "focops", "cppo_pid")
GOALS = ("point_goal1", "car_goal1")
ROBOTS = ("halfcheetah", "hopper", "ant")
ALL_ROBOTS = (*ROBOTS, "walker2d", "swimmer", "humanoid")
# of another task, limit or number of seeds
OTHERS = ("env.rules=", "algo.cost_limit=", "num_seeds=")


class Cell(NamedTuple):
    """An algorithm on a task: `shipped` are the options of what stands for it, `steps` those of all."""

    env: str
    algo: str
    shipped: str
    steps: str
    studies: tuple[str, ...]


class Made(NamedTuple):
    """What policies of five seeds made, by the mean over seeds, with their options."""

    options: str
    ret: float
    cost: float


def asked() -> list[Cell]:
    """The 71 cells, in the order of the table."""
    off = ("off_policy", "td3")
    goal = ("goal_off_policy",)
    on = ("velocity", "velocity_settings")
    at_256 = {x: "preset=parallel_navigation algo.n_step=3" for x in FIVE} | {"sac": "preset=parallel"}
    tasks = [f"{robot}_velocity" for robot in ROBOTS]
    return [
        *(Cell(env, x, "preset=parallel", "1e6", off) for env in tasks for x in FIVE),
        *(Cell(env, x, at_256[x], "3e6", goal) for env in GOALS for x in FIVE),
        *(Cell(env, x, "", "1e7", off) for env in (*GOALS, *tasks) for x in ("sac_lag", "td3_lag")),
        *(Cell(f"{robot}_velocity", x, "", "", on) for robot in ALL_ROBOTS for x in SIX),
    ]


def runs_of(cell: Cell) -> list[Made]:
    """The evaluated runs of five seeds, with any settings, that have the task's own rules and limit."""
    found: dict[str, list[tuple[float, float]]] = {}
    for name in cell.studies:
        with (RESULTS / name / "final.csv").open(newline="") as file:
            for row in csv.DictReader(file):
                given = row["run"].split()
                head = [f"env={cell.env}", f"algo={cell.algo}", *filter(None, [steps(cell)])]
                others = any(x.startswith(OTHERS) for x in given)
                if not others and set(head) <= set(given) and row["final return"]:
                    options = " ".join(x for x in given if x not in head)
                    figures = float(row["final return"]), float(row["final cost"])
                    found.setdefault(options, []).append(figures)
    return [Made(x, *np.mean(made, axis=0)) for x, made in found.items() if len(made) == 5]


def steps(cell: Cell) -> str:
    return f"total_steps={cell.steps}" if cell.steps else ""


def counts(made: Made, cell: Cell, known: Published) -> bool:
    return within(made, cell, known) and made.ret >= known.ret[0] - known.ret[1]


def within(made: Made, cell: Cell, known: Published) -> bool:
    """Whether the cost is at most the published limit, or the algorithm has none."""
    return not has_limit(cell.algo) or made.cost <= known.cost_limit


def table(published: Mapping[tuple[str, str], Published]) -> str:
    """How many cells count with the settings that are shipped and with the best of each cell, and a row
    for each that does not with the first."""
    lines = ["| | OmniSafe | shipped | ours | the best that was tried | ours |"]
    lines.append("|---|---:|---|---:|---|---:|")
    shipped_in = best_in = 0
    cells = asked()
    for cell in cells:
        known, made = published[cell.env, cell.algo], runs_of(cell)
        (shipped,) = (x for x in made if x.options == cell.shipped)
        best = max(made, key=lambda x: (counts(x, cell, known), worth(x, cell, known)))
        good = counts(shipped, cell, known), counts(best, cell, known)
        shipped_in, best_in = shipped_in + good[0], best_in + good[1]
        if not good[0]:
            theirs = f"{known.ret[0]:,.1f} ± {known.ret[1]:,.1f} at {known.cost[0]:.0f}"
            name = f"`{cell.env}` `{cell.algo}`" + f" {cell.steps}" * bool(cell.steps)
            tried = named(best.options) if best != shipped else ""
            last = figures(best) if best != shipped else ""
            last = f"**{last or 'outside'}**" if not good[1] else last
            row = [name, theirs, named(cell.shipped), figures(shipped), tried, last]
            lines.append(f"| {' | '.join(row)} |")
    total = len(cells)
    summary = (
        f"Of {total} cells {shipped_in} count with the settings that are shipped, and {best_in} with "
        f"the best that was tried for each: {total - shipped_in} and {total - best_in} are outside, "
        f"{(total - shipped_in) / total:.0%} and {(total - best_in) / total:.0%}."
    )
    return "\n".join([summary, "", *lines])


def worth(made: Made, cell: Cell, known: Published) -> float:
    """The return, where the limit is held; else less the higher the cost is."""
    return made.ret if within(made, cell, known) else -made.cost


def figures(made: Made) -> str:
    return f"{made.ret:,.1f} at {made.cost:.0f}"


def named(options: str) -> str:
    return f"`{options}`" if options else "defaults"

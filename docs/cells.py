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
ON_POLICY = [f"{robot}_velocity" for robot in (*ROBOTS, "walker2d", "swimmer", "humanoid")]
FREQUENT = "preset=frequent"
PARALLEL = "preset=published algo.num_envs=160 algo.horizon=125"
EARLY_PRICE = f"{FREQUENT} algo.lam_init=1"
# How runs of the studies say what is shipped for a task, after 1e7 steps: `preset=auto` gives the same.
# A run with no options stands for the other tasks.
SHIPPED = {
    **{
        (f"{robot}_velocity", x): FREQUENT for robot in ("walker2d", "swimmer", "humanoid") for x in SIX
    },
    **{("hopper_velocity", x): PARALLEL for x in ("cpo", "cppo_pid")},
    ("hopper_velocity", "focops"): FREQUENT,
    **{("swimmer_velocity", x): EARLY_PRICE for x in ("ppo_lag", "trpo_lag")},
    **{("humanoid_velocity", x): PARALLEL for x in ("ppo", "ppo_lag", "cppo_pid")},
    **{
        (f"{robot}_velocity", "td3_lag"): "preset=fast algo.lr_decay=true"
        for robot in ("halfcheetah", "ant")
    },
}
# Off-policy studies have bfloat16. A run of theirs in float32, as is shipped, stands for its cell.
FLOAT32 = " algo.hidden_dtype=float32"
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
        *(
            Cell(env, x, SHIPPED.get((env, x), ""), "1e7", off)
            for env in (*GOALS, *tasks)
            for x in ("sac_lag", "td3_lag")
        ),
        *(Cell(env, x, SHIPPED.get((env, x), ""), "", on) for env in ON_POLICY for x in SIX),
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
    lines = ["| | OmniSafe | shipped | the best tried |", "|---|---:|---:|---:|"]
    cells, count, above = asked(), np.zeros(2, int), 0
    for cell in cells:
        known, made = published[cell.env, cell.algo], runs_of(cell)
        by_options = {x.options: x for x in made}
        shipped = by_options.get(cell.shipped + FLOAT32) or by_options[cell.shipped]
        best = max(made, key=lambda x: (counts(x, cell, known), worth(x, cell, known)))
        chosen = shipped, best
        good = [counts(x, cell, known) for x in chosen]
        count += good
        above += good[0] and shipped.ret > known.ret[0] + known.ret[1]
        if not good[0]:
            theirs = f"{known.ret[0]:,.1f} ± {known.ret[1]:,.1f} at {known.cost[0]:.0f}"
            name = f"`{cell.env}` `{cell.algo}`" + f" {cell.steps}" * bool(cell.steps)
            shown = [figures(x, counted) for x, counted in zip(chosen, good, strict=True)]
            if best == shipped:
                shown[1] = "**the same**"
            lines.append(f"| {' | '.join([name, theirs, *shown])} |")
    total = len(cells)
    outside = total - count
    shares = ", ".join(f"{x / total:.0%}" for x in outside)
    summary = (
        f"Of {total} cells {count[0]} count with the settings that are shipped, and {count[1]} with "
        f"the best that was tried for each. Outside are {outside[0]} and {outside[1]}: {shares}. With "
        f"what is shipped {above} that count earn more than OmniSafe's by more than its spread."
    )
    return "\n".join([summary, "", *lines])


def worth(made: Made, cell: Cell, known: Published) -> float:
    """The return, where the limit is held; else less the higher the cost is."""
    return made.ret if within(made, cell, known) else -made.cost


def figures(made: Made, counted: bool) -> str:
    """Return and cost with the options, bold where the cell does not count."""
    shown = f"{made.ret:,.1f} at {made.cost:.0f}"
    options = f"`{made.options}`" if made.options else "the defaults"
    return f"{shown if counted else f'**{shown}**'}<br>{options}"

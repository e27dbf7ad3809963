"""What the results pages say must hold of the runs that they are made from."""

import itertools
import statistics
from pathlib import Path

import pytest

from jaxsafe.report import study_files

RESULTS = Path(__file__).parents[2] / "docs" / "results"
# the return of an episode at the velocity that is just allowed, from the thresholds
CEILING = {
    "ant_velocity": 3622, "halfcheetah_velocity": 3210, "hopper_velocity": 1740,
    "walker2d_velocity": 3342, "swimmer_velocity": 228, "humanoid_velocity": 6769,
}  # fmt: skip


def rows_of(study: str) -> list[dict[str, str]]:
    return [row for row in study_files.read(RESULTS / study).rows if row["state"] == "done"]


def mean(rows: list[dict[str, str]], name: str, **where: str) -> float:
    """Over the seeds of the rows with these values."""
    found = [row for row in rows if all(part in row[key] for key, part in where.items())]
    return statistics.mean(float(row[name]) for row in found)


@pytest.mark.parametrize("study", ["velocity", "velocity_settings", "off_policy"])
@pytest.mark.parametrize("when", ["", "final "])
def test_no_agent_within_the_limit_outruns_what_is_allowed(study, when):
    seeds = [row for row in rows_of(study) if row["env"] in CEILING and row[when + "cost"]]
    safe = [row for row in seeds if float(row[when + "cost"]) <= 25]
    assert len(safe) > 5
    for row in safe:
        assert float(row[when + "return"]) < 1.01 * CEILING[row["env"]], row["run"]


@pytest.mark.parametrize("env", ["point_circle1", "car_circle1", "point_goal1"])
def test_the_cost_of_imitation_falls_with_the_share_of_safe_episodes(env):
    runs = [f"algo=bc dataset=runs/data/{env}/{beta}" for beta in ("0.25", "0.50", "0.75")]
    costs = [mean(rows_of("offline"), "final cost", env=env, run=run) for run in runs]
    assert all(a > b for a, b in itertools.pairwise(costs))


@pytest.mark.parametrize("env", ["point_circle1", "car_circle1"])
@pytest.mark.parametrize("beta", ["0.25", "0.50", "0.75"])
def test_imitation_of_the_safe_episodes_alone_holds_the_limit(env, beta):
    run = f"algo=bc_safe dataset=runs/data/{env}/{beta}"
    assert mean(rows_of("offline"), "final cost", env=env, run=run) <= 25


def test_a_planner_within_a_limit_earns_and_costs_next_to_nothing_and_a_blind_one_costs_much():
    rows = rows_of("planning")
    planned, blind = (
        {"env": "point_goal1", "run": f"env=point_goal1 algo={algo} num_seeds=5 total_steps=1e6"}
        for algo in ("cce_pets", "pets")
    )
    assert mean(rows, "final return", **planned) >= 24 and mean(rows, "final cost", **planned) <= 3
    assert 40 < mean(rows, "final cost", **blind) < 70

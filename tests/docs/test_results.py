"""What the results pages say must hold of the runs that they are made from."""

import itertools
import json
import re
import statistics
from collections import Counter, defaultdict
from pathlib import Path

import pytest

from jaxsafe.commands.study import states
from jaxsafe.report import studies, study_files

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


@pytest.mark.parametrize("name", sorted(path.parent.name for path in RESULTS.glob("*/study.yaml")))
def test_a_page_counts_the_runs_of_its_study_that_are_done(name):
    found = list(states(studies.read(RESULTS / name)).values())
    text = (RESULTS / name / "README.md").read_text()
    words = {"None": "0", "One": "1", "Eight": "8", "four": "4", "nine": "9"}
    counted = re.findall(r"(\w+) (?:of )?(?:the )?(\w+) runs (?:is|are) (?:done|begun)", text)
    for done, of in counted:
        of = words.get(of, of)
        done = of if done == "All" else words.get(done, done)
        assert (done, of) == (str(found.count("done")), str(len(found)))


@pytest.mark.parametrize(
    "study",
    ["velocity", "velocity_settings", "off_policy", "td3", "fast", "planning_velocity"],
)
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


def test_c_crr_holds_the_limit_in_three_of_six_runs_on_circle_and_comes_near_in_a_fourth():
    costs = sorted(
        mean(rows_of("offline"), "final cost", env=env, run=f"algo=ccrr dataset=runs/data/{env}/{beta}")
        for env in ("point_circle1", "car_circle1")
        for beta in ("0.25", "0.50", "0.75")
    )
    assert costs[2] <= 25 < costs[3] < 26 < 40 < costs[4]


@pytest.mark.parametrize(
    "env, cells",
    [
        ("point_circle1", {"a4bacb1": 4, "81e3279": 5, "4963301": 1, "1113832": 2}),
        ("car_circle1", {"81e3279": 9, "06f42f6": 1, "4963301": 2}),
    ],
)
def test_the_cells_beside_omnisafes_are_of_data_made_at_these_commits(env, cells):
    of_run = {
        row["run"]: row["commit"][:7]
        for row in rows_of("offline")
        if row["env"] == env
        and row["algo"] in ("vae_bc", "ccrr", "bcq_lag", "coptidice")
        and "total_updates" not in row["run"]
    }
    assert Counter(of_run.values()) == cells


def test_a_planner_within_a_limit_earns_and_costs_next_to_nothing_and_a_blind_one_costs_much():
    rows, sizes = rows_of("planning"), "algo.model_lr=1e-3 num_seeds=5 total_steps=1e6"
    planned, blind = (
        {"env": "point_goal1", "run": f"env=point_goal1 algo={algo} {sizes}"}
        for algo in ("cce_pets", "pets")
    )
    assert mean(rows, "final return", **planned) >= 24 and mean(rows, "final cost", **planned) <= 3
    assert 40 < mean(rows, "final cost", **blind) < 70


def seditor(task: str, name: str, edit: str = "") -> float:
    """The mean of a figure over SEditor's seeds with the defaults, or with another `edit`."""
    run = f"env=seditor_point_{task} algo=seditor{edit}"
    found = [row for row in rows_of("seditor") if row["run"] == run]
    assert len(found) == 3
    return mean(found, name)


@pytest.mark.parametrize("task", ["goal1", "goal2", "button1", "button2"])
def test_seditor_succeeds_within_a_violation_in_1000_steps_on_goal_and_button(task):
    """In the last tenth of training. The estimate is of 999 steps, from the cost of each."""
    assert seditor(task, "goals") >= 0.9 and seditor(task, "cost estimate") <= 1


def test_seditor_succeeds_in_three_of_ten_episodes_of_push_more_than_one_policy_does():
    alone = seditor("push1", "goals", " algo.edit=none")
    assert seditor("push1", "goals") >= alone + 0.3


# what OmniSafe's best algorithm on policy earns at a cost of at most 27.5
BARS = {
    "point_goal1": 19.2, "car_goal1": 27.0, "point_goal2": 4.6, "car_goal2": 2.3,
    "point_button1": 4.6, "car_button1": 0.0, "point_button2": 5.4, "car_button2": -0.99,
}  # fmt: skip


@pytest.mark.parametrize("env", sorted(BARS))
def test_a_policy_of_ours_within_the_limit_earns_what_omnisafes_best_on_policy_does(env):
    runs = defaultdict(list)
    for study in ("goal", "button", "causes", "off_policy"):
        for row in rows_of(study):
            if row["env"] == env and row["final return"] and "terminated" not in row["algo"]:
                runs[study, row["run"]].append(row)
    found = [
        mean(rows, "final return")
        for rows in runs.values()
        if len(rows) >= 5 and mean(rows, "final cost") <= 25
    ]
    assert max(found) >= BARS[env]


@pytest.mark.parametrize("study", ["goal", "button"])
def test_ten_algorithms_are_of_one_commit_and_evaluated_with_both_kinds_of_action(study):
    ten = ["ppo", "ppo_lag", "trpo_lag", "cpo", "pcpo", "cup", "focops", "p3o", "trpo_pid", "rcpo"]
    rows = [row for row in rows_of(study) if row["algo"] in ten]
    assert Counter(row["algo"] for row in rows) == dict.fromkeys(ten, 4 * 5)  # tasks and seeds
    assert {row["commit"][:7] for row in rows} == {"24de6da"}
    assert all(row["final return"] and row["final sampled return"] for row in rows)


def test_the_first_table_of_offline_algorithms_has_what_their_policies_cost():
    text, rows = (RESULTS / "offline" / "README.md").read_text(), rows_of("offline")
    tasks = [
        (env, beta)
        for env in ("point_circle1", "car_circle1", "point_goal1")
        for beta in ("0.25", "0.50", "0.75")
    ]
    found = re.findall(r"^\| `(\w+)` \|((?: [*\d.]+(?: \[\d+\])? \|){9})$", text, re.M)
    assert len(found) == 8
    for algo, cells in found:
        costs = [cell.split()[0] for cell in cells.strip("|").split("|")]
        for (env, beta), cost in zip(tasks, costs, strict=True):
            run = f"algo={algo} dataset=runs/data/{env}/{beta}.hdf5"
            one = [row for row in rows if row["env"] == env and row["run"].endswith(run)]
            made, shown = mean(one, "final cost"), cost.strip("*")
            assert f"{made:.{1 if '.' in shown else 0}f}" == shown, (algo, env, beta)
            assert cost.startswith("**") == (made <= 25)


@pytest.mark.parametrize(
    "study, envs, returns, costs",
    [
        ("goal", ["point_goal1", "car_goal1"], ("11", "25"), ("16", "31")),
        ("goal", ["point_goal2", "car_goal2"], ("0.5", "5"), ("20", "39")),
        ("button", ["point_button1", "point_button2"], ("-1", "6.1"), ("10", "30")),
        ("button", ["car_button1", "car_button2"], ("-1", "1.5"), ("12", "44")),
    ],
)
def test_the_14_algorithms_with_a_limit_train_between_these_figures(study, envs, returns, costs):
    others = ["ppo", "trpo", "pg", "npg", "pdo", "ipo", "crpo", "ppo_penalty"]
    rows = [row for row in rows_of(study) if row["env"] in envs and row["algo"] not in others]
    cells = {(row["env"], row["algo"]) for row in rows if "terminated" not in row["algo"]}
    assert len(cells) == 14 * len(envs)
    for name, said in {"return": returns, "cost": costs}.items():
        made = [
            mean([row for row in rows if (row["env"], row["algo"]) == cell], name) for cell in cells
        ]
        for value, figure in zip((min(made), max(made)), said, strict=True):
            assert f"{value:.{len(figure.partition('.')[2])}f}" == figure


def test_cpo_trains_within_1_2_of_its_limit_on_goal_and_button():
    for study in ("goal", "button"):
        rows = [row for row in rows_of(study) if row["algo"] == "cpo"]
        for env in {row["env"] for row in rows}:
            assert abs(mean(rows, "cost", env=env) - 25) <= 1.2


@pytest.mark.parametrize("envs, times", [(2048, "4.3"), (32768, "9.1")])
def test_training_is_so_many_times_as_fast_as_that_of_crax(envs, times):
    lines = (RESULTS.parent / "data" / "benchmark_h200.jsonl").read_text().splitlines()
    rows = [
        row
        for row in map(json.loads, lines)
        if row.get("algo") == "ppo_lag" and row["num_envs"] == envs
    ]
    ours = [row for row in rows if row.get("solver") == "jaxsafe, all passes" and row["num_seeds"] == 1]
    theirs = [row for row in rows if row["env"] == "safe_goal_point"]
    assert f"{ours[-1]['env_steps_per_s'] / theirs[-1]['env_steps_per_s']:.1f}" == times

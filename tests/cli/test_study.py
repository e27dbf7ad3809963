"""Studies: what their files hold, and the command that makes and continues them."""

import contextlib
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jaxsafe import envs
from jaxsafe.commands import study as command
from jaxsafe.config import ConfigError
from jaxsafe.report import plots, studies, study_files
from jaxsafe.report.group import Group
from jaxsafe.report.published import Published
from jaxsafe.report.read import defaults, read, read_one
from jaxsafe.run import files, run_folder
from jaxsafe.run.arguments import compose
from jaxsafe.run.checkpoint import Progress
from jaxsafe.run.divergence import Lost, write_lost

ROOT = Path(__file__).parent.parent.parent
TOY = """
title: Toy
about: Which of two earns more?
options: total_steps=4000 num_seeds=2
runs:
- env=point_goal1 algo=cpo
- env=point_goal1 algo=ppo_lag algo.dual_lr=0.2
windows: [[1000, 2000]]
"""


@pytest.fixture
def toy(tmp_path) -> studies.Study:
    folder = tmp_path / "results" / "toy"
    folder.mkdir(parents=True)
    (folder / "study.yaml").write_text(TOY)
    return studies.read(folder)


def trained(folder: Path, options: list[str], steps: int = 4000, nonfinite: Any = (0, 0)) -> None:
    """Write what training with these options leaves: iterations of 10 steps, returns by the seed."""
    given = dict(word.split("=") for word in options)
    algo = {"name": given["algo"]} | ({"dual_lr": 0.2} if "algo.dual_lr" in given else {})
    folder.mkdir(parents=True)
    config = {"env": {"name": given["env"]}, "algo": algo, "total_steps": 4000, "num_seeds": 2}
    config |= {name: given[name] for name in ("dataset", "preset") if name in given}
    run_folder.write_config(folder, config)
    run_folder.append_versions(folder, "abacus", "c")
    names = [*study_files.CURVES, "train/nonfinite"]
    log = run_folder.Metrics(folder, names, 0)
    for i in range(1, steps // 10 + 1):
        values = [np.array([i, 2 * i]), np.array([i % 40, 30.0]), np.full(2, 0.1), np.full(2, 0.3)]
        values.append(np.array(nonfinite))
        values[0] = np.where(i < 5, np.nan, values[0])
        at = Progress(i, 10 * i, i)
        log.append(at, [0, 1], 60.0 * i, dict(zip(names, values, strict=True)))
    log.close()
    (folder / "evaluation.json").write_text(
        json.dumps({"seeds": {"return": [5.0, 7.0], "cost": [1.0, 2.0]}})
    )


def call(monkeypatch, *arguments: Any, train: Any = command.train) -> int:
    monkeypatch.setattr(sys, "argv", ["study.py", *map(str, arguments)])
    monkeypatch.setattr(command, "train", train)
    return command.main()


# ---- the files -------------------------------------------------------------------------------


def test_each_run_has_a_folder_whose_name_a_file_system_takes():
    runs = [f"env=point_goal1 algo=ambs {'algo.penalty_coef=0.5 ' * 20}seed={seed}" for seed in (1, 2)]
    first, second = map(study_files.name_of, runs)
    assert first != second and max(len(first), len(second)) < 255
    assert first == study_files.name_of(runs[0]) and first.startswith("point_goal1-ambs-algo.penalty")
    assert study_files.name_of("env=point_goal1 algo=cpo seed=1") == "point_goal1-cpo-seed_1"


def test_figures_and_curves_of_a_study_are_those_of_its_runs(toy, tmp_path):
    trained(tmp_path / "run", toy.command(toy.runs[1]))
    (run,) = read_one(tmp_path / "run")
    studies.add(toy, toy.runs[1], run, studies.origin_of(tmp_path / "run"))
    (same,) = read([toy.folder])
    assert same.setting == run.setting and same.limits == run.limits and same.steps == run.steps
    for name, values in run.values.items():
        np.testing.assert_allclose(same.values[name], values, rtol=1e-8, err_msg=name)
    assert {*same.values} - {*run.values} == {f"{k} 1000-2000" for k in ("return", "cost", "swing")} | {
        "minutes"
    }
    edges = np.linspace(0, run.steps, 51)
    for name in study_files.CURVES:
        here, there = (plots.stretches(r.table, name, edges) for r in (same, run))
        np.testing.assert_allclose(here, there, rtol=2e-3, err_msg=name)


def test_a_study_from_before_override_rates_were_kept_has_none(toy, tmp_path):
    trained(tmp_path / "run", toy.command(toy.runs[0]))
    (run,) = read_one(tmp_path / "run")
    studies.add(toy, toy.runs[0], run, study_files.Origin())
    path = toy.folder / "curves.npz"
    found = dict(np.load(path))
    np.testing.assert_allclose(found["curves"][:, 3], 0.3, rtol=1e-3)
    np.savez(path, **found | {"curves": found["curves"][:, : study_files.OLDER]})
    (older,) = read([toy.folder])
    assert {"train/cost_rate"} == older.table.keys() & {"train/cost_rate", "train/overruled"}
    np.savez(path, **found | {"curves": found["curves"][:, :2]})
    with pytest.raises(ConfigError, match=r"curves\.npz has curves float32"):
        study_files.read(toy.folder)


def test_a_rate_that_no_run_of_a_task_has_is_left_out_of_its_row(toy, tmp_path):
    """As a shield's, where one of two tasks has been trained with one."""
    groups = []
    for env, shielded in (("car_goal1", False), ("point_goal1", True)):
        trained(tmp_path / env, [f"env={env}", "algo=ambs"])
        (run,) = read_one(tmp_path / env)
        if not shielded:
            run.table["train/overruled"] = np.full_like(run.table["train/overruled"], np.nan)
        groups.append(Group(env, {"algo.name": "ambs", "env.name": env}, [run]))
    shown = [axes.get_visible() for axes in plots.learning(groups).axes]
    assert shown == [True, True, True, False, True, True, True, True]


def test_learning_from_a_data_set_is_counted_in_gradient_updates(toy, tmp_path):
    """Also in the files of a study, which has no columns for them."""
    runs = ["env=point_goal1 algo=bc dataset=data/0.25.hdf5", "env=point_goal1 algo=cpo"]
    study = toy._replace(runs=runs)
    for i, run in enumerate(runs):
        trained(tmp_path / str(i), study.command(run))
        (found,) = read_one(tmp_path / str(i))
        studies.add(study, run, found, studies.origin_of(tmp_path / str(i)))
    offline, online = read([study.folder])
    assert (offline.clock, online.clock) == ("updates", "steps")
    assert offline.steps == online.steps == 4000
    called = [plots.axis_of(run.table) for run in (offline, online)]
    assert called == ["gradient updates", "environment steps"]


def test_a_data_set_is_called_by_its_file(toy, tmp_path):
    runs = [f"env=point_goal1 algo=bc dataset=data/{beta}.hdf5" for beta in ("0.25", "0.75")]
    study = toy._replace(runs=runs)
    for i, run in enumerate(runs):
        trained(tmp_path / str(i), study.command(run))
        (found,) = read_one(tmp_path / str(i))
        studies.add(study, run, found, studies.origin_of(tmp_path / str(i)))
    groups = studies.in_order(study, read([study.folder]))
    assert [g.name for g in groups] == ["bc, dataset=0.25", "bc, dataset=0.75"]


def test_a_run_without_a_finished_episode_is_a_dash(toy, tmp_path):
    trained(tmp_path / "run", toy.command(toy.runs[0]), steps=40)  # returns begin with the fifth row
    (run,) = read_one(tmp_path / "run")
    studies.add(toy, toy.runs[0], run, studies.origin_of(tmp_path / "run"))
    found = studies.matrix(studies.in_order(toy, read([toy.folder])), {})
    assert found.splitlines()[-1] == "| `cpo` | - |"


def test_evaluated_policies_stand_beside_published_ones_and_training_apart(toy, tmp_path):
    trained(tmp_path / "run", toy.command(toy.runs[0]))
    (run,) = read_one(tmp_path / "run")
    studies.add(toy, toy.runs[0], run, studies.origin_of(tmp_path / "run"))
    known = {("point_goal1", "cpo"): Published((9.0, 1.0), (3.0, 1.0), 25.0, "theirs", "")}
    groups = studies.in_order(toy, read([toy.folder]))
    first, second = studies.matrices(groups, known).split("\n\nEvaluated policies")
    assert studies.matrix(groups, {}) in first and "*" not in first
    assert second.endswith("| `cpo` | 6.0, 1.5<br>*9.0, 3.0* |")
    alone = studies.matrices(groups, {})  # nothing is published
    assert alone.endswith(
        "Evaluated policies:\n\n| | `point_goal1` |\n|---|---:|\n| `cpo` | 6.0, 1.5 |"
    )
    assert studies.matrix(groups, {}) in alone
    for run in groups[0].runs:
        run.values.pop("final cost")
    assert studies.matrices(groups, known) == studies.matrix(groups, {})


def test_what_was_published_with_another_limit_is_not_said_to_be_of_a_setting(toy, tmp_path):
    trained(tmp_path / "run", toy.command(toy.runs[0]))
    (run,) = read_one(tmp_path / "run")
    figures = Published((9.0, 1.0), (3.0, 1.0), 25.0, "theirs", "")
    known = {("point_goal1", "cpo"): figures}
    assert studies.published_cell(run, known) == "theirs 9.00 ± 1.00, cost 3.00 ± 1.00"
    known = {("point_goal1", "cpo"): figures._replace(cost_limit=10.0)}
    assert studies.published_cell(run, known).startswith("none (unconstrained PPO: ")


def test_what_training_has_cost_is_told_along_the_way(toy, tmp_path):
    """Every step of the policy costs 0.1, for 4,000 and for 2,000 steps of the environment."""
    for i, (repeat, steps) in enumerate(((1, 4000), (2, 2000))):
        trained(tmp_path / str(i), toy.command(toy.runs[i]), steps=steps)
        (run,) = read_one(tmp_path / str(i))
        run.config["env.wrap.action_repeat"] = repeat
        studies.add(toy, toy.runs[i], run, studies.origin_of(tmp_path / str(i)))
    found = studies.costs_so_far(studies.in_order(toy, read([toy.folder])))
    header, _, whole, half = found.splitlines()
    assert header == "| `point_goal1`, steps | 1,000 | 2,000 | 3,000 | 4,000 |"
    told = ["100 (100 to 100)", "200 (200 to 200)", "300 (300 to 300)", "400 (400 to 400)"]
    assert [cell.strip() for cell in whole.split("|")[2:-1]] == told
    told = ["50 (50 to 50)", "100 (100 to 100)", "", ""]
    assert [cell.strip() for cell in half.split("|")[2:-1]] == told


def test_a_stretch_without_an_iteration_has_the_rate_of_the_one_that_follows():
    """Iterations end after 3, 6 and 9 stretches of 10 steps, with rates of 1, 2 and 3."""
    rate = [np.nan, np.nan, 1, 1, 1, 2, 2, 2, 3]
    table = {"seed": np.zeros(9), "steps": np.arange(10, 100, 10), "train/cost_rate": np.array(rate)}
    run: Any = SimpleNamespace(seeds=[0], table=table, config={})
    assert studies.cost_so_far(run, np.array([30, 60, 90])).tolist() == [[30, 90, 180]]


def test_a_setting_is_called_by_the_few_options_that_its_run_sets(toy, tmp_path):
    """Even where another algorithm tells it apart. A length that all have is not named, nor what is
    set as it is anyway."""
    more = "- env=car_goal1 algo=cpo algo.gae_lambda=0.95\nwindows"
    (toy.folder / "study.yaml").write_text(TOY.replace("windows", more))
    study = studies.read(toy.folder)
    for run in study.runs:
        trained(tmp_path / study_files.name_of(run), study.command(run))
        (found,) = read_one(tmp_path / study_files.name_of(run))
        studies.add(study, run, found, study_files.Origin())
    names = [g.name for g in studies.in_order(study, read([study.folder]))]
    assert names == ["cpo", "ppo_lag, algo.dual_lr=0.2", "cpo"]
    assert studies.few_options("algo=cpo num_envs=8 algo.a=1 algo.b=2 algo.c=3 algo.d=4") == []
    assert studies.few_options("algo.a=1 total_steps=1e6") == ["algo.a", "total_steps"]


def test_a_lone_run_has_its_preset_in_its_name(toy, tmp_path):
    runs = TOY.replace("algo=cpo", "algo=cpo preset=published")
    (toy.folder / "study.yaml").write_text(runs)
    study = studies.read(toy.folder)
    run = study.runs[0]
    trained(tmp_path / "run", study.command(run))
    (found,) = read_one(tmp_path / "run")
    studies.add(study, run, found, study_files.Origin())
    assert [g.name for g in studies.in_order(study, read([study.folder]))] == ["cpo, preset=published"]


def test_a_setting_keeps_the_options_that_were_unusual_when_it_was_made(toy, tmp_path):
    """The default of `dual_lr` may be 0.2 one day. The run is still called by it."""
    run = toy.runs[1]
    trained(tmp_path / "run", toy.command(run))
    (found,) = read_one(tmp_path / "run")
    studies.add(toy, run, found, studies.origin_of(tmp_path / "run"))
    (g,) = studies.in_order(toy, read([toy.folder]))
    assert g.name == "ppo_lag, algo.dual_lr=0.2"
    usual = dict(g.runs[0].config) | {
        "algo.dual_lr": defaults("point_goal1", "ppo_lag")["algo.dual_lr"]
    }
    today = g._replace(runs=[g.runs[0]._replace(config=usual)])
    told = {"algo.name", "algo.dual_lr"}
    assert studies.said(today, told, set()) == {"algo.name": "ppo_lag"}
    odd = studies.once_unusual(toy)[run]
    assert studies.said(today, told, odd) == {"algo.name": "ppo_lag", "algo.dual_lr": 0.2}


def test_the_defaults_of_today_are_those_of_what_is_registered_now():
    assert defaults("short", "ppo") == {}
    for steps in (7, 8):
        envs.register("short", envs.ENVS["point_goal1"] | {"num_steps": steps})
        assert defaults("short", "ppo")["env.num_steps"] == steps


def test_a_figure_of_curves_has_few_tasks_and_settings():
    tasks = [f"task{i}" for i in range(6)]
    groups = [Group(env, {"algo.name": f"a{i}"}, []) for i in range(9) for env in tasks]
    parts = studies.chunks(groups)
    assert [sorted({g.env for g in part}) for part in parts] == 2 * [tasks[:3]] + 2 * [tasks[3:]]
    assert [len({g.name for g in part}) for part in parts] == [8, 1, 8, 1]
    assert sorted(map(str, groups)) == sorted(str(g) for part in parts for g in part)


def test_a_window_has_means_and_the_swing_of_the_cost_by_hand(toy, tmp_path):
    trained(tmp_path / "run", toy.command(toy.runs[0]))
    (run,) = read_one(tmp_path / "run")
    found = studies.more_figures(run.table, toy.windows)  # iterations 101 .. 200, five spans of 20
    np.testing.assert_allclose(found["return 1000-2000"], [150.5, 301])
    # costs are 21 .. 39, 0, then 1 .. 20, and so on: means of spans are 28.5 and 10.5 in turn
    np.testing.assert_allclose(found["cost 1000-2000"], [21.3, 30])
    np.testing.assert_allclose(found["swing 1000-2000"], [18 * (0.6 * 0.4) ** 0.5, 0])
    # the first episode ends at step 50: iterations without one count for nothing
    early = studies.more_figures(run.table, [(0, 100)])
    np.testing.assert_allclose(early["return 0-100"], [7.5, 15])


def test_what_a_step_promises_and_keeps_is_a_slope_by_hand():
    count = 5 * studies.SPAN
    promise = np.repeat([-0.1, -0.2, -0.3, -0.1, -0.2], studies.SPAN)
    drops = np.cumsum([0, *(0.5 * studies.SPAN * np.array([-0.1, -0.2, -0.3, -0.1]))])
    table = {
        "seed": np.zeros(count),
        "steps": np.arange(count) + 1.0,
        "train/objective_c": promise,
        "train/violation": np.repeat(drops, studies.SPAN),
    }
    found = studies.more_figures(table, [])
    np.testing.assert_allclose(found["promised"], [0.18])
    np.testing.assert_allclose(found["kept"], [0.5])  # half of each promise comes true
    # two spans have one change, which has no slope
    short = {name: x[: 3 * studies.SPAN - 1] for name, x in table.items()}
    assert studies.more_figures(short, []) == {}


def test_rows_say_what_a_run_was_made_with_and_how_it_ended(toy, tmp_path):
    for i, (steps, nonfinite) in enumerate([(4000, (1, 0)), (2000, (0, 0))]):
        trained(tmp_path / str(i), toy.command(toy.runs[i]), steps, nonfinite)
        write_lost(tmp_path / str(i), [Lost(50, 1, "", "why")] if i == 0 else [])
        (run,) = read_one(tmp_path / str(i))
        studies.add(toy, toy.runs[i], run, studies.origin_of(tmp_path / str(i)))
    rows = study_files.read(toy.folder).rows
    assert [row["state"] for row in rows] == ["done", "diverged", "unfinished", "unfinished"]
    assert [run.diverged for run in read_one(toy.folder)] == [(1,), ()]
    assert [row["settings"] for row in rows] == ["", "", "algo.dual_lr=0.2", "algo.dual_lr=0.2"]
    first = rows[0]
    assert (first["device"], first["engine"], first["seed"], first["steps"]) == (
        "abacus",
        "c",
        "0",
        "4000",
    )
    last = json.loads((tmp_path / "0" / "versions.json").read_text())[-1]["commit"]
    assert last is None or (last.startswith(first["commit"]) and len(first["commit"]) == 7)
    assert first["dirty"] == ("" if last is None else "yes" if last.endswith("-dirty") else "no")


def test_rows_that_two_commands_add_at_once_are_all_kept(toy, tmp_path, monkeypatch):
    both, read_files = threading.Barrier(2), study_files.read

    def read_beside_the_other(folder: Path) -> study_files.Condensed:
        found = read_files(folder)
        with contextlib.suppress(threading.BrokenBarrierError):
            both.wait(0.3)  # until the other has read too, if it may
        return found

    runs = []
    for i, run in enumerate(toy.runs):
        trained(tmp_path / str(i), toy.command(run))
        runs += read_one(tmp_path / str(i))
    monkeypatch.setattr(study_files, "read", read_beside_the_other)
    with ThreadPoolExecutor(2) as pool:
        several = [
            pool.submit(studies.add, toy, run, found, study_files.Origin())
            for run, found in zip(toy.runs, runs, strict=True)
        ]
    assert [each.result() for each in several] == [None, None]
    assert [row["algo"] for row in read_files(toy.folder).rows] == ["cpo"] * 2 + ["ppo_lag"] * 2


def test_a_study_is_read_whole_where_its_writer_was_stopped_between_its_files(toy, tmp_path):
    for i, run in enumerate(toy.runs):
        trained(tmp_path / str(i), toy.command(run))
        (found,) = read_one(tmp_path / str(i))
        before = (toy.folder / "final.csv").read_bytes() if i else b""
        studies.add(toy, run, found, study_files.Origin())
    (toy.folder / "final.csv").write_bytes(before)  # curves.npz is written first
    assert [run.config["algo.name"] for run in read([toy.folder])] == ["cpo"]


def test_a_study_whose_files_do_not_belong_together_is_refused(toy, tmp_path):
    trained(tmp_path / "run", toy.command(toy.runs[0]))
    (run,) = read_one(tmp_path / "run")
    studies.add(toy, toy.runs[0], run, study_files.Origin())
    table = toy.folder / "final.csv"
    whole = table.read_text()
    table.write_text(whole.replace("algo=cpo", "algo=pcpo"))
    with pytest.raises(ConfigError, match="lacks rows of final"):
        study_files.read(toy.folder)
    for column in ("state", "return", "commit"):
        table.write_text(whole.replace(f",{column},", ",other,", 1))
        with pytest.raises(ConfigError, match=f"final.csv has no column {column}"):
            study_files.read(toy.folder)
    (toy.folder / "curves.npz").write_bytes(b"PK no more")
    with pytest.raises(ConfigError, match="cannot be read"):
        study_files.read(toy.folder)


# ---- the command -----------------------------------------------------------------------------


def test_an_interrupted_study_continues_with_what_is_left(toy, tmp_path, monkeypatch, capsys):
    asked: list[str] = []

    def train(options: list[str], place: command.Place) -> int:
        asked.append(place.folder.name)
        if len(asked) == 2:
            place.folder.mkdir()
            return 130  # as after Ctrl-C
        trained(place.folder, options) if not place.folder.exists() else None
        return 0

    runs = tmp_path / "runs"
    arguments = (toy.folder, "--runs", runs)
    assert call(monkeypatch, *arguments, train=train) == 130
    assert "left to do: point_goal1-ppo_lag-algo.dual_lr_0.2\n" in capsys.readouterr().out
    assert call(monkeypatch, *arguments, "--list") == 0
    assert (
        capsys.readouterr().out
        == "point_goal1-cpo: done\npoint_goal1-ppo_lag-algo.dual_lr_0.2: to do\n"
    )
    assert call(monkeypatch, *arguments, "--commands") == 0
    (line,) = capsys.readouterr().out.splitlines()
    folder = runs / "toy" / "point_goal1-ppo_lag-algo.dual_lr_0.2"
    assert line.startswith("python scripts/train.py ") and line.endswith(
        f" run_dir={folder} resume=true"
    )
    assert compose(shlex.split(line)[2:]).train.run_dir == str(folder)
    shutil.rmtree(runs / "toy" / asked[1])
    assert call(monkeypatch, *arguments, train=train) == 0
    assert asked == ["point_goal1-cpo", *["point_goal1-ppo_lag-algo.dual_lr_0.2"] * 2]
    assert call(monkeypatch, *arguments, train=train) == 0 and len(asked) == 3
    assert {p.name for p in toy.folder.iterdir()} == {
        "study.yaml",
        "final.csv",
        "curves.npz",
        "README.md",
    }
    text = (toy.folder / "README.md").read_text()
    assert (
        "| `point_goal1` `cpo` | 2 |" in text
        and "| `point_goal1` `ppo_lag` `algo.dual_lr=0.2` |" in text
    )
    for name in ("toy-trade_off.png", "toy-curves1.png"):
        assert f"(../images/{name})" in text and (toy.folder.parent / "images" / name).exists()


@pytest.mark.parametrize("closed", ["runs/toy", "results/toy"])
def test_where_nobody_can_write_nothing_is_trained(closed, toy, tmp_path, monkeypatch, capsys):
    def try_writing(folder: Path) -> None:
        if folder == tmp_path / closed:
            raise OSError(30, "Read-only file system")

    def train(options: list[str], place: command.Place) -> int:
        pytest.fail("it went on to train")

    monkeypatch.setattr(files, "try_writing", try_writing)
    assert call(monkeypatch, toy.folder, "--runs", tmp_path / "runs", train=train) == 1
    out, err = capsys.readouterr()
    assert out == "" and err == f"error: cannot write to {tmp_path / closed}: Read-only file system\n"


def test_a_run_that_another_process_trains_is_left_to_it(toy, tmp_path, monkeypatch, capsys):
    runs, asked = tmp_path / "runs", []

    def train(options: list[str], place: command.Place) -> int:
        asked.append(place.folder.name)
        trained(place.folder, options)
        return 0

    busy = runs / "toy" / "point_goal1-cpo"
    busy.mkdir(parents=True)
    with files.held(busy):
        assert call(monkeypatch, toy.folder, "--runs", runs, train=train) == 130
    out = capsys.readouterr().out
    assert f"point_goal1-cpo: another process is training in {busy}\n" in out
    assert "left to do: point_goal1-cpo\n" in out
    assert asked == ["point_goal1-ppo_lag-algo.dual_lr_0.2"]
    assert [row["algo"] for row in study_files.read(toy.folder).rows] == ["ppo_lag"] * 2


def test_runs_at_the_same_time_have_a_gpu_each_and_one_that_breaks_leaves_the_other(
    toy, tmp_path, monkeypatch, capsys
):
    gpus, begun = [], threading.Barrier(2, timeout=60)  # neither goes on before both have begun

    def train(options: list[str], place: command.Place) -> int:
        gpus.append(place.gpu)
        begun.wait()
        if "algo=cpo" in options:
            raise OSError("no such kernel")
        trained(place.folder, options)
        return 0

    arguments = (toy.folder, "--runs", tmp_path / "runs", "--gpus", "3,5")
    assert call(monkeypatch, *arguments, train=train) == 1
    assert sorted(gpus) == ["3", "5"]
    out = capsys.readouterr().out
    assert "point_goal1-cpo: OSError('no such kernel')\n" in out
    assert "left to do: point_goal1-cpo\n" in out
    assert [row["algo"] for row in study_files.read(toy.folder).rows] == ["ppo_lag"] * 2


def test_a_command_ends_quietly_where_nobody_reads_its_output(toy):
    command = [sys.executable, "-m", "jaxsafe", "study", str(toy.folder), "--commands"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout and process.stderr
        process.stdout.close()  # as `head` does when it has seen enough
        assert (process.stderr.read(), process.wait()) == ("", 141)


def test_a_page_keeps_the_words_around_its_tables(toy, tmp_path):
    trained(tmp_path / "run", toy.command(toy.runs[0]))
    (run,) = read_one(tmp_path / "run")
    studies.add(toy, toy.runs[0], run, study_files.Origin())
    page = toy.folder / "README.md"
    page.write_text("# Mine\n\nbefore\n\n<!-- measured: matrix -->\nold\n<!-- end -->\n\nafter\n")
    studies.write_page(toy)
    text = page.read_text()
    assert text.startswith("# Mine\n\nbefore\n") and text.endswith("\n\nafter\n") and "old" not in text
    assert "| `cpo` | " in text
    page.write_text("<!-- measured: matrix -->\nold\n")
    with pytest.raises(
        ConfigError, match=r"README\.md: no <!-- measured: matrix --> with <!-- end -->"
    ):
        studies.write_page(toy)


def test_a_page_replaces_the_pictures_of_its_study_and_no_others(toy, tmp_path):
    trained(tmp_path / "run", toy.command(toy.runs[0]))
    (run,) = read_one(tmp_path / "run")
    studies.add(toy, toy.runs[0], run, study_files.Origin())
    images = toy.folder.parent / "images"
    images.mkdir()
    for name in ("toy-curves9.png", "toy-trade_off.png", "toy-two-curves1.png", "toy-mine.png"):
        (images / name).touch()
    studies.write_page(toy)
    kept = {path.name for path in images.iterdir()}
    assert kept == {"toy-curves1.png", "toy-two-curves1.png", "toy-mine.png"}


def test_of_a_crowd_the_first_settings_of_each_task_have_points(toy, tmp_path, monkeypatch):
    monkeypatch.setattr(studies, "MOST", 1)
    for i, run in enumerate(toy.runs):
        trained(tmp_path / str(i), toy.command(run))
        (one,) = read_one(tmp_path / str(i))
        studies.add(toy, run, one, study_files.Origin())
    studies.write_page(toy)
    page = (toy.folder / "README.md").read_text()
    assert "![Return against cost of last 10% of training of the first 1 settings of a task" in page


@pytest.mark.parametrize("where, name", [("toy", "."), ("toy/images", ".."), (".", "./toy")])
def test_a_study_has_its_name_whichever_way_its_folder_is_given(
    where, name, toy, tmp_path, monkeypatch
):
    trained(tmp_path / "run", toy.command(toy.runs[0]))
    (run,) = read_one(tmp_path / "run")
    studies.add(toy, toy.runs[0], run, study_files.Origin())
    (toy.folder / "images").mkdir()
    monkeypatch.chdir(toy.folder.parent / where)
    assert call(monkeypatch, name, "--page") == 0
    pictures = [path.relative_to(toy.folder.parent) for path in toy.folder.parent.rglob("*.png")]
    assert pictures == [Path("images/toy-curves1.png")]


def test_failed_runs_are_kept_and_tried_again_last(toy, tmp_path, monkeypatch, capsys):
    asked: list[str] = []

    def train(options: list[str], place: command.Place) -> int:
        asked.append(place.folder.name)
        shutil.rmtree(place.folder, ignore_errors=True)
        trained(place.folder, options, 2000)
        return 1 if "algo=cpo" in options else 130

    arguments = (toy.folder, "--runs", tmp_path / "runs")
    assert call(monkeypatch, *arguments, train=train) == 1
    assert "point_goal1-cpo: failed, see" in capsys.readouterr().out
    assert {row["state"] for row in study_files.read(toy.folder).rows} == {"failed"}
    assert call(monkeypatch, *arguments, train=train) == 1
    assert asked == [*asked[:2], *asked[1::-1]] and asked[0] == "point_goal1-cpo"


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["nothing"], "no study nothing"),
        (["gaol"], "no study gaol; did you mean 'goal'?"),
        (
            ["goal", "--only", "point_goal1-cop"],
            "--only point_goal1-cop; did you mean 'point_goal1-cpo'?",
        ),
    ],
)
def test_what_is_not_there_is_one_line_and_status_2(arguments, message, monkeypatch, capsys):
    assert call(monkeypatch, *arguments, "--list") == 2
    assert capsys.readouterr().err.startswith(f"error: {message}")


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("title: Toy", "titel: Toy", "expected about, options, runs, title and perhaps"),
        ("algo=ppo_lag algo.dual_lr=0.2", "algo=cpo", "point_goal1-cpo occurs twice"),
        ("- env", "env", "cannot be read"),
        ("options: total", "options: [a, b]\n#", "expected options in one line"),
        ("options: total", "options:\n#", "expected options in one line"),
        ("env=point_goal1 algo=cpo", "''", "expected runs as a list of options"),
        ("[[1000, 2000]]", "[1000, 2000]", "expected windows as"),
        ("[[1000, 2000]]", "[[early, late]]", "expected windows as"),
        ("windows: [[1000, 2000]]", "printed: 9.4", "expected printed as a text for each run"),
        ("windows: [[1000, 2000]]", "published: 3", "expected published and ends as file names"),
    ],
)
def test_a_study_yaml_that_says_something_else_is_refused(old, new, message, toy):
    (toy.folder / "study.yaml").write_text(TOY.replace(old, new))
    with pytest.raises(ConfigError, match=message):
        studies.read(toy.folder)


@pytest.mark.slow  # two real runs of scripts/train.py, one of them stopped half-way
def test_real_training_is_stopped_and_continued(tmp_path):
    folder = tmp_path / "results" / "toy"
    folder.mkdir(parents=True)
    (folder / "study.yaml").write_text(
        "title: Toy\nabout: Which earns more?\n"
        "options: >-\n  env=toys:Corridor num_envs=4 algo.horizon=16 algo.minibatches=2\n"
        "  algo.critic_epochs=2 algo.hidden=[8,8] total_steps=64000 eval_episodes=2 video=false\n"
        "runs:\n- algo=ppo\n- algo=cpo\n"
    )
    runs = tmp_path / "runs"
    words = [sys.executable, ROOT / "scripts" / "study.py", folder, "--runs", runs]
    environ = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"}
    process = subprocess.Popen(words, env=environ)
    log = runs / "toy" / "ppo" / "metrics.csv"
    while not (log.exists() and log.read_text().count("\n") > 20):
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    assert process.wait() == 130 and not study_files.holds_study(folder)
    done = subprocess.run(words, env=environ, text=True, capture_output=True)
    assert done.returncode == 0 and "left to do: nothing" in done.stdout, done.stdout + done.stderr
    assert "resuming at" in (runs / "toy" / "ppo.log").read_text()
    rows = study_files.read(folder).rows
    assert [(row["algo"], row["state"], row["steps"]) for row in rows] == [
        ("ppo", "done", "64000"),
        ("cpo", "done", "64000"),
    ]
    assert "| `ppo` | 1 |" in (folder / "README.md").read_text()

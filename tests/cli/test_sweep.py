"""Sweeps of a toy environment, all in this process."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import shell
from toys import START, Corridor, run_episodes

from jaxsafe import algos
from jaxsafe.config import ConfigError, fields_of
from jaxsafe.learn.offline import OfflineConfig, data_set_like
from jaxsafe.report import plots, trade_off
from jaxsafe.report.evaluation import evaluate
from jaxsafe.report.finish import finish
from jaxsafe.report.group import EVALUATED, LATE
from jaxsafe.report.sweep_summary import rows_of, summarise
from jaxsafe.run import arguments, checkpoint, files, loop, memory, programs, run_folder, session, sweep
from jaxsafe.run.arguments import compose
from jaxsafe.run.dataset import write_dataset
from jaxsafe.run.policies import open_run
from jaxsafe.run.programs import build, members
from jaxsafe.run.progress import Reporter
from jaxsafe.run.session import Session
from jaxsafe.run.settings import TrainConfig, settings_from_config
from jaxsafe.run.sweep_folder import open_folder
from jaxsafe.run.sweep_plan import Sweep, plan

SMALL = [
    "env=toys:Corridor", "env.half_width=0.01", "algo=ppo_lag", "num_envs=4", "algo.horizon=8",
    "algo.minibatches=2", "algo.epochs=2", "algo.critic_epochs=2", "algo.hidden=[8,8]",
    "total_steps=192", "eval_episodes=0", "video=false",
]  # fmt: skip
GRID = ["algo.cost_limit=0.5,5", "algo.dual_lr=0.01,1", "num_seeds=2"]


def planned(*texts: str) -> Sweep:
    given = arguments.read_values([*texts])
    return plan(given.options, given.several)


def train(folder: Path, *texts: str) -> None:
    asked = planned(*SMALL, *texts, f"run_dir={folder}")
    assert sweep.train(asked, "again", Reporter(), sweep.After(finish, summarise)) == 0


def tables(folder: Path) -> dict[tuple, dict[str, np.ndarray]]:
    """metrics.csv of each setting and seed of a sweep, wherever it was trained."""
    found = {}
    for path in sorted(folder.glob("*/config.yaml")):
        saved = settings_from_config(run_folder.read_config(path.parent))
        parts = run_folder.by_setting(run_folder.read_metrics(path.parent)).values()
        for cfg, part in zip(saved.configs, parts, strict=True):
            for seed in saved.train.seed + np.arange(saved.train.num_seeds):
                own = {k: v[part["seed"] == seed] for k, v in part.items() if k.startswith("train/")}
                found[cfg.cost_limit, cfg.dual_lr, int(seed)] = own
    return found


def assert_close(a: dict[tuple, dict[str, np.ndarray]], b: dict[tuple, dict[str, np.ndarray]]) -> None:
    assert a.keys() == b.keys()
    for member in a:
        assert a[member].keys() == b[member].keys()
        for name in a[member]:
            np.testing.assert_allclose(
                a[member][name], b[member][name], rtol=1e-3, atol=1e-4, err_msg=f"{member} {name}"
            )


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """An uninterrupted sweep in one program, which nobody changes."""
    folder = tmp_path_factory.mktemp("finished") / "sweep"
    train(folder, *GRID)
    return folder


def test_a_grid_is_floats_side_by_side_and_a_group_of_each_other_value():
    asked = planned(
        "env=point_goal1", "algo=ppo_lag,cppo_pid", "algo.hidden=[8,8],[4]", "algo.clip=0.1,0.2",
        "algo.cost_limit=5,10,25", "num_seeds=3", "seed=7",
    )  # fmt: skip
    assert [(s.algo_name, s.algo.hidden) for s in asked.groups.values()] == [
        (name, hidden) for name in ("ppo_lag", "cppo_pid") for hidden in ((8, 8), (4,))
    ]
    for settings in asked.groups.values():
        pairs = [(c.clip, c.cost_limit) for c in settings.configs]
        assert pairs == [(clip, limit) for clip in (0.1, 0.2) for limit in (5.0, 10.0, 25.0)]
        run = members(settings.configs, settings.train)
        assert [m.seed for m in run] == [7, 8, 9] * 6
        assert run[4].swept == {"algo.clip": 0.1, "algo.cost_limit": 10.0}
    assert asked.swept == ["algo.name", "algo.hidden", "algo.clip", "algo.cost_limit"]
    names = list(asked.groups)
    assert names[1] == "001-point_goal1-ppo_lag-algo.hidden=_4_" and len({*names}) == 4


def test_a_grid_over_named_limits_is_side_by_side_too():
    limits = ["algo.cost_limits.vases_contact=25", "algo.cost_limits.hazards=5,10"]
    asked = planned("env=point_goal2", "algo=ppo_lag", "algo.clip=0.1,0.2", *limits, "num_seeds=2")
    ((name, settings),) = asked.groups.items()
    assert name == "000-point_goal2-ppo_lag"
    assert asked.swept == ["algo.clip", "algo.cost_limits.hazards"]
    assert [(c.clip, c.cost_limits) for c in settings.configs] == [
        (clip, {"hazards": limit, "vases_contact": 25.0})
        for clip in (0.1, 0.2)
        for limit in (5.0, 10.0)
    ]
    run = members(settings.configs, settings.train)
    assert run[2].setting == "algo.clip=0.1, algo.cost_limits.hazards=10"
    plain = settings.plain()
    assert plain["algo"]["cost_limits"] == {"hazards": [5.0, 10.0, 5.0, 10.0], "vases_contact": 25.0}
    assert settings_from_config(plain)._replace(env_entry=settings.env_entry) == settings
    one = compose(
        ["env=point_goal2", "algo.cost_limits.hazards=5", "algo.cost_limits={vases_contact: 3}"]
    )
    assert one.algo.cost_limits == {"hazards": 5.0, "vases_contact": 3.0}


def test_a_sweep_over_a_named_limit_from_training_to_summary(tmp_path, capsys):
    folder = tmp_path / "sweep"
    limits = ["algo.cost_limits.wall=0.5,50", "num_seeds=2"]
    train(folder, *limits, "eval_episodes=2", "total_steps=1920")
    assert "algo.cost_limits.wall=50: return" in capsys.readouterr().out
    (run,) = folder.glob("0*")
    tables = run_folder.by_setting(run_folder.read_metrics(run))
    assert [*tables] == ["algo.cost_limits.wall=0.5", "algo.cost_limits.wall=50"]
    tight, loose = (table["train/lam_wall"][-2:] for table in tables.values())
    assert (tight > loose).all()
    rows = rows_of(folder)
    assert [r.limits for r in rows] == [{"wall": 0.5}, {"wall": 50.0}]
    assert rows[0].held != "yes" and rows[1].held == "yes"  # two seeds may leave it unclear
    text = (folder / "summary.md").read_text().splitlines()
    assert text[0] == (
        "| algo.cost_limits.wall | seeds | steps | return | cost | cost wall | limit | limit held |"
    )
    assert text[2].startswith("| 0.5 | 2 | 1,920 |")
    assert text[2].endswith(f"| wall 0.5 | {rows[0].held} |")
    with (folder / "summary.csv").open() as file:
        assert [row["cost_limit_wall"] for row in csv.DictReader(file)] == ["0.5", "50.0"]
    found = evaluate(open_run(run), 2, 0)
    assert [s.limits for s in found] == [{"wall": 0.5}, {"wall": 50.0}]
    assert "wall over 50" in found[1].rows
    for other in (["algo.clip=0.1,0.2", "num_seeds=2"], ["algo.cost_limits.wall=1,50", "num_seeds=2"]):
        with pytest.raises(ConfigError, match="belongs to another sweep: algo"):
            open_folder(planned(*SMALL, *other, "eval_episodes=2", f"run_dir={folder}"))


def test_limits_of_named_costs_swept_have_lines_of_their_own(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        plots.Axes, "axhline", lambda self, y, **style: drawn.append((y, style["color"]))
    )
    metrics = {
        "steps": np.repeat([1.0, 2.0], 2), "seed": np.zeros(4),
        "algo.cost_limits.a": np.tile([5.0, 10.0], 2), "train/cost": np.arange(4.0),
        "train/cost_a": np.arange(4.0), "train/cost_b": np.arange(4.0),
    }  # fmt: skip
    plots.curves(metrics, tmp_path / "curves.png", "title", 25.0, {"a": 5.0, "b": 3.0})
    assert drawn == [(5.0, "C0"), (10.0, "C1"), (3.0, "C3")]


def test_parts_are_whole_settings_or_seeds_of_one_and_of_equal_size():
    asked = planned("algo.cost_limit=1,2,3,4", "num_seeds=8")
    (settings,) = asked.groups.values()

    def shapes(parallel: int) -> list[tuple]:
        return [
            ([c.cost_limit for c in p.configs], p.train.seed, p.train.num_seeds)
            for p in sweep.parts(settings, parallel)
        ]

    assert shapes(32) == [([1, 2, 3, 4], 0, 8)]
    assert shapes(31) == shapes(16) == [([1, 2], 0, 8), ([3, 4], 0, 8)]
    assert shapes(5) == [([limit], seed, 4) for limit in (1, 2, 3, 4) for seed in (0, 4)]
    assert len(shapes(1)) == 32
    assert sweep.slices(7, 3) == [slice(0, 2), slice(2, 4), slice(4, 7)]


@pytest.mark.parametrize(
    "limits, seeds, parallel, sizes",
    [
        (6, 1, 4, [2, 4]),
        (6, 1, 3, [2, 2, 2]),
        (4, 3, 7, [6, 6]),
        (2, 3, 5, [2, 1, 2, 1]),  # a lone member's environments split
        (5, 1, 8, [4, 1]),
        (2, 2, 1, [1, 1, 1, 1]),
    ],
)
def test_parts_split_over_the_devices(limits, seeds, parallel, sizes):
    values = ",".join(map(str, range(1, limits + 1)))
    asked = planned(f"algo.cost_limit={values}", f"num_seeds={seeds}", "devices=2")
    (settings,) = asked.groups.values()
    pieces = sweep.parts(settings, parallel)
    assert [piece.num_members for piece in pieces] == sizes
    trained = [
        (c.cost_limit, s)
        for p in pieces
        for c in p.configs
        for s in range(p.train.seed, p.train.seed + p.train.num_seeds)
    ]
    assert sorted(trained) == [(1 + limit, seed) for limit in range(limits) for seed in range(seeds)]
    assert [sweep.on_devices(n, 4) for n in (1, 3, 4, 7, 8)] == [1, 1, 4, 4, 8]


def test_a_sweep_deletes_nothing_that_was_trained_or_is_being_trained(finished, tmp_path):
    folder = tmp_path / "sweep"
    shutil.copytree(finished, folder)
    (group,) = folder.glob("0*")
    shutil.rmtree(group / "checkpoints")
    (group / "notes.txt").touch()
    train(folder, *GRID)  # is finished all the same
    with pytest.raises(ConfigError, match="no checkpoint to go on from, only a policy"):
        train(folder, *GRID, "total_steps=1e4")
    assert (group / "notes.txt").exists()
    shutil.rmtree(group / "policy")
    with files.held(group), pytest.raises(ConfigError, match="another process is training"):
        train(folder, *GRID)
    assert (group / "notes.txt").exists()


@pytest.mark.parametrize("name", sorted(algos.ALGOS))
def test_every_float_of_every_algorithm_may_differ_between_members(name):
    kind = algos.ALGOS[name].config
    offline = issubclass(kind, OfflineConfig)
    small: dict[str, Any] = {
        field: (4,) for field in ("hidden", "model_hidden") if hasattr(kind, field)
    }
    # a horizon that every `learn_every` divides
    cfg = kind(**small) if offline else kind(num_envs=256, horizon=80, **small)
    values = dict.fromkeys(fields_of(kind, float), 0.25) | {"total_iterations": 2.5, "budget_ramp": 2.5}
    other = replace(cfg, **{k: x for k, x in values.items() if hasattr(kind, k)})
    data = data_set_like(Corridor()) if offline else ()
    train = TrainConfig(num_seeds=2, total_updates=1) if offline else TrainConfig(num_seeds=2)
    program = build(Corridor(), algos.ALGOS[name].make, (cfg, other), train, data)
    ts = jax.eval_shape(program.init, program.start, program.shared())
    assert all(x.shape == (4,) for x in jax.tree.leaves(ts.config))
    assert jax.tree.leaves(program.start[1])[0].dtype == np.float32


def test_a_member_is_the_lone_run_of_its_setting_and_seed(finished, tmp_path):
    lone = ["algo.cost_limit=0.5", "algo.dual_lr=1", "seed=1", f"run_dir={tmp_path / 'lone'}"]
    settings = compose([*SMALL, *lone])
    lone_run = Session(settings, tmp_path / "lone", *session.prepare(settings), "again")
    assert session.run(lone_run, Reporter(), finish) == 0
    together, alone = tables(finished), tables(tmp_path)
    assert len(together) == 8 and [*alone] == [(0.5, 1.0, 1)]
    assert_close({member: together[member] for member in alone}, alone)
    lam = {member: table["train/lam"][-1] for member, table in together.items()}
    assert lam[0.5, 1.0, 1] > 10 * lam[0.5, 0.01, 1] > 0  # and the settings matter
    assert lam[0.5, 1.0, 1] != lam[5.0, 1.0, 1] != lam[5.0, 1.0, 0]
    columns = run_folder.read_metrics(tmp_path / "lone").keys()
    assert run_folder.read_metrics(next(finished.glob("0*"))).keys() - columns == {
        "algo.cost_limit",
        "algo.dual_lr",
    }


def test_parts_give_what_all_at_once_give(finished, tmp_path):
    train(tmp_path / "sweep", *GRID, "max_parallel=1")
    assert len(list(tmp_path.glob("sweep/*.part*"))) == 8
    assert_close(tables(tmp_path / "sweep"), tables(finished))
    rows, expected = (rows_of(f) for f in (tmp_path / "sweep", finished))
    for a, b in zip(rows, expected, strict=True):
        assert (a.by, a.cost_limit, a.steps) == (b.by, b.cost_limit, b.steps)
        np.testing.assert_allclose([a.costs, a.returns], [b.costs, b.returns], rtol=1e-3, atol=1e-4)


def test_an_interrupted_sweep_goes_on_and_ends_bit_for_bit_as_if_uninterrupted(tmp_path, monkeypatch):
    args = (*GRID, "max_parallel=4", "checkpoint_iterations=2")
    train(tmp_path / "whole", *args)
    save, saved = checkpoint.save, []

    def killed(*arguments):
        path = save(*arguments)
        saved.append(path)
        if len(saved) == 7:  # the first part has three checkpoints, each with its policies
            raise KeyboardInterrupt
        return path

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(checkpoint, "save", killed)
        train(tmp_path / "sweep", *args)
    first, second = sorted((tmp_path / "sweep").glob("0*"))
    assert [run_folder.newest_progress(f) for f in (first, second)] == [(6, 192, 24), (2, 64, 8)]
    train(tmp_path / "sweep", *GRID, "checkpoint_iterations=2")  # the parts are remembered
    starts = [len(json.loads((f / "versions.json").read_text())) for f in (first, second)]
    assert starts == [1, 2]
    for a, b in zip((first, second), sorted((tmp_path / "whole").glob("0*")), strict=True):
        left, right = (checkpoint.load(f / "checkpoints")[0] for f in (a, b))
        for name in left:
            np.testing.assert_array_equal(left[name], right[name], err_msg=name)
    assert (tmp_path / "sweep" / "summary.csv").read_text() == (
        tmp_path / "whole" / "summary.csv"
    ).read_text()


def test_the_memory_decides_how_many_members_run_at_once(monkeypatch):
    asked = planned(*SMALL, *GRID)
    (settings,) = asked.groups.values()
    parallel, program = sweep.members_at_once(settings, None)
    assert parallel == len(program.members) == 8
    like = jax.eval_shape(program.init, program.start, START)
    used = programs.compiled(program, like).memory_analysis()
    need = used.temp_size_in_bytes + used.output_size_in_bytes  # arguments are reused for the output
    monkeypatch.setattr(
        memory, "device_memory", lambda: (need * 0.5 / memory.PROGRAM_SHARE, "this machine")
    )
    assert 3 <= memory.capacity(program) <= 4
    monkeypatch.setattr(memory, "device_memory", lambda: (1.0, "this machine"))
    with pytest.raises(ConfigError, match="this machine has"):
        sweep.members_at_once(settings, None)


def test_a_train_state_is_the_same_compiled_well_or_quickly():
    (settings,) = planned(*SMALL, *GRID).groups.values()
    _, program = session.prepare(settings)
    well = {"xla_backend_optimization_level": 3, "xla_llvm_disable_expensive_passes": False}
    expected = jax.jit(program.init, compiler_options=well)(program.start, program.shared())
    found = loop.fresh(program, loop.Hooks("")).ts
    jax.tree.map(
        np.testing.assert_array_equal, checkpoint.to_arrays(found), checkpoint.to_arrays(expected)
    )


def test_a_folder_of_another_sweep_is_refused_and_a_longer_one_is_not(finished, tmp_path):
    def opened(*texts: str) -> dict[str, int]:
        asked = planned(*SMALL, *texts, f"run_dir={finished}")
        return open_folder(asked)

    assert [*opened(*GRID, "total_steps=1e6").values()] == [8]
    with pytest.raises(ConfigError, match=r"another sweep: seed is 0 there, 3 here"):
        opened(*GRID, "seed=3")
    with pytest.raises(ConfigError, match=r"algo.cost_limit is \[0.5, 0.5, 5.0, 5.0\] there, \[0.5, "):
        opened(*GRID, "algo.clip=0.1,0.3")
    with pytest.raises(ConfigError, match=r"another sweep, of 000-toys.Corridor-ppo_lag;"):
        opened(*GRID, "algo.epochs=1,2")
    (tmp_path / "config.yaml").touch()
    with pytest.raises(ConfigError, match="holds something else than a sweep"):
        open_folder(planned(*SMALL, *GRID, f"run_dir={tmp_path}"))


def test_the_policies_of_a_group_are_evaluated_setting_by_setting(finished):
    (folder,) = finished.glob("0*")
    run = open_run(folder)
    found = evaluate(run, 3, 0)
    assert [(s.name, s.limits, s.episodes) for s in found] == [
        (f"algo.cost_limit={limit:g}, algo.dual_lr={rate:g}", {"": limit}, 6)
        for limit in (0.5, 5.0)
        for rate in (0.01, 1.0)
    ]
    for i, s in enumerate(found):
        own = jax.tree.map(lambda x, i=i: x[2 * i : 2 * i + 2], run.learned)
        alone = run_episodes(run.algo, own, 3, 0)
        assert s.rows["return"].mean == pytest.approx(alone.ret.mean(), rel=1e-5)


def test_evaluate_says_how_many_policies_it_plays(finished, capsys):
    (folder,) = finished.glob("0*")
    assert shell.typed("evaluate", str(folder), "--episodes", "3") == 0
    assert "| 8 x 3 episodes, mean actions\n" in capsys.readouterr().out  # 4 settings of 2 seeds


def write(folder: Path, configs: dict[str, Any], table: list[tuple]) -> None:
    """A run folder with some rows of seed, cost limit (None: no column), return and cost."""
    folder.mkdir(parents=True)
    run_folder.write_config(folder, configs)
    swept = ["algo.cost_limit"] if table[0][1] is not None else []
    log = run_folder.Metrics(folder, [*swept, "train/return", "train/cost"], 0)
    for iteration in range(1, 21):
        late = iteration > 18
        seeds, limits, returns, costs = (np.array(c) for c in zip(*table, strict=True))
        values = {"train/return": late * returns, "train/cost": np.where(late, costs, 99.0)}
        at = checkpoint.Progress(iteration, iteration * 10, iteration)
        log.append(at, list(seeds), 0.0, values | dict.fromkeys(swept, limits))
    log.close()


def test_the_summary_is_the_last_tenth_of_training_over_the_seeds_of_each_setting(tmp_path):
    asked = planned(*SMALL, "algo.cost_limit=2,4,8,16", f"run_dir={tmp_path}")
    sweep.write_folder(asked, {})
    ((name, settings),) = asked.groups.items()
    plain: Any = settings.plain() | {"num_seeds": 2}
    three = plain | {"algo": plain["algo"] | {"cost_limit": [2.0, 4.0, 8.0]}}
    table = [(0, 2.0, 1.0, 1.0), (1, 2.0, 3.0, 3.0), (0, 4.0, 5.0, 3.0), (1, 4.0, 5.0, 7.0)]
    write(tmp_path / f"{name}.part0", three, [*table, (0, 8.0, 0.0, 9.45), (1, 8.0, 0.0, 9.55)])
    for seed in range(2):  # a setting whose seeds were trained apart
        alone = plain | {"algo": plain["algo"] | {"cost_limit": 16.0}, "seed": seed, "num_seeds": 1}
        write(tmp_path / f"{name}.part{seed + 1}", alone, [(seed, None, 1.0, np.nan)])
    assert summarise(tmp_path) == (
        "| algo.cost_limit | seeds | steps | return | cost | limit | limit held |\n"
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |\n"
        "| 2 | 2 | 200 | 2 | 2 | 2 | yes |\n"
        "| 4 | 2 | 200 | 5 | 5 | 4 | unclear |\n"
        "| 8 | 2 | 200 | 0 | 9.5 | 8 | no |\n"
        "| 16 | 2 | 200 | 1 | - | 16 | - |\n"
    )
    with (tmp_path / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    found = [float(rows[1][k]) for k in ("cost", "cost_low", "cost_high", "cost_limit")]
    np.testing.assert_allclose(found, [5, 5, 5, 4])
    assert (tmp_path / "summary.png").stat().st_size > 10_000


def test_the_summary_of_learning_from_data_is_of_the_final_evaluation(tmp_path, monkeypatch):
    titles = []
    monkeypatch.setattr(trade_off, "draw", lambda rows, title: titles.append(title))
    monkeypatch.setattr(plots, "save", lambda *_: None)
    write_dataset(tmp_path / "data.npz", data_set_like(Corridor()))
    offline = [
        "env=toys:Corridor", "algo=bc", f"dataset={tmp_path / 'data.npz'}", "algo.hidden=[4]",
        "algo.updates=5", "total_updates=10", "algo.cost_limit=10,40", f"run_dir={tmp_path / 'sweep'}",
    ]  # fmt: skip
    asked = planned(*offline)
    sweep.write_folder(asked, {})
    ((name, settings),) = asked.groups.items()
    folder = tmp_path / "sweep" / name
    folder.mkdir()
    run_folder.write_config(folder, settings.plain() | {"num_seeds": 2})
    log = run_folder.Metrics(folder, ["algo.cost_limit", "train/cost_estimate"], 0)
    for iteration in (1, 2):
        limits, guesses = np.repeat([10.0, 40.0], 2), np.full(4, -0.5)
        at = checkpoint.Progress(iteration, 0, 5 * iteration)
        values = {"algo.cost_limit": limits, "train/cost_estimate": guesses}
        log.append(at, [0, 1, 0, 1], 0.0, values)
    log.close()
    header = (
        "| algo.cost_limit | seeds | updates | return | cost | limit | limit held |\n"
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |\n"
    )
    assert summarise(tmp_path / "sweep") == (
        f"{header}| 10 | 2 | 10 | - | - | 10 | - |\n| 40 | 2 | 10 | - | - | 40 | - |\n"
    )
    found = {
        f"algo.cost_limit={limit}": {"seeds": {"return": [ret, ret], "cost": [20.0, 20.0]}}
        for limit, ret in ((10, 1.0), (40, 2.0))
    }
    (folder / "evaluation.json").write_text(json.dumps(found))
    assert summarise(tmp_path / "sweep") == (
        f"{header}| 10 | 2 | 10 | 1 | 20 | 10 | no |\n| 40 | 2 | 10 | 2 | 20 | 40 | yes |\n\n"
        "Training has no episodes: return and cost of algo.cost_limit=10; algo.cost_limit=40 are of "
        "the final evaluation.\n"
    )
    with (tmp_path / "sweep" / "summary.csv").open() as file:
        row = next(csv.DictReader(file))
    assert (row["updates"], row["return"], row["cost"], row["held"]) == ("10", "1.0", "20.0", "no")
    assert titles == [LATE, EVALUATED], "two seeds have no interval to speak of"
    monkeypatch.undo()
    assert shell.typed("plot", str(folder), "--out", str(tmp_path / "plot")) == 0
    text = (tmp_path / "plot" / "results.md").read_text()
    assert "Return of an episode, final evaluation: mean" in text and "| updates |" in text
    assert "| `bc, algo.cost_limit=10` | 1.00 |" in text and "limit=40` | 2.00 |" in text


def test_curves_of_settings_side_by_side_have_their_own_limits(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        plots.Axes, "axhline", lambda self, y, **style: drawn.append((y, style["color"]))
    )
    metrics = {
        "steps": np.repeat([1.0, 2.0], 4), "seed": np.tile([0.0, 1.0], 4),
        "algo.cost_limit": np.tile([5.0, 5.0, 10.0, 10.0], 2), "train/cost": np.arange(8.0),
    }  # fmt: skip
    plots.curves(metrics, tmp_path / "curves.png", "title", 25.0)
    assert drawn == [(5.0, "C0"), (10.0, "C1")]


BAD = {
    "algo.cost_limt=5,10": "did you mean 'cost_limit'?",
    "algo.cost_limit=5,wide": "algo.cost_limit='wide': expected a",
    "algo.epochs=5,1.5": "algo.epochs=1.5: expected a whole number",
    "algo.cost_limit=5,-1": "algo.cost_limit=-1: expected a number between 0 and",
    "algo.cost_limit=5,": "cannot read 'algo.cost_limit=5,'",
    "algo.cost_limit=5,5": "algo.cost_limit=5 occurs twice",
    "algo.cost_limit=5,5.0": "occurs twice",
    "algo.cost_limit=": "algo.cost_limit='': expected a number",
    "algo.cost_limit=5": "nothing to sweep",
    "algo.hidden=[8,8]": "nothing to sweep",
    "env=point_goal2 algo.cost_limits.hazard=5,10": "unknown cost 'hazard'; did you mean 'hazards'?",
    "env=point_goal2 algo.cost_limits.hazards=5,-1": "algo.cost_limits.hazards=-1: expected",
    "env=point_goal2 algo.cost_limits.hazards=5,wide": "algo.cost_limits.hazards='wide': expected a",
    "env=point_goal2 algo=p3o algo.cost_limits.hazards=5,10": "of p3o; did you mean 'cost_limit'?",
    "algo.cost_limit.hazards=5,10": "did you mean 'cost_limits'?",
    "algo=ppo_lag,cop": "did you mean 'cpo'?",
    "env=point_goal1,Safexp-PointGoal1-v0": "env=Safexp-PointGoal1-v0: these settings occur twice",
    "preset=auto,fast": "preset=fast: these settings occur twice",
    "env=point_goal1,car_gaol1": "did you mean 'car_goal1'?",
    "algo.minibatches=8,7": "minibatches=7",
    "algo.min_std=0,0.7": "min_std=0.7",
    "resume=true": "the same command is given again",
    "max_parallel=0 algo.clip=0.1,0.2": "max_parallel=0: expected a whole number",
    "init_from=nowhere algo.clip=0.1,0.2": "not a run folder",
    "--fast": "unrecognized arguments: --fast",
    "--summary=nowhere": "not a sweep's folder",
}


@pytest.mark.parametrize("arguments", BAD)
def test_a_bad_sweep_is_one_line_and_status_2(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(loop, "train", lambda *a, **k: pytest.fail("it went on to train"))
    assert shell.typed("sweep", *arguments.split()) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ") and BAD[arguments] in lines[0]
    assert not list(tmp_path.glob("runs/*"))


def test_the_summary_of_another_sweep_is_neither_shown_nor_written_again(tmp_path, capsys):
    sweep.write_folder(planned(*SMALL, "algo.cost_limit=2,4", f"run_dir={tmp_path}"), {})
    assert shell.typed("sweep", *SMALL, "algo.cost_limit=2,5", f"run_dir={tmp_path}") == 2
    out, err = capsys.readouterr()
    assert out == "" and "belongs to another sweep: algo.cost_limit is [2.0, 4.0] there" in err
    assert [path.name for path in tmp_path.iterdir()] == ["sweep.yaml"]


def test_a_sweep_in_a_place_where_nobody_can_write_compiles_nothing(monkeypatch, capsys):
    monkeypatch.setattr(sweep, "members_at_once", lambda *_: pytest.fail("it went on to compile"))
    assert shell.typed("sweep", *SMALL, *GRID, "run_dir=/proc/here/sweep") == 1  # as train.py
    out, err = capsys.readouterr()
    assert out == "" and err == "error: cannot write to /proc/here/sweep: No such file or directory\n"


def test_the_command_rewrites_the_summary_of_a_sweep_at_any_time(tmp_path, capsys):
    asked = planned("env=point_goal0", "algo.cost_limit=2,4", f"run_dir={tmp_path}")
    sweep.write_folder(asked, {})
    ((name, settings),) = asked.groups.items()
    write(tmp_path / name, settings.plain(), [(0, 2.0, 1.0, 1.0), (0, 4.0, 1.0, 1.0)])
    assert shell.typed("sweep", "--summary", str(tmp_path)) == 0
    out, err = capsys.readouterr()
    assert out == (tmp_path / "summary.md").read_text() and "| 4 | 1 | 200 |" in out and err == ""

"""Runs that learn from a data set: trained, evaluated, stopped, resumed, compared, refused."""

import contextlib
import dataclasses
import json
import shutil
from typing import Any

import jax
import numpy as np
import pytest
from shell import TOY, assert_same_run, start, typed, wait_for

import jaxsafe
from jaxsafe.algos import ALGOS
from jaxsafe.config import ConfigError, flat
from jaxsafe.learn.offline import DataSet, OfflineConfig, data_set
from jaxsafe.report import read
from jaxsafe.run import checkpoint, dataset, run_folder, session
from jaxsafe.run.arguments import compose
from jaxsafe.run.dataset import read_dataset, write_dataset
from jaxsafe.run.policies import open_run
from jaxsafe.run.settings import settings_from_config

BC = (TOY, "algo=bc", "algo.updates=10", "algo.hidden=[8]", "eval_episodes=2", "video=false")


def make_data(n: int = 100) -> DataSet:
    rng = np.random.default_rng(0)
    obs, action = rng.normal(size=(n, 4)), rng.uniform(-1, 1, (n, 2))
    late = np.arange(n) % 20 == 19
    costs = {"wall": rng.integers(0, 2, n)}
    return data_set(
        obs, action, rng.normal(size=n), costs["wall"], obs + 0.1, np.zeros(n, bool), late, costs
    )


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "data.npz"
    write_dataset(path, make_data())
    return path


@pytest.fixture(scope="module")
def whole(tmp_path_factory, data):
    run = tmp_path_factory.mktemp("whole") / "run"
    args = (*BC, f"dataset={data}", "total_updates=400", "num_seeds=2", f"run_dir={run}")
    assert typed("train", *args) == 0
    return run


def test_a_data_set_comes_back_from_its_file(data):
    for x, y in zip(*map(jax.tree.leaves, (read_dataset(str(data)), make_data())), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name for name, row in ALGOS.items() if issubclass(row.config, OfflineConfig)]
)
def test_each_offline_learner_trains_and_is_evaluated(name, data, tmp_path):
    known = {field.name for field in dataclasses.fields(ALGOS[name].config)}
    sizes = ["algo.vae_hidden=[8]"] if "vae_hidden" in known else []
    length = ("total_updates=40", "eval_every=20", "num_seeds=2")
    args = (*BC, f"algo={name}", *sizes, f"dataset={data}", *length)
    assert typed("train", *args, f"run_dir={tmp_path / 'run'}") == 0
    scores = json.loads((tmp_path / "run/evaluation.json").read_text())
    assert np.isfinite([scores["return"]["mean"], scores["cost"]["mean"]]).all()
    assert (tmp_path / "run/curves.png").exists()


def test_a_run_counts_gradient_steps_and_needs_no_data_to_be_evaluated(whole, data, capsys):
    table = run_folder.read_metrics(whole)
    assert table["updates"][::2].tolist() == [10.0 * (i + 1) for i in range(40)]
    assert not table["steps"].any() and table["train/actor_loss"][-1] < table["train/actor_loss"][0]
    assert run_folder.newest_progress(whole) == (40, 0, 400)
    config = run_folder.read_config(whole)
    assert (config["dataset"], config["total_updates"]) == (str(data), 400)
    assert run_folder.dataset_of(whole) == dataset.sha256(str(data))
    assert not (whole / "curves.png").exists()  # no evaluation in training, nothing to draw
    scores = json.loads((whole / "evaluation.json").read_text())
    episodes = make_data().episodes
    assert scores["data return"]["mean"] == pytest.approx(episodes.ret.mean(), rel=1e-5)
    safe = episodes.ret[episodes.cost <= 25]
    assert scores["data best safe return"]["mean"] == pytest.approx(safe.max(), rel=1e-5)
    assert scores["DSRL cost"]["mean"] == pytest.approx(scores["cost"]["mean"] / 25)
    config["dataset"] = "/nowhere.npz"
    copy = whole.parent / "copy"
    shutil.copytree(whole, copy)
    run_folder.write_config(copy, config)
    assert open_run(copy, (TOY,)).learned.normaliser.mean.shape == (2, 4)
    assert typed("evaluate", str(copy), TOY, "--episodes", "2") == 0
    assert "return" in capsys.readouterr().out


def test_the_normaliser_that_acts_is_that_of_the_data(whole):
    params = open_run(whole, (TOY,)).learned
    np.testing.assert_allclose(params.normaliser.mean[1], make_data().obs.mean(0), atol=1e-5)


def test_killed_and_resumed_it_ends_bit_for_bit_as_if_uninterrupted(whole, data, tmp_path, capsys):
    run, moved = tmp_path / "run", tmp_path / "moved.npz"
    args = (*BC, "total_updates=400", "num_seeds=2", f"run_dir={run}")
    process = start("train", *args, f"dataset={data}", "checkpoint_iterations=1", cwd=tmp_path)
    wait_for(lambda: len(checkpoint.checkpoints(run / "checkpoints")) == 2, process)
    process.kill()
    process.communicate()
    reached = run_folder.newest_progress(run)
    assert reached is not None and 0 < reached.iteration < 40, "killed too late to test anything"
    shutil.copy(data, moved)
    assert typed("train", *args, f"dataset={moved}", "resume=true") == 0
    assert f"resuming at {reached.updates} updates" in capsys.readouterr().out
    assert_same_run(run, whole)


def test_another_data_set_is_refused_on_resumption(whole, data, tmp_path, capsys):
    other = tmp_path / "other.npz"
    write_dataset(other, make_data(50))
    args = (f"resume={whole}", TOY, f"dataset={other}")
    assert typed("train", *args) == 2
    assert f"dataset={other} is not the file that {whole} was trained with" in capsys.readouterr().err
    assert not session.is_same_run(compose([*BC, f"dataset={other}"]), whole)


def test_a_comparison_holds_runs_without_training_episodes(whole):
    (run,) = read.read([whole])
    assert run.steps == 400 and run.ended
    assert np.isnan(run.values["return"]).all() and np.isfinite(run.values["final return"]).all()
    assert run.clock == "updates" and not run.evaluated
    assert typed("plot", str(whole), "--out", str(whole.parent / "comparison")) == 0


def test_a_sweep_falls_back_on_the_evaluation_of_a_named_cost_too(whole):
    (run,) = read.read([whole])
    run = run._replace(limits={"wall": 2.0}, values=run.values | {"final cost wall": np.ones(2)})
    assert np.isnan(read.measured("toys", run.table, run.limits)["return"]).all()
    found = read.or_evaluated(run)
    assert found.evaluated and found.values["cost wall"].tolist() == [1, 1]
    watched = run._replace(values=run.values | {"return": np.zeros(2), "cost": np.zeros(2)})
    for name in ("return", "cost"):
        np.testing.assert_array_equal(found.values[name], run.values[f"final {name}"])
        # what `eval_every` evaluated is not compared with the final evaluation of other runs
        assert read.or_evaluated(watched).values[name] is run.values[f"final {name}"]


def test_evaluation_during_training_stands_in_for_its_episodes(data, tmp_path, capsys):
    """The last evaluation is said beside the data's own episodes, of 20 steps."""
    run = tmp_path / "run"
    args = (*BC, f"dataset={data}", "total_updates=100", "eval_every=30", f"run_dir={run}")
    assert typed("train", *args) == 0
    last, episodes = capsys.readouterr().out.splitlines()[-2], make_data().episodes
    ret, cost = (f"{x.mean():.4g}" for x in (episodes.ret, episodes.cost))
    safe = f"{episodes.ret[episodes.cost <= 25].max():.4g}"
    assert "DSRL's scores: cost " in last
    assert last.endswith(f"of the data: return {ret}, cost {cost}, best safe return {safe}")
    table = run_folder.read_metrics(run)
    assert table["updates"][np.isfinite(table["eval/cost"])].tolist() == [30, 60, 90, 100]
    np.testing.assert_array_equal(table["eval/return"], table["eval/return_sampled"])  # deterministic
    (found,) = read.read([run])
    assert found.values["return"][0] == pytest.approx(table["eval/return"][-1], rel=1e-6)


def test_python_trains_on_a_path(data, tmp_path, capsys):
    run = jaxsafe.train("toys:Corridor", "bc", dataset=data, total_updates=10, updates=10, hidden=(8,),
                        eval_episodes=0, video=False, run_dir=tmp_path / "run")  # fmt: skip
    assert run.settings.train.dataset == str(data) and run.metrics["updates"].tolist() == [10]
    assert "1 seed | cpu" in capsys.readouterr().out


def test_a_data_set_has_100_000_updates_unless_told_otherwise(data):
    assert compose([*BC, f"dataset={data}"]).train.total_updates == 100_000
    assert compose([*BC]).train.total_updates is None
    with pytest.raises(ConfigError, match="total_steps=5000: this run ends at total_updates=100000"):
        compose([*BC, f"dataset={data}", "total_steps=5000"])
    config = compose([*BC, f"dataset={data}"]).plain()  # which has total_steps, too
    assert settings_from_config(config).train.total_updates == 100_000


def test_processes_whose_files_differ_are_refused(data, tmp_path, monkeypatch):
    """As process 1 of two whose process 0 has another file under the same path."""
    settings = compose([*BC, f"dataset={data}", f"run_dir={tmp_path}"])
    mine = flat(settings.plain()) | {"the data set's SHA-256": dataset.sha256(str(data))}
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(session.distributed, "leads", lambda: False)
    for theirs, message in ((mine, None), (mine | {"the data set's SHA-256": "0"}, "SHA-256=.* 0 in")):
        said = json.dumps([str(tmp_path), theirs])
        monkeypatch.setattr(session.distributed, "text_from_process_0", lambda text, said=said: said)
        with pytest.raises(ConfigError, match=message) if message else contextlib.nullcontext():
            assert session.agree_on_folder(settings, None, print) == tmp_path


@pytest.mark.parametrize(
    "options, message",
    [
        (["algo=bc"], "an offline algorithm learns from a data set: give dataset=PATH"),
        (["algo=bc", "dataset=nowhere.npz"], "dataset=nowhere.npz: there is no such file"),
        (["algo=ppo_lag", "dataset=DATA"], "this algorithm learns from no data set"),
        (["algo=bc", "dataset=DATA", "num_envs=4"], "num_envs=4: bc trains without environments"),
        (
            ["algo=bc", "dataset=DATA", "total_steps=5000"],
            "total_steps=5000: this run ends at total_updates=100000; give that instead",
        ),
        (
            ["algo=ppo_lag", "total_updates=10", "total_steps=5e3"],
            "ends at total_updates=10; give that",
        ),
        (["algo=bc", "dataset=DATA", "env=toys:Ticker"], "observations have 4 numbers, those of the"),
        (
            ["algo=bc", "dataset=DATA", "algo.updates=0"],
            "updates=0: expected a whole number",
        ),
        (
            ["algo=bc", "dataset=DATA", "total_updates=0"],
            "total_updates=0: expected a whole number",
        ),
    ],
)
def test_what_cannot_work_is_one_line(tmp_path, data, capsys, options, message):
    options = [text.replace("DATA", str(data)) for text in options]
    assert typed("train", TOY, f"run_dir={tmp_path / 'run'}", *options) == 2
    said = capsys.readouterr()
    assert message in said.err and len((said.out + said.err).strip().splitlines()) == 1


def test_data_of_another_task_is_one_line_that_names_both(tmp_path, capsys):
    for name, lines in (("point_circle1", 1), ("toys:Corridor", 0)):
        path = tmp_path / "data.npz"
        write_dataset(path, make_data(), about={"env": json.dumps({"name": name})})
        run = tmp_path / f"run{lines}"
        args = (*BC, f"dataset={path}", "total_updates=10", "eval_episodes=0", f"run_dir={run}")
        assert typed("train", *args) == 0
        said = f"dataset={path} is of point_circle1, and env=toys:Corridor; expected data of the same"
        out = capsys.readouterr().out
        assert out.count("warning: ") == out.count(f"warning: {said}") == lines


def test_numbers_that_no_environment_gives_are_a_line_each(data):
    sound = dataset.read_dataset(str(data))
    assert dataset.oddities("x", sound) == []
    odd = sound._replace(action=7 * sound.action, cost=-sound.cost)
    actions, costs = dataset.oddities("x", odd)
    most = 7 * np.abs(sound.action).max()
    assert actions.startswith(f"warning: dataset=x has actions up to {most:g}, which")
    assert costs == "warning: dataset=x has costs down to -1; expected 0 or more"


def test_a_lone_seed_without_environments_does_not_split_over_devices(data, monkeypatch):
    monkeypatch.setattr(session, "check_devices", lambda devices: None)
    with pytest.raises(ConfigError, match="devices=2: a lone seed has no environments to split"):
        session.prepare(compose([*BC, f"dataset={data}", "devices=2"]))


@pytest.mark.parametrize(
    "name, array, message",
    [
        ("terminals", None, "has no terminals; did you mean"),
        ("rewards", np.zeros((100, 1)), r"rewards is float64\[100, 1\], expected numbers \[n\]"),
        ("actions", np.zeros((99, 2)), r"actions is float64\[99, 2\], expected numbers \[n, size\]"),
        ("costs", np.full(100, np.nan), "costs holds numbers that are not finite"),
        ("costs", np.full(100, 1e300), "costs holds numbers that are not finite"),
        ("costs", np.full(100, "1"), "costs is <U1"),
        ("observations", np.zeros((0, 4)), "observations is empty"),
        ("costs", np.array([{}] * 100), "cannot be read as .npz: Object arrays cannot be loaded"),
    ],
)
def test_wrong_arrays_are_one_line(tmp_path, data, name, array, message):
    with np.load(data) as file:
        arrays: dict[str, Any] = {k: file[k] for k in file.files} | {"terminated": np.zeros(1)}
    arrays = {k: x for k, x in (arrays | {name: array}).items() if x is not None}
    np.savez(tmp_path / "wrong.npz", **arrays)
    with pytest.raises(ConfigError, match=message) as error:
        read_dataset(str(tmp_path / "wrong.npz"))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 torn", b"text"])
def test_a_file_of_another_kind_is_one_line(tmp_path, content):
    path = tmp_path / "data.npz"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"is neither \.hdf5 nor \.npz"):
        read_dataset(str(path))
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(ConfigError, match=r"is neither \.hdf5 nor \.npz"):
        read_dataset(str(path))
    path = tmp_path / "data.hdf5"
    path.write_bytes(dataset.HDF5 + b" torn")
    with pytest.raises(ConfigError, match=r"cannot be read as \.hdf5"):
        read_dataset(str(path))
    with pytest.raises(ConfigError, match=r"is a folder without main_data\.hdf5"):
        read_dataset(str(tmp_path))


def test_members_share_one_copy_of_the_data_and_nothing_of_it_is_given_up(data):
    _, program = session.prepare(compose([*BC, f"dataset={data}", "num_seeds=3"]))
    like = jax.eval_shape(program.init, program.start, program.shared())
    count = len(read_dataset(str(data)).reward)
    assert not any(count in x.shape for x in jax.tree.leaves(like))

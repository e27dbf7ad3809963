"""The command as a user meets it. Bad input is tested in this process, the rest in new ones."""

import csv
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from tasks import FAST

from jaxsafe import algos, envs
from jaxsafe.config import ConfigError
from jaxsafe.run import checkpoint, command, compat, run_folder, runner, viewing
from jaxsafe.types import Shared

SCRIPTS = Path(__file__).parent.parent.parent / "scripts"
SMALL = (
    "env=point_goal0", "env.num_steps=40", "algo=ppo_lag", "num_envs=4", "algo.horizon=16",
    "algo.minibatches=2", "algo.epochs=2", "algo.critic_epochs=2", "algo.hidden=[8,8]",
    "total_steps=640", "eval_episodes=2", "video=false",
)  # fmt: skip


def start(script: str, *args: str, cwd: Path, **kwargs) -> subprocess.Popen:
    environ = {**os.environ, "JAX_PLATFORMS": "cpu"}
    return subprocess.Popen(
        [sys.executable, str(SCRIPTS / script), *args],
        cwd=cwd, env=environ, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **kwargs,
    )  # fmt: skip


def call(script: str, *args: str, cwd: Path) -> tuple[int, str, str]:
    process = start(script, *args, cwd=cwd)
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


def arrays(run: Path) -> dict[str, np.ndarray]:
    return checkpoint.load(run / "checkpoints")[0]


def rows(run: Path) -> list[list[str]]:
    """metrics.csv without the column of wall-clock seconds."""
    with (run / "metrics.csv").open() as file:
        return [row[:3] + row[4:] for row in csv.reader(file)]


def assert_same_run(a: Path, b: Path) -> None:
    left, right = arrays(a), arrays(b)
    assert left.keys() == right.keys()
    for name in left:
        np.testing.assert_array_equal(left[name], right[name], err_msg=name)
    assert rows(a) == rows(b)


def wait_for(condition, process: subprocess.Popen, seconds: float = 200) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.005)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> tuple[Path, str]:
    """An uninterrupted run, which nobody changes, and what it printed."""
    home = tmp_path_factory.mktemp("finished")
    status, out, err = call("train.py", *SMALL, "run_dir=run", cwd=home)
    assert status == 0, err
    return home / "run", out


BAD = {
    "env=point_gol1": "did you mean 'point_goal1'?",
    "env=Safexp-PointGoal9-v0": "did you mean",
    "algo=cop": "did you mean 'cpo'?",
    "algo.cost_limt=3": "did you mean 'cost_limit'?",
    "env.hazard_num=3": "did you mean 'hazards_num'?",
    "total_step=5": "did you mean 'total_steps'?",
    "cost_limit=5": "did you mean 'algo.cost_limit'?",
    "total_steps=-1": "expected at least 1",
    "total_steps=1.5": "expected a whole number",
    "total_steps=many": "expected a whole number",
    "num_envs=0": "expected at least 1",
    "num_seeds=0": "expected at least 1",
    "seed=-1": "expected at least 0",
    "algo.cost_limit=-1": "expected at least 0",
    "algo.discount=1.1": "expected between 0 and 1",
    "algo.gae_lambda=nan": "expected between 0 and 1",
    "algo.clip=wide": "expected a number",
    "algo.minibatches=7": "minibatches",
    "algo.cost_limit=[5,5]": "algo.cost_limit=5 occurs twice",
    "algo.cost_limit=[]": "not 0 of algo.cost_limit",
    "algo.cost_limit=[5,wide]": "expected a number",
    "env.engine=quick": "quick",
    "env.hazards_num=many": "hazards_num",
    "env.placements_extents=[1,2]": "placements_extents",
    "num_envs=1e9": "GiB",
    "devices=512": "devices=512",
    "seed=1,2": "--multirun",
    "+seed=1": "without '+'",
    "seed": "cannot read",
    "algo.clip=[1": "cannot read",
    "preset=quick": "valid: fast",
    "compat=omnisaf": "did you mean 'omnisafe'?",
    "resume=nowhere": "not a run folder",
    "init_from=nowhere": "not a run folder",
    "env.name=point_goal1": "choose with env=",
    "--fast": "unknown flag --fast",
}


@pytest.mark.parametrize("argument", BAD)
def test_bad_input_is_one_line_and_status_2(argument, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    monkeypatch.setattr(sys, "argv", ["train.py", argument])
    monkeypatch.setattr(runner, "train", lambda *a, **k: pytest.fail("it went on to train"))
    try:
        status = command.train_main(envs, algos)
    except SystemExit as stop:
        status = stop.code
    lines = capsys.readouterr().err.splitlines()
    assert status == 2
    assert len(lines) == 1 and lines[0].startswith("error: ") and BAD[argument] in lines[0]
    assert not list(tmp_path.glob("runs/*"))


def test_a_new_process_reports_bad_input_the_same_way(tmp_path):
    status, out, err = call("train.py", "algo.clip=wide", cwd=tmp_path)
    assert (status, out, err) == (2, "", "error: algo.clip='wide': expected a number\n")
    status, out, err = call("train.py", "-m", "--cfg", "job", cwd=tmp_path)
    assert (status, out) == (2, "") and err.startswith("error: Only one of") and err.count("\n") == 1


def test_help_and_cfg_show_every_option_with_its_default(tmp_path):
    status, out, _ = call("train.py", "--help", cwd=tmp_path)
    assert status == 0 and "env=car_push1 algo=cpo" in out and "total_steps: 10000000" in out
    status, out, _ = call(
        "train.py", "--cfg", "job", "env=Safexp-CarPush1-v0", "algo=cpo", "total_steps=1e7",
        "env.placements_extents=[-1,-1,1,1]", cwd=tmp_path,
    )  # fmt: skip
    shown = yaml.safe_load(out)
    assert status == 0 and shown["env"]["name"] == "car_push1" and shown["algo"]["name"] == "cpo"
    assert shown["env"]["placements_extents"] == [-1, -1, 1, 1]
    assert shown["env"].keys() - {"name"} == envs.env_defaults("car_push1").keys()


def test_published_settings_are_defaults_that_the_command_line_overrides():
    request = command.read_arguments(["preset=published", "algo=cpo"], envs, algos)
    setting = next(iter(algos.ALGOS["cpo"].published.values()))
    assert request.groups["algo"]["cpo"].items() >= setting.items()


def test_every_chosen_name_has_its_options_and_no_other():
    texts = ["-m", "env=car_push1,Safexp-PointGoal1-v0", "algo=cpo,trpo"]
    groups = command.read_arguments(texts, envs, algos).groups
    chosen = {group: {name for name, options in g.items() if options} for group, g in groups.items()}
    assert chosen == {"env": {"car_push1", "point_goal1"}, "algo": {"cpo", "trpo"}}


def test_the_conventions_of_omnisafe_are_defaults_of_either_preset():
    for preset in ("fast", "published"):
        texts = [f"preset={preset}", "compat=omnisafe", "algo=cpo", "algo.margin_lr=0.1"]
        settings = command.compose(texts, envs, algos)
        cfg = settings.algo
        assert (cfg.per_step, cfg.violation_gain, cfg.margin_lr) == (False, 1.0, 0.1)
        assert (cfg.kl_per_action, cfg.target_kl, cfg.cost_window) == (True, 0.01, 5)
        assert settings.plain()["compat"] == "omnisafe"


def test_each_convention_is_of_some_algorithm_and_differs_from_its_defaults():
    for convention in compat.OMNISAFE:
        takers = [e.config for e in algos.ALGOS.values() if convention.applies(e.config)]
        assert takers
        for config in takers:
            assert all(getattr(config(), k) != v for k, v in convention.options.items())


def test_a_run_folder_holds_what_a_reader_needs(finished):
    run, out = finished
    first = out.splitlines()[0]
    assert all(
        s in first for s in ("point_goal0", "ppo_lag", "1 seed x 4 envs", "engine c", "compiling")
    )
    assert "compiled in" in out and f"run folder: {run.name}" in out
    for name in ("config.yaml", "versions.json", "metrics.csv", "curves.png", "evaluation.json"):
        assert (run / name).stat().st_size > 0
    assert list(run.glob("tensorboard/seed0/events*"))
    assert run_folder.progress(run) == (10, 640)
    assert [p for p in run.rglob("*") if p.suffix in (".pkl", ".pickle", ".npy")] == []
    saved = run_folder.read_config(run)
    assert command.settle(saved, envs, algos).plain() == saved


def test_killed_and_resumed_it_ends_bit_for_bit_as_if_uninterrupted(finished, tmp_path):
    args = (*SMALL, "run_dir=run", "checkpoint_iterations=1")
    run = tmp_path / "run"
    process = start("train.py", *args, cwd=tmp_path)
    wait_for(lambda: len(checkpoint.checkpoints(run / "checkpoints")) == 2, process)
    process.kill()
    process.communicate()
    reached = run_folder.progress(run)
    assert reached is not None and 0 < reached[0] < 10, "killed too late to test anything"
    status, out, err = call("train.py", *args, "resume=true", cwd=tmp_path)
    assert status == 0 and "resuming at" in out, err
    assert_same_run(run, finished[0])


def test_ctrl_c_saves_and_says_how_to_resume_and_that_works(finished, tmp_path):
    run = tmp_path / "run"
    args = [*SMALL, "run_dir=run", "total_steps=1e8"]
    process = start("train.py", *args, cwd=tmp_path)
    wait_for(lambda: (run / "metrics.csv").exists() and len(rows(run)) > 2, process)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130 and err == ""
    assert "python scripts/train.py resume=run" in out
    reached = run_folder.progress(run)
    assert reached is not None
    status, out, err = call("train.py", "resume=run", f"total_steps={reached[1] + 64}", cwd=tmp_path)
    assert status == 0, err
    assert run_folder.progress(run) == (reached[0] + 1, reached[1] + 64)
    table, reference = rows(run), rows(finished[0])
    assert table[: len(reference)] == reference[: len(table)]
    assert [row[0] for row in table[1:]] == [str(i + 1) for i in range(reached[0] + 1)]


def test_ctrl_c_during_the_evaluation_leaves_a_run_that_is_trained(finished, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished[0], run)
    (run / "curves.png").unlink(missing_ok=True)  # it is drawn right before the evaluation
    process = start("train.py", "resume=run", "eval_episodes=20000", cwd=tmp_path)
    wait_for((run / "curves.png").exists, process)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130 and err == ""
    assert "the training is saved" in out and "python scripts/train.py resume=run" in out


def settings(*args: str) -> command.Settings:
    """Top-level options as the command line would settle them."""
    base = {k: yaml.safe_load(v) for k, v in (a.split("=") for a in args)}
    groups = {"env": {"name": "point_goal0"}, "algo": {"name": "ppo_lag"}}
    return command.settle({**groups, **base}, envs, algos)


def test_a_folder_with_a_run_is_not_overwritten_nor_resumed_with_other_settings(finished, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished[0], run)
    with pytest.raises(ConfigError, match="resume=true"):
        command.choose_folder(settings(f"run_dir={run}"), envs, algos, None, print)
    saved = command.settle(run_folder.read_config(run) | {"resume": str(run)}, envs, algos)
    assert command.choose_folder(saved, envs, algos, None, print) == run
    longer = command.settle(
        run_folder.read_config(run) | {"resume": str(run), "total_steps": 10**6}, envs, algos
    )
    assert command.choose_folder(longer, envs, algos, None, print) == run
    other = command.settle(run_folder.read_config(run) | {"resume": str(run), "seed": 5}, envs, algos)
    with pytest.raises(ConfigError, match=r"seed=5 but .* was trained with 0"):
        command.choose_folder(other, envs, algos, None, print)


def test_resume_true_finds_the_newest_unfinished_run_of_the_same_settings(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wanted = settings("seed=1", "resume=true")
    for name, seed in (
        ("20260101-000000-seed1", 1),
        ("20260102-000000-seed1", 1),
        ("20260103-000000-seed2", 2),
    ):
        folder = tmp_path / "runs" / "point_goal0-ppo_lag" / name
        folder.mkdir(parents=True)
        run_folder.write_config(folder, settings(f"seed={seed}").plain())
    assert command.choose_folder(wanted, envs, algos, None, print).name == "20260102-000000-seed1"


def test_evaluate_prints_the_table(finished, tmp_path):
    status, out, err = call("evaluate.py", str(finished[0]), "--episodes", "3", cwd=tmp_path)
    assert status == 0, err
    for row in ("return", "cost", "violation rate", "cost rate"):
        assert any(line.startswith(row) for line in out.splitlines())


@pytest.mark.parametrize("name", ["ppo_lag", "ppo_simmer_pid"])
def test_the_policy_of_a_run_is_read_whatever_its_minibatches_divide(tmp_path, name):
    """Only the whole batch, 8 x 5, divides by 4: one environment's steps do not."""
    base: dict[str, Any] = {"env": {"name": "point_goal0", "num_steps": 40}}
    base["algo"] = {"name": name, "num_envs": 8, "horizon": 5, "minibatches": 4, "hidden": [8, 8]}
    run = command.settle(base, envs, algos)
    env, make = command.make_env(run, envs), algos.ALGOS[name].make
    program = runner.build(env, make, run.configs, run.train)
    ones = jax.tree.map(
        lambda x: np.ones(x.shape, x.dtype),
        program.params(jax.eval_shape(program.init, program.start, Shared(np.int32(0)))),
    )
    run_folder.write_config(tmp_path, run.plain())
    checkpoint.save(tmp_path / "policy", ones, 1, 40)
    algo, params = command.policy_of(run, env, algos, tmp_path)
    params = jax.tree.map(lambda x: x[0], params)
    action, _, _ = algo.policy.act(params, (), jnp.zeros(algo.task(params).obs_size), None)
    assert action.shape == (env.action_size,)
    assert params.config.cost_limit == 25.0  # `task` may need the settings, and the dual
    assert all((x == 1).all() for x in jax.tree.leaves((params.params, params.normaliser, params.dual)))


def test_evaluate_render_and_watch_refuse_a_bad_folder_in_one_line(tmp_path, monkeypatch, capsys):
    for main in (command.evaluate_main, viewing.render_main, viewing.watch_main):
        monkeypatch.setattr(sys, "argv", ["script", str(tmp_path)])
        assert main(envs, algos) == 2
        assert (
            capsys.readouterr().err == f"error: {tmp_path} is not a run folder: it has no config.yaml\n"
        )


def test_a_full_disk_ends_training_in_one_line(tmp_path):
    """A limit on file size stands in for the disk: checkpoints fit, metrics soon do not."""
    args = (*SMALL, "run_dir=run", "total_steps=1e8", "checkpoint_iterations=20")
    process = start("train.py", *args, cwd=tmp_path)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (40_000, 40_000))
    _, err = process.communicate(timeout=200)
    assert process.returncode == 1
    assert len(err.splitlines()) == 1 and err.startswith("error: ") and "large" in err
    assert checkpoint.load(tmp_path / "run" / "checkpoints")[1].iteration > 0


@pytest.mark.parametrize("num_seeds", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_two_devices_share_seeds_or_the_environments_of_one(finished, tmp_path, monkeypatch, num_seeds):
    monkeypatch.setenv("JAX_NUM_CPU_DEVICES", "2")
    args = (*SMALL, "run_dir=run", "devices=2", f"num_seeds={num_seeds}")
    status, out, err = call("train.py", *args, cwd=tmp_path)
    assert status == 0, err
    table = run_folder.read_metrics(tmp_path / "run")
    assert sorted(set(table["seed"])) == list(range(num_seeds)) and table["steps"].max() == 640
    status, out, err = call("evaluate.py", "run", "--episodes", "2", cwd=tmp_path)
    assert status == 0 and f"{num_seeds} x 2 episodes" in out, err
    if num_seeds == 2:  # a seed of the sweep is the lone run of that seed
        lone = run_folder.read_metrics(finished[0])
        for name in table.keys() - {"seconds"}:
            np.testing.assert_allclose(
                table[name][0], lone[name][0], rtol=1e-3, atol=1e-4, err_msg=name
            )


def policy_rows(run: Path) -> dict[str, np.ndarray]:
    return {k: v for k, v in arrays(run).items() if k.split(".")[0] in runner.POLICY}


def warm(*args: str, **algo: Any):
    """A train state of ppo without an update, before and after it takes over a policy."""
    base = {k: yaml.safe_load(v) for k, v in (a.split("=") for a in args)}
    sizes = {"num_envs": 2, "horizon": 4, "minibatches": 1, "hidden": [8, 8]}
    groups = {
        "env": {"name": "point_goal0", "num_steps": 40},
        "algo": {"name": "ppo", **sizes, **algo},
    }
    run = command.settle({**groups, **base}, envs, algos)
    said: list[str] = []
    _, program = command.prepare(run, envs, algos)
    adapt = command.warm_start(run, program, envs, algos, said.append)
    fresh = jax.jit(program.init, compiler_options=FAST)(program.start)
    return checkpoint.to_arrays(fresh), checkpoint.to_arrays(adapt(fresh)), said[0]


def test_a_run_starts_from_the_parameters_and_normaliser_of_another_and_nothing_else(finished):
    policy = policy_rows(finished[0])
    fresh, taken, said = warm(f"init_from={finished[0]}", "num_seeds=2", cost_limit=[1.0, 2.0])
    assert {name.split(".")[0] for name in policy} == set(runner.POLICY)
    for name, value in taken.items():
        expected = np.repeat(policy[name], 4, axis=0) if name in policy else fresh[name]
        np.testing.assert_array_equal(value, expected, err_msg=name)
    assert said == f"starting from {finished[0]}: seed 0 from its seed 0, 1 from its seed 0"
    kernel = "params.actor.mean.params.Dense_0.kernel"
    assert (fresh[kernel] != taken[kernel]).any() and (taken["opt_state.actor.iteration"] == 0).all()


def test_each_seed_starts_from_the_same_seed_where_there_is_one(finished, tmp_path):
    source = tmp_path / "run"
    source.mkdir()
    run_folder.write_config(source, run_folder.read_config(finished[0]) | {"seed": 4, "num_seeds": 3})
    three = {k: np.concatenate([v, v + 1, v + 2]) for k, v in policy_rows(finished[0]).items()}
    checkpoint.save(source / "checkpoints", three, 1, 64)
    _, taken, said = warm(f"init_from={source}", "seed=5", "num_seeds=3")
    for name, value in three.items():
        np.testing.assert_array_equal(taken[name], value[[1, 2, 0]])
    assert said.endswith("seed 5 from its seed 5, 6 from its seed 6, 7 from its seed 4")


@pytest.mark.parametrize(
    ("args", "algo", "expected"),
    [
        ((), {"hidden": [4]}, ("is [8], expected [4]; algo.hidden is [8, 8] there, [4] here",)),
        ((), {"obs_normalize": False}, ("expected absent", "algo.obs_normalize is True there")),
        ((), {"activation": "relu"}, ("algo.activation is tanh there, relu here",)),
        ((), {"trunk": "shared"}, ("algo.trunk is separate there, shared here",)),
        ((), {"std": "state"}, ("is [2], expected [4]; algo.std is free there, state here",)),
        (
            ("env={name: point_goal1, num_steps: 40}",), {},
            ("[60]", "[28]", "env.name is point_goal0 there, point_goal1 here"),
        ),
    ],
)  # fmt: skip
def test_a_policy_of_another_kind_is_refused_by_what_differs(finished, args, algo, expected):
    with pytest.raises(ConfigError) as error:
        warm(f"init_from={finished[0]}", *args, **algo)
    assert all(part in str(error.value) for part in ("does not fit", *expected)), error.value
    assert "\n" not in str(error.value)


def test_a_run_without_checkpoint_is_no_policy_to_start_from(tmp_path):
    run_folder.write_config(tmp_path, settings().plain())
    with pytest.raises(ConfigError, match="holds no checkpoint"):
        warm(f"init_from={tmp_path}")


def test_a_resumed_run_does_not_start_from_the_other_policy_again(finished, tmp_path):
    source = tmp_path / "source"
    shutil.copytree(finished[0], source)
    args = (*SMALL, "run_dir=run", "init_from=source")
    status, out, err = call("train.py", *args, "total_steps=320", cwd=tmp_path)
    assert status == 0 and "starting from source" in out, err
    shutil.rmtree(source)
    status, out, err = call("train.py", *args, "resume=true", cwd=tmp_path)
    assert status == 0 and "starting from" not in out, err
    assert run_folder.read_config(tmp_path / "run")["init_from"] == "source"
    assert run_folder.progress(tmp_path / "run") == (10, 640)


@pytest.mark.slow
def test_the_command_of_the_results_trains_what_is_asked_for(tmp_path):
    """With options it is a trial: nothing comes into docs/results."""
    results = SCRIPTS.parent / "docs" / "results"
    before = sorted(results.iterdir())
    options = [o for o in SMALL if not o.startswith(("env=", "algo=", "video", "num_envs"))]
    done = subprocess.run(
        [sys.executable, results / "run.py", *options, "num_envs=4", "num_seeds=1",
         "--tasks", "point_goal0", "--algos", "ppo_lag", "ppo", "--at-once", "2", "--runs", tmp_path],
        env={**os.environ, "JAX_PLATFORMS": "cpu"}, text=True, capture_output=True,
    )  # fmt: skip
    logs = "".join(log.read_text() for log in tmp_path.glob("*.log"))
    assert done.returncode == 0, done.stdout + done.stderr + logs
    assert "2 of 2 runs to do" in done.stdout and "left to do: nothing" in done.stdout
    for algo in ("ppo_lag", "ppo"):
        assert f"point_goal0-{algo}: done" in done.stdout
        assert rows(tmp_path / f"point_goal0-{algo}")[-1][1] == "640"
    assert sorted(results.iterdir()) == before

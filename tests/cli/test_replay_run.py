"""Runs with a replay: stopped, killed, resumed, and too large."""

import gc
import shutil

import jax
import numpy as np
import pytest
from shell import TOY, assert_same_run, start, typed, wait_for
from toys import Corridor

from jaxsafe.algos import ALGOS
from jaxsafe.commands import train
from jaxsafe.learn.planning import planning_bytes
from jaxsafe.run import checkpoint, memory, programs, run_folder
from jaxsafe.run.run_folder import read_metrics

SAC = (
    TOY, "algo=sac", "num_envs=4", "algo.horizon=8", "algo.learn_every=4", "algo.batch_size=16",
    "algo.replay_ratio=4", "algo.replay_size=250", "algo.learning_starts=64", "algo.hidden=[8]",
    "eval_episodes=2", "video=false",
)  # fmt: skip
STEPS = 32  # of an update
END = 30 * STEPS


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    run = tmp_path_factory.mktemp("whole") / "run"
    assert typed("train", *SAC, f"total_steps={END}", f"run_dir={run}") == 0
    return run


def test_killed_and_resumed_with_its_replay_it_ends_bit_for_bit_as_if_uninterrupted(
    whole, tmp_path, capsys
):
    run = tmp_path / "run"
    args = (*SAC, f"total_steps={END}", f"run_dir={run}")
    process = start("train", *args, "checkpoint_iterations=1", cwd=tmp_path)
    wait_for(lambda: len(checkpoint.checkpoints(run / "checkpoints")) == 2, process)
    process.kill()
    process.communicate()
    reached = run_folder.newest_progress(run)
    assert reached is not None and 0 < reached[0] < 30, "killed too late to test anything"
    assert typed("train", *args, "resume=true") == 0
    said = capsys.readouterr().out
    assert "replay of 256 transitions a seed, 0.00 GB in all\n" in said and "empty" not in said
    assert_same_run(run, whole)


@pytest.mark.slow
def test_seditor_on_pictures_resumes_and_is_evaluated(tmp_path):
    args = (
        *SAC, "env=toys:Patch", "algo=seditor", "algo.encoder=cnn", "algo.n_step=3",
        "algo.lr_decay=false",
    )  # fmt: skip
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert typed("train", *args, f"total_steps={8 * STEPS}", f"run_dir={whole}") == 0
    for updates in (4, 8):
        again = (*args, f"total_steps={updates * STEPS}", f"run_dir={parts}", "resume=true")
        assert typed("train", *(again if updates == 8 else again[:-1])) == 0
    assert np.isfinite(read_metrics(parts)["train/critic_loss"][-1])
    assert_same_run(parts, whole)
    assert typed("evaluate", str(whole), "--episodes", "2") == 0


def test_resumed_without_its_replay_it_fills_it_anew_before_it_learns_on(tmp_path, capsys):
    run = tmp_path / "run"
    args = (*SAC, f"run_dir={run}", "checkpoint_replay=false", "eval_episodes=0")
    assert typed("train", *args, f"total_steps={8 * STEPS}") == 0
    said = capsys.readouterr().out
    assert "not kept in checkpoints: a resumed run first fills it anew with its policy" in said
    arrays, manifest = checkpoint.load(run / "checkpoints")
    assert not any(map(checkpoint.in_replay, arrays)) and manifest.since == 0
    assert typed("train", *args, f"total_steps={12 * STEPS}", "resume=true") == 0
    assert "resuming at 256 steps, with an empty replay" in capsys.readouterr().out
    losses = read_metrics(run)["train/critic_loss"]
    learns = np.isfinite(losses)
    # 64 steps are 2 updates: the second learns once it has all of them
    assert learns.tolist() == [False, *[True] * 7, False, *[True] * 3]
    # with the replay kept from here on, the gap before it is remembered
    again = (*SAC, f"run_dir={run}", "eval_episodes=0", f"total_steps={14 * STEPS}", "resume=true")
    assert typed("train", *again) == 0
    assert checkpoint.load(run / "checkpoints")[1].since == 12


def test_the_device_has_let_go_of_the_replay_when_the_policy_is_evaluated(tmp_path, monkeypatch):
    """The replay of a large run leaves an evaluation and a film no room beside it."""
    left = []

    def finish(*_):
        gc.collect()
        left.extend(x.shape for x in jax.live_arrays() if x.shape[:3] == (1, 4, 64))  # the ring's

    monkeypatch.setattr(train, "finish", finish)
    args = (*SAC, f"total_steps={2 * STEPS}", f"run_dir={tmp_path / 'run'}")
    assert typed("train", *args) == 0
    assert not left


def test_a_kept_replay_that_is_missing_is_one_line(tmp_path, capsys):
    run = tmp_path / "run"
    args = (*SAC, f"run_dir={run}", "eval_episodes=0", "checkpoint_iterations=1")
    assert typed("train", *args, f"total_steps={3 * STEPS}") == 0
    for kept in checkpoint.checkpoints(run / "checkpoints"):
        max((kept / "state").rglob("*"), key=lambda file: file.stat().st_size).unlink()
    capsys.readouterr()
    assert typed("train", *args, f"total_steps={4 * STEPS}", "resume=true") == 2
    said = capsys.readouterr()
    (line,) = said.err.splitlines()
    assert line.startswith("error: ") and "is corrupt (missing file state/" in line
    assert "warning" not in said.out


def test_a_run_that_has_lost_its_checkpoints_is_not_begun_anew_over_its_metrics(tmp_path, capsys):
    run = tmp_path / "run"
    args = (*SAC, f"run_dir={run}", "eval_episodes=0")
    assert typed("train", *args, f"total_steps={3 * STEPS}") == 0
    shutil.rmtree(run / "checkpoints")
    before = (run / "metrics.csv").read_bytes()
    capsys.readouterr()
    for resume in (f"run_dir={run}", "resume=true"), (f"resume={run}",):
        assert typed("train", *SAC, "eval_episodes=0", f"total_steps={4 * STEPS}", *resume) == 2
        said = capsys.readouterr()
        (line,) = (said.out + said.err).splitlines()
        assert line.startswith(
            f"error: {run} has no checkpoint to go on from, only a policy; init_from="
        )
    assert (run / "metrics.csv").read_bytes() == before
    shutil.rmtree(run / "policy")  # as of one that was killed before its first checkpoint
    assert typed("train", *args, f"total_steps={4 * STEPS}", "resume=true") == 0
    assert f"no checkpoint in {run} yet: starting from the beginning" in capsys.readouterr().out


@pytest.mark.parametrize(
    "options, message",
    [
        (
            ["algo.replay_size=2e9"],
            "a run keeps 72.6 GiB a device (train state 0.0, replay 72.6), this machine has 7.5 GiB; "
            "use a smaller algo.replay_size",
        ),
        (["algo.n_step=300"], "algo.replay_size=250 holds 64 steps of 4 environments"),
        (["algo.batch_size=1000"], "the nearest that fit are"),
        (
            ["algo.batch_size=512", "algo.replay_ratio=32"],
            "expected at least algo.batch_size=512 transitions",
        ),
        (
            ["env.wrap.action_bounds=[-1,inf]"],
            "env.wrap.action_bounds[1]=inf: expected a number between",
        ),
        (["algo.replay_ratio=0"], "replay_ratio=0: expected a whole number between 1 and"),
        (["algo.alpha_init=-1"], "algo.alpha_init=-1: expected a number between 1e-10 and"),
        (["algo.tau=nan"], "algo.tau=nan: expected a number between 0 and 1"),
    ],
)
def test_what_cannot_work_is_one_line(tmp_path, capsys, monkeypatch, options, message):
    monkeypatch.setattr(memory, "device_memory", lambda: (8e9, "this machine"))
    assert typed("train", *SAC, f"run_dir={tmp_path / 'run'}", *options) == 2
    said = capsys.readouterr()
    assert message in said.out + said.err and len((said.out + said.err).strip().splitlines()) == 1


def test_plans_that_do_not_fit_are_one_line(tmp_path, capsys, monkeypatch):
    """1000 plans of 20 particles: 7 steps of 3 numbers, 4 observed, and 2 layers of 200."""
    each = 4 * 1000 * 20 * (7 * 3 + 4 + 2 * 200)
    config = ALGOS["pets"].config
    assert planning_bytes(Corridor(), config(plans=1000)) == each
    assert planning_bytes(Corridor(), config(plans=1000, true_model=True)) == 4 * 1000 * (7 * 3 + 4)
    planning = (TOY, "algo=pets", "algo.plans=1000", "num_envs=4", "eval_episodes=9", "num_seeds=2")
    monkeypatch.setattr(memory, "device_memory", lambda: (18 * each - 1, "this machine"))
    assert typed("train", *planning, f"run_dir={tmp_path / 'run'}") == 2
    said = capsys.readouterr()
    assert "planning in 18 environments at once needs at least 0.6 GiB" in said.out + said.err
    assert len((said.out + said.err).strip().splitlines()) == 1


def test_an_update_that_does_not_fit_is_one_line(tmp_path, capsys, monkeypatch):
    """Everything but the compiled update fits."""
    monkeypatch.setattr(memory, "device_memory", lambda: (8e9, "this machine"))

    def counted(*given):
        monkeypatch.setattr(memory, "device_memory", lambda: (1000.0, "this machine"))
        return use_of(*given)

    use_of = memory.use_of
    monkeypatch.setattr(memory, "use_of", counted)
    assert typed("train", *SAC, f"run_dir={tmp_path / 'run'}", "num_seeds=2") == 2
    (line,) = [x for x in capsys.readouterr().err.splitlines() if x.startswith("error: ")]
    assert "an update needs 0.0 GiB a device (train state 0.0, replay 0.0, working arrays 0.0)" in line
    assert "this machine has 0.0 GiB; use a smaller algo.batch_size, num_envs, " in line
    assert line.endswith(" or num_seeds")


def test_a_device_that_runs_out_of_memory_is_one_line_and_leaves_what_was_saved(
    tmp_path, capsys, monkeypatch
):
    """XLA's error comes in the fourth update, which may begin with a checkpoint after each."""

    def tired(program, ts):
        update, done = compiled(program, ts), iter(range(3))

        class Tired:
            memory_analysis = update.memory_analysis

            def __call__(self, *given):
                if next(done, None) is None:
                    raise jax.errors.JaxRuntimeError(message)
                return update(*given)

        return Tired()

    run, compiled = tmp_path / "run", programs.compiled
    message = "INTERNAL: Error dispatching computation: Out of memory allocating 4800000000 bytes."
    args = (*SAC, f"total_steps={8 * STEPS}", f"run_dir={run}", "checkpoint_iterations=1")
    monkeypatch.setattr(programs, "compiled", tired)
    assert typed("train", *args, "eval_every=1e6") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: out of memory; use a smaller ") and "algo.batch_size" in line
    assert line.endswith(" or eval_episodes; what was saved stays")
    at = run_folder.newest_progress(run)
    assert at is not None and at.iteration == 3 and len(read_metrics(run)["steps"]) == 3
    message = "INTERNAL: no such kernel"
    with pytest.raises(jax.errors.JaxRuntimeError):  # any other error of XLA's is nobody's mistake
        typed("train", *args, "eval_every=1e6", "resume=true")
    monkeypatch.setattr(programs, "compiled", compiled)
    assert typed("train", *args, "eval_every=1e6", "resume=true") == 0

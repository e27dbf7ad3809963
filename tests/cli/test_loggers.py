"""Metrics beside the run folder: a callback, and Weights & Biases over it."""

import sys
import types

import numpy as np
import pytest
import yaml
from shell import SMALL, STEPS, TOY, typed
from toys import Corridor

import jaxsafe
from jaxsafe.commands.train import resume_command
from jaxsafe.config import ConfigError
from jaxsafe.run import run_folder
from jaxsafe.run.loggers import wandb_callback
from jaxsafe.run.settings import settings_from_options

OPTIONS = {
    "num_envs": 4, "horizon": 16, "minibatches": 2, "epochs": 2, "critic_epochs": 2, "hidden": (8, 8),
    "eval_episodes": 0, "num_seeds": 2,
}  # fmt: skip


def test_a_callback_gets_what_the_file_gets_iteration_by_iteration(tmp_path):
    seen = []
    run = jaxsafe.train(
        Corridor(), "ppo_lag", callback=lambda clock, metrics: seen.append((clock, metrics)),
        total_steps=3 * STEPS, run_dir=tmp_path / "run", **OPTIONS,
    )  # fmt: skip
    assert [clock.iteration for clock, _ in seen] == [1, 2, 3]
    assert [clock.steps for clock, _ in seen] == [STEPS, 2 * STEPS, 3 * STEPS]
    for name, column in run.metrics.items():
        if name in seen[0][1]:
            found = np.stack([metrics[name] for _, metrics in seen])
            np.testing.assert_allclose(found, column, rtol=1e-5, err_msg=name)
    assert seen[0][1]["train/lam"].shape == (2,)


def test_what_a_callback_raises_ends_the_training_and_the_run_goes_on_without_it(tmp_path):
    def stop(clock, metrics):
        if clock.iteration == 2:
            raise RuntimeError("seen enough")

    options = OPTIONS | {"run_dir": tmp_path / "run", "total_steps": 4 * STEPS}
    with pytest.raises(RuntimeError, match="seen enough"):
        jaxsafe.train(Corridor(), "ppo_lag", callback=stop, checkpoint_iterations=1, **options)
    run = jaxsafe.train(Corridor(), "ppo_lag", resume=True, checkpoint_iterations=1, **options)
    assert run.steps == 4 * STEPS


class FakeRun:
    def __init__(self, **how):
        self.how, self.rows, self.ended = how, [], []

    def log(self, row, step):
        assert not self.ended
        self.rows.append((step, row))

    def finish(self, exit_code):
        self.ended.append(exit_code)


@pytest.fixture
def runs(monkeypatch) -> list[FakeRun]:
    """Those that a stand-in for wandb begins."""
    found: list[FakeRun] = []
    fake = types.SimpleNamespace(init=lambda **how: found.append(FakeRun(**how)) or found[-1])
    monkeypatch.setitem(sys.modules, "wandb", fake)  # type: ignore[arg-type]
    return found


def test_wandb_gets_the_metrics_of_every_iteration_and_no_file_switches_it_on(tmp_path, runs, capsys):
    args = (*SMALL, f"total_steps={2 * STEPS}", f"run_dir={tmp_path / 'run'}", "eval_episodes=0")
    assert typed("train", *args, "logger=wandb") == 0
    (run,) = runs
    assert run.how["name"] == "run" and run.ended == [0]
    assert run.how["config"]["algo"]["name"] == "ppo_lag"
    assert [step for step, _ in run.rows] == [1, 2]
    assert run.rows[1][1]["steps"] == 2 * STEPS and "train/lam" in run.rows[1][1]
    saved = run_folder.read_config(tmp_path / "run")
    assert "logger" not in saved
    (tmp_path / "run" / "config.yaml").write_text(yaml.safe_dump(saved | {"logger": "wandb"}))
    assert typed("train", f"resume={tmp_path / 'run'}", TOY) == 2
    assert "sets logger, which only a command may" in capsys.readouterr().err
    assert len(runs) == 1


def test_a_folder_has_one_run_of_wandb_which_ends_with_its_training(tmp_path, runs):
    def stop(clock, metrics):
        raise RuntimeError("seen enough")

    options = OPTIONS | {"logger": "wandb", "total_steps": STEPS}
    with pytest.raises(RuntimeError, match="seen enough"):
        jaxsafe.train(Corridor(), "ppo_lag", callback=stop, run_dir=tmp_path / "a" / "000", **options)
    assert [run.ended for run in runs] == [[1]]
    jaxsafe.train(Corridor(), "ppo_lag", resume=True, run_dir=tmp_path / "a" / "000", **options)
    again = wandb_callback(tmp_path / "b" / ".." / "a" / "000", {}, [])
    other = wandb_callback(tmp_path / "b" / "000", {}, [])
    ids = [how["id"] for how in (*(run.how for run in runs), again.how, other.how)]
    assert len({*ids[:3]}) == 1 and ids[3] != ids[0] and {name[:4] for name in ids} == {"000-"}
    odd = wandb_callback(tmp_path / f"a:b {'c' * 200}", {}, []).how["id"]
    assert odd.startswith("a_b_ccc") and len(odd) < 128


def test_what_continues_a_run_goes_on_logging(tmp_path):
    command = resume_command(settings_from_options({"logger": "wandb"}), tmp_path)
    assert command.endswith(f" resume={tmp_path} logger=wandb")


def test_without_wandb_there_is_one_line_before_anything_is_trained(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert typed("train", *SMALL, "logger=wandb") == 2
    expected = "error: logger=wandb: it is not installed: pip install 'jaxsafe[wandb]'\n"
    assert capsys.readouterr().err == expected


def test_a_logger_that_there_is_not_is_refused():
    with pytest.raises(ConfigError, match=r"logger='wanda'; did you mean 'wandb'\?"):
        jaxsafe.train(Corridor(), logger="wanda")

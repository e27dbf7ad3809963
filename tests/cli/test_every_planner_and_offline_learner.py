"""Every planner and every offline learner by the command line: trained, evaluated, drawn."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shell import TOY, typed

from jaxsafe.algos import ALGOS
from jaxsafe.learn.models import ModelConfig
from jaxsafe.learn.offline import OfflineConfig, data_set
from jaxsafe.run import run_folder
from jaxsafe.run.dataset import write_dataset

PLANNERS = [name for name, row in ALGOS.items() if issubclass(row.config, ModelConfig)]
OFFLINE = [name for name, row in ALGOS.items() if issubclass(row.config, OfflineConfig)]
SIZES: dict[str, Any] = {
    "horizon": 8, "replay_size": 400, "learning_starts": 64, "refit_every": 64, "plan_steps": 3,
    "cem_iterations": 2, "plans": 8, "elites": 3, "particles": 2, "models": 2, "model_hidden": "[8]",
    "model_batch": 8, "epoch_steps": 4, "learn_every": 4, "replay_ratio": 4, "batch_size": 16,
    "hidden": "[8]", "vae_hidden": "[8]", "updates": 10,
}  # fmt: skip


def sizes_of(name: str) -> list[str]:
    known = {field.name for field in dataclasses.fields(ALGOS[name].config)}
    return [f"algo.{k}={v}" for k, v in SIZES.items() if k in known]


def ran(name: str, *options: str) -> None:
    """A whole run with two seeds, whose evaluation is finite."""
    args = (TOY, f"algo={name}", *sizes_of(name), "num_seeds=2", "eval_episodes=2", "video=false")
    assert typed("train", *args, *options, "run_dir=run") == 0
    folder = Path("run")
    scores = json.loads((folder / "evaluation.json").read_text())
    assert np.isfinite([scores["return"]["mean"], scores["cost"]["mean"]]).all()
    assert (folder / "curves.png").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANNERS)
def test_a_planner_trains(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ran(name, "num_envs=4", "total_steps=256")
    assert np.isfinite(run_folder.read_metrics(Path("run"))["train/model_error"][-1])


@pytest.mark.slow
@pytest.mark.parametrize("name", OFFLINE)
def test_an_offline_learner_trains(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    obs, action, wall = rng.normal(size=(100, 4)), rng.uniform(-1, 1, (100, 2)), rng.random(100) < 0.3
    late = np.arange(100) % 20 == 19
    data = data_set(
        obs, action, rng.normal(size=100), wall, obs + 0.1, late & False, late, {"wall": wall}
    )
    write_dataset(tmp_path / "data.npz", data)
    ran(name, "dataset=data.npz", "total_updates=40")

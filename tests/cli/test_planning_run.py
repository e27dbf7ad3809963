"""Every planner by the command line: trained, evaluated, drawn."""

import dataclasses
import json
from typing import Any

import numpy as np
import pytest
from shell import TOY, typed

from jaxsafe.algos import ALGOS
from jaxsafe.learn.models import ModelConfig
from jaxsafe.run import run_folder

NAMES = [name for name, row in ALGOS.items() if issubclass(row.config, ModelConfig)]
SIZES: dict[str, Any] = {
    "horizon": 8, "replay_size": 400, "learning_starts": 64, "refit_every": 64, "plan_steps": 3,
    "cem_iterations": 2, "plans": 8, "elites": 3, "particles": 2, "models": 2, "model_hidden": "[8]",
    "model_batch": 8, "epoch_steps": 4, "learn_every": 4, "replay_ratio": 4, "batch_size": 16,
    "hidden": "[8]",
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_it_trains_and_is_evaluated(name, tmp_path):
    known = {field.name for field in dataclasses.fields(ALGOS[name].config)}
    sizes = [f"algo.{k}={v}" for k, v in SIZES.items() if k in known]
    run = tmp_path / "run"
    args = (TOY, f"algo={name}", *sizes, "num_envs=4", "num_seeds=2", "eval_episodes=2", "video=false")
    assert typed("train", *args, "total_steps=256", f"run_dir={run}") == 0
    scores = json.loads((run / "evaluation.json").read_text())
    assert np.isfinite([scores["return"]["mean"], scores["cost"]["mean"]]).all()
    assert np.isfinite(run_folder.read_metrics(run)["train/model_error"][-1])
    assert (run / "curves.png").exists()

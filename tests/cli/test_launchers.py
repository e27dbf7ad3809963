"""Hydra's launchers run the jobs of a --multirun in processes of their own, two at a time."""

import csv
from pathlib import Path

import pytest
import yaml
from shell import SMALL, STEPS, call

LAUNCHERS = {
    "joblib": ("hydra_plugins.hydra_joblib_launcher", ["hydra.launcher.n_jobs=2"]),
    "submitit_local": ("hydra_plugins.hydra_submitit_launcher", ["hydra.launcher.timeout_min=10"]),
}


def multirun(launcher: str, cwd: Path, *arguments: str) -> tuple[int, str, str]:
    module, options = LAUNCHERS[launcher]
    pytest.importorskip(module, reason="pip install -e '.[launchers]'")
    words = ["-m", *SMALL, f"total_steps={2 * STEPS}", f"hydra/launcher={launcher}", *options]
    return call("train", *words, *arguments, cwd=cwd)


@pytest.mark.slow  # each job is a new process, which imports and compiles
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_each_job_of_a_launcher_trains_in_its_own_folder(launcher, tmp_path):
    status, _, err = multirun(launcher, tmp_path, "algo.cost_limit=5,10")
    assert status == 0, err
    limits = []
    for run in tmp_path.glob(
        "runs/toys.Corridor-ppo_lag/*-job?"
    ):  # code of the user's, found there too
        limits.append(yaml.safe_load((run / "config.yaml").read_text())["algo"]["cost_limit"])
        with (run / "metrics.csv").open() as file:
            assert len(list(csv.reader(file))) == 1 + 2
    assert sorted(limits) == [5, 10]


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_job_that_fails_elsewhere_fails_the_command_and_leaves_the_others(launcher, tmp_path):
    status, _, err = multirun(launcher, tmp_path, "algo.cost_limit=-1,5", "run_dir=here")
    assert status == 2 and "'algo.cost_limit=-1'" in err and "Traceback" not in err
    assert (tmp_path / "here/1/evaluation.json").exists() and not (tmp_path / "here/0").exists()


@pytest.mark.slow
def test_jobs_of_joblib_can_take_a_gpu_each(tmp_path):
    (tmp_path / "which.py").write_text(
        "import os\n\nfrom toys import Corridor\n\n\ndef world():\n"
        "    open(os.environ['CUDA_VISIBLE_DEVICES'], 'x').close()\n    return Corridor()\n"
    )
    gpu = "+hydra.job.env_set.CUDA_VISIBLE_DEVICES=${hydra:job.num}"
    status, _, err = multirun("joblib", tmp_path, "env=which:world", "seed=0,1", gpu)
    assert status == 0, err
    assert (tmp_path / "0").exists() and (tmp_path / "1").exists()


def test_a_launcher_that_is_not_installed_is_one_line_that_says_what_to_do(tmp_path):
    status, out, err = call("train", "-m", *SMALL, "hydra/launcher=nowhere", cwd=tmp_path)
    assert (status, out) == (2, "") and err.count("\n") == 1
    assert err.startswith("error: hydra/launcher=nowhere: it is not installed; pip install ")

"""Commands as a user types them: in this process, or in a new one where a process is the point."""

import csv
import importlib
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from jaxsafe.run import checkpoint

TESTS = Path(__file__).parent
SCRIPTS = TESTS.parent / "scripts"
TOY = "env=toys:Corridor"
SMALL = (
    TOY, "algo=ppo_lag", "num_envs=4", "algo.horizon=16", "algo.minibatches=2", "algo.epochs=2",
    "algo.critic_epochs=2", "algo.hidden=[8,8]", "eval_episodes=2", "video=false",
)  # fmt: skip
STEPS = 64  # of an update of SMALL


def typed(script: str, *args: str) -> int | str | None:
    """The exit status of 'train', 'sweep', ... with these arguments, in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [f"{script}.py", *args])
        try:
            return importlib.import_module(f"jaxsafe.commands.{script}").main()
        except SystemExit as stop:
            return stop.code


def start(script: str, *args: str, cwd: Path, **environ: str) -> subprocess.Popen:
    """A new process, which finds the toys."""
    path = os.pathsep.join([str(TESTS), str(SCRIPTS.parent), os.environ.get("PYTHONPATH", "")])
    process = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": path, **environ}
    return subprocess.Popen(
        [sys.executable, str(SCRIPTS / f"{script}.py"), *args],
        cwd=cwd, env=process, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def call(script: str, *args: str, cwd: Path, **environ: str) -> tuple[int, str, str]:
    """Exit status, stdout and stderr of a new process."""
    process = start(script, *args, cwd=cwd, **environ)
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


def wait_for(condition: Callable[[], bool], *processes: subprocess.Popen, seconds: float = 200) -> None:
    end = time.monotonic() + seconds
    while not condition():
        for process in processes:
            assert process.poll() is None, process.communicate()
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.005)


def rows(run: Path) -> list[list[str]]:
    """metrics.csv without the column of wall-clock seconds."""
    with (run / "metrics.csv").open() as file:
        return [row[:4] + row[5:] for row in csv.reader(file)]


def assert_same_run(a: Path, b: Path) -> None:
    """Bit for bit: the newest checkpoints and all metrics."""
    left, right = (checkpoint.load(run / "checkpoints")[0] for run in (a, b))
    assert left.keys() == right.keys()
    for name in left:
        np.testing.assert_array_equal(left[name], right[name], err_msg=name)
    assert rows(a) == rows(b)

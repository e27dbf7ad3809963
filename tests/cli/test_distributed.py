"""Two real processes with a CPU device each, beside one process with two."""

import shutil
import signal
import socket
import subprocess
import threading
import time
from pathlib import Path

import jax
import numpy as np
import pytest
import shell

from jaxsafe.config import ConfigError
from jaxsafe.run import checkpoint, distributed, run_folder
from jaxsafe.run.devices import check_devices
from jaxsafe.run.distributed import Position

ARGS = (
    "env=toys:Corridor", "algo=pg", "num_envs=4", "algo.horizon=16", "algo.minibatches=1",
    "algo.critic_epochs=1", "algo.hidden=[8]", "algo.total_iterations=1000", "eval_episodes=0",
    "video=false", "devices=2",
)  # fmt: skip
STEPS = 64  # of an update


def free_port() -> int:
    with socket.create_server(("", 0)) as server:
        return server.getsockname()[1]


def start(cwd: Path, *args: str, devices: int = 1) -> subprocess.Popen:
    return shell.start("train", *ARGS, *args, cwd=cwd, JAX_NUM_CPU_DEVICES=str(devices))


def start_pair(cwd: Path, *args: str) -> list[subprocess.Popen]:
    where = (f"coordinator=localhost:{free_port()}", "num_processes=2")
    return [start(cwd, *args, *where, f"process_index={i}") for i in range(2)]


def ends(*processes: subprocess.Popen) -> list[tuple[int, str, str]]:
    """Exit status, stdout without what Gloo says, stderr."""
    done = [(*p.communicate(timeout=200), p.returncode) for p in processes]
    return [
        (status, "".join(x for x in out.splitlines(True) if "[Gloo]" not in x), err)
        for out, err, status in done
    ]


def wait_for_rows(run: Path, processes: list[subprocess.Popen]) -> None:
    shell.wait_for(lambda: run_folder.read_metrics(run).get("steps", np.zeros(0)).size > 0, *processes)


def reached(run: Path) -> int:
    done = run_folder.newest_progress(run)
    assert done is not None
    return done.steps


def assert_same_run(a: Path, b: Path) -> None:
    left, right = (checkpoint.load(run / "checkpoints")[0] for run in (a, b))
    assert left.keys() == right.keys()
    for name in left:
        np.testing.assert_allclose(left[name], right[name], rtol=1e-3, atol=1e-4, err_msg=name)
    left, right = run_folder.read_metrics(a), run_folder.read_metrics(b)
    for name in left.keys() - {"seconds"}:
        np.testing.assert_allclose(left[name], right[name], rtol=1e-3, atol=1e-4, err_msg=name)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory) -> tuple[Path, list[tuple[int, str, str]]]:
    """The run of a pair of which one was interrupted, and how both ended."""
    home = tmp_path_factory.mktemp("stopped")
    pair = start_pair(home, "total_steps=1e9", "run_dir=run")
    wait_for_rows(home / "run", pair)
    pair[1].send_signal(signal.SIGINT)
    return home / "run", ends(*pair)


def test_an_interruption_of_one_stops_both_with_a_checkpoint(stopped):
    run, ((status, out, err), other) = stopped
    assert (status, err) == (130, "") and other == (130, "", "")
    assert "cpu" in out and "in 2 processes" in out.splitlines()[0]
    assert f"stopped at {reached(run):,} steps; continue with: " in out.splitlines()[-1]
    assert run_folder.read_metrics(run)["steps"][-1] == reached(run)
    assert not {*distributed.OPTIONS} & run_folder.read_config(run).keys()


def test_a_pair_and_a_lone_process_continue_it_alike_and_as_if_uninterrupted(stopped, tmp_path):
    end = f"total_steps={reached(stopped[0]) + 5 * STEPS}"
    for name in ("pair", "lone"):
        shutil.copytree(stopped[0], tmp_path / name)
    lead, other = ends(*start_pair(tmp_path, end, "run_dir=pair", "resume=true"))
    assert lead[::2] == (0, "") and "resuming at" in lead[1] and other == (0, "", "")
    assert (tmp_path / "pair" / "curves.png").exists()
    for args in (("run_dir=lone", "resume=true"), ("run_dir=whole",)):
        ((status, _, err),) = ends(start(tmp_path, end, *args, devices=2))
        assert status == 0, err
        assert_same_run(tmp_path / "pair", tmp_path / args[0].removeprefix("run_dir="))


@pytest.mark.parametrize("victim", [0, 1])
def test_the_death_of_one_ends_the_other_with_a_line(tmp_path, victim):
    pair = start_pair(tmp_path, "total_steps=1e9", "run_dir=run", "checkpoint_iterations=1")
    wait_for_rows(tmp_path / "run", pair)
    pair[victim].kill()
    killed_at = time.monotonic()
    status, _, err = ends(*pair)[1 - victim]
    assert time.monotonic() - killed_at < 20
    line = f"error: process {victim} has ended, and so this one; the last checkpoint stays\n"
    if victim == 1:
        assert (status, err) == (1, line)
    else:  # `jax.distributed` notices the end of process 0 too, and may be the first to end this one
        assert (status == 1 and line in err) or (
            status == -signal.SIGABRT and "another task died" in err
        )


def test_what_one_cannot_do_ends_both_with_one_line(tmp_path):
    pair = start_pair(tmp_path, "devices=3")
    found = ends(*pair)
    assert [status for status, _, _ in found] == [2, 2]
    lines = {line for _, _, err in found for line in err.splitlines()}
    assert lines == {"error: devices=3: expected 2, which the 2 processes have together (cpu)"}


def test_a_run_that_diverges_ends_both_with_one_line(tmp_path):
    pair = start_pair(tmp_path, "env=toys:Lost", "total_steps=1e9", "run_dir=run")
    found = ends(*pair)
    assert [status for status, _, _ in found] == [3, 3]
    (line,) = {line for _, _, err in found for line in err.splitlines()}
    assert "diverged at" in line and "the reward of worlds is not finite" in line


def test_process_0_tells_the_others_its_status_and_ends_after_them(monkeypatch):
    here, there = socket.socketpair()
    left = []
    monkeypatch.setattr(distributed, "_lifelines", {1: here})
    monkeypatch.setattr(distributed.os, "_exit", left.append)
    leader = threading.Thread(target=distributed.exit_all, args=(3,))
    leader.start()
    assert there.recv(1) == bytes([3])
    leader.join(0.2)
    assert not left
    there.close()
    leader.join(10)
    assert left == [3]


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (("here:1", 2, None), "process_index missing"),
        ((None, 2, 0), "coordinator missing"),
        (("here:1", 2, 2), "process_index=2: expected 0 to 1"),
        (("here", 2, 0), "coordinator=here: expected host:port"),
    ],
)
def test_options_that_name_no_process_are_refused(options, problem):
    with pytest.raises(ConfigError, match=problem):
        distributed.position_from_options(*options, devices=2)


def test_a_process_without_the_others_gives_up_in_one_line_that_says_what_to_check(monkeypatch):
    monkeypatch.setattr(distributed, "PATIENCE", 0.2)
    with pytest.raises(ConfigError, match=r"finds no process 0 .*refused.*check that"):
        distributed.meet(Position("localhost", free_port(), 2, 1))
    with pytest.raises(ConfigError, match=r"process 1, 2 of 3 did not come .*check that"):
        distributed.meet(Position("localhost", free_port(), 3, 0))
    with distributed.listen(0) as server, pytest.raises(ConfigError, match="cannot listen there"):
        distributed.meet(Position("localhost", server.getsockname()[1], 2, 0))


SLURM = {
    "SLURM_JOB_ID": "4097", "SLURM_STEP_NODELIST": "gpu[07-09,12],cpu1", "SLURM_STEP_NUM_TASKS": "8",
    "SLURM_STEP_TASKS_PER_NODE": "2(x4)", "SLURM_PROCID": "5", "SLURM_LOCALID": "1",
}  # fmt: skip


def test_slurm_says_where_a_task_stands(monkeypatch):
    assert distributed.slurm_position(SLURM) == Position("gpu07", 61441, 8, 5, None)
    gpus = {"CUDA_VISIBLE_DEVICES": "0,1"}  # of the host: each of its two tasks takes one
    assert distributed.slurm_position(SLURM | gpus) == Position("gpu07", 61441, 8, 5, 1)
    single = {"SLURM_STEP_NODELIST": "node-3,gpu1", "SLURM_STEP_TASKS_PER_NODE": "1(x8)"}
    assert distributed.slurm_position(SLURM | gpus | single) == Position("node-3", 61441, 8, 5, None)
    assert distributed.slurm_position({"SLURM_JOB_ID": "1"}) is None
    for name, value in SLURM.items():
        monkeypatch.setenv(name, value)
    assert (
        distributed.position_from_options(None, None, None, devices=1) is None
    )  # each task its own run
    assert distributed.position_from_options(None, 1, None, devices=8) is None
    assert distributed.position_from_options(None, None, None, devices=8) == Position(
        "gpu07", 61441, 8, 5, None
    )


def test_more_devices_than_the_processes_have_are_refused(monkeypatch):
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    with pytest.raises(ConfigError, match="devices=1: expected"):
        monkeypatch.setattr(jax, "device_count", lambda: 2)
        check_devices(1)

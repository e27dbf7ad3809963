"""Agreement with recordings of the original engine, step by step. See tests/data/README.md."""

import dataclasses
import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest

from jaxsafe.config import ConfigError
from jaxsafe.envs.safety_gym.recording import Recording, compare

ROOT = Path(__file__).parent.parent.parent
DATA = Path(__file__).parent.parent / "data"
RECORDINGS = sorted(p for p in DATA.glob("*.npz") if not p.name.startswith("layouts_"))


def parity(*args: str | Path) -> int:
    """The exit status of scripts/parity.py."""
    return runpy.run_path(str(ROOT / "scripts" / "parity.py"))["main"](list(map(str, args)))


@pytest.mark.parametrize("path", RECORDINGS, ids=lambda p: p.stem)
def test_each_step_of_a_recording_is_repeated(path):
    comparison = compare(Recording(path), "c")
    assert comparison.failures() == []
    assert comparison.strict.mean() > 0.75
    for name, differs in comparison.mismatches.items():
        assert not differs.any(), name


def test_the_recordings_hold_every_robot_task_and_event():
    found = [Recording(path) for path in RECORDINGS]
    assert {r.meta["robot"] for r in found} == {"Point", "Car", "Doggo"}
    tasks = {r.meta["config"]["task"] for r in found}
    assert tasks == {"goal", "button", "push", "x", "z", "circle"}
    events = {k[5:] for r in found for k, v in r.arrays.items() if k.startswith("step.") and v.any()}
    costs = {f"cost_{k}" for k in ("hazards", "pillars", "buttons", "gremlins")}
    costs |= {f"cost_vases_{k}" for k in ("contact", "displace", "velocity")}
    assert costs | {"goal_met", "done"} <= events


@pytest.mark.parametrize(
    "name, wrong",
    [
        (
            "point_goal2",
            {
                "reward_distance": (2.0, "reward"),
                "hazards_cost": (1.01, "cost_hazards"),
                "vases_contact_cost": (2.0, "cost_vases_contact"),
                "vases_velocity_cost": (1.01, "cost_vases_velocity"),
                "lidar_max_dist": (3.1, "lidar"),
            },
        ),
        (
            "point_goal2",
            {"hazards_size": (0.15, "cost_hazards"), "vases_size": (0.12, "cost_vases_velocity")},
        ),
        (
            "car_natural_all",
            {
                "gremlins_contact_cost": (9.0, "cost_gremlins"),
                "pillars_cost": (9.0, "cost_pillars"),
                "vases_displace_cost": (1.01, "cost_vases_displace"),
            },
        ),
        (
            "point_button1",
            {
                "gremlins_travel": (0.25, "gremlins_lidar"),
                "buttons_resampling_delay": (9, "buttons_timer"),
            },
        ),
        ("doggo_button2", {"buttons_cost": (2.0, "cost_buttons")}),
        ("car_push2", {"box_null_dist": (20.0, "reward")}),
        ("doggo_circle", {"circle_radius": (1.4, "reward")}),
        ("car_explidar_push", {"box_density": (0.1, "robot velocity")}),
    ],
)
def test_each_wrong_option_is_noticed_in_what_it_alone_changes(name, wrong):
    recording = Recording(DATA / f"{name}.npz")
    recording.meta["config"] |= {option: value for option, (value, _) in wrong.items()}
    comparison = compare(recording, "c")
    differing = [event for event, differs in comparison.mismatches.items() if differs.any()]
    noticed = comparison.failures() + differing
    for option, (_, says) in wrong.items():
        assert any(says in line for line in noticed), option


def test_a_wrong_action_a_wrong_cost_and_a_wrong_goal_are_noticed():
    recording = Recording(DATA / "point_goal2.npz")
    recording.arrays["step.action"] = np.flip(recording["step.action"], 1)
    recording.arrays["step.cost_hazards"] = 1 - recording["step.cost_hazards"]
    recording.arrays["step.goal_met"] = ~recording["step.goal_met"]
    failed = {line.split(":")[0] for line in compare(recording, "c").failures()}
    assert {"robot pose", "robot velocity", "reward", "cost_hazards", "goal_met"} <= failed


def test_steps_that_versions_dispute_are_not_held_to_the_tolerance():
    comparison = compare(Recording(DATA / "point_run.npz"), "c")
    comparison.errors["robot pose"][3] = 1.0
    assert comparison.failures() == ["robot pose: 1 steps past the tolerance, worst 1 at step 3"]
    strict = comparison.strict.copy()
    strict[3] = False
    assert dataclasses.replace(comparison, strict=strict).failures() == []


def test_the_script_prints_pass_and_writes_a_table(tmp_path, capsys):
    path = tmp_path / "table.md"
    assert parity(DATA / "point_run.npz", DATA / "car_z.npz", "--engine", "c", "--table", path) == 0
    out = capsys.readouterr().out
    assert out.count("\n  pass\n") == 2 and "robot velocity" in out
    names = [line.split(" | ")[0] for line in path.read_text().splitlines() if line.startswith("| ")]
    assert names == ["| recording", "| point_run", "| car_z"]


def test_the_script_tells_a_failure_from_bad_input(tmp_path, capsys):
    recording = dict(np.load(DATA / "point_run.npz"))
    recording["step.reward"] = recording["step.reward"] + 1
    np.savez(tmp_path / "wrong.npz", **recording)
    shutil.copy(DATA / "README.md", tmp_path / "text.npz")
    assert parity(tmp_path / "wrong.npz", "--engine", "c") == 1
    assert "reward: 16 steps past the tolerance" in capsys.readouterr().out
    for bad in (["text.npz"], ["missing.npz"], ["wrong.npz", "--engine", "warped"]):
        assert parity(tmp_path / bad[0], *bad[1:]) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and error.count("\n") == 1


def test_a_recording_without_steps_is_not_a_recording(tmp_path):
    np.savez(tmp_path / "empty.npz", meta="{}")
    with pytest.raises(ConfigError, match="not a recording"):
        Recording(tmp_path / "empty.npz")
    with pytest.raises(ConfigError, match="not a recording"):
        Recording(DATA / "layouts_point_goal2.npz")

"""Record what velocities cost in Safety-Gymnasium: python tests/data/velocity/costs.py FOLDER OUT.csv

FOLDER holds the unpacked wheel of safety-gymnasium 1.0.0. Its classes are made and stepped as they are,
on the installed Gymnasium. In place of physics, each step moves the robot at a velocity near the
threshold.
"""

import csv
import importlib
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from jaxsafe.envs.velocity.suite import NAMES

NEAR, AROUND = (0.999, 1.001), (0.5, 0.9, 0.999, 1.001, 1.1, 2.0)  # in units of the threshold
ALL_WAYS = ((1, 0), (-1, 0), (0, 1), (0, -1), (0.6, 0.8), (-0.6, -0.8))
ALONG_X = ALL_WAYS[:2]
TASKS = "safety_gymnasium.tasks.safe_velocity"


def without_the_rest(folder: Path) -> None:
    """Let the modules of the tasks be imported without their package, which asks for an old MuJoCo."""
    for name in ("safety_gymnasium", "safety_gymnasium.tasks", TASKS, "safety_gymnasium.utils"):
        module = ModuleType(name)
        module.__path__ = [str(folder.joinpath(*name.split(".")))]
        sys.modules[name] = module
    drawing: Any = ModuleType("safety_gymnasium.utils.task_utils")
    drawing.add_velocity_marker = drawing.clear_viewer = lambda *_, **__: None
    sys.modules[drawing.__name__] = drawing


def recorded(robot: str, version: str) -> list[tuple[str, float, float, float]]:
    name = {"halfcheetah": "half_cheetah"}.get(robot, robot)
    module = importlib.import_module(f"{TASKS}.safety_{name}_velocity_{version}")
    env = getattr(module, f"Safety{NAMES[robot]}VelocityEnv")()
    has_y = robot in ("ant", "humanoid", "swimmer")
    rows = []
    for way in ALL_WAYS if has_y else ALONG_X:
        for share in NEAR if has_y else AROUND:
            velocity = share * env._velocity_threshold * np.array(way)

            def move(*_: Any, by: np.ndarray = velocity * env.dt) -> None:
                qpos, size = env.data.qpos.copy(), 2 if has_y else 1
                qpos[:size] += by[:size]
                env.set_state(qpos, env.data.qvel.copy())

            env.reset(seed=0)
            env.do_simulation = move
            _, _, cost, *_ = env.step(np.zeros(env.model.nu))
            rows.append((f"Safety{NAMES[robot]}Velocity-{version}", *velocity.round(9), cost))
    return rows


def main() -> None:
    folder, out = map(Path, sys.argv[1:])
    without_the_rest(folder)
    with out.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("task", "vx", "vy", "cost"))
        writer.writerows(row for robot in NAMES for v in ("v1", "v0") for row in recorded(robot, v))


if __name__ == "__main__":
    main()

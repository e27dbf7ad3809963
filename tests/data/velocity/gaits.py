"""Record states of trained gaits: python tests/data/velocity/gaits.py RUN... OUT.npz

Each RUN is one of a velocity task. Its policy drives the robot of Gymnasium, by mean actions, through
episodes of 200 steps. Kept are 60 states, the solver's warm start and the action there, evenly spread.
"""

import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from jaxsafe import Run
from jaxsafe.envs.velocity.suite import NAMES

STEPS, EPISODE, KEPT = 600, 200, 60


def recorded(run: Run) -> dict[str, np.ndarray]:
    robot = run.config["env"]["name"].removesuffix("_velocity")
    env: Any = gymnasium.make(f"{NAMES[robot]}-v4").unwrapped
    data, rows, ended = env.data, [], True
    for step in range(STEPS):
        if ended or step % EPISODE == 0:
            obs, _ = env.reset(seed=step)
        action = np.clip(run.policy(obs.astype(np.float32)), -1, 1)
        rows.append([np.float32(x) for x in (data.qpos, data.qvel, data.qacc_warmstart, action)])
        obs, _, ended, _, _ = env.step(action * env.action_space.high)
    kept = zip(*rows[:: STEPS // KEPT], strict=True)
    names = ("qpos", "qvel", "warmstart", "action")
    return {f"{robot}.{name}": np.stack(x) for name, x in zip(names, kept, strict=True)}


def main() -> None:
    *runs, out = map(Path, sys.argv[1:])
    found: dict[str, Any] = {k: x for run in runs for k, x in recorded(Run(run)).items()}
    np.savez_compressed(out, **found)


if __name__ == "__main__":
    main()

"""The six velocity tasks by name.

Source: Safety-Gymnasium 1.0.0, `tasks/safe_velocity`, on Gymnasium's environments of version 4.
"""

import math
from typing import Any

from jaxsafe.envs.velocity.config import VelocityConfig

NAMES = {  # as ids have them
    "ant": "Ant",
    "halfcheetah": "HalfCheetah",
    "hopper": "Hopper",
    "walker2d": "Walker2d",
    "swimmer": "Swimmer",
    "humanoid": "Humanoid",
}
LEG = {
    "frame_skip": 4,
    "reset_noise_scale": 0.005,
    "ctrl_cost_weight": 1e-3,
    "healthy_reward": 1.0,
}
OPTIONS: dict[str, dict[str, Any]] = {
    "ant": {"ctrl_cost_weight": 0.5, "healthy_reward": 1.0, "healthy_z_range": (0.2, 1.0)},
    "halfcheetah": {},
    "hopper": LEG
    | {
        "healthy_z_range": (0.7, math.inf),
        "healthy_angle_range": (-0.2, 0.2),
        "healthy_state_range": (-100.0, 100.0),
    },
    "walker2d": LEG | {"healthy_z_range": (0.8, 2.0), "healthy_angle_range": (-1.0, 1.0)},
    "swimmer": {"frame_skip": 4, "ctrl_cost_weight": 1e-4},
    "humanoid": {
        "reset_noise_scale": 0.01,
        "forward_reward_weight": 1.25,
        "healthy_reward": 5.0,
        "healthy_z_range": (1.0, 2.0),
    },
}


def suite() -> dict[str, VelocityConfig]:
    return {f"{name}_velocity": VelocityConfig(robot=name, **OPTIONS[name]) for name in NAMES}  # type: ignore[arg-type]


def aliases() -> dict[str, tuple[str, dict[str, Any]]]:
    """Safety-Gymnasium's ids: our name, and the options that make our task that one."""
    versions: dict[str, dict[str, Any]] = {"v1": {}, "v0": {"thresholds": "v0"}}
    return {
        f"Safety{theirs}Velocity-{version}": (f"{ours}_velocity", options)
        for ours, theirs in NAMES.items()
        for version, options in versions.items()
    }

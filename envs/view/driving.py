"""A robot's action from the two things a driver wants: to go and to turn."""

import numpy as np

from jaxsafe.config import ConfigError
from jaxsafe.envs.racing.task import CarRacing
from jaxsafe.envs.safety_gym import scene
from jaxsafe.envs.safety_gym.task import SafetyGym
from jaxsafe.envs.velocity.task import Velocity

FRONT = {"point": 0.0, "car": -np.pi / 2, "doggo": 0.0}  # where a robot's front is in its frame, rad
# Doggo's gaits, found by random search: torque o + a sin(2 pi (f t + p)), diagonal legs in antiphase.
# Rows are the front legs and the rear ones, columns hip_z, hip_y and ankle; for legs on the left a is
# (1 - s) times that of the table, on the right (1 + s). They go 0.25 m/s, and turn about 1 rad/s left.
WALK = {
    "f": 1.30,  # Hz
    "a": [[0.41, 1.34, 0.54], [0.95, 0.44, 1.50]],
    "p": [[0.68, 0.48, 0.60], [0.57, 0.85, 0.39]],
    "o": [[-0.41, -0.17, -0.06], [0.20, 0.23, -0.33]],
    "s": [[0, 0, 0], [0, 0, 0]],
}
BACK = {
    "f": 0.75,
    "a": [[2.68, 1.31, -0.36], [1.45, 1.82, 0.52]],
    "p": [[0.55, 0.83, 0.92], [0.25, 1.01, 0.15]],
    "o": [[0.04, 0.34, -0.12], [0.77, -0.12, 0.14]],
    "s": [[0, 0, 0], [0, 0, 0]],
}
TURN = {
    "f": 1.99,
    "a": [[0.61, 0.34, 0.02], [0.77, 1.07, 1.51]],
    "p": [[0.51, 0.83, 0.15], [0.99, 0.66, -0.16]],
    "o": [[-0.29, 0.10, -0.20], [-0.16, 0.20, 0.23]],
    "s": [[0.79, 0.51, -0.44], [2.87, 0.04, 2.26]],
}


def drivable(env: SafetyGym | Velocity | CarRacing) -> SafetyGym:
    """`env` itself.

    Raises:
        ConfigError: a robot that no keys are known for.
    """
    if isinstance(env, CarRacing):
        raise ConfigError(f"racing: keys drive {', '.join(FRONT)} alone; a film shows it")
    if isinstance(env, Velocity):
        raise ConfigError(
            f"env.robot={env.config.robot!r}: keys drive {', '.join(FRONT)} alone; a film shows it"
        )
    robot_of(env)
    return env


def robot_of(env: SafetyGym) -> str:
    """'point', 'car' or 'doggo'.

    Raises:
        ConfigError: a robot of the user's own, which no keys are known for.
    """
    path = scene.robot_file(env.config.robot_base)
    if path.parent != scene.ASSETS or path.stem not in FRONT:
        raise ConfigError(
            f"env.robot_base={env.config.robot_base!r}: keys drive {', '.join(FRONT)} alone"
        )
    return path.stem


def drive(env: SafetyGym, forward: float, turn: float, seconds: float) -> np.ndarray:
    """The action [A] that goes forward (1) or back (-1) and turns left (1) or right (-1).

    Point takes both as they are; Car's wheels get their sum and difference. Doggo walks: a
    gait of its twelve torques, at this time of the episode; while it turns it does not go.
    """
    robot = robot_of(env)
    if robot == "point":
        return np.array([forward, turn])
    if robot == "car":
        return np.clip([forward + turn, forward - turn], -1, 1)
    if turn:
        return gait(TURN, seconds, right=turn < 0)
    if forward:
        return gait(WALK if forward > 0 else BACK, seconds)
    return np.zeros(12)


def gait(table: dict, seconds: float, right: bool = False) -> np.ndarray:
    """Doggo's torques [12] in the order of its actuators: hip_z, hip_y, ankle, of legs 1 to 4 each."""
    rear, side = np.array([0, 1, 1, 0]), np.array([-1, -1, 1, 1])  # legs 1 and 2 are the left ones
    a, p, o, s = (np.array(table[name])[rear].T for name in "apos")  # [3, 4]
    diagonal = np.array([0.5, 0.0, 0.5, 0.0])
    side = -side if right else side
    torque = o + a * (1 + s * side) * np.sin(2 * np.pi * (table["f"] * seconds + p + diagonal))
    return np.clip(torque, -1, 1).reshape(-1)

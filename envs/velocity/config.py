"""Options of the velocity tasks, with the bounds of each, and what is fixed of each robot."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

from jaxsafe.config import Amount, Bounds, ConfigError, Real, Weight, check_values, from_dict
from jaxsafe.envs.engines import Room

Speed = Annotated[float, Bounds(0, 1000)]  # m/s
Range = tuple[
    Annotated[float, Bounds(-1000, 1000)], Annotated[float, Bounds(-1000, 1000, inf="no bound")]
]


class Robot(NamedTuple):
    """What is no option of a robot.

    file: of its model, in assets.
    thresholds: m/s, by the version of Safety-Gymnasium's ids.
    unseen: how many leading coordinates of qpos are not observed.
    height, pitch: where they are in qpos, or None.
    free: whether it moves in space, where its speed is that in x and y. In a plane its speed is that
        in x, with its sign.
    gaussian: velocities at a reset are normal, not uniform.
    clip: observed velocities are clipped to +-clip, m/s and rad/s; None: they are not.
    room: contacts on average and rows of constraints at most, for engine warp.
    """

    file: str
    thresholds: dict[str, float]
    unseen: int
    height: int | None
    pitch: int | None
    free: bool
    gaussian: bool
    clip: float | None
    room: Room


def robot(v1: float, v0: float, file: str, **facts: Any) -> Robot:
    plane = {"unseen": 1, "height": 1, "pitch": 2, "free": False, "gaussian": False, "clip": None}
    return Robot(file=file, thresholds={"v1": v1, "v0": v0}, **(plane | facts))


SPACE = {"unseen": 2, "height": 2, "pitch": None, "free": True}
SWIMS = {"unseen": 2, "height": None, "pitch": None}
ROBOTS = {
    "ant": robot(2.6222, 2.5745, "ant.xml", **SPACE, gaussian=True, room=Room(25, 108)),
    "halfcheetah": robot(3.2096, 2.8795, "half_cheetah.xml", gaussian=True, room=Room(16, 70)),
    "hopper": robot(0.7402, 0.37315, "hopper.xml", clip=10.0, room=Room(11, 38)),
    "walker2d": robot(2.3415, 1.7075, "walker2d.xml", clip=10.0, room=Room(14, 62)),
    "swimmer": robot(0.2282, 0.04845, "swimmer.xml", **SWIMS, room=Room(1, 2)),
    "humanoid": robot(1.4149, 2.3475, "humanoid.xml", **SPACE, room=Room(24, 128)),
}


@dataclass(frozen=True, kw_only=True)
class VelocityConfig:
    """A velocity task: a robot of Gymnasium's, what it is paid for, and how fast it may go.

    A robot is healthy while its height, its pitch and its state are within their ranges. The options
    have Gymnasium's names where it has them.
    """

    # which robot
    robot: Literal["ant", "halfcheetah", "hopper", "walker2d", "swimmer", "humanoid"]
    # of Safety-Gymnasium's ids: v1, or v0 with older thresholds, where Swimmer's speed in y counts, too
    thresholds: Literal["v1", "v0"] = "v1"
    velocity_threshold: Speed | None = None  # m/s; a faster step costs 1; null: that of `thresholds`
    num_steps: Amount = 1000  # time limit
    frame_skip: Annotated[int, Bounds(1, 1000)] = 5  # physics steps in a step
    reset_noise_scale: Annotated[float, Bounds(0, 10)] = 0.1  # of positions (m, rad) and velocities
    forward_reward_weight: Real = 1.0  # reward for a speed of 1 m/s along x
    ctrl_cost_weight: Weight = 0.1  # reward less for the sum of squared controls
    healthy_reward: Real = 0.0  # of a step that ends healthy, and of one that ends the episode
    terminate_when_unhealthy: bool = True  # whether being unhealthy ends the episode
    healthy_z_range: Range | None = None  # of the height, m, halfcheetah's from 0.7 m up; null: any
    healthy_angle_range: Range | None = None  # of the pitch, rad
    healthy_state_range: Range | None = None  # of qvel, and of qpos but its first two
    # ours: of engine warp, times the room estimated for contacts
    contact_room: Annotated[float, Bounds(0.01, 100)] = 1.0

    def __post_init__(self) -> None:
        check_values(self, "env.")
        if self.robot not in ROBOTS:
            from_dict(VelocityConfig, {"robot": self.robot}, "env.")  # raises
        body = ROBOTS[self.robot]
        for name, place in {"z": body.height, "angle": body.pitch, "state": 0}.items():
            option = f"healthy_{name}_range"
            value = getattr(self, option)
            if value is None:
                continue
            if place is None:
                part = {"z": "height", "angle": "pitch"}[name]
                raise ConfigError(
                    f"env.{option}={list(value)}: {self.robot} has no {part}: expected null"
                )
            if not value[0] < value[1]:
                raise ConfigError(f"env.{option}={list(value)}: expected [min, max] with min < max")


def config_from_plain(values: dict[str, Any]) -> VelocityConfig:
    """A config from plain values; an unknown name or a wrong type is a `ConfigError`."""
    return from_dict(VelocityConfig, values, "env.")

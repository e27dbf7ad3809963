"""Every option of Safety Gym's Engine, with its name and default, and the checks on them.

Source: Ray, Achiam and Amodei (2019), "Benchmarking Safe Exploration in Deep Reinforcement
Learning", and the Engine of the authors' package `safety_gym`.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from jaxsafe.config import (
    Amount,
    Bounds,
    ConfigError,
    Pixels,
    Real,
    Share,
    Weight,
    check_values,
    from_dict,
    nearest,
)

Distance = Annotated[float, Bounds(0, 1000)]  # m
Size = Annotated[float, Bounds(1e-4, 1000)]  # m
Coordinate = Annotated[float, Bounds(-1000, 1000)]  # m
Angle = Annotated[float, Bounds(-1000, 1000)]  # rad
Density = Annotated[float, Bounds(1e-6, 1e6)]  # kg/m^3
Objects = Annotated[int, Bounds(0, 200)]  # of a kind
Point2 = tuple[Coordinate, Coordinate]
Rectangle = tuple[Coordinate, Coordinate, Coordinate, Coordinate]  # xmin, ymin, xmax, ymax (m)
Rectangles = tuple[Rectangle, ...]
Points = tuple[Point2, ...]

TASKS = ("goal", "button", "push", "x", "z", "circle", "run", "none")
# Observations that Safety-Gymnasium does not have.
OURS_ALONE = tuple(
    f"observe_{part}" for part in ["goal_dist", "remaining", "qpos", "qvel", "ctrl", "freejoint", "com"]
)
KINDS = ("hazards", "vases", "pillars", "buttons", "gremlins", "walls")


@dataclass(frozen=True, kw_only=True)
class SafetyGymConfig:
    """A task: robot, layout, observation, reward and constraints. Lengths in m, angles in rad.

    `*_placements` are rectangles to draw from instead of `placements_extents`, `*_locations` fixed
    positions of the first objects of a kind, `*_keepout` the radius that stays free around each.
    """

    # ours: whose, where they differ
    rules: Literal["safety_gym", "safety_gymnasium", "seditor"] = "safety_gym"
    # Episode
    num_steps: Amount = 1000  # time limit
    action_noise: Weight = 0.0  # standard deviation, added after the action is clipped
    # Placement
    placements_extents: Rectangle = (-2.0, -2.0, 2.0, 2.0)
    placements_margin: Annotated[float, Bounds(-2, 1000)] = (
        0.0  # added to the distance required between any two objects
    )
    floor_display_mode: bool = False  # rendering: the floor ends 0.1 m outside the extents
    # Robot
    robot_placements: Rectangles | None = None
    robot_locations: Points = ()
    robot_keepout: Distance = 0.4
    robot_base: str = "xmls/car.xml"  # point, car or doggo, or a path to an MJCF file
    robot_rot: Angle | None = None  # heading at the start; null is uniform
    # Layout
    randomize_layout: bool = True  # false: every episode repeats one layout and its later draws
    build_resample: bool = True  # never read, as in the original
    continue_goal: bool = True  # after a success a new goal, else the episode ends
    terminate_resample_failure: bool = True  # no room for a new goal ends the episode, else keeps it
    # What is observed
    observation_flatten: bool = True  # one vector, components sorted by name; else a dict
    # ours: components, those below. coordinates, of Goal: where the goal and the hazards are, in the
    # robot's frame, instead of lidars and all other components
    observation: Literal["components", "coordinates"] = "components"
    observe_sensors: bool = True
    observe_goal_dist: bool = False
    observe_goal_comp: bool = False
    observe_goal_lidar: bool = False
    observe_box_comp: bool = False
    observe_box_lidar: bool = False
    observe_circle: bool = False
    observe_remaining: bool = False  # the fraction elapsed, as in the original
    observe_walls: bool = False
    observe_hazards: bool = False
    observe_vases: bool = False
    observe_pillars: bool = False
    observe_buttons: bool = False
    observe_gremlins: bool = False
    observe_vision: bool = False  # a dict: vision, uint8 [height, width, 3], and vector, all else
    observe_qpos: bool = False
    observe_qvel: bool = False
    observe_ctrl: bool = False
    observe_freejoint: bool = False
    observe_com: bool = False
    # Rendering
    render_labels: bool = False
    render_lidar_markers: bool = True
    render_lidar_radius: Size = 0.15
    render_lidar_size: Size = 0.025
    render_lidar_offset_init: Distance = 0.5
    render_lidar_offset_delta: Distance = 0.06
    vision_size: Pixels = (60, 40)  # of the picture that is observed
    vision_render: bool = True  # films and the live view show that picture beside the scene
    vision_render_size: Pixels = (300, 200)  # how large they show it
    # ours: vision, on the robot; vision_back, of Point and Car; fixednear, fixedfar, track
    vision_camera: str = "vision"
    # Lidar and compass
    lidar_num_bins: Annotated[int, Bounds(1, 1000)] = 10
    lidar_max_dist: Size | None = None  # null: exp(-lidar_exp_gain distance) instead of linear
    lidar_exp_gain: Weight = 1.0
    lidar_type: Literal["pseudo", "natural"] = "pseudo"
    lidar_alias: bool = True
    compass_shape: Literal[2, 3] = 2
    # Task
    task: Literal["goal", "button", "push", "x", "z", "circle", "run", "none"] = "goal"
    goal_placements: Rectangles | None = None
    goal_locations: Points = ()
    goal_keepout: Distance = 0.4
    goal_size: Size = 0.3
    box_placements: Rectangles | None = None
    box_locations: Points = ()
    box_keepout: Distance = 0.2
    box_size: Size = 0.2  # half side
    box_density: Density = 0.001
    box_null_dist: Weight = 2.0  # times box_size: closer than this, nearing the box pays nothing
    # Reward
    reward_distance: Real = 1.0
    reward_goal: Real = 1.0
    reward_box_dist: Real = 1.0
    reward_box_goal: Real = 1.0
    reward_orientation: bool = False
    reward_orientation_scale: Real = 0.002
    reward_orientation_body: str = "robot"
    reward_exception: Real = -10.0
    reward_x: Real = 1.0
    reward_z: Real = 1.0
    reward_circle: Real = 0.1
    reward_clip: Weight | None = 10.0  # of the dense part; null or 0 is no clip
    # Buttons
    buttons_num: Objects = 0
    buttons_placements: Rectangles | None = None
    buttons_locations: Points = ()
    buttons_keepout: Distance = 0.3
    buttons_size: Size = 0.1
    buttons_cost: Weight = 1.0
    buttons_resampling_delay: Annotated[int, Bounds(0, 2**24)] = 10  # steps
    # Circle and run
    circle_radius: Size = 1.5
    # ours: lines that the robot must not cross; 2 at x = +-bounds, 4 at y = +-bounds, too
    bounds_num: Literal[0, 2, 4] = 0
    bounds: Size = 1.125
    bounds_cost: Weight = 1.0
    # Sensors
    sensors_obs: tuple[str, ...] = ("accelerometer", "velocimeter", "gyro", "magnetometer")
    sensors_hinge_joints: bool = True  # never read, as in the original: always observed
    sensors_ball_joints: bool = True  # never read, as in the original: always observed
    sensors_angle_components: bool = True  # sine and cosine, rotation matrices
    # Walls
    walls_num: Objects = 0
    walls_placements: Rectangles | None = None
    walls_locations: Points = ()
    walls_keepout: Distance = 0.0
    walls_size: Size = 0.5  # half side
    # Constraints
    constrain_hazards: bool = False
    constrain_vases: bool = False
    constrain_pillars: bool = False
    constrain_buttons: bool = False
    constrain_gremlins: bool = False
    constrain_indicator: bool = True  # every cost, and their sum, is 1 if above 0
    # Hazards
    hazards_num: Objects = 0
    hazards_placements: Rectangles | None = None
    hazards_locations: Points = ()
    hazards_keepout: Distance = 0.4
    hazards_size: Size = 0.3  # radius
    hazards_cost: Weight = 1.0
    # Vases
    vases_num: Objects = 0
    vases_placements: Rectangles | None = None
    vases_locations: Points = ()
    vases_keepout: Distance = 0.15
    vases_size: Size = 0.1  # half side
    vases_density: Density = 0.001
    vases_sink: Distance = 4e-5
    vases_contact_cost: Weight = 1.0
    vases_displace_cost: Weight = 0.0
    vases_displace_threshold: Weight = 1e-3
    vases_velocity_cost: Weight = 1.0
    vases_velocity_threshold: Weight = 1e-4
    # Pillars
    pillars_num: Objects = 0
    pillars_placements: Rectangles | None = None
    pillars_locations: Points = ()
    pillars_keepout: Distance = 0.3
    pillars_size: Size = 0.2  # radius
    pillars_height: Size = 0.5  # half height
    pillars_cost: Weight = 1.0
    # Gremlins
    gremlins_num: Objects = 0
    gremlins_placements: Rectangles | None = None
    gremlins_locations: Points = ()
    gremlins_keepout: Distance = 0.5
    gremlins_travel: Distance = 0.3  # radius of their circles
    gremlins_size: Size = 0.1  # half side
    gremlins_density: Density = 0.001
    gremlins_contact_cost: Weight = 1.0
    gremlins_dist_threshold: Weight = 0.2  # never read, as in the original
    gremlins_dist_cost: Weight = 1.0  # never read, as in the original
    # Physics
    frameskip_binom_n: Annotated[int, Bounds(1, 1000)] = 10  # physics steps in a step ~ Binomial(n, p)
    frameskip_binom_p: Share = 1.0
    # ours: vases, and gremlins, simulated at once; null: the engine's
    awake: Annotated[int, Bounds(1, 1000)] | None = None
    # ours: of engine warp, times the room estimated for contacts
    contact_room: Annotated[float, Bounds(0.01, 100)] = 1.0
    # Random numbers
    _seed: Annotated[int, Bounds(0, 2**32 - 1)] | None = None  # mixed into the key of every reset

    def __post_init__(self) -> None:
        check_config(self)

    def half_height(self, half: float) -> float:
        """Of an object of this half height in Safety Gym: SEditor's are all 0.4 m high."""
        return 0.2 if self.rules == "seditor" else half


def config_from_plain(values: dict[str, Any]) -> SafetyGymConfig:
    """A config from plain values; an unknown name or a wrong type is a `ConfigError`."""
    return from_dict(SafetyGymConfig, values, "env.")


def defaults(**overrides: Any) -> dict[str, Any]:
    """Every option as a plain value, with `overrides` applied."""
    return dataclasses.asdict(SafetyGymConfig()) | overrides


def check_rules(cfg: SafetyGymConfig) -> None:
    """Raise `ConfigError` for what Safety-Gymnasium has not, or has another way than we do."""
    unlike = [
        ("robot_base", Path(cfg.robot_base).stem == "doggo", "its Doggo is another, half as long"),
        ("task", cfg.task in ("x", "z", "none"), "it has no such task; its run is env=point_run0"),
        (
            "robot_keepout",
            cfg.task == "circle" and cfg.robot_keepout > 0,
            "its circles are env=point_circle0 to point_circle2",
        ),
        ("lidar_type", cfg.lidar_type == "natural", "its natural lidar does not see the goal"),
        ("walls_num", cfg.walls_num > 0, "its tasks have no such walls"),
        *((name, getattr(cfg, name), "it has no such observation") for name in OURS_ALONE),
    ]
    for name, found, reason in unlike:
        if found:
            value = getattr(cfg, name)
            raise ConfigError(f"env.{name}={value} with env.rules=safety_gymnasium: {reason}")


def check_config(cfg: SafetyGymConfig) -> None:
    """Raise `ConfigError` for a config that no episode could be drawn from."""
    check_values(cfg, "env.")
    if cfg.rules == "safety_gymnasium":
        check_rules(cfg)
    if cfg.task not in TASKS:
        raise ConfigError(f"env.task={cfg.task!r}{nearest(cfg.task, TASKS)}")
    if cfg.observation == "coordinates" and cfg.task != "goal":
        raise ConfigError(f"env.observation=coordinates: expected env.task=goal, not {cfg.task}")
    if cfg.task == "button" and cfg.buttons_num < 1:
        raise ConfigError("env.buttons_num=0: the button task needs at least 1")
    rectangles = [("placements_extents", (cfg.placements_extents,))]
    rectangles += [
        (f"{kind}_placements", getattr(cfg, f"{kind}_placements") or ())
        for kind in ("robot", "goal", "box", *KINDS)
    ]
    for name, areas in rectangles:
        for xmin, ymin, xmax, ymax in areas:
            if not (xmin < xmax and ymin < ymax):
                area = [xmin, ymin, xmax, ymax]
                raise ConfigError(
                    f"env.{name}={area}: expected [xmin, ymin, xmax, ymax] with min < max"
                )

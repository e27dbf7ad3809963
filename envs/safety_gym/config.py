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

# Observations that Safety-Gymnasium does not have.
OURS_ALONE = tuple(
    f"observe_{part}" for part in ["goal_dist", "remaining", "qpos", "qvel", "ctrl", "freejoint", "com"]
)
KINDS = ("hazards", "vases", "pillars", "buttons", "gremlins", "walls")


@dataclass(frozen=True, kw_only=True)
class SafetyGymConfig:
    """A task: robot, layout, observation, reward and constraints. Lengths in m, angles in rad.

    Options whose comments begin with `ours` are not Safety Gym's.
    """

    # ours: whose rules, where Safety Gym and its successors differ
    rules: Literal["safety_gym", "safety_gymnasium", "seditor"] = "safety_gym"
    # ---- episode
    num_steps: Amount = 1000  # time limit
    action_noise: Weight = 0.0  # standard deviation, added after the action is clipped
    # ---- placement
    # where objects are that have no placements of their own
    placements_extents: Rectangle = (-2.0, -2.0, 2.0, 2.0)
    placements_margin: Annotated[float, Bounds(-2, 1000)] = (
        0.0  # added to the distance required between any two objects
    )
    floor_display_mode: bool = False  # rendering: the floor ends 0.1 m outside the extents
    # ---- robot
    robot_placements: Rectangles | None = None  # rectangles to draw from; null: placements_extents
    robot_locations: Points = ()  # fixed position
    robot_keepout: Distance = 0.4  # radius that stays free around it
    robot_base: str = "xmls/car.xml"  # point, car or doggo, or a path to an MJCF file
    robot_rot: Angle | None = None  # heading at the start; null is uniform
    # ---- layout
    randomize_layout: bool = True  # false: every episode repeats one layout and its later draws
    build_resample: bool = True  # never read, as in the original
    continue_goal: bool = True  # after a success a new goal, else the episode ends
    terminate_resample_failure: bool = True  # no room for a new goal ends the episode, else keeps it
    # ---- what is observed
    observation_flatten: bool = True  # one vector, components sorted by name; else a dict
    # ours: components, those below. coordinates, of Goal: where the goal and the hazards are, in the
    # robot's frame, instead of lidars and all other components
    observation: Literal["components", "coordinates"] = "components"
    observe_sensors: bool = True  # those of sensors_obs, and the joints
    observe_goal_dist: bool = False  # exp(-distance of the goal)
    observe_goal_comp: bool = False  # the goal's direction, a compass
    observe_goal_lidar: bool = False  # a lidar of the goal
    observe_box_comp: bool = False  # the box's direction, a compass
    observe_box_lidar: bool = False  # a lidar of the box
    observe_circle: bool = False  # a lidar of the middle of the circle
    observe_remaining: bool = False  # the share of `num_steps` that is over, as in the original
    observe_walls: bool = False  # a lidar of the walls
    observe_hazards: bool = False  # a lidar of the hazards
    observe_vases: bool = False  # a lidar of the vases
    observe_pillars: bool = False  # a lidar of the pillars
    observe_buttons: bool = False  # a lidar of the buttons
    observe_gremlins: bool = False  # a lidar of the gremlins
    observe_vision: bool = False  # a dict: vision, uint8 [height, width, 3], and vector, all else
    observe_qpos: bool = False  # MuJoCo's qpos, of the robot and what else moves
    observe_qvel: bool = False  # MuJoCo's qvel, likewise
    observe_ctrl: bool = False  # the controls that the last action became
    observe_freejoint: bool = False  # the first 7 numbers of qpos
    observe_com: bool = False  # the robot's centre of mass
    # ---- rendering
    render_labels: bool = False  # show the names of objects
    render_lidar_markers: bool = True  # balls above the robot that show its lidars
    render_lidar_radius: Size = 0.15  # of their rings
    render_lidar_size: Size = 0.025  # radius of a ball
    render_lidar_offset_init: Distance = 0.5  # height of the first ring
    render_lidar_offset_delta: Distance = 0.06  # between two rings
    vision_size: Pixels = (60, 40)  # of the picture that is observed
    vision_render: bool = True  # films and the live view show that picture beside the scene
    vision_render_size: Pixels = (300, 200)  # how large they show it
    # ours: vision, on the robot; vision_back, of Point and Car; fixednear, fixedfar, track
    vision_camera: str = "vision"
    # ---- lidar and compass
    lidar_num_bins: Annotated[int, Bounds(1, 1000)] = 10  # sectors around the robot, a number each
    # where readings reach 0; null: they are exp(-lidar_exp_gain distance)
    lidar_max_dist: Size | None = None
    lidar_exp_gain: Weight = 1.0  # per m; see lidar_max_dist
    # pseudo: by the centres of objects; natural: by rays
    lidar_type: Literal["pseudo", "natural"] = "pseudo"
    lidar_alias: bool = True  # pseudo: a reading also shows in the two sectors beside
    compass_shape: Literal[2, 3] = 2  # 2: in the plane, 3: in space
    # ---- task
    # what is rewarded
    task: Literal["goal", "button", "push", "x", "z", "circle", "run", "none"] = "goal"
    goal_placements: Rectangles | None = None  # rectangles to draw from; null: placements_extents
    goal_locations: Points = ()  # fixed position
    goal_keepout: Distance = 0.4  # radius that stays free around it
    goal_size: Size = 0.3  # radius; nearer than this is a success
    box_placements: Rectangles | None = None  # rectangles to draw from; null: placements_extents
    box_locations: Points = ()  # fixed position
    box_keepout: Distance = 0.2  # radius that stays free around it
    box_size: Size = 0.2  # half side
    box_density: Density = 0.001  # kg/m^3
    box_null_dist: Weight = 2.0  # times box_size: closer than this, nearing the box pays nothing
    # ---- reward
    reward_distance: Real = 1.0  # times m nearer to the goal or button
    reward_goal: Real = 1.0  # for a success
    reward_box_dist: Real = 1.0  # times m nearer to the box
    reward_box_goal: Real = 1.0  # times m that the box is nearer to the goal
    reward_orientation: bool = False  # whether an upright body pays
    reward_orientation_scale: Real = 0.002  # times its uprightness, from -1 to 1
    reward_orientation_body: str = "robot"  # whose uprightness
    reward_exception: Real = -10.0  # the reward where the physics fails, which ends the episode
    reward_x: Real = 1.0  # times m along x
    reward_z: Real = 1.0  # times m up
    reward_circle: Real = 0.1  # times the speed along the circle
    reward_clip: Weight | None = 10.0  # of the dense part; null or 0 is no clip
    # ---- buttons
    buttons_num: Objects = 0  # how many
    buttons_placements: Rectangles | None = None  # rectangles to draw from; null: placements_extents
    buttons_locations: Points = ()  # fixed positions of the first ones
    buttons_keepout: Distance = 0.3  # radius that stays free around it
    buttons_size: Size = 0.1  # radius
    buttons_cost: Weight = 1.0  # for each point of contact with a wrong button
    # steps after a success in which no button costs anything or shows in lidars
    buttons_resampling_delay: Annotated[int, Bounds(0, 2**24)] = 10
    # ---- circle and run
    circle_radius: Size = 1.5  # where speed pays most
    # ours: lines that the robot must not cross; 2 at x = +-bounds, 4 at y = +-bounds, too
    bounds_num: Literal[0, 2, 4] = 0
    bounds: Size = 1.125  # how far they are from the middle
    bounds_cost: Weight = 1.0  # of a step beyond a line
    # ---- sensors
    # which are observed
    sensors_obs: tuple[str, ...] = ("accelerometer", "velocimeter", "gyro", "magnetometer")
    sensors_hinge_joints: bool = True  # never read, as in the original: always observed
    sensors_ball_joints: bool = True  # never read, as in the original: always observed
    sensors_angle_components: bool = True  # sine and cosine, rotation matrices
    # ---- walls
    walls_num: Objects = 0  # how many
    walls_placements: Rectangles | None = None  # rectangles to draw from; null: placements_extents
    walls_locations: Points = ()  # fixed positions of the first ones
    walls_keepout: Distance = 0.0  # radius that stays free around it
    walls_size: Size = 0.5  # half side
    # ---- constraints
    constrain_hazards: bool = False  # whether they cost
    constrain_vases: bool = False  # whether they cost
    constrain_pillars: bool = False  # whether they cost
    constrain_buttons: bool = False  # whether they cost
    constrain_gremlins: bool = False  # whether they cost
    constrain_indicator: bool = True  # every cost, and their sum, is 1 if above 0
    # ---- hazards
    hazards_num: Objects = 0  # how many
    hazards_placements: Rectangles | None = None  # rectangles to draw from; null: placements_extents
    hazards_locations: Points = ()  # fixed positions of the first ones
    hazards_keepout: Distance = 0.4  # radius that stays free around it
    hazards_size: Size = 0.3  # radius
    hazards_cost: Weight = 1.0  # times m inside
    # ---- vases
    vases_num: Objects = 0  # how many
    vases_placements: Rectangles | None = None  # rectangles to draw from; null: placements_extents
    vases_locations: Points = ()  # fixed positions of the first ones
    vases_keepout: Distance = 0.15  # radius that stays free around it
    vases_size: Size = 0.1  # half side
    vases_density: Density = 0.001  # kg/m^3
    vases_sink: Distance = 4e-5  # how deep it stands in the floor
    vases_contact_cost: Weight = 1.0  # for each point of contact with one
    vases_displace_cost: Weight = 0.0  # times m from where it stood
    vases_displace_threshold: Weight = 1e-3  # m, from which on it counts
    vases_velocity_cost: Weight = 1.0  # times m/s
    vases_velocity_threshold: Weight = 1e-4  # m/s, from which on it counts
    # ---- pillars
    pillars_num: Objects = 0  # how many
    pillars_placements: Rectangles | None = None  # rectangles to draw from; null: placements_extents
    pillars_locations: Points = ()  # fixed positions of the first ones
    pillars_keepout: Distance = 0.3  # radius that stays free around it
    pillars_size: Size = 0.2  # radius
    pillars_height: Size = 0.5  # half height
    pillars_cost: Weight = 1.0  # for each point of contact with one
    # ---- gremlins
    gremlins_num: Objects = 0  # how many
    gremlins_placements: Rectangles | None = None  # rectangles to draw from; null: placements_extents
    gremlins_locations: Points = ()  # fixed positions of the first ones
    gremlins_keepout: Distance = 0.5  # radius that stays free around it
    gremlins_travel: Distance = 0.3  # radius of their circles
    gremlins_size: Size = 0.1  # half side
    gremlins_density: Density = 0.001  # kg/m^3
    gremlins_contact_cost: Weight = 1.0  # for each point of contact with one
    gremlins_dist_threshold: Weight = 0.2  # never read, as in the original
    gremlins_dist_cost: Weight = 1.0  # never read, as in the original
    # ---- physics
    frameskip_binom_n: Annotated[int, Bounds(1, 1000)] = 10  # physics steps in a step ~ Binomial(n, p)
    frameskip_binom_p: Share = 1.0  # see frameskip_binom_n
    # ours: vases, and gremlins, simulated at once; null: the engine's
    awake: Annotated[int, Bounds(1, 1000)] | None = None
    # ours: of engine warp, times the room estimated for contacts
    contact_room: Annotated[float, Bounds(0.01, 100)] = 1.0
    # ---- random numbers
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

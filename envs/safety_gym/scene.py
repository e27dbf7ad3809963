"""The MuJoCo model of a task, shared by all its layouts, and where things are in it.

Only what can push is physics. Hazards, goals and circles never collide, so they are arrays; the
robot, vases, gremlins and the box are bodies; pillars, walls and buttons are mocap bodies, so that
one compiled model serves every layout. `drawn=True` adds light, cameras and colours for the renderer,
which draws the arrays over it.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from jaxsafe.config import ConfigError, nearest
from jaxsafe.envs.engines import Room, Simulation
from jaxsafe.envs.safety_gym.config import SafetyGymConfig

TORQUESCALE = 10  # its place in the data of a weld
ASSETS = Path(__file__).parent / "assets"
OBJECT = {"condim": 6, "friction": (1.0, 0.005, 0.0001)}
RGBA = {
    "goal": (0, 1, 0, 0.25),
    "hazard": (0, 0, 1, 0.25),
    "vase": (0, 1, 1, 1),
    "pillar": (0.5, 0.5, 1, 1),
    "wall": (0.5, 0.5, 0.5, 1),
    "gremlin": (0.5, 0, 1, 1),
    "button": (1, 0.5, 0, 1),
    "box": (1, 1, 0, 1),
    "circle": (0, 1, 0, 0.1),
}
ROBOT = (0.9, 0.15, 0.15, 1)  # where its file gives no colour
GROUP = {
    "goal": 0,
    "box": 1,
    "button": 1,
    "wall": 2,
    "pillar": 2,
    "hazard": 3,
    "vase": 4,
    "gremlin": 5,
    "circle": 6,
}
MOCAPS = ("gremlins", "pillars", "walls", "buttons")  # in the order of their mocap ids
JOINT_SENSORS = (  # in the order in which Safety-Gymnasium observes them
    mujoco.mjtSensor.mjSENS_JOINTVEL,
    mujoco.mjtSensor.mjSENS_BALLANGVEL,
    mujoco.mjtSensor.mjSENS_JOINTPOS,
    mujoco.mjtSensor.mjSENS_BALLQUAT,
)
HALF = math.sqrt(0.5)
BACK = {  # where a robot's rear camera is in its frame: level, and turned away from its front
    "point": {"pos": (0, 0, 0.15), "quat": (HALF, HALF, HALF, HALF)},
    "car": {"pos": (0, 0, 0.2), "quat": (HALF, HALF, 0, 0)},
}
PLANAR = ["slide (1 0 0)", "slide (0 1 0)", "hinge (0 0 1)"]  # the joints of a robot without a free one
FREES = ("vases", "gremlins", "box")  # in the order of their free joints


@dataclass(frozen=True)
class Scene:
    """A compiled task. Counts are those of the config; addresses index the model's arrays."""

    spec: mujoco.MjSpec  # what `model` was compiled from
    model: mujoco.MjModel
    planar: bool  # the robot slides and turns (Point), else it has a free joint
    robot_height: float  # of body `robot` at the start, m
    robot_nq: int
    robot_nv: int
    frees: dict[str, int]  # kind -> number of free bodies, in the order of FREES
    mocaps: dict[str, int]  # kind -> number of mocap bodies, in the order of MOCAPS
    orbit: np.ndarray  # [nmocap] radius of each mocap body's circle; 0 for those at rest
    watched: dict[str, list[str]]  # kind -> bodies whose contacts with the robot are counted

    def simulation(self, cfg: SafetyGymConfig, fields: tuple[str, ...] = ()) -> Simulation:
        """What an engine simulates and reports; `fields` are poses that the task asks for."""
        return Simulation(
            spec=self.spec,
            substeps=cfg.frameskip_binom_n,
            varied=cfg.frameskip_binom_p < 1,
            fields=fields,
            contacts=tuple(("robot", name) for names in self.watched.values() for name in names),
            orbits=self.orbit,
            pillars=tuple(f"pillar{i}" for i in range(self.mocaps["pillars"])),
            room=self.room(cfg.contact_room),
        )

    def room(self, factor: float = 1.0) -> Room:
        """Memory for contacts, times `factor`.

        A resting cube touches the floor in 4 points, and so do a box's four columns. A robot on wheels
        or legs touches it with some of its geoms. Cubes that meet share up to 8 points. Each contact
        takes 10 rows (condim 6, pyramidal cone), a weld takes 6.
        """
        model = self.model
        resting = 4 * sum(self.frees.values()) + 16 * self.frees["box"]
        robot = int((model.body_rootid[model.geom_bodyid] == model.body("robot").id).sum())
        standing = 0 if self.planar else robot
        average = resting + standing + (8 if self.frees["box"] else 4)
        fullest = 10 * (resting + 2 * standing + 16) + 6 * self.frees["gremlins"]
        rows = math.ceil(factor * fullest) + int(model.jnt_limited.sum())
        return Room(math.ceil(factor * average), rows)

    @property
    def contact_count(self) -> int:
        return sum(map(len, self.watched.values()))

    def contact_slice(self, kind: str) -> slice:
        return entries({k: len(names) for k, names in self.watched.items()}, kind)

    def qpos_slice(self, kind: str) -> slice:
        return entries(self.frees, kind, 7, self.robot_nq)

    def qvel_slice(self, kind: str) -> slice:
        return entries(self.frees, kind, 6, self.robot_nv)

    def mocap_slice(self, kind: str) -> slice:
        return entries(self.mocaps, kind)


def entries(counts: dict[str, int], kind: str, each: int = 1, start: int = 0) -> slice:
    """Where the objects of `kind` are, if those of `counts` come from `start` on, in its order."""
    start += each * sum(counts[k] for k in itertools.takewhile(kind.__ne__, counts))
    return slice(start, start + each * counts[kind])


def robot_file(base: str) -> Path:
    """The MJCF file of a robot: point, car, doggo (also as the original's xmls/car.xml) or a path."""
    if path := built_in(base):
        return path
    if base.endswith(".xml") and Path(base).is_file():
        return Path(base)
    robots = [path.stem for path in ASSETS.glob("*.xml")]
    raise ConfigError(f"env.robot_base={base!r}: no such robot{nearest(name_of(base), robots)}")


def name_of(base: str) -> str:
    return base.removeprefix("xmls/").removesuffix(".xml")


def built_in(base: str) -> Path | None:
    """The MJCF file of one of our own robots; None of a path."""
    return next((path for path in ASSETS.glob("*.xml") if path.stem == name_of(base)), None)


def build(cfg: SafetyGymConfig, mjx: bool = False, drawn: bool = False) -> Scene:
    """Compile the scene of `cfg`.

    Args:
        mjx: build it for engine `jax`. Pillars become capsules with their caps out of reach, which
            collide better there than cylinders. Fixed bodies do not meet each other. There is room for
            the contacts of `mjx_limits` only.
        drawn: add what only rendering needs (light, cameras, colours, the gremlins' guides).
    Raises:
        ConfigError: an unknown robot, sensor or body; a robot that does not fit; for engine `jax`, a
            pillar with its cap in reach.
    """
    spec, robot = read_robot(cfg)
    check_robot(cfg, robot)
    with in_one_line(cfg):
        model = add_task(spec, robot, cfg, mjx, drawn)
    orbit = np.zeros(model.nmocap)
    orbit[: cfg.gremlins_num] = cfg.gremlins_travel
    return Scene(
        spec=spec,
        model=model,
        planar=bool(robot.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE),
        robot_height=float(robot.body("robot").pos[2]),
        robot_nq=robot.nq,
        robot_nv=robot.nv,
        frees={"vases": cfg.vases_num, "gremlins": cfg.gremlins_num, "box": int(cfg.task == "push")},
        mocaps={kind: getattr(cfg, f"{kind}_num") for kind in MOCAPS},
        orbit=orbit,
        watched=watched_bodies(cfg),
    )


def add_task(
    spec: mujoco.MjSpec, robot: mujoco.MjModel, cfg: SafetyGymConfig, mjx: bool, drawn: bool
) -> mujoco.MjModel:
    """Add to the robot what `build` says, and compile it all."""
    half = max(map(abs, cfg.placements_extents)) + 0.1 if cfg.floor_display_mode else 3.5
    fixed = OBJECT | ({"contype": 0} if mjx else {})
    floor = spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(half, half, 0.1), **fixed
    )
    if drawn:
        light(spec, floor)
        add_cameras(spec, cfg)
    add_free_objects(spec, cfg)
    for i in range(cfg.gremlins_num):
        half = cfg.half_height(cfg.gremlins_size) if drawn else None
        add_gremlin_guide(spec, i, cfg.gremlins_size, half)
    if mjx:
        check_pillars(cfg, robot)
    pillar = mujoco.mjtGeom.mjGEOM_CAPSULE if mjx else mujoco.mjtGeom.mjGEOM_CYLINDER
    add_fixed_objects(spec, cfg, pillar, fixed)
    kept = needed_sensors(cfg)
    for sensor in list(spec.sensors):
        of_joint = sensor.name and sensor.type in JOINT_SENSORS
        if sensor.name not in kept and not of_joint:
            spec.delete(sensor)
    if mjx:
        for name, value in mjx_limits(cfg, robot).items():
            spec.add_numeric(name=name, data=[value], size=1)
    return spec.compile()


def read_robot(cfg: SafetyGymConfig) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """The robot's file, and the robot alone, compiled."""
    path = robot_file(cfg.robot_base)
    with in_one_line(cfg):
        spec = mujoco.MjSpec.from_file(str(path))
        robot = spec.compile()
    if spec.body("robot") is None or not any(site.name == "robot" for site in spec.sites):
        raise ConfigError(f"env.robot_base={cfg.robot_base!r}: it has no body and site named 'robot'")
    return spec, robot


@contextmanager
def in_one_line(cfg: SafetyGymConfig) -> Iterator[None]:
    """What MuJoCo refuses of the robot's file, as a `ConfigError`."""
    try:
        yield
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"env.robot_base={cfg.robot_base!r}: {str(error).splitlines()[0]}") from error


def check_pillars(cfg: SafetyGymConfig, robot: mujoco.MjModel) -> None:
    """Raise `ConfigError` for pillars lower than the robot or a block as they stand."""
    if not cfg.pillars_num:
        return
    data = mujoco.MjData(robot)
    mujoco.mj_kinematics(robot, data)
    up = data.geom_xmat.reshape(-1, 3, 3)[:, 2]  # of each geom's axes
    middle, half = robot.geom_aabb[:, :3], robot.geom_aabb[:, 3:]
    heights = data.geom_xpos[:, 2] + (up * middle + np.abs(up) * half).sum(1)
    carried = robot.body_rootid[robot.geom_bodyid] == robot.body("robot").id
    tops = [
        float(heights[carried].max(initial=0.0)),
        (cfg.vases_num > 0) * 2 * cfg.half_height(cfg.vases_size),
        (cfg.gremlins_num > 0) * (cfg.gremlins_size + 2 * cfg.half_height(cfg.gremlins_size)),  # hover
        (cfg.task == "push") * 2 * cfg.half_height(cfg.box_size),
    ]
    tallest = round(max(tops), 6)
    if 2 * cfg.pillars_height < tallest:
        raise ConfigError(
            f"env.pillars_height={cfg.pillars_height} with env.engine=jax, where pillars have round "
            f"caps: expected at least {math.ceil(500 * tallest) / 1000:g}, half of the tallest body's "
            "height; engines c and warp take lower pillars"
        )


def mjx_limits(cfg: SafetyGymConfig, robot: mujoco.MjModel) -> dict[str, int]:
    """How many contacts engine `jax` computes: the nearest pairs of each two types of shapes, and the
    deepest points of all.

    16 pairs and 48 points are enough where up to 40 points rest: 4 of a block, 20 of a box with its
    columns, and 1 of each of the robot's geoms. With each point more there is room for a pair, and for
    2 points of bodies that meet.
    """
    box = cfg.task == "push"
    resting = 4 * (cfg.vases_num + cfg.gremlins_num) + 20 * box + robot.ngeom
    more = max(0, resting - 40)
    return {"max_geom_pairs": 16 + more, "max_contact_points": 48 + 3 * more}


def add_free_objects(spec: mujoco.MjSpec, cfg: SafetyGymConfig) -> None:
    """Vases, gremlins and the box, in the order of `FREES`."""
    for i in range(cfg.vases_num):
        half = cfg.half_height(cfg.vases_size)
        add_block(spec, f"vase{i}", "vase", cfg.vases_size, half, cfg.vases_density)
    for i in range(cfg.gremlins_num):
        half = cfg.half_height(cfg.gremlins_size)
        add_block(spec, f"gremlin{i}obj", "gremlin", cfg.gremlins_size, half, cfg.gremlins_density)
    if cfg.task == "push":
        add_box(spec, cfg)


def add_fixed_objects(
    spec: mujoco.MjSpec, cfg: SafetyGymConfig, pillar: mujoco.mjtGeom, fixed: dict[str, Any]
) -> None:
    """Pillars, walls and buttons, in the order of `MOCAPS`.

    Args:
        pillar: the shape of a pillar.
        fixed: options of the geoms of what is fixed.
    """
    box, sphere = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE
    button = pillar if cfg.rules == "seditor" else sphere
    sizes = {
        "pillar": (cfg.pillars_size, cfg.pillars_height, 0),
        "wall": (cfg.walls_size,) * 3,
        "button": (cfg.buttons_size, cfg.half_height(0), 0),
    }
    for kind, shape in {"pillar": pillar, "wall": box, "button": button}.items():
        for i in range(getattr(cfg, f"{kind}s_num")):
            body = spec.worldbody.add_body(name=f"{kind}{i}", mocap=True)
            body.add_geom(name=f"{kind}{i}", type=shape, size=sizes[kind], **fixed, **look(kind))


def watched_bodies(cfg: SafetyGymConfig) -> dict[str, list[str]]:
    """By kind, the bodies whose contacts with the robot are counted."""
    on = {
        "vases": cfg.constrain_vases,
        "pillars": cfg.constrain_pillars,
        "gremlins": cfg.constrain_gremlins,
        "buttons": cfg.constrain_buttons or cfg.task == "button",
    }
    end = {"gremlins": "obj"}  # the other body of a gremlin is its guide
    return {
        kind: [f"{kind[:-1]}{i}{end.get(kind, '')}" for i in range(getattr(cfg, f"{kind}_num"))]
        if watched
        else []
        for kind, watched in on.items()
    }


def check_robot(cfg: SafetyGymConfig, robot: mujoco.MjModel) -> None:
    own = robot.body("robot").id
    for i in range(robot.njnt):
        if robot.body_rootid[robot.jnt_bodyid[i]] != robot.body_rootid[own]:
            raise ConfigError(
                f"env.robot_base={cfg.robot_base!r}: joint {robot.joint(i).name!r} is of another body "
                "than 'robot' and its parts"
            )
    joints = [in_words(robot, i) for i in range(robot.njnt) if i < 3 or robot.jnt_bodyid[i] == own]
    if joints == PLANAR:
        check_planar(cfg, robot)
    elif joints[:1] != ["free"]:
        raise ConfigError(
            f"env.robot_base={cfg.robot_base!r}: its joints are {', '.join(joints) or 'none'}: "
            f"expected of body 'robot' free, or {', '.join(PLANAR)} alone"
        )
    if robot.nmocap:
        name = robot.body(int(np.flatnonzero(robot.body_mocapid >= 0)[0])).name
        raise ConfigError(
            f"env.robot_base={cfg.robot_base!r}: body {name!r} is a mocap body: expected none, for the "
            "task has its own"
        )
    if any(robot.geom(i).name == "floor" for i in range(robot.ngeom)):
        raise ConfigError(f"env.robot_base={cfg.robot_base!r}: leave out its floor, the task has one")
    for i in np.flatnonzero(robot.actuator_ctrllimited == 0):
        name = robot.actuator(i).name
        raise ConfigError(f"env.robot_base={cfg.robot_base!r}: actuator {name!r} has no ctrlrange")
    sensors = [robot.sensor(i).name for i in range(robot.nsensor)]
    for name in cfg.sensors_obs:
        if name not in sensors:
            raise ConfigError(
                f"env.sensors_obs: {cfg.robot_base} has no sensor {name!r}{nearest(name, sensors)}"
            )
    for name in needed_sensors(cfg) - {*sensors}:
        raise ConfigError(
            f"env.robot_base={cfg.robot_base!r}: it has no sensor {name!r}, which env.task={cfg.task} "
            "or env.observe_com=true needs"
        )
    bodies = [robot.body(i).name for i in range(robot.nbody) if robot.body(i).name]
    if cfg.reward_orientation and cfg.reward_orientation_body not in bodies:
        name = cfg.reward_orientation_body
        raise ConfigError(f"env.reward_orientation_body={name!r}{nearest(name, bodies)}")
    if cfg.observe_freejoint and robot.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        raise ConfigError(f"env.observe_freejoint=true: {cfg.robot_base} has no free joint")


def in_words(robot: mujoco.MjModel, i: int) -> str:
    """The kind and the axis of joint `i`, and its body if that is not 'robot'."""
    kind = mujoco.mjtJoint(robot.jnt_type[i]).name.removeprefix("mjJNT_").lower()
    axis = f" ({numbers(robot.jnt_axis[i])})" if kind in ("slide", "hinge") else ""
    body = robot.body(robot.jnt_bodyid[i]).name
    return f"{kind}{axis}" + (f" of {body!r}" if body != "robot" else "")


def numbers(values: Any) -> str:
    return " ".join(f"{x + 0.0:g}" for x in np.round(values, 6))


def check_planar(cfg: SafetyGymConfig, robot: mujoco.MjModel) -> None:
    """Refuse a robot whose first three numbers are not its x, y and heading in the world."""
    body = robot.body("robot")
    parent = robot.body(int(body.parentid[0])).name
    if parent != "world":
        raise ConfigError(
            f"env.robot_base={cfg.robot_base!r}: body 'robot' is in body {parent!r}: expected it in "
            "the worldbody"
        )
    for what, came, expected in (
        ("x, y of body 'robot'", body.pos[:2], (0, 0)),
        ("quat of body 'robot'", body.quat, (1, 0, 0, 0)),
        ("ref of its first three joints", robot.qpos0[:3], (0, 0, 0)),
        ("x, y of its hinge", robot.jnt_pos[2, :2], (0, 0)),
    ):
        if numbers(came) != numbers(expected):
            raise ConfigError(
                f"env.robot_base={cfg.robot_base!r}: {what} = {numbers(came)}: expected "
                f"{numbers(expected)}"
            )


def needed_sensors(cfg: SafetyGymConfig) -> set[str]:
    names = set(cfg.sensors_obs)
    if cfg.observe_com or cfg.task in ("x", "z", "circle"):
        names.add("subtreecom")
    return names


def look(kind: str) -> dict:
    return {"rgba": RGBA[kind], "group": min(GROUP[kind], 5)}


def add_block(
    spec: mujoco.MjSpec, name: str, kind: str, size: float, half_height: float, density: float
) -> None:
    """A free block, `size` half a side of its square base. Its pose comes from the layout."""
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=(size, size, half_height),
        density=density,
        **OBJECT,
        **look(kind),
    )


def add_box(spec: mujoco.MjSpec, cfg: SafetyGymConfig) -> None:
    """The box to push: a block with four overlapping corner posts that a robot can catch."""
    s, half = cfg.box_size, cfg.half_height(cfg.box_size)
    add_block(spec, "box", "box", s, half, cfg.box_density)
    for i, (x, y) in enumerate([(s, s), (-s, s), (s, -s), (-s, -s)]):
        spec.body("box").add_geom(
            name=f"col{i + 1}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=(s / 2, s / 2, half),
            pos=(x, y, 0),
            density=cfg.box_density,
            **OBJECT,
            **look("box"),
        )


def add_gremlin_guide(
    spec: mujoco.MjSpec, i: int, size: float, half_height: float | None = None
) -> None:
    """The mocap body that leads gremlin i, of half side `size`, along its circle by a soft weld; with a
    `half_height` it is drawn.

    Safety Gym and Safety-Gymnasium ran on MuJoCo 2, which took a weld's rotational inertia for its
    translational one. Since MuJoCo 3.0 the rotation is 1.5 / size^2 times as soft. The weld's
    torquescale takes that back, so that a gremlin which is hit keeps its heading as in the original.
    """
    body = spec.worldbody.add_body(name=f"gremlin{i}mocap", mocap=True)
    if half_height is not None:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=(size, size, half_height),
            contype=0,
            conaffinity=0,
            rgba=(*RGBA["gremlin"][:3], 0.1),
            group=GROUP["gremlin"],
        )
    spec.add_equality(
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1=f"gremlin{i}mocap",
        name2=f"gremlin{i}obj",
        solref=(0.02, 1.5),
        # anchor, position, quaternion, torquescale
        data=[0, 0, 0, 0, 0, 0, 1, 0, 0, 0, math.sqrt(1.5) / size, 1],
    )


def with_soft_gremlins(scene: Scene) -> Scene:
    """`scene` with the welds of MuJoCo 3, on which recordings were made."""
    spec = scene.spec.copy()
    for weld in spec.equalities:
        weld.data = [*weld.data[:TORQUESCALE], 1, *weld.data[TORQUESCALE + 1 :]]
    return dataclasses.replace(scene, spec=spec, model=spec.compile())


def light(spec: mujoco.MjSpec, floor: mujoco.MjsGeom, squares: int = 10) -> None:
    """A checkered floor with so many squares along a side, a sky, soft light, and a robot that stands
    out."""
    spec.add_texture(
        name="checker",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=(0.85, 0.85, 0.85),
        rgb2=(0.75, 0.75, 0.75),
        width=300,
        height=300,
    )
    spec.add_material(name="checker", texrepeat=(squares, squares), texuniform=False).textures[
        mujoco.mjtTextureRole.mjTEXROLE_RGB
    ] = "checker"
    floor.material = "checker"
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.5, 0.65, 0.8),
        rgb2=(0.85, 0.9, 0.95),
        width=128,
        height=128,
    )
    for geom in spec.geoms:
        if tuple(geom.rgba) == (0.5, 0.5, 0.5, 1) and not geom.material:  # MuJoCo's grey
            geom.rgba = ROBOT
    spec.visual.headlight.ambient[:] = 0.35
    spec.visual.headlight.diffuse[:] = 0.35
    spec.visual.headlight.specular[:] = 0
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=(0, 0, 4),
        dir=(0.3, 0.4, -1),
        diffuse=(0.5, 0.5, 0.5),
        specular=(0, 0, 0),
        castshadow=False,
    )


def add_cameras(spec: mujoco.MjSpec, cfg: SafetyGymConfig) -> None:
    """Those of the original and, of Safety-Gymnasium, `vision_back` and Car's `vision`."""
    down = (np.cos(np.pi / 8), np.sin(np.pi / 8), 0, 0)  # half of up's right angle to the horizon
    for name, pos in (("fixednear", (0, -2, 2)), ("fixedfar", (0, -5, 5))):
        spec.worldbody.add_camera(name=name, pos=pos, quat=down)
    track = mujoco.mjtCamLight.mjCAMLIGHT_TRACK
    spec.body("robot").add_camera(name="track", pos=(0, -2, 2), quat=down, mode=track)
    robot = built_in(cfg.robot_base)
    if robot and robot.stem in BACK:
        spec.body("robot").add_camera(name="vision_back", fovy=90, **BACK[robot.stem])
    if robot and robot.stem == "car" and cfg.rules == "safety_gymnasium":
        camera = spec.camera("vision")
        camera.pos, camera.fovy = (0, 0, 0.2), 90

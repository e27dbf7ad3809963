"""What a picture shows: the bodies of a task in MuJoCo's own model, and what is drawn over them.

In Safety Gym's tasks goals, hazards, circles and lidars are arrays in the physics, so they are drawn as
loose geoms over each frame, with the shapes and colours of the original: its Engine's `render`,
`render_lidar`, `render_compass`, `render_area` and `render_sphere`.
"""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from PIL import Image

from jaxsafe.config import ConfigError
from jaxsafe.envs import engines
from jaxsafe.envs.racing.task import CarRacing
from jaxsafe.envs.safety_gym import scene as scenes
from jaxsafe.envs.safety_gym import sight
from jaxsafe.envs.safety_gym.arena import World
from jaxsafe.envs.safety_gym.config import SafetyGymConfig
from jaxsafe.envs.safety_gym.task import SafetyGym
from jaxsafe.envs.velocity.task import Velocity
from jaxsafe.envs.velocity.task import World as VelocityWorld
from jaxsafe.envs.wrap import innermost
from jaxsafe.learn.observations import vector_of
from jaxsafe.types import State

# Rows of the halo, from the lowest up.
SEEN = ("box", "goal", "buttons", "circle", "walls", "hazards", "pillars", "gremlins", "vases")
RED = (1, 0, 0, 1)
BESIDE = (np.cos(np.deg2rad(32)), np.sin(np.deg2rad(32)), 0, 0)  # along y, 26 degrees downwards
SPHERE, CYLINDER = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CYLINDER


class Stage:
    """The bodies of one of Safety Gym's tasks in MuJoCo's own model, and what is drawn over them.

    It needs no display.
    """

    def __init__(self, env: SafetyGym):
        self.env = env
        self.scene = scenes.build(env.config, drawn=True)
        self.model = self.scene.model
        self.data = mujoco.MjData(self.model)

    def move(self, world: World) -> None:
        """Put the model's bodies where they are in `world`."""
        physics, data = world.bodies, self.data
        time = np.maximum(physics.substeps - 1, 0) * self.model.opt.timestep
        orbit = self.scene.orbit * (physics.substeps > 0)  # gremlins start at their circles' centres
        data.qpos[:] = physics.qpos
        data.mocap_pos[:] = engines.mocap_at(np.asarray(physics.mocap_pos), np.asarray(orbit), time, np)
        data.mocap_quat[:] = physics.mocap_quat
        mujoco.mj_forward(self.model, data)

    def mark(self, geoms: mujoco.MjvScene, state: State) -> None:
        """Add to `geoms` what is no body: goal, hazards, circle, halo, and the light of a cost."""
        env, cfg, world = self.env, self.env.config, state.physics
        seen = sight.marks_of(env.arena)
        for mark in seen:
            for place in sight.places(env.arena, world, mark):
                self._add(geoms, mark.kind, CYLINDER, (*mark.size, 0), place, colour(mark.kind))
        # more opaque than the original's 0.1, which is hardly seen; where SEditor's goal stands, none
        if cfg.task == "button" and "goal" not in [mark.kind for mark in seen]:
            radius = 2 * cfg.buttons_size
            size = (radius, min(radius, 0.3), 0)
            rgba = (*colour("button")[:3], 0.35)
            self._add(geoms, "goal", CYLINDER, size, env.arena.goal_position(world), rgba)
        if cfg.render_lidar_markers:
            self._mark_halo(geoms, state.obs)
        if state.cost > 0:
            place = self.data.body("robot").xpos
            self._add(geoms, "cost", SPHERE, (0.25, 0, 0), place, faded(RED, 0.5))

    def seen(self, state: State) -> np.ndarray | None:
        """What the policy sees, as large as the config has it: uint8 [height, width, 3]. None where it
        sees no picture, or where that is not to be shown."""
        cfg = self.env.config
        if not (cfg.observe_vision and cfg.vision_render):
            return None
        newest = np.asarray(state.obs["vision"])[..., :3]  # of several frames
        size = cfg.vision_render_size
        return np.asarray(Image.fromarray(newest).resize(size, Image.Resampling.NEAREST))

    def _mark_halo(self, geoms: mujoco.MjvScene, obs: Any) -> None:
        """Rows of spheres above the robot, one a kind that is seen.

        A sphere a bin, the more opaque the nearer its target; a larger one where a compass points.
        """
        cfg, robot = self.env.config, self.data.body("robot")
        rotation = robot.xmat.reshape(3, 3)
        parts = split(obs, self.env.observation_spec)
        angles = lidar_angles(cfg)
        height = cfg.render_lidar_offset_init
        for kind in SEEN:
            lidar, compass = parts.get(f"{kind}_lidar"), parts.get(f"{kind}_compass")
            for angle, value in zip(angles, () if lidar is None else lidar, strict=lidar is not None):
                x, y = cfg.render_lidar_radius * np.cos(angle), cfg.render_lidar_radius * np.sin(angle)
                rgba = faded(colour(kind), min(1.0, float(value) + 0.1))
                size = (cfg.render_lidar_size, 0, 0)
                self._add(geoms, "", SPHERE, size, robot.xpos + rotation @ (x, y, height), rgba)
            if compass is not None:
                place = robot.xpos + rotation @ (*(0.15 * compass[:2]), height)
                self._add(geoms, "", SPHERE, (0.05, 0, 0), place, faded(colour(kind), 0.5))
            if lidar is not None or compass is not None:
                height += cfg.render_lidar_offset_delta

    def _add(
        self, geoms: mujoco.MjvScene, name: str, shape: mujoco.mjtGeom, size: Any, place: Any, rgba: Any
    ) -> None:
        """Add one upright geom with its label."""
        geom = geoms.geoms[geoms.ngeom]
        add_geom(geoms, shape, size, place, rgba)
        geom.label = name if self.env.config.render_labels else ""


class Runway:
    """A velocity task's robot on a checkered floor, as `Stage` has Safety Gym's. Cameras run along."""

    def __init__(self, env: Velocity):
        spec = env.spec()
        scenes.light(spec, spec.geom("floor"), squares=40)
        along = mujoco.mjtCamLight.mjCAMLIGHT_TRACK
        for name, far in (("fixednear", 2), ("fixedfar", 4), ("track", 3)):
            spec.body("torso").add_camera(name=name, pos=(0, -far, far / 2), quat=BESIDE, mode=along)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)

    def move(self, world: VelocityWorld) -> None:
        self.data.qpos[:] = world.physics.qpos
        mujoco.mj_forward(self.model, self.data)

    def seen(self, state: State) -> None:
        """Robots here see no picture."""

    def mark(self, geoms: mujoco.MjvScene, state: State) -> None:
        """The light of a cost."""
        if state.cost > 0:
            add_geom(geoms, SPHERE, (0.35, 0, 0), self.data.body("torso").xpos, faded(RED, 0.5))


def stage_of(env: SafetyGym | Velocity) -> Stage | Runway:
    inside: Any = innermost(env)
    return Runway(inside) if isinstance(inside, Velocity) else Stage(inside)


def add_geom(geoms: mujoco.MjvScene, shape: mujoco.mjtGeom, size: Any, place: Any, rgba: Any) -> None:
    """Add one upright geom to a scene."""
    size, place, rgba = np.array(size, float), np.array(place, float), np.array(rgba, np.float32)
    mujoco.mjv_initGeom(geoms.geoms[geoms.ngeom], shape.value, size, place, np.eye(3).reshape(9), rgba)
    geoms.ngeom += 1


def drawable(env: Any) -> SafetyGym | Velocity | CarRacing:
    """`env` without its wrappers.

    Raises:
        ConfigError: it is neither Safety Gym's nor a velocity nor a racing task.
    """
    inside = innermost(env)
    if not isinstance(inside, SafetyGym | Velocity | CarRacing):
        raise ConfigError(
            "only Safety Gym's environments, velocity and racing tasks can be drawn, not a "
            f"{type(inside).__name__}"
        )
    return inside


def lidar_angles(cfg: SafetyGymConfig) -> np.ndarray:
    """Where each bin is drawn [bins], radians to the left of the robot's x axis."""
    middle = 0.5 if cfg.lidar_type == "pseudo" else 0.0  # a bin's sector, or the direction of a ray
    return 2 * np.pi * (np.arange(cfg.lidar_num_bins) + middle) / cfg.lidar_num_bins


def split(obs: Any, spec: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """Components of an observation by name, each flat; what follows them, as older frames, is left
    out."""
    if isinstance(obs, dict) and "vector" not in obs:
        return {name: np.asarray(obs[name])[..., : k[-1]].reshape(-1) for name, k in spec.items()}
    ends = np.cumsum([int(np.prod(shape)) for shape in spec.values()], dtype=int)
    return dict(zip(spec, np.split(np.asarray(vector_of(obs)), ends), strict=False))


def colour(name: str) -> tuple[float, ...]:
    """RGBA of a kind, in the singular or the plural."""
    return scenes.RGBA[name if name in scenes.RGBA else name[:-1]]


def faded(rgba: Sequence[float], alpha: float) -> tuple[float, ...]:
    """The original's way to draw a colour faintly: darker and more transparent, whatever its alpha."""
    return tuple(alpha * x for x in (*rgba[:3], 1.0))

"""Frames and films of an episode, drawn by MuJoCo off screen.

Bodies come from the model. In Safety Gym's tasks goals, hazards, circles and lidars are arrays in the
physics, so they are drawn as loose geoms over each frame, with the shapes and colours of the original:
its Engine's `render`, `render_lidar`, `render_compass`, `render_area` and `render_sphere`.
"""

import atexit
import functools
import importlib
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import imageio
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jaxsafe.config import ConfigError, nearest
from jaxsafe.envs import engines
from jaxsafe.envs.safety_gym import scene as scenes
from jaxsafe.envs.safety_gym.arena import World
from jaxsafe.envs.safety_gym.config import SafetyGymConfig
from jaxsafe.envs.safety_gym.task import SafetyGym
from jaxsafe.envs.velocity.task import Velocity
from jaxsafe.envs.velocity.task import World as VelocityWorld
from jaxsafe.envs.wrap import innermost, raw_steps
from jaxsafe.learn.acting import Player
from jaxsafe.types import PyTree, State

FPS = 30
BACKENDS = {"Linux": ("egl", "osmesa", "glfw"), "Darwin": ("cgl", "glfw")}
# Rows of the halo, from the lowest up.
SEEN = ("box", "goal", "buttons", "circle", "walls", "hazards", "pillars", "gremlins", "vases")
RED = (1, 0, 0, 1)
BESIDE = (np.cos(np.deg2rad(32)), np.sin(np.deg2rad(32)), 0, 0)  # along y, 26 degrees downwards
CAPTION, GAP = 24, 4  # height of the line over a labelled frame, width between two panels, pixels
SPHERE, CYLINDER = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CYLINDER
PROBE = """
import importlib, os, sys, mujoco
context = importlib.import_module("mujoco." + sys.argv[1]).GLContext(8, 8)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), 100)
os._exit(0)  # past the clean-up, which fails in some drivers
"""


class NoDisplay(RuntimeError):
    """Nothing to render with. The message is one line."""


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
        if cfg.task in ("goal", "push"):
            size = (cfg.goal_size, cfg.goal_size / 2, 0)
            self._add(geoms, "goal", CYLINDER, size, env.goal_position(world), colour("goal"))
        if cfg.task == "button":  # more opaque than the original's 0.1, which is hardly seen
            radius = 2 * cfg.buttons_size
            size = (radius, min(radius, 0.3), 0)
            rgba = (*colour("button")[:3], 0.35)
            self._add(geoms, "goal", CYLINDER, size, env.goal_position(world), rgba)
        if cfg.task == "circle":
            size = (cfg.circle_radius, 0.01, 0)
            self._add(geoms, "circle", CYLINDER, size, (0, 0, 0.02), colour("circle"))
        for xy in env.positions(world, "hazards"):
            size = (cfg.hazards_size, 0.01, 0)
            self._add(geoms, "hazard", CYLINDER, size, (*xy, 0.02), colour("hazard"))
        if cfg.render_lidar_markers:
            self._mark_halo(geoms, state.obs)
        if state.cost > 0:
            place = self.data.body("robot").xpos
            self._add(geoms, "cost", SPHERE, (0.25, 0, 0), place, faded(RED, 0.5))

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

    def mark(self, geoms: mujoco.MjvScene, state: State) -> None:
        """The light of a cost."""
        if state.cost > 0:
            add_geom(geoms, SPHERE, (0.35, 0, 0), self.data.body("torso").xpos, faded(RED, 0.5))


def stage_of(env: SafetyGym | Velocity) -> Stage | Runway:
    env = drawable(env)
    return Runway(env) if isinstance(env, Velocity) else Stage(env)


def add_geom(geoms: mujoco.MjvScene, shape: mujoco.mjtGeom, size: Any, place: Any, rgba: Any) -> None:
    """Add one upright geom to a scene."""
    size, place, rgba = np.array(size, float), np.array(place, float), np.array(rgba, np.float32)
    mujoco.mjv_initGeom(geoms.geoms[geoms.ngeom], shape.value, size, place, np.eye(3).reshape(9), rgba)
    geoms.ngeom += 1


class Renderer:
    """Draws states of `env`: `frame(state)`.

    Args:
        width, height: of a frame, pixels.
        camera: 'fixedfar', 'fixednear', 'track' (beside the robot), of Safety Gym's robots 'vision' (on
            it), or an MjvCamera.
    Raises:
        NoDisplay: this machine has neither EGL nor OSMesa nor a display.
        ConfigError: an unknown camera, or an environment that cannot be drawn.
    """

    def __init__(
        self,
        env: SafetyGym | Velocity,
        width: int = 640,
        height: int = 480,
        camera: str | mujoco.MjvCamera = "fixedfar",
    ):
        self.stage = stage_of(env)
        model = self.stage.model
        self.camera = named_camera(model, camera) if isinstance(camera, str) else camera
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = 1
        self._geoms = mujoco.MjvScene(model, maxgeom=10_000)
        self._rect = mujoco.MjrRect(0, 0, width, height)
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        gl_context().make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)

    def frame(self, state: State) -> np.ndarray:
        """The picture of one environment's state: uint8 [height, width, 3]."""
        stage, every = self.stage, mujoco.mjtCatBit.mjCAT_ALL.value
        stage.move(state.physics)
        mujoco.mjv_updateScene(
            stage.model, stage.data, self._option, None, self.camera, every, self._geoms
        )
        stage.mark(self._geoms, state)
        gl_context().make_current()
        pixels = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        mujoco.mjr_render(self._rect, self._geoms, self._context)
        mujoco.mjr_readPixels(pixels, None, self._rect, self._context)
        return pixels[::-1].copy()  # OpenGL's first row is at the bottom


def render_episode(
    env: SafetyGym | Velocity,
    player: Player,
    key: jax.Array,
    length: int | None = None,
    every: int | None = None,
    label: str | None = None,
    **renderer: Any,
) -> list[np.ndarray]:
    """One episode as frames, uint8 [H, W, 3], up to its termination.

    Args:
        player: what acts in `env`, or in `env` with what an algorithm appends to its observation.
        length: most steps; None is the time limit.
        every: steps from a frame to the next; None is as near to real time at 30 frames a second as
            whole steps allow, and never less than one step.
        label: written above each frame, with the return and the cost so far.
        renderer: arguments of `Renderer`.
    Raises:
        NoDisplay: this machine has neither EGL nor OSMesa nor a display.
    """
    draw = Renderer(env, **renderer)  # first: an episode is not worth simulating if it cannot be drawn
    states = run_episode(player, key, length or env.episode_length)
    steps = len(states.terminated)
    ends = np.flatnonzero(states.ended)
    last = int(ends[0]) if len(ends) else steps - 1
    seconds = drawable(env).step_seconds * raw_steps(env)
    every = every or max(1, round(1 / (FPS * seconds)))
    times = range(0, last + 1, every)
    frames = [draw.frame(jax.tree.map(lambda x, t=t: x[t], states)) for t in times]
    if label is None:
        return frames
    returns, costs = np.cumsum(states.reward), np.cumsum(states.cost)
    return [
        captioned(frame, f"{label}   return {returns[t]:.1f}   cost {costs[t]:.0f}")
        for t, frame in zip(times, frames, strict=True)
    ]


def captioned(frame: np.ndarray, text: str) -> np.ndarray:
    """The frame under a line of text: uint8 [height + CAPTION, width, 3]."""
    line = Image.new("RGB", (frame.shape[1], CAPTION), "white")
    font = ImageFont.load_default(16)
    ImageDraw.Draw(line).text((8, CAPTION / 2), text, "black", font, anchor="lm")
    return np.vstack([np.asarray(line), frame])


def side_by_side(films: Sequence[Sequence[np.ndarray]]) -> list[np.ndarray]:
    """Films of one size as one, in panels from left to right; one that ends early stays at its end."""
    gap = np.full((len(films[0][0]), GAP, 3), 255, np.uint8)

    def at(t: int) -> np.ndarray:
        first, *others = (film[min(t, len(film) - 1)] for film in films)
        return np.hstack([first, *(part for frame in others for part in (gap, frame))])

    return [at(t) for t in range(max(map(len, films)))]


def run_episode(player: Player, key: jax.Array, length: int) -> State:
    """The states of an episode of mean actions on the host, [length + 1, ...], from the reset on."""
    reset_key, _ = jax.random.split(key)

    def step(now: tuple[State, PyTree], _: None) -> tuple[tuple[State, PyTree], State]:
        state, carry = now
        action, carry = player.act(carry, state)
        state = player.task.step(state, action)
        return (state, carry), state

    def episode() -> State:
        first = player.task.reset(reset_key)
        _, rest = jax.lax.scan(step, (first, player.begin()), None, length)
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)

    return jax.device_get(jax.jit(episode)())


def write_video(frames: Sequence[np.ndarray], path: str | Path, fps: float = FPS) -> None:
    """Write an .mp4 (H.264), or a .gif of every third frame, to a path that is not there or is to be
    written over.

    Raises:
        ConfigError: another ending.
    """
    path = Path(path)
    if path.suffix not in (".mp4", ".gif"):
        raise ConfigError(f"{path}: expected a name that ends in .mp4 or .gif")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".gif":
        imageio.mimwrite(path, list(frames[::3]), duration=3000 / fps, loop=0)  # type: ignore[arg-type]
    else:
        # ffmpeg is spawned instead of forked, of which JAX warns
        os.environ.setdefault("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")
        options: dict[str, Any] = {"codec": "libx264", "quality": 7, "macro_block_size": 2}
        imageio.mimwrite(path, list(frames), fps=fps, **options)


# Where to draw ---------------------------------------------------------------------------------------


@functools.cache
def gl_context() -> Any:
    """The OpenGL context of this process. Only the cache holds it, so that its end is ours to time."""
    context = importlib.import_module(f"mujoco.{find_backend()}").GLContext(64, 64)
    atexit.register(gl_context.cache_clear)  # while its library is still there
    return context


def find_backend() -> str:
    """The first of MuJoCo's OpenGL backends that works here, or the one that MUJOCO_GL names.

    Raises:
        NoDisplay: none does.
    """
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    names = BACKENDS.get(platform.system(), ("glfw",))
    if wanted not in ("", "1", "on", "true", "enable", "enabled"):
        names = ({"glx": "glfw", "wgl": "glfw"}.get(wanted, wanted),)
    for name in names:
        if works(name):
            return name
    hint = f"unset MUJOCO_GL={wanted}" if names == (wanted,) else "install libegl1 or libosmesa6"
    raise NoDisplay(f"nothing to render with here: {', '.join(names)} failed; {hint}")


def works(backend: str) -> bool:
    """Try a backend in a process of its own: a failure would bar the next one from this process."""
    try:
        probe = subprocess.run([sys.executable, "-c", PROBE, backend], capture_output=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return probe.returncode == 0


# Small parts -----------------------------------------------------------------------------------------


def drawable(env: Any) -> SafetyGym | Velocity:
    """`env` without its wrappers.

    Raises:
        ConfigError: it is neither Safety Gym's nor a velocity task.
    """
    inside = innermost(env)
    if not isinstance(inside, SafetyGym | Velocity):
        raise ConfigError(
            "only Safety Gym's environments and velocity tasks can be drawn, not a "
            f"{type(inside).__name__}"
        )
    return inside


def named_camera(model: mujoco.MjModel, name: str) -> mujoco.MjvCamera:
    names = [model.camera(i).name for i in range(model.ncam)]
    if name not in names:
        raise ConfigError(f"no camera {name!r}{nearest(name, names)}")
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
    camera.fixedcamid = names.index(name)
    return camera


def lidar_angles(cfg: SafetyGymConfig) -> np.ndarray:
    """Where each bin is drawn [bins], radians to the left of the robot's x axis."""
    middle = 0.5 if cfg.lidar_type == "pseudo" else 0.0  # a bin's sector, or the direction of a ray
    return 2 * np.pi * (np.arange(cfg.lidar_num_bins) + middle) / cfg.lidar_num_bins


def split(obs: Any, spec: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """Components of an observation by name, each flat; what follows them is left out."""
    if isinstance(obs, dict):
        return {name: np.asarray(value).reshape(-1) for name, value in obs.items()}
    ends = np.cumsum([int(np.prod(shape)) for shape in spec.values()], dtype=int)
    return dict(zip(spec, np.split(np.asarray(obs), ends), strict=False))


def colour(name: str) -> tuple[float, ...]:
    """RGBA of a kind, in the singular or the plural."""
    return scenes.RGBA[name if name in scenes.RGBA else name[:-1]]


def faded(rgba: Sequence[float], alpha: float) -> tuple[float, ...]:
    """The original's way to draw a colour faintly: darker and more transparent, whatever its alpha."""
    return tuple(alpha * x for x in (*rgba[:3], 1.0))

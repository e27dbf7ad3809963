"""Frames and films of an episode. MuJoCo draws them off screen; those of racing tasks JAX draws."""

import os
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
from jaxsafe.envs.racing.picture import COLOURS, picture
from jaxsafe.envs.racing.task import CarRacing, World
from jaxsafe.envs.safety_gym.task import SafetyGym
from jaxsafe.envs.velocity.task import Velocity
from jaxsafe.envs.view.backend import gl_context
from jaxsafe.envs.view.stage import drawable, stage_of
from jaxsafe.envs.wrap import raw_steps
from jaxsafe.learn.acting import Player, played
from jaxsafe.types import Env, State

FPS = 30
CAPTION, GAP = 24, 4  # height of the line over a labelled frame, width between two panels, pixels


class Renderer:
    """Draws states of one of Safety Gym's environments or a velocity task: `frame(state)`.

    Args:
        width, height: of a frame, pixels.
        camera: 'fixedfar', 'fixednear', 'track' (beside the robot), of Safety Gym's robots 'vision' (on
            it), or an MjvCamera.
    Raises:
        NoDisplay: this machine has neither EGL nor OSMesa nor a display.
        ConfigError: an unknown camera.
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

    def frame(self, state: State, overruled: bool = False) -> np.ndarray:
        """The picture of one environment's state, uint8 [height, width, 3]; where the policy sees a
        picture, with that one to the right. A light tells that a shield `overruled` the policy."""
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
        frame = pixels[::-1].copy()  # OpenGL's first row is at the bottom
        frame = with_light(frame) if overruled else frame
        seen = stage.seen(state)
        return frame if seen is None else beside(frame, seen)


class Aerial:
    """Draws states of a racing task from above, in colours: `frame(state)`. It needs no display.

    Args:
        width, height: of a frame, pixels.
    """

    def __init__(self, width: int = 600, height: int = 400):
        kinds = np.arange(len(COLOURS), dtype=np.uint8)

        def draw(world: World) -> jax.Array:
            return picture(world.car, world.track, world.obstacles, (width, height), kinds)

        self._draw = jax.jit(draw)

    def frame(self, state: State, overruled: bool = False) -> np.ndarray:
        """The picture of one state, uint8 [height, width, 3], with the light of a shield."""
        frame = COLOURS[np.asarray(self._draw(state.physics))]
        return with_light(frame) if overruled else frame


def renderer_of(env: Any, **options: Any) -> Renderer | Aerial:
    """What draws states of `env`, by the options of its class.

    Raises:
        NoDisplay: as of `Renderer`.
        ConfigError: an unknown camera, or an environment that cannot be drawn.
    """
    inside = drawable(env)
    return Aerial(**options) if isinstance(inside, CarRacing) else Renderer(inside, **options)


def named_camera(model: mujoco.MjModel, name: str) -> mujoco.MjvCamera:
    names = [model.camera(i).name for i in range(model.ncam)]
    if name not in names:
        raise ConfigError(f"no camera {name!r}{nearest(name, names)}")
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
    camera.fixedcamid = names.index(name)
    return camera


def render_episode(
    env: Env,
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
        renderer: arguments of what draws it, `Renderer` or `Aerial`.
    Raises:
        NoDisplay: this machine has neither EGL nor OSMesa nor a display.
        ConfigError: an environment that cannot be drawn.
    """
    draw = renderer_of(env, **renderer)  # first, to refuse what cannot be drawn
    states, said = run_episode(player, key, length or env.episode_length)
    steps = len(states.terminated)
    ends = np.flatnonzero(states.ended)
    last = int(ends[0]) if len(ends) else steps - 1
    seconds = drawable(env).step_seconds * raw_steps(env)
    every = every or max(1, round(1 / (FPS * seconds)))
    times = range(0, last + 1, every)
    acts = said.get("overruled", np.zeros(steps, bool))
    frames = [
        draw.frame(jax.tree.map(lambda x, t=t: x[t], states), bool(acts[t : t + every].any()))
        for t in times
    ]
    if label is None:
        return frames
    returns, costs = np.cumsum(states.reward), np.cumsum(states.cost)
    return [
        captioned(frame, f"{label}   return {returns[t]:.1f}   cost {costs[t]:.0f}")
        for t, frame in zip(times, frames, strict=True)
    ]


def with_light(frame: np.ndarray) -> np.ndarray:
    """The frame with a red light in its upper right corner: a shield overrules the policy."""
    image, radius = Image.fromarray(frame), max(3, frame.shape[0] // 24)
    x, y = frame.shape[1] - 2 * radius, 2 * radius
    box = (x - radius, y - radius, x + radius, y + radius)
    ImageDraw.Draw(image).ellipse(box, fill=(220, 30, 30), outline="white")
    return np.asarray(image)


def captioned(frame: np.ndarray, text: str) -> np.ndarray:
    """The frame under a line of text: uint8 [height + CAPTION, width, 3]."""
    line = Image.new("RGB", (frame.shape[1], CAPTION), "white")
    font = ImageFont.load_default(16)
    ImageDraw.Draw(line).text((8, CAPTION / 2), text, "black", font, anchor="lm")
    return np.vstack([np.asarray(line), frame])


def beside(frame: np.ndarray, panel: np.ndarray) -> np.ndarray:
    """`frame` and, to the right, `panel`; what is lower ends in white."""
    height = max(len(frame), len(panel))
    left, right = (
        np.pad(x, ((0, height - len(x)), (0, 0), (0, 0)), constant_values=255) for x in (frame, panel)
    )
    return np.hstack([left, np.full((height, GAP, 3), 255, np.uint8), right])


def side_by_side(films: Sequence[Sequence[np.ndarray]]) -> list[np.ndarray]:
    """Films of one size as one, in panels from left to right; one that ends early stays at its end."""
    gap = np.full((len(films[0][0]), GAP, 3), 255, np.uint8)

    def at(t: int) -> np.ndarray:
        first, *others = (film[min(t, len(film) - 1)] for film in films)
        return np.hstack([first, *(part for frame in others for part in (gap, frame))])

    return [at(t) for t in range(max(map(len, films)))]


def run_episode(player: Player, key: jax.Array, length: int) -> tuple[State, dict[str, np.ndarray]]:
    """An episode of mean actions, on the host: its states, [length + 1, ...], from the reset on; and
    what the policy says beside its actions, [length] by name."""

    def episode() -> tuple[State, dict[str, jax.Array]]:
        start, (rest, said) = played(player, key, lambda step: (step.after, step.said), steps=length)
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, rest), said

    return jax.device_get(jax.jit(episode)())


def write_video(frames: Sequence[np.ndarray], path: str | Path) -> None:
    """Write an .mp4 (H.264) of `FPS` frames a second, or a .gif of every third frame.

    Args:
        path: not there, or to be written over.

    Raises:
        ConfigError: another ending.
    """
    path = Path(path)
    if path.suffix not in (".mp4", ".gif"):
        raise ConfigError(f"{path}: expected a name that ends in .mp4 or .gif")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".gif":
        imageio.mimwrite(path, list(frames[::3]), duration=3000 / FPS, loop=0)  # type: ignore[arg-type]
    else:
        # ffmpeg is spawned instead of forked, of which JAX warns
        os.environ.setdefault("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")
        options: dict[str, Any] = {"codec": "libx264", "quality": 7, "macro_block_size": 2}
        imageio.mimwrite(path, list(frames), fps=FPS, **options)

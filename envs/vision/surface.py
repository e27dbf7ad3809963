"""How bright and of what colour a surface is: MuJoCo's lights, checkered floors and sky.

What MuJoCo's renderer draws and this does not: shadows, reflections and highlights.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxsafe.envs.vision.rays import Vector, dot, inverse, root

Colour = tuple[jax.Array, jax.Array, jax.Array]  # red, green, blue, from 0 to 1


class Lights(NamedTuple):
    """The camera's own light, and those of the world, which are far away.

    ambient [3], diffuse [1 + n, 3]: the camera's light comes first. towards [n, 3]: where the others
    are, unit vectors in the world.
    """

    ambient: np.ndarray
    diffuse: np.ndarray
    towards: np.ndarray


def lights_of(model: mujoco.MjModel) -> Lights:
    """Those that are on. Raises ValueError for lights that are near, and for highlights."""
    own, on = model.vis.headlight, model.light_active.astype(bool)
    directional = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    if (model.light_type[on] != directional).any() or (model.light_bodyid[on] != 0).any():
        raise ValueError("expected directional lights that belong to the world")
    if np.any(own.specular) or model.light_specular[on].any():
        raise ValueError("expected lights without highlights: specular 0")
    towards = -model.light_dir[on] / np.linalg.norm(model.light_dir[on], axis=1, keepdims=True)
    return Lights(
        own.ambient + model.light_ambient[on].sum(0),
        np.concatenate([own.diffuse[None], model.light_diffuse[on]]),
        towards,
    )


def lit(
    rgb: tuple[float, float, float],
    glow: float,
    lights: Lights,
    normal: Vector,
    towards: list[Vector],
) -> Colour:
    """A surface of colour `rgb` under its own `glow` and the lights that stand `towards`, in the frame
    of `normal`."""
    shares = [jnp.maximum(dot(normal, light), 0.0) for light in towards]

    def channel(k: int) -> jax.Array:
        falling = zip(lights.diffuse[:, k].tolist(), shares, strict=True)
        light = glow + float(lights.ambient[k])
        light += sum(strength * share for strength, share in falling)
        return jnp.clip(rgb[k] * light, 0.0, 1.0)

    return channel(0), channel(1), channel(2)


class Checker(NamedTuple):
    """Squares of two colours, whose corners lie at multiples of `side` [2] (m)."""

    even: tuple[float, ...]
    odd: tuple[float, ...]
    side: tuple[float, float]


def checker_of(model: mujoco.MjModel, geom: int) -> Checker | None:
    """The pattern on a plane; None where it has no texture. ValueError for any other texture."""
    material = model.geom_matid[geom]
    textures = model.mat_texid[material] if material >= 0 else np.full(1, -1)
    texture = textures.max()
    if texture < 0:
        return None
    sizes = model.tex_height, model.tex_width, model.tex_nchannel
    height, width, depth = (int(size[texture]) for size in sizes)
    start = model.tex_adr[texture]
    pixels = model.tex_data[start : start + height * width * depth].reshape(height, width, depth)
    squares = pixels[:: height // 2, :: width // 2][:2, :2]
    whole = np.kron(squares[..., 0], np.ones((height // 2, width // 2), np.uint8))
    plane = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE
    crossed = (squares[0, 0] == squares[1, 1]).all() and (squares[0, 1] == squares[1, 0]).all()
    if not (plane and crossed and (whole == pixels[..., 0]).all()):
        raise ValueError(f"geom {geom}: expected a checker on a plane for a texture")
    half, repeat = model.geom_size[geom], model.mat_texrepeat[material]
    side = float(half[0] / repeat[0]), float(half[1] / repeat[1])
    even, odd = (tuple((c / 255).tolist()) for c in (squares[1, 0, :3], squares[0, 0, :3]))
    return Checker(even, odd, side)


def checkered(checker: Checker, x: jax.Array, y: jax.Array, width: jax.Array) -> Colour:
    """The mean colour of a square of `width` (m) about the point x, y of a plane.

    A pattern finer than a pixel so turns grey, as with OpenGL's smaller textures.
    """
    signs = jnp.ones_like(x)
    for at, side in zip((x, y), checker.side, strict=True):
        over = jnp.maximum(width / side, 1e-3)
        # the integral of a wave that is 1 on [0, 1), -1 on [1, 2), and so on
        ahead, behind = (1 - jnp.abs(jnp.mod(at / side + s * over / 2, 2.0) - 1) for s in (1, -1))
        signs = signs * (ahead - behind) * inverse(over)
    even, odd = checker.even, checker.odd
    share = (1 + signs) / 2

    def channel(k: int) -> jax.Array:
        return odd[k] + (even[k] - odd[k]) * share

    return channel(0), channel(1), channel(2)


class Sky(NamedTuple):
    """The colours straight up and straight down."""

    up: np.ndarray
    down: np.ndarray


def sky_of(model: mujoco.MjModel) -> Sky | None:
    """None: black. ValueError for a sky that is not a gradient."""
    found = np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    if not len(found):
        return None
    texture = found[0]
    side = model.tex_width[texture]
    faces = model.tex_data[model.tex_adr[texture] :][: 6 * side * side * 3].reshape(6, side, side, 3)
    centres = faces[:, side // 2, side // 2] / 255  # right, left, up, down, front, back
    if np.ptp(centres[[0, 1, 4, 5]], axis=0).max() > 2 / 255:
        raise ValueError("expected a sky with a gradient from up to down")
    return Sky(centres[2], centres[3])


def sky_colour(sky: Sky | None, direction: Vector) -> Colour:
    """Of rays into the sky: MuJoCo's gradient over the elevation, whose unit here is a right angle.

    share of `up` = (1 + sqrt(2) e / sqrt(1 + e^2)) / 2
    """
    x, y, z = direction
    if sky is None:
        black = jnp.zeros_like(z)
        return black, black, black
    e = jnp.arctan2(z, root(x**2 + y**2)) / (jnp.pi / 2)
    share = (1 + jnp.sqrt(2.0) * e * jax.lax.rsqrt(1 + e**2)) / 2

    def channel(k: int) -> jax.Array:
        return float(sky.down[k]) + float(sky.up[k] - sky.down[k]) * share

    return channel(0), channel(1), channel(2)

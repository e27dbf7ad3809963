"""A camera that draws a MuJoCo model: a ray through the middle of each pixel.

    colour of a pixel = the nearest opaque surface, or the sky, seen through what is translucent

MuJoCo's OpenGL draws what is translucent twice, once from front to back and once from back to front:

    c <- T_1 ... T_n T_n ... T_1 c,   T_i c = (1 - alpha_i) c + alpha_i colour_i

so alpha a counts as 1 - (1 - a)^2. Here the order is that of the model and not of the distance, the
last geom being the nearest. For two layers of alpha 1/4 that changes a colour by at most 3%.

The loop over geoms is unrolled, so that a pixel stays in the registers of a few kernels.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxsafe.envs.vision import surface
from jaxsafe.envs.vision.poses import Pose, fixed, kinematics, placed, turned
from jaxsafe.envs.vision.rays import SHAPES, Vector, inverse, root

# (qpos [nq], mocap_pos [nmocap, 3], mocap_quat [nmocap, 4]) -> uint8 [height, width, 3]
Eye = Callable[[jax.Array, jax.Array, jax.Array], jax.Array]
GREY = (0.5, 0.5, 0.5, 1.0)  # of a geom that has no colour of its own: it has its material's
BANDS = 4  # parts in which a picture is drawn, one after the other: fewer need more memory


class Thing(NamedTuple):
    """A geom as it is compiled. glow: what shines on it besides the lights, in all of its colours."""

    kind: int
    size: tuple[float, float, float]
    rgb: tuple[float, float, float]
    alpha: float
    glow: float
    checker: surface.Checker | None


class Drawing(NamedTuple):
    """What is fixed of a picture. near: m, what is less deep is not seen. pixel: the side of a pixel,
    where a ray is 1 m deep."""

    things: list[Thing]
    lights: surface.Lights
    sky: surface.Sky | None
    near: float
    pixel: float


class View(NamedTuple):
    """Where the camera is.

    axes: float [3, 3], of the camera in the world, in columns: right, up, back.
    origins: float [G, 3], the camera's place in the frame of each geom.
    bases: float [G, 3, 3], its axes there. towards: float [G, n, 3], the lights there.
    """

    axes: jax.Array
    origins: jax.Array
    bases: jax.Array
    towards: jax.Array


def make_eye(model: mujoco.MjModel, camera: str, size: tuple[int, int]) -> Eye:
    """What a camera of `model` sees, for one world; callers `vmap`.

    Args:
        size: of the picture, width and height in pixels.
    Raises:
        ValueError: a shape, a texture, a light or a camera that it cannot draw.
    """
    (width, height), reach = size, math.tan(math.radians(model.camera(camera).fovy[0]) / 2)
    drawing = Drawing(
        things=[thing_of(model, geom) for geom in range(model.ngeom)],
        lights=surface.lights_of(model),
        sky=surface.sky_of(model),
        near=float(model.vis.map.znear * model.stat.extent),
        pixel=2 * reach / height,
    )
    poses, look = kinematics(model), camera_of(model, camera)
    in_bodies = fixed(model.geom_pos, model.geom_quat)
    # where the rays are when they are 1 m deep; the last band may have rows to spare
    u = np.float32(drawing.pixel / 2 * (2 * np.arange(width) + 1 - width))
    v = np.float32(drawing.pixel / 2 * (height - 1 - 2 * np.arange(height)))
    bands = np.resize(v, (BANDS, -(-height // BANDS)))

    def eye(qpos: jax.Array, mocap_pos: jax.Array, mocap_quat: jax.Array) -> jax.Array:
        bodies = poses(qpos, mocap_pos, mocap_quat)
        place, axes = look(bodies)
        geoms = placed(Pose(*(x[model.geom_bodyid] for x in bodies)), in_bodies)
        inverse = jnp.swapaxes(geoms.rotation, 1, 2)
        lights = jnp.asarray(drawing.lights.towards, jnp.float32)
        view = View(
            axes,
            origins=turned(inverse, place - geoms.position),
            bases=(inverse[..., None] * axes).sum(2),
            towards=turned(inverse[:, None], lights),
        )

        def draw(v: jax.Array) -> jax.Array:
            return packed(colours(drawing, view, jnp.asarray(u)[None, :], v[:, None]))

        # in a loop: fused with the unpacking, XLA would draw every pixel once for each channel
        pixels = jax.lax.map(draw, jnp.asarray(bands)).reshape(-1, width)[:height]
        return jax.lax.bitcast_convert_type(pixels, jnp.uint8)[..., :3]

    return eye


# ---- the model ----------------------------------------------------------------------------------


def thing_of(model: mujoco.MjModel, geom: int) -> Thing:
    kind, name = int(model.geom_type[geom]), model.geom(geom).name or geom
    if kind not in SHAPES:
        raise ValueError(f"geom {name}: expected a plane, sphere, capsule, cylinder or box")
    material, rgba, glow = model.geom_matid[geom], model.geom_rgba[geom], 0.0
    if material >= 0:
        rgba = model.mat_rgba[material] if (rgba == GREY).all() else rgba
        glow = float(model.mat_emission[material])
    red, green, blue, alpha = rgba.tolist()
    x, y, z = model.geom_size[geom].tolist()
    checker = surface.checker_of(model, geom)
    return Thing(kind, (x, y, z), (red, green, blue), alpha, glow, checker)


def camera_of(model: mujoco.MjModel, name: str) -> Callable[[Pose], Pose]:
    """Where a camera is, of the poses of all bodies: on a body or, as one that tracks it, beside."""
    index = model.camera(name).id
    body, mode = model.cam_bodyid[index], model.cam_mode[index]
    perspective = model.cam_projection[index] == mujoco.mjtProjection.mjPROJ_PERSPECTIVE
    if not perspective or model.cam_sensorsize[index].any():
        raise ValueError(f"camera {name}: expected a perspective one with fovy, without sensorsize")
    if mode == mujoco.mjtCamLight.mjCAMLIGHT_TRACK:
        offset = jnp.asarray(model.cam_pos0[index], jnp.float32)
        axes = jnp.asarray(model.cam_mat0[index].reshape(3, 3), jnp.float32)
        return lambda bodies: Pose(bodies.position[body] + offset, axes)
    if mode != mujoco.mjtCamLight.mjCAMLIGHT_FIXED:
        raise ValueError(f"camera {name}: expected one that is fixed to its body, or tracks it")
    own = fixed(model.cam_pos[[index]], model.cam_quat[[index]])

    def look(bodies: Pose) -> Pose:
        on_body = placed(Pose(*(x[body][None] for x in bodies)), own)
        return Pose(*(x[0] for x in on_body))

    return look


# ---- the picture --------------------------------------------------------------------------------


def colours(drawing: Drawing, view: View, u: jax.Array, v: jax.Array) -> surface.Colour:
    """Of the rays through u [1, W] and v [H, 1], from 0 to 1, [H, W] each."""
    shape = jnp.broadcast_shapes(u.shape, v.shape)
    depth: jax.Array = jnp.full(shape, jnp.inf)
    seen = surface.sky_colour(drawing.sky, ray(view.axes, u, v))
    for geom, thing in enumerate(drawing.things):
        if thing.alpha == 1:
            t, colour = painted(drawing, view, geom, u, v)
            nearer = (t > drawing.near) & (t < depth)
            depth = jnp.where(nearer, t, depth)
            seen = each(lambda new, old, nearer=nearer: jnp.where(nearer, new, old), colour, seen)
    # T_1 ... T_n T_n ... T_1 c = through c + added
    through, nothing = jnp.ones(shape), jnp.zeros(shape)
    added = nothing, nothing, nothing
    for geom, thing in enumerate(drawing.things):
        if 0 < thing.alpha < 1:
            t, colour = painted(drawing, view, geom, u, v)
            a = jnp.where((t > drawing.near) & (t < depth), thing.alpha, 0.0)
            own, rest = a * ((1 - a) * through + 1), 1 - a
            added = each(lambda c, b, own=own, rest=rest: own * c + rest * b, colour, added)
            through = rest**2 * through
    return each(lambda c, b: through * c + b, seen, added)


def each(f: Callable[..., jax.Array], *colours: surface.Colour) -> surface.Colour:
    """`f` of each of the three channels."""
    red, green, blue = (f(*channels) for channels in zip(*colours, strict=True))
    return red, green, blue


def ray(axes: jax.Array, u: jax.Array, v: jax.Array) -> Vector:
    """The direction of the rays, 1 m deep, by the camera's axes in some frame."""
    x, y, z = (u * axes[i, 0] + v * axes[i, 1] - axes[i, 2] for i in range(3))
    return x, y, z


def painted(
    drawing: Drawing, view: View, geom: int, u: jax.Array, v: jax.Array
) -> tuple[jax.Array, surface.Colour]:
    """How deep a geom is in each pixel, infinite where it is not seen, and its colour there."""
    thing, axes = drawing.things[geom], view.bases[geom]
    origin, direction = vector(view.origins[geom]), ray(axes, u, v)
    lamps = [vector(axes[:, 2]), *(vector(light) for light in view.towards[geom])]
    t, normal = SHAPES[thing.kind](thing.size, origin, direction)
    colour = surface.lit(thing.rgb, thing.glow, drawing.lights, normal, lamps)
    if thing.checker is None:
        return t, colour
    seen = jnp.where(jnp.isfinite(t), t, 0.0)
    x, y = (origin[i] + seen * direction[i] for i in (0, 1))
    flat = inverse(jnp.where(seen > 0, direction[2], 1.0))
    moves = [  # squared: how far x, y move from a pixel to the next, to the right and upwards
        sum((axes[i, k] - axes[2, k] * flat * direction[i]) ** 2 for i in (0, 1)) for k in (0, 1)
    ]
    width = drawing.pixel * seen * root(jnp.maximum(*moves))
    return t, each(jnp.multiply, colour, surface.checkered(thing.checker, x, y, width))


def vector(x: jax.Array) -> Vector:
    return x[0], x[1], x[2]


def packed(colour: surface.Colour) -> jax.Array:
    """The three channels, from 0 to 1, as the bytes of one number, the lowest first."""
    red, green, blue = (jnp.round(255 * jnp.clip(x, 0.0, 1.0)).astype(jnp.uint32) for x in colour)
    return red | green << 8 | blue << 16

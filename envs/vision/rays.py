"""Where rays enter shapes, in closed form.

A ray is o + t d, in the shape's own frame, with one origin for a whole picture: `origin` is three
scalars, `direction` three arrays of one shape. d need not have length 1. All shapes are convex, and
their sizes are those of MuJoCo's geoms. A ray that begins inside a shape does not enter it.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco

Vector = tuple[jax.Array, jax.Array, jax.Array]
Size = tuple[float, float, float]
TINY = 1e-12  # for what is divided by or rooted


class Hit(NamedTuple):
    """t where a ray enters, infinite for a miss, and the outward normal there, of length 1."""

    distance: jax.Array
    normal: Vector


def dot(a: Vector, b: Vector) -> jax.Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


# Both by way of 1 / sqrt(x), for which processors have a fast instruction.


def root(x: jax.Array) -> jax.Array:
    """sqrt(x), of what is positive."""
    x = jnp.maximum(x, TINY)
    return x * jax.lax.rsqrt(x)


def inverse(x: jax.Array) -> jax.Array:
    """1 / x, and 0 of what is nearly 0."""
    return x * jax.lax.rsqrt(jnp.maximum(x**2, TINY**2)) ** 2


def hit(there: jax.Array, distance: jax.Array, normal: Vector) -> Hit:
    return Hit(jnp.where(there, distance, jnp.inf), normal)


def plane(size: Size, origin: Vector, direction: Vector) -> Hit:
    """The upper side of z = 0, within +-size[0] and +-size[1]; a size of 0 has no end."""
    t = -origin[2] * inverse(direction[2])
    there = direction[2] < 0
    for axis in (0, 1):
        if size[axis]:
            there &= jnp.abs(origin[axis] + t * direction[axis]) <= size[axis]
    zero = jnp.zeros_like(t)
    return hit(there, t, (zero, zero, zero + 1))


def sphere(size: Size, origin: Vector, direction: Vector) -> Hit:
    """|o + t d| = r: the smaller root of |d|^2 t^2 + 2 (o.d) t + |o|^2 - r^2."""
    radius = size[0]
    a, b, c = dot(direction, direction), dot(origin, direction), dot(origin, origin) - radius**2
    square = b**2 - a * c
    t = -(b + root(square)) * inverse(a)
    x, y, z = ((o + t * d) / radius for o, d in zip(origin, direction, strict=True))
    return hit(square > 0, t, (x, y, z))


class Tube(NamedTuple):
    """Where a ray enters and leaves an endless tube around z, and whether it does."""

    there: jax.Array
    enter: jax.Array
    leave: jax.Array


def tube(radius: float, origin: Vector, direction: Vector) -> Tube:
    (x, y, _), (dx, dy, _) = origin, direction
    a, b, c = jnp.maximum(dx**2 + dy**2, TINY), x * dx + y * dy, x**2 + y**2 - radius**2
    square = b**2 - a * c
    half, scale = root(square), inverse(a)
    return Tube(square > 0, -(b + half) * scale, (half - b) * scale)


def capsule(size: Size, origin: Vector, direction: Vector) -> Hit:
    """A tube around z between -h and h, with a half sphere at each end."""
    radius, half = size[0], size[1]
    round_ = tube(radius, origin, direction)
    z = origin[2] + round_.enter * direction[2]
    end = jnp.where(z > 0, half, -half)  # of the two spheres only this one can be entered first
    cap = sphere(size, (origin[0], origin[1], origin[2] - end), direction)
    side = jnp.abs(z) <= half
    x, y = ((origin[i] + round_.enter * direction[i]) / radius for i in (0, 1))
    nx, ny, nz = cap.normal
    normal = (jnp.where(side, x, nx), jnp.where(side, y, ny), jnp.where(side, 0.0, nz))
    return hit(round_.there, jnp.where(side, round_.enter, cap.distance), normal)


def cylinder(size: Size, origin: Vector, direction: Vector) -> Hit:
    """The part of a tube around z between -h and h."""
    radius, half = size[0], size[1]
    round_ = tube(radius, origin, direction)
    steep = inverse(direction[2])
    middle, reach = -origin[2] * steep, half * jnp.abs(steep)
    top = middle - reach > round_.enter
    t = jnp.maximum(middle - reach, round_.enter)
    x, y = ((origin[i] + t * direction[i]) / radius for i in (0, 1))
    up = jnp.where(direction[2] > 0, -1.0, 1.0)
    zero = jnp.zeros_like(x)
    normal = (jnp.where(top, zero, x), jnp.where(top, zero, y), jnp.where(top, up, zero))
    return hit(round_.there & (t < jnp.minimum(middle + reach, round_.leave)), t, normal)


def box(size: Size, origin: Vector, direction: Vector) -> Hit:
    """What three pairs of planes have in common."""
    enters, leaves = [], []
    for half, o, d in zip(size, origin, direction, strict=True):
        steep = inverse(d)
        middle, reach = -o * steep, half * jnp.abs(steep)
        enters.append(middle - reach)
        leaves.append(middle + reach)
    x, y, z = enters
    t = jnp.maximum(jnp.maximum(x, y), z)
    by_x, by_y = x >= t, y >= t
    dx, dy, dz = (jnp.where(d > 0, -1.0, 1.0) for d in direction)
    normal = (
        jnp.where(by_x, dx, 0.0),
        jnp.where(by_y & ~by_x, dy, 0.0),
        jnp.where(by_x | by_y, 0.0, dz),
    )
    leave = jnp.minimum(jnp.minimum(leaves[0], leaves[1]), leaves[2])
    return hit(t < leave, t, normal)


SHAPES: dict[int, Callable[[Size, Vector, Vector], Hit]] = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): plane,
    int(mujoco.mjtGeom.mjGEOM_SPHERE): sphere,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): capsule,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): cylinder,
    int(mujoco.mjtGeom.mjGEOM_BOX): box,
}

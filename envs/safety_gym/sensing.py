"""Lidars and compasses, as Safety Gym defines them. Source: its Engine, `obs_lidar*`, `obs_compass`."""

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxsafe.config import ConfigError

TINY = 1e-12
PARALLEL = 1e-6  # in float32 a ray this close to a face runs along it


def in_frame(targets: jax.Array, position: jax.Array, rotation: jax.Array) -> jax.Array:
    """Targets [n, 2] on the floor, in the robot's frame: the first two coordinates, float [n, 2].

    A target's height counts as 0 and the robot's does not, so a tilted robot sees its own height
    leak into them (kept from the original).
    """
    offset = jnp.pad(targets - position[:2], ((0, 0), (0, 1)), constant_values=-position[2])
    return (offset[:, :, None] * rotation[:, :2]).sum(1)


def pseudo_lidar(
    targets: jax.Array,
    position: jax.Array,
    rotation: jax.Array,
    bins: int,
    max_dist: float | None,
    exp_gain: float,
    alias: bool,
) -> jax.Array:
    """Closeness of the nearest target in each of `bins` sectors around the robot.

    The sector of a target exactly ahead is taken modulo `bins`, where the original raises an
    IndexError.

    Args:
        targets: float [n, 2] (m), as of `in_frame`.
        position, rotation: float [3], [3, 3] of the robot's body.
        max_dist: range of the linear law (m); None for exp(-exp_gain distance).
        alias: share the reading with the two sectors beside, by the angle within the sector.
    Returns:
        float [bins] in [0, 1].
    """
    ego = in_frame(targets, position, rotation)
    distance = jnp.sqrt(jnp.maximum(jnp.square(ego).sum(-1), TINY**2))
    width = 2 * jnp.pi / bins
    angle = jnp.mod(jnp.arctan2(ego[:, 1], ego[:, 0]), 2 * jnp.pi)
    sector = jnp.floor(angle / width)
    if max_dist is None:
        closeness = jnp.exp(-exp_gain * distance)
    else:
        closeness = jnp.maximum(0.0, max_dist - distance) / max_dist
    within = angle / width - sector
    each = jnp.arange(bins)

    def reading(shift: int, value: jax.Array) -> jax.Array:
        hit = each == jnp.mod(sector.astype(jnp.int32) + shift, bins)[:, None]
        return jnp.where(hit, value[:, None], 0.0).max(0, initial=0.0)

    lidar = reading(0, closeness)
    if alias:
        lidar = jnp.maximum(lidar, reading(1, within * closeness))
        lidar = jnp.maximum(lidar, reading(-1, (1 - within) * closeness))
    return lidar


def compass(target: jax.Array, position: jax.Array, rotation: jax.Array, size: int) -> jax.Array:
    """Direction of a target [3] in the robot's frame, of length just under 1: float [size]."""
    ego = ((target - position)[:, None] * rotation).sum(0)[:size]
    return ego / (jnp.linalg.norm(ego) + 0.001)


@dataclass
class Shapes:
    """Geoms that rays can meet: kind, size [n, 3] and group are fixed, position and rotation traced."""

    kind: np.ndarray
    size: np.ndarray
    group: np.ndarray
    position: jax.Array
    rotation: jax.Array


def natural_lidar(
    shapes: Shapes, position: jax.Array, rotation: jax.Array, bins: int, group: int, slack: float
) -> jax.Array:
    """exp(-distance) at which `bins` level rays from the robot's centre meet geoms of a group.

    As in the original, nothing of body `robot` itself is met, but its wheels and legs are. Some kinds
    share a group: goal and floor, box and buttons, pillars and walls. Group 6 does not exist in the
    original, so the circle is never seen.

    `slack` (m) thickens every shape, or thins it if negative. A reading that depends on its sign hangs
    on rounding: Car's ball is tangent to its rays, and Doggo's rays start on a surface of its own.
    """
    angles = 2 * jnp.pi * jnp.arange(bins) / bins
    level = jnp.stack([jnp.cos(angles), jnp.sin(angles), jnp.zeros(bins)], -1)
    rays = (level[:, None] * rotation).sum(-1)
    distances = [jnp.full((1, bins), jnp.inf)]
    for kind in sorted({*shapes.kind[shapes.group == group]}):  # all of a kind at once
        if kind not in HITS:
            name = mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
            raise ConfigError(
                f"env.lidar_type=natural: a geom of group {group}, which a lidar observes, is of type "
                f"{name}: expected plane, sphere, capsule, cylinder or box; pseudo takes any"
            )
        which = np.flatnonzero((shapes.group == group) & (shapes.kind == kind))
        hit = jax.vmap(functools.partial(HITS[int(kind)], slack=slack), (0, None, None))

        def meet(place: jax.Array, turn: jax.Array, size: jax.Array, hit: Any = hit) -> jax.Array:
            origin = ((position - place)[:, None] * turn).sum(0)
            return hit((rays[:, :, None] * turn).sum(1), origin, size)

        size = jnp.asarray(shapes.size[which], jnp.float32)
        distances.append(jax.vmap(meet)(shapes.position[which], shapes.rotation[which], size))
    return jnp.exp(-jnp.concatenate(distances).min(0))


# Ray against shape, in the shape's frame: unit direction [3], origin [3], the shape's size [3] ->
# distance, inf if none.


def over(x: jax.Array) -> jax.Array:
    """A divisor that is never 0."""
    return jnp.where(jnp.abs(x) < TINY, TINY, x)


def roots(
    a: jax.Array, b: jax.Array, c: jax.Array, slack: float
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Roots of a t^2 + 2 b t + c and whether they are real; c is a squared distance less a radius."""
    square = b * b - a * c
    root = jnp.sqrt(jnp.maximum(square, TINY))
    return (-b - root) / over(a), (-b + root) / over(a), square >= TINY - slack * a


def nearest_hit(*hits: tuple[jax.Array, jax.Array], slack: float) -> jax.Array:
    """The smallest t >= 0 among (t, whether it counts)."""
    return jnp.stack([jnp.where(ok & (t >= -slack), jnp.maximum(t, 0), jnp.inf) for t, ok in hits]).min(
        0
    )


def hit_plane(d: jax.Array, o: jax.Array, size: Any, slack: float) -> jax.Array:
    t = -o[2] / over(d[2])
    at = jnp.abs(o + t * d)
    inside = (at[0] <= size[0] + slack) & (at[1] <= size[1] + slack)
    return nearest_hit((t, inside & (d[2] < -TINY)), slack=slack)


def hit_sphere(d: jax.Array, o: jax.Array, size: Any, slack: float) -> jax.Array:
    near, far, real = roots((d * d).sum(), (d * o).sum(), (o * o).sum() - size[0] ** 2, slack)
    return nearest_hit((near, real), (far, real), slack=slack)


def hit_side(d: jax.Array, o: jax.Array, size: Any, slack: float) -> jax.Array:
    """The side of an upright cylinder of radius size[0] and half height size[1]."""
    d2, o2 = d[:2], o[:2]
    near, far, real = roots((d2 * d2).sum(), (d2 * o2).sum(), (o2 * o2).sum() - size[0] ** 2, slack)
    within = [(t, real & (jnp.abs(o[2] + t * d[2]) <= size[1] + slack)) for t in (near, far)]
    return nearest_hit(*within, slack=slack)


def hit_cylinder(d: jax.Array, o: jax.Array, size: Any, slack: float) -> jax.Array:
    lids = []
    for z in (-size[1], size[1]):
        t = (z - o[2]) / over(d[2])
        radius = jnp.sqrt(jnp.square((o + t * d)[:2]).sum() + TINY)
        lids.append((t, (radius <= size[0] + slack) & (jnp.abs(d[2]) >= PARALLEL)))
    return jnp.minimum(hit_side(d, o, size, slack), nearest_hit(*lids, slack=slack))


def hit_capsule(d: jax.Array, o: jax.Array, size: Any, slack: float) -> jax.Array:
    caps = []
    for z in (-size[1], size[1]):
        end = o.at[2].add(-z)
        near, far, real = roots((d * d).sum(), (d * end).sum(), (end * end).sum() - size[0] ** 2, slack)
        heights = [(o[2] + t * d[2]) * jnp.sign(z) for t in (near, far)]
        beyond = [real & (height >= jnp.abs(z) - slack) for height in heights]
        caps += [*zip((near, far), beyond, strict=True)]
    return jnp.minimum(hit_side(d, o, size, slack), nearest_hit(*caps, slack=slack))


def hit_box(d: jax.Array, o: jax.Array, size: Any, slack: float) -> jax.Array:
    hits = []
    for axis in range(3):
        i, j = (k for k in range(3) if k != axis)
        for side in (-size[axis], size[axis]):
            t = (side - o[axis]) / over(d[axis])
            at = jnp.abs(o + t * d)
            inside = (at[i] <= size[i] + slack) & (at[j] <= size[j] + slack)
            hits.append((t, inside & (jnp.abs(d[axis]) >= PARALLEL)))
    return nearest_hit(*hits, slack=slack)


HITS = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): hit_plane,
    int(mujoco.mjtGeom.mjGEOM_SPHERE): hit_sphere,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): hit_capsule,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): hit_cylinder,
    int(mujoco.mjtGeom.mjGEOM_BOX): hit_box,
}

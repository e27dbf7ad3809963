"""Contacts for engine `jax` as MuJoCo finds them, for the pairs of shapes where MJX finds others.

    cylinder and box               MJX has no collision
    capsule and box                it misses most contacts of an upright capsule
    cylinder and sphere, capsule   it is centimetres off
    plane and capsule              it has another contact frame if the capsule is upright
    box and plane, box             it has other points

Our collisions are registered with MJX when this module is imported. Only engine `jax` imports it. From
then on they hold for every user of MJX in the process.
"""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.mjx import GeomType
from mujoco.mjx._src import collision_driver, collision_primitive, math
from mujoco.mjx._src.collision_types import GeomInfo

from jaxsafe.envs.engines.jax import boxes, rods

collider: Any = collision_primitive.collider  # (pose and size of each) -> contacts, for MJX
Collision = tuple[jax.Array, jax.Array, jax.Array]  # distance (m), position [3], frame [3, 3]
HALVINGS = 24  # of a capsule's axis
LEVEL = 1e-5  # slope below which it is rounding
NONE = 1.0  # m, the distance of a contact that is not there
CORNERS = np.array([[1.0, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]])  # of a box's upper side


@collider(ncon=2)
def plane_capsule(plane: GeomInfo, capsule: GeomInfo) -> Collision:
    """Contacts of a capsule's two ends, whose first tangent is the capsule's axis, as in C.

    MJX takes a fixed tangent once the axis is within 30 degrees of the normal; with pyramidal friction
    cones the tangents matter, and Doggo's legs are mostly that upright.
    """
    normal, axis = plane.mat[:, 2], capsule.mat[:, 2]
    tangent, length = math.normalize_with_norm(axis - normal * jnp.dot(normal, axis))
    tangent = jnp.where(length < 0.5 * mujoco.mjMINVAL, jnp.array([1.0, 0.0, 0.0]), tangent)
    frame = jnp.array([normal, tangent, jnp.cross(normal, tangent)])
    ends = capsule.pos + jnp.array([1.0, -1.0])[:, None] * axis * capsule.size[1]
    dist = (ends - plane.pos) @ normal - capsule.size[0]
    pos = ends - normal * (capsule.size[0] + 0.5 * dist[:, None])
    return dist, pos, jnp.stack([frame, frame])


@collider(ncon=4)
def plane_box(plane: GeomInfo, box: GeomInfo) -> Collision:
    """Contacts of a box's four lower corners, as in C.

    MJX only has the corners that are at most 1 mm higher than the lowest one.
    """
    normal = plane.mat[:, 2]
    corners = (CORNERS * box.size) @ box.mat.T
    corners *= jnp.where(corners @ normal > 0, -1.0, 1.0)[:, None]  # the opposite one is lower
    dist = (box.pos - plane.pos + corners) @ normal
    pos = box.pos + corners - 0.5 * dist[:, None] * normal
    return dist, pos, jnp.tile(math.make_frame(normal), (4, 1, 1))


@collider(ncon=1)
def sphere_cylinder(sphere: GeomInfo, cylinder: GeomInfo) -> Collision:
    """MJX's own, ten steps of a gradient descent, is up to 2 cm and 25 degrees off."""
    return ball_cylinder(sphere.pos, sphere.size[0], cylinder)


@collider(ncon=1)
def capsule_cylinder(capsule: GeomInfo, cylinder: GeomInfo) -> Collision:
    """The contact of the ball around the point of the capsule's axis that is deepest in the cylinder.

    The distance from the cylinder is convex along the axis. So that point is where its slope changes
    sign. Where the slope is 0 on a stretch, it is the middle of the stretch. (MJX's own is a gradient
    descent, too.)
    """
    axis, half = capsule.mat[:, 2], capsule.size[1]

    def slope(t: jax.Array) -> jax.Array:
        return from_cylinder(capsule.pos + t * axis, cylinder)[1].dot(axis)

    def halve(_: int, bounds: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = bounds
        middle = (low + high) / 2
        rises = jax.vmap(slope)(middle) > jnp.array([-LEVEL, LEVEL])
        return jnp.where(rises, low, middle), jnp.where(rises, middle, high)

    ends = jnp.full(2, half)  # both ends of a level stretch are sought
    low, high = jax.lax.fori_loop(0, HALVINGS, halve, (-ends, ends))
    deepest = (low + high).mean() / 2
    return ball_cylinder(capsule.pos + deepest * axis, capsule.size[0], cylinder)


def ball_cylinder(centre: jax.Array, radius: jax.Array, cylinder: GeomInfo) -> Collision:
    outside, out = from_cylinder(centre, cylinder)
    dist = outside - radius
    return dist, centre - out * (radius + dist / 2), math.make_frame(-out)


def from_cylinder(point: jax.Array, cylinder: GeomInfo) -> tuple[jax.Array, jax.Array]:
    """How far `point` is outside a cylinder (m), and the direction away from it [3]."""
    axis, from_centre = cylinder.mat[:, 2], point - cylinder.pos
    height = from_centre.dot(axis)
    across, reach = math.normalize_with_norm(from_centre - height * axis)
    along = jnp.where(height < 0, -axis, axis)
    beyond = jnp.array([reach - cylinder.size[0], jnp.abs(height) - cylinder.size[1]])
    rim, corner = math.normalize_with_norm(jnp.maximum(beyond, 0.0))
    nearest = jnp.where(beyond[0] > beyond[1], jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]))
    share = jnp.where(beyond.min() > 0, rim, nearest)
    outside = jnp.where(beyond.min() > 0, corner, beyond.max())
    return outside, share[0] * across + share[1] * along


@collider(ncon=2)
def cylinder_box(cylinder: GeomInfo, box: GeomInfo) -> Collision:
    return rod_and_box(cylinder, box, round_ends=False)


@collider(ncon=2)
def capsule_box(capsule: GeomInfo, box: GeomInfo) -> Collision:
    """MJX's own misses most contacts of a box with an upright capsule."""
    return rod_and_box(capsule, box, round_ends=True)


def rod_and_box(shape: GeomInfo, box: GeomInfo, round_ends: bool) -> Collision:
    centre, axis = box.mat.T @ (shape.pos - box.pos), box.mat.T @ shape.mat[:, 2]
    rod = rods.Rod(centre, axis, shape.size[0], shape.size[1], round_ends)
    found = rods.touching(rod, box.size)
    frame = math.make_frame(box.mat @ found.n)
    return (
        jnp.where(jnp.stack([True, found.twice]), found.dist, NONE),
        box.pos + found.pos @ box.mat.T,
        jnp.stack([frame, frame]),
    )


@collider(ncon=boxes.MOST)
def box_box(one: GeomInfo, two: GeomInfo) -> Collision:
    """The contacts of two boxes that MuJoCo finds; MJX's own are other points."""
    turn, away = one.mat.T @ two.mat, one.mat.T @ (two.pos - one.pos)
    found = boxes.touching(boxes.Boxes(turn, away, one.size, two.size))
    frame = math.make_frame(one.mat @ found.normal)
    return found.dist, one.pos + found.pos @ one.mat.T, jnp.tile(frame, (boxes.MOST, 1, 1))


collision_driver._COLLISION_FUNC[GeomType.PLANE, GeomType.CAPSULE] = plane_capsule
collision_driver._COLLISION_FUNC[GeomType.PLANE, GeomType.BOX] = plane_box
collision_driver._COLLISION_FUNC[GeomType.SPHERE, GeomType.CYLINDER] = sphere_cylinder
collision_driver._COLLISION_FUNC[GeomType.CAPSULE, GeomType.CYLINDER] = capsule_cylinder
collision_driver._COLLISION_FUNC[GeomType.CYLINDER, GeomType.BOX] = cylinder_box
collision_driver._COLLISION_FUNC[GeomType.CAPSULE, GeomType.BOX] = capsule_box
collision_driver._COLLISION_FUNC[GeomType.BOX, GeomType.BOX] = box_box

"""Contacts for engine `jax`: as MuJoCo's in C, where MJX has others.

MJX has no collision of a cylinder with a box, misses most of a box with an upright capsule, and is
centimetres off where a cylinder meets a sphere or a capsule. Of a plane with an upright capsule its
contact frame is another, of a box with a plane or a box its points are. Our collisions are registered
with MJX when this module is imported. Only engine `jax` imports it. From then on they hold for every
user of MJX in the process.
"""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.mjx._src import collision_driver, collision_primitive, math
from mujoco.mjx._src.types import GeomType

collider: Any = collision_primitive.collider  # (pose and size of each) -> contacts, for MJX
Collision = tuple[jax.Array, jax.Array, jax.Array]  # distance (m), position [3], frame [3, 3]
FLAT = 0.02  # rad between normal and side (or end) within which it lies flat
PROJECTIONS = 8  # between cylinder and box, towards their closest points
HALVINGS = 24  # of a capsule's axis
LEVEL = 1e-5  # slope below which it is rounding
PARALLEL = 3e-4  # sine between edges below which their crossing is rounding
CORNERS = np.array([[1.0, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]])  # of a box's upper side
SQUARE = CORNERS[:, :2]


@collider(ncon=2)
def plane_capsule(plane: Any, capsule: Any) -> Collision:
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
def plane_box(plane: Any, box: Any) -> Collision:
    """Contacts of a box's four lower corners, as in C.

    MJX has those only that are at most 1 mm higher than the lowest.
    """
    normal = plane.mat[:, 2]
    corners = (CORNERS * box.size) @ box.mat.T
    corners *= jnp.where(corners @ normal > 0, -1.0, 1.0)[:, None]
    dist = (box.pos - plane.pos + corners) @ normal
    pos = box.pos + corners - 0.5 * dist[:, None] * normal
    return dist, pos, jnp.tile(math.make_frame(normal), (4, 1, 1))


@collider(ncon=1)
def sphere_cylinder(sphere: Any, cylinder: Any) -> Collision:
    """MJX's own, ten steps of a gradient descent, is up to 2 cm and 25 degrees off."""
    return ball_cylinder(sphere.pos, sphere.size[0], cylinder)


@collider(ncon=1)
def capsule_cylinder(capsule: Any, cylinder: Any) -> Collision:
    """The contact of the ball around that point of the capsule's axis which is deepest in the cylinder.

    The depth is convex along the axis, so the point is where its slope changes sign, in the middle
    where it is zero on a stretch. (MJX's own is a gradient descent, too.)
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


def ball_cylinder(centre: jax.Array, radius: jax.Array, cylinder: Any) -> Collision:
    outside, out = from_cylinder(centre, cylinder)
    dist = outside - radius
    return dist, centre - out * (radius + dist / 2), math.make_frame(-out)


def from_cylinder(point: jax.Array, cylinder: Any) -> tuple[jax.Array, jax.Array]:
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
def cylinder_box(cylinder: Any, box: Any) -> Collision:
    return rod_box(cylinder, box, cap=0.0)


@collider(ncon=2)
def capsule_box(capsule: Any, box: Any) -> Collision:
    """MJX's own finds most contacts of a box with an upright capsule not at all."""
    return rod_box(capsule, box, cap=1.0)


def rod_box(rod: Any, box: Any, cap: float) -> Collision:
    """The contact of a rod and a box, or two where the rod lies along a face.

    The rod is a cylinder (cap 0), or a capsule (cap 1): a segment with a ball around each point.
    Along a unit vector n from rod to box they are s(n) apart, the gap between the box's nearest
    and the rod's farthest point; the largest s is their distance, or less their depth. Candidates
    for n are the faces of both, the edges of the box against the rod's side, and the line between
    the box and the closest point of a thinner rod, which finds corners and rims.
    """
    radius, half, extent = rod.size[0], rod.size[1], box.size
    centre = box.mat.T @ (rod.pos - box.pos)  # in the box's frame
    axis = box.mat.T @ rod.mat[:, 2]

    def project(point: jax.Array, radius: jax.Array, half: jax.Array) -> jax.Array:
        """The closest point to `point` of a cylinder on the rod's axis."""
        along = axis * (point - centre).dot(axis)
        across = point - centre - along
        across *= jnp.minimum(1.0, radius / jnp.maximum(jnp.linalg.norm(across), 1e-9))
        return centre + axis * jnp.clip(along.dot(axis), -half, half) + across

    def closest(inset: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The closest points of a rod thinner by `inset` (a cylinder also shorter) and of the box."""
        thin, short = radius - jnp.maximum(inset, cap * radius), half - (1 - cap) * inset
        point = centre
        for _ in range(PROJECTIONS):
            point = project(jnp.clip(point, -extent, extent), thin, short)
        return point, jnp.clip(point, -extent, extent)

    # candidates for n: the box's faces, the rod's ends, edges against its side, and lines between pairs
    pairs = [closest(share * jnp.minimum(radius, half)) for share in (1.0, 0.5, 0.1)]
    lines = jnp.stack([*jnp.eye(3), axis, *jnp.cross(jnp.eye(3), axis)])
    lines = jnp.where((lines @ centre > 0)[:, None], -lines, lines)
    lines = jnp.concatenate([lines, jnp.stack([on_box - on_rod for on_rod, on_box in pairs])])
    lengths = jnp.linalg.norm(lines, axis=1)
    lines /= jnp.maximum(lengths, 1e-9)[:, None]

    # s(n) of each, and the n of the largest
    cosine = lines @ axis
    sine = jnp.sqrt(jnp.maximum(1 - cosine**2, 0.0))
    reach = half * jnp.abs(cosine) + radius * jnp.maximum(sine, cap)
    apart = -jnp.abs(lines) @ extent - lines @ centre - reach
    best = jnp.argmax(jnp.where(lengths > 1e-6, apart, -jnp.inf))
    n, dist = lines[best], apart[best]

    # a side that leans less than FLAT on a face
    top = jnp.abs(n).argmax()
    upright = jnp.where(jnp.arange(3) == top, jnp.sign(n), 0.0)
    flat = (n.dot(upright) > 1 - FLAT**2 / 2) & (jnp.abs(axis[top]) < FLAT)
    n = jnp.where(flat, upright, n)

    # from the axis to the rod's farthest point along n
    lean = n.dot(axis)
    across = n - lean * axis
    steep = jnp.linalg.norm(across)
    towards = jnp.clip(centre, -extent, extent) - centre
    inner = towards - axis * towards.dot(axis)
    inner *= jnp.minimum(1.0, radius / jnp.maximum(jnp.linalg.norm(inner), 1e-9))
    side = jnp.where(steep > FLAT, radius * across / jnp.maximum(steep, 1e-9), inner)

    # The part of the rod, from low to high on its axis, that lies on the box. The box's axes that are
    # `free`, square to n, span what touches: two a face, one an edge. As in MuJoCo a face is touched at
    # both ends of that part, or twice at one end if the other is off the face. An edge is touched at
    # high. A rod that does not lie on the box touches at one point.
    free = jnp.abs(n) < FLAT
    lies = jnp.linalg.norm(jnp.where(free, 0.0, axis - lean * n)) < FLAT
    slope = jnp.where(jnp.abs(axis) < 1e-6, 1e-6, axis)
    beside = centre + side
    bounds = jnp.sort(jnp.stack([-extent - beside, extent - beside]) / slope, axis=0)
    low = jnp.max(jnp.where(free, bounds[0], -half), initial=-half)
    high = jnp.min(jnp.where(free, bounds[1], half), initial=half)
    lies &= low < high
    twice = flat & lies
    point = jnp.clip((pairs[0][1] - centre).dot(axis), -half, half)
    point = jnp.where(lies, high, point)
    point = jnp.where(jnp.abs(lean) > FLAT, jnp.sign(lean) * half, point)
    ends = jnp.where(twice, jnp.stack([low, high]), point)
    over = -beside @ n - ends * lean - jnp.abs(n) @ extent  # of the ends, from the face
    ends = jnp.where(twice & (over > 0), ends[over.argmin()], ends)
    dists = jnp.where(twice, jnp.where(over > 0, over.min(), over), dist)

    side = jnp.where((cap > 0) & ~twice, radius * n, side)
    pos = centre + side + 0.5 * dists[:, None] * n + ends[:, None] * axis
    frame = math.make_frame(box.mat @ n)
    none = 1.0  # m, a contact that is not there
    return (
        jnp.where(jnp.stack([True, twice]), dists, none),
        box.pos + pos @ box.mat.T,
        jnp.stack([frame, frame]),
    )


@collider(ncon=8)
def box_box(one: Any, two: Any) -> Collision:
    """The contacts of two boxes that MuJoCo finds; MJX's own are other points.

    Of the boxes' six faces and nine crossings of edges the one along which they are farthest apart, or
    least deep, separates them. A face: of the face that looks at it, the part within its outline
    touches at each vertex that is behind it, eight at most. A crossing: the two edges touch once.
    """
    turn, away = one.mat.T @ two.mat, one.mat.T @ (two.pos - one.pos)  # of box two, in the frame of one
    back = -turn.T @ away

    # how far they are apart, along the normals of faces and along crossings of edges
    faces = jnp.abs(jnp.concatenate([away, back])) - jnp.concatenate(
        [one.size + jnp.abs(turn) @ two.size, two.size + jnp.abs(turn.T) @ one.size]
    )
    lines = jnp.cross(jnp.eye(3)[:, None], turn.T[None]).reshape(9, 3)
    lengths = jnp.linalg.norm(lines, axis=1)
    lines /= jnp.maximum(lengths, 1e-9)[:, None]
    lines *= jnp.where(lines @ away < 0, -1.0, 1.0)[:, None]
    edges = lines @ away - jnp.abs(lines) @ one.size - jnp.abs(lines @ turn) @ two.size
    edges = jnp.where(lengths > PARALLEL, edges, -jnp.inf)
    face, edge = faces.argmax(), edges.argmax()
    normals = jnp.concatenate([jnp.eye(3), turn.T])
    alike = jnp.abs(normals[face] @ lines[edge]) > 0.99  # then a face is as good, with more points
    crossing = edges[edge] > faces[face] + jnp.where(alike, 0.05, 1e-6) * jnp.abs(faces[face])

    first = face < 3
    dists, pos, normal = clipped(
        jnp.where(first, turn, turn.T),
        jnp.where(first, away, back),
        jnp.where(first, one.size, two.size),
        jnp.where(first, two.size, one.size),
        face % 3,
    )
    pos = jnp.where(first, pos, away + pos @ turn.T)
    normal = jnp.where(first, normal, -turn @ normal)

    dist, point = crossed(turn, away, one.size, two.size, lines[edge], edge // 3, edge % 3)
    none = 1.0  # m, a contact that is not there
    dists = jnp.where(crossing, jnp.where(jnp.arange(8) == 0, dist, none), dists)
    pos = jnp.where(crossing, point, pos)
    normal = jnp.where(crossing, lines[edge], normal)
    dists = jnp.where(jnp.maximum(faces[face], edges[edge]) > 0, none, dists)
    frame = math.make_frame(one.mat @ normal)
    return dists, one.pos + pos @ one.mat.T, jnp.tile(frame, (8, 1, 1))


def crossed(
    turn: jax.Array,
    away: jax.Array,
    one: jax.Array,
    two: jax.Array,
    line: jax.Array,
    i: jax.Array,
    j: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Distance and middle of the closest points of box one's edge along axis i and two's along j.

    Of the four parallel edges of each it is the one farthest along `line`, the unit vector from
    box to box that is normal to both.
    """
    way = turn[:, j]
    start = jnp.where(jnp.arange(3) == i, 0.0, jnp.sign(line) * one)
    end = away - turn @ jnp.where(jnp.arange(3) == j, 0.0, jnp.sign(line @ turn) * two)
    gap, cosine = end - start, way[i]
    s = (gap[i] - cosine * way.dot(gap)) / jnp.maximum(1 - cosine**2, PARALLEL**2)
    s = jnp.clip(s, -one[i], one[i])
    t = jnp.clip(cosine * s - way.dot(gap), -two[j], two[j])
    s = jnp.clip(gap[i] + cosine * t, -one[i], one[i])
    near, far = start + s * (jnp.arange(3) == i), end + t * way
    return (far - near).dot(line), (near + far) / 2


def clipped(
    turn: jax.Array, away: jax.Array, size: jax.Array, other: jax.Array, axis: jax.Array
) -> Collision:
    """Distances [8], places [8, 3] and normal [3], where box B touches box A's face on `axis`.

    Args:
        turn, away: axes (columns) and centre of B, in the frame of A.
        size, other: half lengths of A and of B.
    """
    # from here on: x and y along A's face, z off it, towards B; the origin is the face's middle
    order = (axis + jnp.array([1, 2, 0])) % 3  # of coordinates: along the face, then off it
    up = jnp.where(away[axis] < 0, -1.0, 1.0)
    mirror = jnp.array([1.0, 1.0, up])
    size, centre = size[order], away[order] * mirror - size[order] * jnp.array([0.0, 0, 1])
    turn = turn[order] * mirror[:, None]

    # B's side that faces A, of centre +- u +- v
    facing = (jnp.abs(turn[2]).argmax() + jnp.array([1, 2, 0])) % 3
    u, v, w = (turn[:, facing] * other[facing]).T
    centre -= jnp.sign(w[2]) * w
    corners = centre + SQUARE @ jnp.stack([u, v])

    # each side within the outline, from where it comes in to where it goes out
    sides = jnp.roll(corners, -1, 0) - corners
    slope = jnp.where(jnp.abs(sides[:, :2]) < 1e-9, 1e-9, sides[:, :2])
    bounds = (jnp.stack([-size[:2], size[:2]])[:, None] - corners[:, :2]) / slope
    begin = jnp.clip(bounds.min(0).max(1), min=0.0)
    end = jnp.clip(bounds.max(0).min(1), max=1.0)
    inside = begin <= end
    points = [corners + begin[:, None] * sides, corners + end[:, None] * sides]

    # corners of the outline over the face
    area = u[0] * v[1] - u[1] * v[0]
    outline = SQUARE * size[:2]
    off = outline - centre[:2]
    along_u = (off[:, 0] * v[1] - off[:, 1] * v[0]) / area
    along_v = (off[:, 1] * u[0] - off[:, 0] * u[1]) / area
    over = (jnp.abs(along_u) < 1) & (jnp.abs(along_v) < 1)
    points.append(jnp.column_stack([outline, centre[2] + along_u * u[2] + along_v * v[2]]))

    # of all these points the eight deepest
    points = jnp.concatenate(points)
    there = jnp.concatenate([inside, inside & (end < 1), over]) & (points[:, 2] <= 0)
    dists, chosen = jax.lax.top_k(-jnp.where(there, points[:, 2], 1.0), 8)
    x, y, z = points[chosen].T
    back = jnp.argsort(order)
    pos = jnp.stack([x, y, up * (size[2] + z / 2)])[back].T
    return -dists, pos, up * (jnp.arange(3) == axis)


collision_driver._COLLISION_FUNC[GeomType.PLANE, GeomType.CAPSULE] = plane_capsule
collision_driver._COLLISION_FUNC[GeomType.PLANE, GeomType.BOX] = plane_box
collision_driver._COLLISION_FUNC[GeomType.SPHERE, GeomType.CYLINDER] = sphere_cylinder
collision_driver._COLLISION_FUNC[GeomType.CAPSULE, GeomType.CYLINDER] = capsule_cylinder
collision_driver._COLLISION_FUNC[GeomType.CYLINDER, GeomType.BOX] = cylinder_box
collision_driver._COLLISION_FUNC[GeomType.CAPSULE, GeomType.BOX] = capsule_box
collision_driver._COLLISION_FUNC[GeomType.BOX, GeomType.BOX] = box_box

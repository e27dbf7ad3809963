"""Contacts of two boxes, by the directions that may separate them, as MuJoCo finds them.

Candidates are the normals of the boxes' six faces, and the nine directions that are normal to an edge
of each. The boxes are separated by the one along which they are farthest apart, or least deep. If it is
the normal of a face, the other box's face that looks at it is cut to its outline, and touches at each
vertex that is behind it, eight at most. If it is normal to two edges, these touch once.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

PARALLEL = 3e-4  # sine between edges below which their crossing is rounding
SQUARE = np.array([[1.0, 1], [-1, 1], [-1, -1], [1, -1]])  # corners, in the order of an outline
MOST = 8  # points of contact
NONE = 1.0  # m, the distance of a contact that is not there


class Boxes(NamedTuple):
    """Two boxes in the frame of box one.

    turn: [3, 3], the axes of box two in columns. away: [3], its centre. one, two: [3], half lengths.
    """

    turn: jax.Array
    away: jax.Array
    one: jax.Array
    two: jax.Array

    @property
    def swapped(self) -> "Boxes":
        """In the frame of box two, as if that were box one."""
        return Boxes(self.turn.T, -self.turn.T @ self.away, self.two, self.one)


class Crossings(NamedTuple):
    """Axis i of box one crossed with axis j of box two, at 3 i + j.

    lines: [9, 3], unit vectors from box to box that are normal to both. apart: [9], how far the boxes
    are apart along them, m.
    """

    lines: jax.Array
    apart: jax.Array


class Points(NamedTuple):
    """Up to `MOST` points of contact: distances [MOST], m; positions [MOST, 3]; their normal [3]."""

    dist: jax.Array
    pos: jax.Array
    normal: jax.Array


def touching(boxes: Boxes) -> Points:
    """Where the boxes touch, in the frame of box one."""
    faces, crossings = apart_along_faces(boxes), apart_along_crossings(boxes)
    face, edge = faces.argmax(), crossings.apart.argmax()
    normals = jnp.concatenate([jnp.eye(3), boxes.turn.T])
    alike = jnp.abs(normals[face] @ crossings.lines[edge]) > 0.99  # a face is as good, with more points
    margin = jnp.where(alike, 0.05, 1e-6) * jnp.abs(faces[face])
    crossing = crossings.apart[edge] > faces[face] + margin

    on_face = on_either_face(boxes, face)
    on_edge = at_crossing(boxes, crossings.lines[edge], edge // 3, edge % 3)
    found = jax.tree.map(partial(jnp.where, crossing), on_edge, on_face)
    separate = jnp.maximum(faces[face], crossings.apart[edge]) > 0
    return found._replace(dist=jnp.where(separate, NONE, found.dist))


# ---- how far the boxes are apart -----------------------------------------------------------------


def apart_along_faces(boxes: Boxes) -> jax.Array:
    """Along the axes of box one, and of box two [6], m."""
    turn, back = boxes.turn, boxes.swapped.away
    reach_one = boxes.one + jnp.abs(turn) @ boxes.two
    reach_two = boxes.two + jnp.abs(turn.T) @ boxes.one
    return jnp.abs(jnp.concatenate([boxes.away, back])) - jnp.concatenate([reach_one, reach_two])


def apart_along_crossings(boxes: Boxes) -> Crossings:
    """-inf along edges that are parallel."""
    turn, away = boxes.turn, boxes.away
    lines = jnp.cross(jnp.eye(3)[:, None], turn.T[None]).reshape(9, 3)
    lengths = jnp.linalg.norm(lines, axis=1)
    lines /= jnp.maximum(lengths, 1e-9)[:, None]
    lines *= jnp.where(lines @ away < 0, -1.0, 1.0)[:, None]
    apart = lines @ away - jnp.abs(lines) @ boxes.one - jnp.abs(lines @ turn) @ boxes.two
    return Crossings(lines, jnp.where(lengths > PARALLEL, apart, -jnp.inf))


# ---- two edges that cross ------------------------------------------------------------------------


def at_crossing(boxes: Boxes, line: jax.Array, i: jax.Array, j: jax.Array) -> Points:
    """The middle of the closest points of box one's edge along axis i and two's along j.

    Of the four parallel edges of each it is the one farthest along `line`, the unit vector from
    box to box that is normal to both.
    """
    turn, away, one, two = boxes
    way = turn[:, j]
    start = jnp.where(jnp.arange(3) == i, 0.0, jnp.sign(line) * one)
    end = away - turn @ jnp.where(jnp.arange(3) == j, 0.0, jnp.sign(line @ turn) * two)
    gap, cosine = end - start, way[i]
    s = (gap[i] - cosine * way.dot(gap)) / jnp.maximum(1 - cosine**2, PARALLEL**2)
    s = jnp.clip(s, -one[i], one[i])
    t = jnp.clip(cosine * s - way.dot(gap), -two[j], two[j])
    s = jnp.clip(gap[i] + cosine * t, -one[i], one[i])
    near, far = start + s * (jnp.arange(3) == i), end + t * way
    dist, pos = (far - near).dot(line), (near + far) / 2
    dists = jnp.where(jnp.arange(MOST) == 0, dist, NONE)
    return Points(dists, jnp.broadcast_to(pos, (MOST, 3)), line)


# ---- a face on a box -----------------------------------------------------------------------------


class Face(NamedTuple):
    """The points centre +- u +- v, [3] each."""

    centre: jax.Array
    u: jax.Array
    v: jax.Array


class Vertices(NamedTuple):
    """Points [n, 3] that may be vertices, and whether they are, bool [n]."""

    points: jax.Array
    there: jax.Array


def on_either_face(boxes: Boxes, face: jax.Array) -> Points:
    """Where the boxes touch at `face`: 0, 1, 2 of box one, 3, 4, 5 of box two."""
    first = face < 3
    found = on_face(jax.tree.map(partial(jnp.where, first), boxes, boxes.swapped), face % 3)
    return Points(
        found.dist,
        jnp.where(first, found.pos, boxes.away + found.pos @ boxes.turn.T),
        jnp.where(first, found.normal, -boxes.turn @ found.normal),
    )


def on_face(boxes: Boxes, axis: jax.Array) -> Points:
    """Where box two touches box one's face on `axis`."""
    # from here on: x and y along the face, z off it, towards box two; the origin is the face's middle
    order = (axis + jnp.array([1, 2, 0])) % 3  # of coordinates: along the face, then off it
    up = jnp.where(boxes.away[axis] < 0, -1.0, 1.0)
    mirror = jnp.array([1.0, 1.0, up])
    size = boxes.one[order]
    centre = boxes.away[order] * mirror - size * jnp.array([0.0, 0, 1])
    facing = face_below(boxes.turn[order] * mirror[:, None], centre, boxes.two)
    found = [sides_within(facing, size), corners_under(facing, size)]
    points, there = (jnp.concatenate(x) for x in zip(*found, strict=True))

    there &= points[:, 2] <= 0
    depth, deepest = jax.lax.top_k(-jnp.where(there, points[:, 2], NONE), MOST)
    x, y, z = points[deepest].T
    pos = jnp.stack([x, y, up * (size[2] + z / 2)])[jnp.argsort(order)].T
    return Points(-depth, pos, up * (jnp.arange(3) == axis))


def face_below(turn: jax.Array, centre: jax.Array, size: jax.Array) -> Face:
    """The face of a box with axes `turn` (columns) that looks down most."""
    facing = (jnp.abs(turn[2]).argmax() + jnp.array([1, 2, 0])) % 3
    u, v, w = (turn[:, facing] * size[facing]).T
    return Face(centre - jnp.sign(w[2]) * w, u, v)


def sides_within(face: Face, size: jax.Array) -> Vertices:
    """Where each side of `face` enters the outline of half lengths `size`, and where it leaves it."""
    corners = face.centre + SQUARE @ jnp.stack([face.u, face.v])
    sides = jnp.roll(corners, -1, 0) - corners
    slope = jnp.where(jnp.abs(sides[:, :2]) < 1e-9, 1e-9, sides[:, :2])
    bounds = (jnp.stack([-size[:2], size[:2]])[:, None] - corners[:, :2]) / slope
    begin = jnp.clip(bounds.min(0).max(1), min=0.0)
    end = jnp.clip(bounds.max(0).min(1), max=1.0)
    inside = begin <= end
    points = jnp.concatenate([corners + begin[:, None] * sides, corners + end[:, None] * sides])
    return Vertices(points, jnp.concatenate([inside, inside & (end < 1)]))


def corners_under(face: Face, size: jax.Array) -> Vertices:
    """The corners of the outline of half lengths `size`, as points of `face`, which is over them."""
    centre, u, v = face
    area = u[0] * v[1] - u[1] * v[0]
    outline = SQUARE * size[:2]
    off = outline - centre[:2]
    along_u = (off[:, 0] * v[1] - off[:, 1] * v[0]) / area
    along_v = (off[:, 1] * u[0] - off[:, 0] * u[1]) / area
    over = (jnp.abs(along_u) < 1) & (jnp.abs(along_v) < 1)
    return Vertices(jnp.column_stack([outline, centre[2] + along_u * u[2] + along_v * v[2]]), over)

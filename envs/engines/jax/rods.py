"""Contacts of a rod and a box, by the directions that may separate them.

Along a unit vector n from rod to box they are s(n) apart, the gap between the box's nearest and the
rod's farthest point. The largest s is their distance or, below 0, minus their depth. Candidates for n
are the faces of both, the edges of the box against the rod's side, and the lines from a thinner rod to
the box, which find corners and rims.

All is in the frame of the box, whose middle is the origin. `extent` [3] are half its lengths.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

FLAT = 0.02  # rad between normal and side (or end) within which it lies flat
PROJECTIONS = 8  # between rod and box, towards their closest points


class Rod(NamedTuple):
    """A cylinder or, if it is `round`, a capsule: a segment with a ball around each of its points.

    centre, axis: [3]. radius: m. half: m, from the centre to the ends of the cylinder or the segment.
    """

    centre: jax.Array
    axis: jax.Array
    radius: jax.Array
    half: jax.Array
    round: bool

    def cores(self) -> list["Rod"]:
        """Thinner rods, of which the first is the thinnest: a capsule's segment; cylinders whose
        surfaces are the same distance inside everywhere."""
        if self.round:
            return [self._replace(radius=jnp.zeros(()))]
        insets = [share * jnp.minimum(self.radius, self.half) for share in (1.0, 0.5, 0.1)]
        return [self._replace(radius=self.radius - x, half=self.half - x) for x in insets]

    def project(self, point: jax.Array) -> jax.Array:
        """The closest point to `point` [3] of the cylinder."""
        along = self.axis * (point - self.centre).dot(self.axis)
        across = within(point - self.centre - along, self.radius)
        return self.centre + self.axis * jnp.clip(along.dot(self.axis), -self.half, self.half) + across

    def reach(self, lines: jax.Array) -> jax.Array:
        """How far the rod goes from its centre along `lines` [n, 3]."""
        cosine = lines @ self.axis
        if self.round:
            return self.half * jnp.abs(cosine) + self.radius
        sine = jnp.sqrt(jnp.maximum(1 - cosine**2, 0.0))
        return self.half * jnp.abs(cosine) + self.radius * sine


class Gap(NamedTuple):
    """The closest points of a thinner rod and of the box, [3] each: one of each."""

    on_rod: jax.Array
    on_box: jax.Array


class Normal(NamedTuple):
    """n [3], and how it lies to the rod.

    lean: its cosine to the rod's axis. across: [3], its part square to that axis. flat: bool [], the
    rod's side lies along the face of which n is the normal.
    """

    n: jax.Array
    lean: jax.Array
    across: jax.Array
    flat: jax.Array


class Stretch(NamedTuple):
    """A part of the rod, from low to high along its axis, m. lies: bool [], whether there is one."""

    low: jax.Array
    high: jax.Array
    lies: jax.Array


class Points(NamedTuple):
    """Two points of contact: distance [2], m; position [2, 3]; n [3]; and whether the second is
    there."""

    dist: jax.Array
    pos: jax.Array
    n: jax.Array
    twice: jax.Array


def touching(rod: Rod, extent: jax.Array) -> Points:
    """Where rod and box touch: once, or twice where the rod lies along a face.

    As in MuJoCo a face is touched at both ends of the part that lies on it, or twice at one end if the
    other is off the face. An edge is touched at the part's high end.
    """
    gaps = [closest(core, extent) for core in rod.cores()]
    n, dist = farthest_apart(rod, extent, gaps)
    normal = laid_flat(rod, n)
    n = normal.n
    side = outermost(rod, normal, extent)
    part = on_box(rod, normal, rod.centre + side, extent)
    twice = normal.flat & part.lies

    # where on its axis the rod touches once: by the closest point, on an edge, or at an end
    once = jnp.clip((gaps[0].on_box - rod.centre).dot(rod.axis), -rod.half, rod.half)
    once = jnp.where(part.lies, part.high, once)
    once = jnp.where(jnp.abs(normal.lean) > FLAT, jnp.sign(normal.lean) * rod.half, once)
    ends = jnp.where(twice, jnp.stack([part.low, part.high]), once)
    beside = rod.centre + side
    over = -beside @ n - ends * normal.lean - jnp.abs(n) @ extent  # how far each end is off the face
    ends = jnp.where(twice & (over > 0), ends[over.argmin()], ends)
    dists = jnp.where(twice, jnp.where(over > 0, over.min(), over), dist)

    if rod.round:
        side = jnp.where(~twice, rod.radius * n, side)
    pos = rod.centre + side + 0.5 * dists[:, None] * n + ends[:, None] * rod.axis
    return Points(dists, pos, n, twice)


def closest(core: Rod, extent: jax.Array) -> Gap:
    point = core.centre
    for _ in range(PROJECTIONS):
        point = core.project(jnp.clip(point, -extent, extent))
    return Gap(point, jnp.clip(point, -extent, extent))


def farthest_apart(rod: Rod, extent: jax.Array, gaps: list[Gap]) -> tuple[jax.Array, jax.Array]:
    """The n of the largest s(n), and that s, m."""
    lines = jnp.stack([*jnp.eye(3), rod.axis, *jnp.cross(jnp.eye(3), rod.axis)])
    lines = jnp.where((lines @ rod.centre > 0)[:, None], -lines, lines)
    lines = jnp.concatenate([lines, jnp.stack([gap.on_box - gap.on_rod for gap in gaps])])
    lengths = jnp.linalg.norm(lines, axis=1)
    lines /= jnp.maximum(lengths, 1e-9)[:, None]
    apart = -jnp.abs(lines) @ extent - lines @ rod.centre - rod.reach(lines)
    best = jnp.argmax(jnp.where(lengths > 1e-6, apart, -jnp.inf))
    return lines[best], apart[best]


def laid_flat(rod: Rod, n: jax.Array) -> Normal:
    """n, made the normal of a face on which the rod's side leans less than `FLAT`."""
    top = jnp.abs(n).argmax()
    upright = jnp.where(jnp.arange(3) == top, jnp.sign(n), 0.0)
    flat = (n.dot(upright) > 1 - FLAT**2 / 2) & (jnp.abs(rod.axis[top]) < FLAT)
    n = jnp.where(flat, upright, n)
    lean = n.dot(rod.axis)
    return Normal(n, lean, n - lean * rod.axis, flat)


def outermost(rod: Rod, normal: Normal, extent: jax.Array) -> jax.Array:
    """From the rod's axis to its farthest point along n [3]. On an end, towards the box."""
    steep = jnp.linalg.norm(normal.across)
    towards = jnp.clip(rod.centre, -extent, extent) - rod.centre
    inner = within(towards - rod.axis * towards.dot(rod.axis), rod.radius)
    return jnp.where(steep > FLAT, rod.radius * normal.across / jnp.maximum(steep, 1e-9), inner)


def on_box(rod: Rod, normal: Normal, beside: jax.Array, extent: jax.Array) -> Stretch:
    """The part of the rod that lies on the box. `beside` [3] is next to its centre, at the box.

    The box's axes that are `free`, square to n, span what touches: two a face, one an edge.
    """
    free = jnp.abs(normal.n) < FLAT
    lies = jnp.linalg.norm(jnp.where(free, 0.0, rod.axis - normal.lean * normal.n)) < FLAT
    slope = jnp.where(jnp.abs(rod.axis) < 1e-6, 1e-6, rod.axis)
    bounds = jnp.sort(jnp.stack([-extent - beside, extent - beside]) / slope, axis=0)
    low = jnp.max(jnp.where(free, bounds[0], -rod.half), initial=-rod.half)
    high = jnp.min(jnp.where(free, bounds[1], rod.half), initial=rod.half)
    return Stretch(low, high, lies & (low < high))


def within(vector: jax.Array, length: jax.Array) -> jax.Array:
    """`vector`, no longer than `length`."""
    return vector * jnp.minimum(1.0, length / jnp.maximum(jnp.linalg.norm(vector), 1e-9))

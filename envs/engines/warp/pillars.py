"""Contacts of boxes with pillars, in closed form.

MuJoCo Warp's convex collisions work in float32. Now and then they miss touches of a box and an upright
cylinder that are up to 0.06 mm deep: a robot that leans on a pillar touches it in one substep and not
in the next. Seen from above, the pillar is a circle and the box's shadow is a polygon, and for these
there is a formula. As in MuJoCo, a side that lies flat has two contacts. A standing edge has one, at
its upper end.

A pillar is an upright cylinder of a mocap body, with ends out of the boxes' reach.
"""
# Kernels are Warp's language in Python's syntax, which no type checker of Python knows:
# pyright: reportIndexIssue=false, reportAssignmentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportInvalidTypeForm=false

import dataclasses
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import warp as wp
from mujoco.mjx.third_party import mujoco_warp
from mujoco.mjx.third_party.mujoco_warp._src.collision_core import (
    contact_material_params,
    write_contact,
)
from mujoco.mjx.third_party.mujoco_warp._src.math import make_frame

vec5 = wp.types.vector(length=5, dtype=float)
FLAT = wp.constant(0.02)  # rad that a side may lean and still lie flat
TINY = wp.constant(1e-6)  # m, an edge whose shadow is a point


@wp.func
def gap(n: wp.vec2, away: wp.vec2, ux: wp.vec3, uy: wp.vec3) -> float:
    """Between the point `away` from a box's centre and the box's shadow, along the unit vector n."""
    shadow = 0.0
    for i in range(3):
        shadow += wp.abs(ux[i] * n[0] + uy[i] * n[1])
    return wp.dot(n, away) - shadow


@wp.func
def towards(away: wp.vec2, ux: wp.vec3, uy: wp.vec3) -> tuple[wp.vec2, int]:
    """The unit vector along which the gap is largest, and the edge across which it is, -1: a corner."""
    best, edge = wp.vec2(1.0, 0.0), (-1)
    largest = -1e10
    for i in range(3):
        across = wp.vec2(uy[i], -ux[i])
        if wp.length(across) > TINY:
            n = wp.normalize(across)
            if wp.dot(n, away) < 0.0:
                n = -n
            along = gap(n, away, ux, uy)
            if along > largest:
                largest, best, edge = along, n, i
    for corner in range(8):
        way = wp.vec2(away[0], away[1])
        for i in range(3):
            sign = wp.where((corner >> i) & 1, 1.0, -1.0)
            way -= sign * wp.vec2(ux[i], uy[i])
        if wp.length(way) > TINY:
            n = wp.normalize(way)
            along = gap(n, away, ux, uy)
            if along > largest:
                largest, best, edge = along, n, -1
    return best, edge


@wp.func
def touch(
    pillar: wp.vec3, radius: float, at: wp.vec3, axes: wp.mat33, size: wp.vec3
) -> tuple[wp.vec2, wp.vec2, wp.vec3, bool]:
    """Where a pillar and a box touch: at both ends of a side that lies flat, else at one point.

    Args:
        pillar, at: centres, m.
        axes: the box's, in columns.
        size: half lengths of the box, m.
    Returns:
        distances and heights of both ends, m, or of the point, twice.
        the normal from the box to the pillar, and whether the box lies flat.
    """
    ux = wp.cw_mul(axes[0], size)  # the edges' shadows
    uy = wp.cw_mul(axes[1], size)
    away = wp.vec2(pillar[0] - at[0], pillar[1] - at[1])
    n, edge = towards(away, ux, uy)
    dist = gap(n, away, ux, uy) - radius
    up = axes[2]
    stands = 0  # the axis of the box that is nearest to upright
    for i in range(1, 3):
        if wp.abs(up[i]) > wp.abs(up[stands]):
            stands = i
    facing = wp.vec3(
        axes[0, 0] * n[0] + axes[1, 0] * n[1],
        axes[0, 1] * n[0] + axes[1, 1] * n[1],
        axes[0, 2] * n[0] + axes[1, 2] * n[1],
    )
    normal = wp.vec3(n[0], n[1], 0.0)
    if edge >= 0 and edge != stands and wp.abs(facing[stands]) < FLAT:
        side = 3 - edge - stands
        normal = wp.sign(facing[side]) * wp.vec3(axes[0, side], axes[1, side], axes[2, side])
        begin = -size[stands] * up[stands] + wp.sign(facing[side]) * size[side] * up[side]
        centre = axes[0, edge] * away[0] + axes[1, edge] * away[1]
        begin += wp.clamp(centre, -size[edge], size[edge]) * up[edge]
        rise = 2.0 * size[stands] * up[stands]
        heights = wp.vec2(begin, begin + rise)
        out = size[stands] * wp.abs(facing[stands])
        bend = size[stands] * facing[stands]
        dists = wp.vec2(dist + out + bend, dist + out - bend)
        return dists, heights + wp.vec2(at[2], at[2]), normal, True
    height = at[2]
    for i in range(3):
        end = wp.sign(facing[i])
        if i == stands and wp.abs(facing[i]) < TINY:
            end = wp.sign(up[i])
        height += end * size[i] * up[i]
    return wp.vec2(dist, dist), wp.vec2(height, height), normal, False


@wp.struct
class Geoms:
    """The model's fields that say where geoms are and what they are made of."""

    geom_size: wp.array2d[wp.vec3]
    geom_condim: wp.array[int]
    geom_priority: wp.array[int]
    geom_solmix: wp.array2d[float]
    geom_solref: wp.array2d[wp.vec2]
    geom_solimp: wp.array2d[vec5]
    geom_friction: wp.array2d[wp.vec3]
    geom_adhesion: wp.array2d[float]
    pair_dim: wp.array[int]
    pair_solref: wp.array2d[wp.vec2]
    pair_solreffriction: wp.array2d[wp.vec2]
    pair_solimp: wp.array2d[vec5]
    pair_adhesion: wp.array2d[float]
    pair_friction: wp.array2d[vec5]
    geom_xpos: wp.array2d[wp.vec3]
    geom_xmat: wp.array2d[wp.mat33]


@wp.struct
class Contacts:
    """The list of contacts of all worlds, and how many it has room for."""

    dist: wp.array[float]
    pos: wp.array[wp.vec3]
    frame: wp.array[wp.mat33]
    includemargin: wp.array[float]
    friction: wp.array[vec5]
    solref: wp.array[wp.vec2]
    solreffriction: wp.array[wp.vec2]
    solimp: wp.array[vec5]
    dim: wp.array[int]
    geom: wp.array[wp.vec2i]
    efc_address: wp.array2d[int]
    worldid: wp.array[int]
    type: wp.array[int]
    geomcollisionid: wp.array[int]
    adhesion: wp.array[float]
    count: wp.array[int]
    room: int


@wp.kernel(enable_backward=False)
def pillar_contacts(pairs: wp.array[wp.vec2i], m: Geoms, out: Contacts):
    world, i = wp.tid()
    pair = pairs[i]
    pillar = m.geom_xpos[world, pair[0]]
    shape = m.geom_size[world % m.geom_size.shape[0], pair[0]]
    at, axes = m.geom_xpos[world, pair[1]], m.geom_xmat[world, pair[1]]
    size = m.geom_size[world % m.geom_size.shape[0], pair[1]]
    far = shape[0] + wp.length(size)
    if wp.length_sq(wp.vec2(pillar[0] - at[0], pillar[1] - at[1])) > far * far:
        return
    tall = shape[1] + wp.dot(wp.abs(axes[2]), size)
    if wp.abs(pillar[2] - at[2]) > tall:
        return
    dists, heights, n, flat = touch(pillar, shape[0], at, axes, size)
    deepest = wp.where(dists[0] < dists[1], 0, 1)
    if dists[deepest] >= 0.0:
        return
    condim, friction, solref, solreffriction, solimp, adhesion = contact_material_params(
        m.geom_condim, m.geom_priority, m.geom_solmix, m.geom_solref, m.geom_solimp, m.geom_friction,
        m.geom_adhesion, m.pair_dim, m.pair_solref, m.pair_solreffriction, m.pair_solimp,
        m.pair_adhesion, m.pair_friction, pair, -1, world,
    )  # fmt: skip
    frame = make_frame(-n)
    for k in range(wp.where(flat, 2, 1)):
        end = wp.where(dists[k] < 0.0, k, deepest)  # of a side that leans MuJoCo has one end twice
        back = shape[0] + 0.5 * dists[end]
        pos = wp.vec3(pillar[0] - back * n[0], pillar[1] - back * n[1], heights[end])
        write_contact(
            out.room, k, dists[end], pos, frame, 0.0, 0.0, condim, friction, solref, solreffriction,
            solimp, adhesion, pair, wp.vec2i(-1, -1), world, out.dist, out.pos, out.frame,
            out.includemargin, out.friction, out.solref, out.solreffriction, out.solimp, out.dim,
            out.geom, out.efc_address, out.worldid, out.type, out.geomcollisionid, out.adhesion,
            out.count,
        )  # fmt: skip


@dataclasses.dataclass
class Pillars:
    """Launches the kernel for one `Data`."""

    pairs: wp.array
    geoms: Any
    out: Any

    def contacts(self, worlds: int) -> None:
        inputs = [self.pairs, self.geoms, self.out]
        wp.launch(pillar_contacts, (worlds, len(self.pairs)), inputs=inputs)


def adopt(model: mujoco.MjModel, m: Any, d: Any, upright: Sequence[str]) -> Pillars | None:
    """Take pairs of a box and a pillar from MuJoCo Warp; None: there are none.

    Args:
        model: what `m` and `d` were made of.
        upright: the names of the pillars' bodies.
    """
    cylinder, box = (int(t) for t in (mujoco_warp.GeomType.CYLINDER, mujoco_warp.GeomType.BOX))
    stands = (np.abs(model.geom_quat[:, 1:3]) < 1e-6).all(1)
    named = np.isin(model.geom_bodyid, [model.body(name).id for name in upright])
    fixed = model.body_mocapid[model.geom_bodyid] >= 0
    pillar = (model.geom_type == cylinder) & stands & named & fixed & (model.geom_margin == 0)
    plain = (model.geom_type == box) & (model.geom_margin == 0)
    given, ids = m.nxn_geom_pair_filtered.numpy(), m.nxn_pairid_filtered.numpy()
    first, second = given.T
    either = pillar[first] & plain[second] | plain[first] & pillar[second]
    ours = either & (ids == -1).all(1)  # neither a pair with settings of its own nor a sensor's
    if m.opt.broadphase != mujoco_warp.BroadphaseType.NXN or not ours.any():
        return None
    device = d.qacc.device
    m.nxn_geom_pair_filtered = wp.array(given[~ours], dtype=wp.vec2i, device=device)
    m.nxn_pairid_filtered = wp.array(ids[~ours], dtype=wp.vec2i, device=device)
    pairs = np.where(pillar[first][:, None], given, given[:, ::-1])[ours]
    geoms, out = Geoms(), Contacts()
    for name in Geoms.vars:
        setattr(geoms, name, getattr(m if hasattr(m, name) else d, name))
    for name in Contacts.vars.keys() - {"count", "room"}:
        setattr(out, name, getattr(d.contact, name))
    out.count, out.room = d.nacon, d.naconmax
    return Pillars(wp.array(pairs, dtype=wp.vec2i, device=device), geoms, out)

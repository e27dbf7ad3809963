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

from collections.abc import Sequence

import mujoco
import numpy as np
import warp as wp
from mujoco.mjx.third_party import mujoco_warp

CYLINDER, BOX = int(mujoco_warp.GeomType.CYLINDER), int(mujoco_warp.GeomType.BOX)
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


def upright_pairs(model: mujoco.MjModel, pairs: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Which of `pairs` of geoms [P, 2] are a box and an upright cylinder of `names`, bool [P]."""
    stands = (np.abs(model.geom_quat[:, 1:3]) < 1e-6).all(1)
    named = np.isin(model.geom_bodyid, [model.body(name).id for name in names])
    fixed = model.body_mocapid[model.geom_bodyid] >= 0
    close = (model.geom_margin == 0) & (model.geom_gap == 0)
    pillar = (model.geom_type == CYLINDER) & stands & named & fixed & close
    box = (model.geom_type == BOX) & close
    first, second = pairs.T
    return pillar[first] & box[second] | box[first] & pillar[second]

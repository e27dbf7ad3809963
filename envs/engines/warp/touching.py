"""How two geoms touch, for kinds of geoms that have a formula.

The formulas are MuJoCo Warp's, but for a capsule on a plane. MuJoCo Warp writes the contacts of each
formula by code of its own. Here all return the same, `Touch`, which is written in one place: less code,
that compiles sooner.
"""
# Kernels are Warp's language in Python's syntax, which no type checker of Python knows:
# pyright: reportIndexIssue=false, reportAssignmentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportInvalidTypeForm=false

import warp as wp
from mujoco.mjx.third_party import mujoco_warp
from mujoco.mjx.third_party.mujoco_warp._src import collision_primitive
from mujoco.mjx.third_party.mujoco_warp._src import collision_primitive_core as core
from mujoco.mjx.third_party.mujoco_warp._src.collision_core import Geom
from mujoco.mjx.third_party.mujoco_warp._src.math import make_frame


@wp.struct
class Touch:
    """Points that may be contacts, and the frame of the first of them and of the others."""

    count: int
    dist: core.vec8f
    pos: core.mat83f
    frame: wp.mat33
    frame_of_others: wp.mat33


@wp.func
def once(dist: float, pos: wp.vec3, normal: wp.vec3) -> Touch:
    found = Touch()
    found.count = 1
    found.dist[0] = dist
    found.pos[0] = pos
    found.frame = make_frame(normal)
    return found


@wp.func
def twice(dist: wp.vec2, pos: core.mat23f, frame: wp.mat33, other: wp.mat33) -> Touch:
    found = Touch()
    found.count = 2
    for k in range(2):
        found.dist[k] = dist[k]
        found.pos[k] = pos[k]
    found.frame = frame
    found.frame_of_others = other
    return found


@wp.func
def plane_sphere(one: Geom, other: Geom, margin: float, gap: float) -> Touch:
    dist, pos = core.plane_sphere(one.normal, one.pos, other.pos, other.size[0])
    return once(dist, pos, one.normal)


@wp.func
def capsule_on_plane(
    normal: wp.vec3,
    plane_pos: wp.vec3,
    pos: wp.vec3,
    axis: wp.vec3,
    radius: float,
    half_length: float,
) -> tuple[wp.vec2, core.mat23f, wp.mat33]:
    """Contacts of a capsule's two ends, with the frame of MuJoCo in C.

    There the first tangent is the capsule's axis, however little of it lies in the plane. MuJoCo Warp
    takes a fixed tangent once the axis is within 30 degrees of the normal; with pyramidal friction
    cones the tangents matter, and Doggo's legs are mostly that upright.
    """
    tangent = wp.normalize(axis - normal * wp.dot(normal, axis))
    if wp.length(tangent) < 0.5:
        tangent = wp.vec3(1.0, 0.0, 0.0)
    other = wp.cross(normal, tangent)
    frame = wp.mat33(
        normal[0], normal[1], normal[2],
        tangent[0], tangent[1], tangent[2],
        other[0], other[1], other[2],
    )  # fmt: skip
    end1, end2 = pos + axis * half_length, pos - axis * half_length
    dist1 = wp.dot(end1 - plane_pos, normal) - radius
    dist2 = wp.dot(end2 - plane_pos, normal) - radius
    at1 = end1 - normal * (radius + 0.5 * dist1)
    at2 = end2 - normal * (radius + 0.5 * dist2)
    at = core.mat23f(at1[0], at1[1], at1[2], at2[0], at2[1], at2[2])
    return wp.vec2(dist1, dist2), at, frame


# for all users of MuJoCo Warp in the process, before it compiles the kernels that name the function
collision_primitive.plane_capsule = capsule_on_plane


@wp.func
def plane_capsule(one: Geom, other: Geom, margin: float, gap: float) -> Touch:
    dist, pos, frame = capsule_on_plane(
        one.normal, one.pos, other.pos, other.normal, other.size[0], other.size[1]
    )
    return twice(dist, pos, frame, frame)


@wp.func
def plane_ellipsoid(one: Geom, other: Geom, margin: float, gap: float) -> Touch:
    dist, pos, normal = core.plane_ellipsoid(one.normal, one.pos, other.pos, other.rot, other.size)
    return once(dist, pos, normal)


@wp.func
def plane_cylinder(one: Geom, other: Geom, margin: float, gap: float) -> Touch:
    dist, pos, normal = core.plane_cylinder(
        one.normal, one.pos, other.pos, other.normal, other.size[0], other.size[1]
    )
    found = Touch()
    found.count = 4
    for k in range(4):
        found.dist[k] = dist[k]
        found.pos[k] = pos[k]
    found.frame = make_frame(normal)
    found.frame_of_others = found.frame
    return found


@wp.func
def plane_box(one: Geom, other: Geom, margin: float, gap: float) -> Touch:
    dist, pos, normal = core.plane_box(one.normal, one.pos, other.pos, other.rot, other.size)
    found = Touch()
    found.count = 8
    found.dist = dist
    found.pos = pos
    found.frame = make_frame(normal)
    found.frame_of_others = found.frame
    return found


@wp.func
def sphere_sphere(one: Geom, other: Geom, margin: float, gap: float) -> Touch:
    dist, pos, normal = core.sphere_sphere(one.pos, one.size[0], other.pos, other.size[0])
    return once(dist, pos, normal)


@wp.func
def sphere_capsule(one: Geom, other: Geom, margin: float, gap: float) -> Touch:
    dist, pos, normal = core.sphere_capsule(
        one.pos, one.size[0], other.pos, other.normal, other.size[0], other.size[1]
    )
    return once(dist, pos, normal)


@wp.func
def sphere_cylinder(one: Geom, other: Geom, margin: float, gap: float) -> Touch:
    dist, pos, normal = core.sphere_cylinder(
        one.pos, one.size[0], other.pos, other.normal, other.size[0], other.size[1]
    )
    return once(dist, pos, normal)


@wp.func
def sphere_box(one: Geom, other: Geom, margin: float, gap: float) -> Touch:
    dist, pos, normal = core.sphere_box(one.pos, one.size[0], other.pos, other.rot, other.size)
    return once(dist, pos, normal)


@wp.func
def capsule_capsule(one: Geom, other: Geom, margin: float, gap: float) -> Touch:
    dist, pos, normal = core.capsule_capsule(
        one.pos, one.normal, one.size[0], one.size[1],
        other.pos, other.normal, other.size[0], other.size[1], margin,
    )  # fmt: skip
    return twice(dist, pos, make_frame(normal[0]), make_frame(normal[1]))


@wp.func
def capsule_box(one: Geom, other: Geom, margin: float, gap: float) -> Touch:
    dist, pos, normal = core.capsule_box(
        one.pos, one.normal, one.size[0], one.size[1], other.pos, other.rot, other.size
    )
    return twice(dist, pos, make_frame(normal[0]), make_frame(normal[1]))


@wp.func
def box_box(one: Geom, other: Geom, margin: float, gap: float) -> Touch:
    count, dist, pos, normal = core.box_box(
        one.pos, one.rot, one.size, other.pos, other.rot, other.size, margin + gap
    )
    found = Touch()
    found.count = count
    found.dist = dist
    found.pos = pos
    found.frame = make_frame(normal)
    found.frame_of_others = found.frame
    return found


Kind = mujoco_warp.GeomType
# from two geoms, margin and gap. MuJoCo Warp by default leaves out that of two boxes, which is MuJoCo's
FORMULAS = {
    (Kind.PLANE, Kind.SPHERE): plane_sphere,
    (Kind.PLANE, Kind.CAPSULE): plane_capsule,
    (Kind.PLANE, Kind.ELLIPSOID): plane_ellipsoid,
    (Kind.PLANE, Kind.CYLINDER): plane_cylinder,
    (Kind.PLANE, Kind.BOX): plane_box,
    (Kind.SPHERE, Kind.SPHERE): sphere_sphere,
    (Kind.SPHERE, Kind.CAPSULE): sphere_capsule,
    (Kind.SPHERE, Kind.CYLINDER): sphere_cylinder,
    (Kind.SPHERE, Kind.BOX): sphere_box,
    (Kind.CAPSULE, Kind.CAPSULE): capsule_capsule,
    (Kind.CAPSULE, Kind.BOX): capsule_box,
    (Kind.BOX, Kind.BOX): box_box,
}
# kinds of pairs beyond these: for MuJoCo Warp's kernels, and of a pillar and a box
NONE, PILLAR = wp.constant(len(FORMULAS)), wp.constant(len(FORMULAS) + 1)

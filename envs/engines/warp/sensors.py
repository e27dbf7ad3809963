"""Sensors of a model in one kernel, which MuJoCo Warp takes a dozen for.

Those that `covered` names. Where a model has others, all of its sensors are MuJoCo Warp's.

Source: MuJoCo's documentation, XML reference, sensor.
"""
# Kernels are Warp's language in Python's syntax, which no type checker of Python knows:
# pyright: reportIndexIssue=false, reportAssignmentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportInvalidTypeForm=false

import dataclasses
from typing import Any

import mujoco
import numpy as np
import warp as wp
from mujoco.mjx.third_party.mujoco_warp._src.ray import ray_geom

Sensor, Obj = mujoco.mjtSensor, mujoco.mjtObj
JOINTPOS, JOINTVEL = (wp.constant(int(k)) for k in (Sensor.mjSENS_JOINTPOS, Sensor.mjSENS_JOINTVEL))
BALLQUAT, BALLANGVEL = (wp.constant(int(k)) for k in (Sensor.mjSENS_BALLQUAT, Sensor.mjSENS_BALLANGVEL))
VELOCIMETER, GYRO = (wp.constant(int(k)) for k in (Sensor.mjSENS_VELOCIMETER, Sensor.mjSENS_GYRO))
ACCELEROMETER, MAGNETOMETER = (
    wp.constant(int(k)) for k in (Sensor.mjSENS_ACCELEROMETER, Sensor.mjSENS_MAGNETOMETER)
)
TOUCH, CONTACT = (wp.constant(int(k)) for k in (Sensor.mjSENS_TOUCH, Sensor.mjSENS_CONTACT))
KINDS = [
    int(k)
    for k in (
        JOINTPOS, JOINTVEL, BALLQUAT, BALLANGVEL, VELOCIMETER, GYRO, ACCELEROMETER, MAGNETOMETER, TOUCH,
        CONTACT,
    )
]  # fmt: skip


@wp.struct
class Sensors:
    sensor_type: wp.array[int]
    sensor_objid: wp.array[int]
    sensor_refid: wp.array[int]
    sensor_adr: wp.array[int]
    body_parentid: wp.array[int]
    body_rootid: wp.array[int]
    body_deepest: wp.array[int]  # of dynamics.py
    dof_parentid: wp.array[int]
    jnt_qposadr: wp.array[int]
    jnt_dofadr: wp.array[int]
    geom_bodyid: wp.array[int]
    site_bodyid: wp.array[int]
    site_type: wp.array[int]
    site_size: wp.array[wp.vec3]
    gravity: wp.array[wp.vec3]
    magnetic: wp.array[wp.vec3]
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    qacc: wp.array2d[float]
    cvel: wp.array2d[wp.spatial_vector]
    cdof: wp.array2d[wp.spatial_vector]
    cdof_dot: wp.array2d[wp.spatial_vector]
    subtree_com: wp.array2d[wp.vec3]
    site_xpos: wp.array2d[wp.vec3]
    site_xmat: wp.array2d[wp.mat33]
    force: wp.array2d[float]  # of the rows of constraints
    # contacts: of each world how many and which, and of each its bodies, where it is and its rows
    count: wp.array[int]
    listed: wp.array2d[int]
    geom: wp.array[wp.vec2i]
    pos: wp.array[wp.vec3]
    frame: wp.array[wp.mat33]
    dim: wp.array[int]
    efc_address: wp.array2d[int]
    sensordata: wp.array2d[float]


@wp.func
def put(p: Sensors, world: int, place: int, value: wp.vec3):
    for k in range(3):
        p.sensordata[world, place + k] = value[k]


@wp.func
def inertial(p: Sensors, world: int, kind: int, site: int) -> wp.vec3:
    """Of the site's frame: rates of turning and moving, and how it is pushed, without gravity."""
    body, rot = p.site_bodyid[site], wp.transpose(p.site_xmat[world, site])
    if kind == MAGNETOMETER:
        return rot @ p.magnetic[0]
    motion = p.cvel[world, body]
    turn = rot @ wp.spatial_top(motion)
    if kind == GYRO:
        return turn
    arm = p.site_xpos[world, site] - p.subtree_com[world, p.body_rootid[body]]
    move = rot @ (wp.spatial_bottom(motion) - wp.cross(arm, wp.spatial_top(motion)))
    if kind == VELOCIMETER:
        return move
    rate = wp.spatial_vector(wp.vec3(0.0), -p.gravity[0])
    dof = p.body_deepest[body]
    while dof >= 0:
        rate += p.cdof_dot[world, dof] * p.qvel[world, dof] + p.cdof[world, dof] * p.qacc[world, dof]
        dof = p.dof_parentid[dof]
    linear = rot @ (wp.spatial_bottom(rate) - wp.cross(arm, wp.spatial_top(rate)))
    return linear + wp.cross(turn, move)


@wp.func
def pressed(p: Sensors, world: int, site: int) -> float:
    """The sum of normal forces, N, of contacts of the site's body whose normal meets the site."""
    total, body = float(0.0), p.site_bodyid[site]
    for k in range(p.count[world]):
        i = p.listed[world, k]
        second = p.geom_bodyid[p.geom[i][1]] == body
        if not second and p.geom_bodyid[p.geom[i][0]] != body:
            continue
        rows = wp.max(1, 2 * (p.dim[i] - 1))
        force = float(0.0)
        for r in range(rows):
            force += p.force[world, p.efc_address[i, r]]
        normal = p.frame[i][0] * wp.where(second, -1.0, 1.0)
        far, _ = ray_geom(
            p.site_xpos[world, site], p.site_xmat[world, site], p.site_size[site], p.pos[i], normal,
            p.site_type[site],
        )  # fmt: skip
        if force > 0.0 and far >= 0.0:
            total += force
    return total


@wp.func
def carried(p: Sensors, body: int, by: int) -> bool:
    while body > by:
        body = p.body_parentid[body]
    return body == by


@wp.func
def touching(p: Sensors, world: int, carrier: int, other: int) -> float:
    """How many contacts a body, or one that it carries, has with another one."""
    found = float(0.0)
    for k in range(p.count[world]):
        geoms = p.geom[p.listed[world, k]]
        one, two = p.geom_bodyid[geoms[0]], p.geom_bodyid[geoms[1]]
        if (carried(p, one, carrier) and two == other) or (carried(p, two, carrier) and one == other):
            found += 1.0
    return found


@wp.kernel(enable_backward=False)
def read(p: Sensors):
    sensor, world = wp.tid()
    kind, of, place = p.sensor_type[sensor], p.sensor_objid[sensor], p.sensor_adr[sensor]
    if kind == JOINTPOS:
        p.sensordata[world, place] = p.qpos[world, p.jnt_qposadr[of]]
    elif kind == JOINTVEL:
        p.sensordata[world, place] = p.qvel[world, p.jnt_dofadr[of]]
    elif kind == BALLQUAT:
        at = p.jnt_qposadr[of]
        q = wp.vec4()
        for k in range(4):
            q[k] = p.qpos[world, at + k]
        q = wp.normalize(q)
        for k in range(4):
            p.sensordata[world, place + k] = q[k]
    elif kind == BALLANGVEL:
        for k in range(3):
            p.sensordata[world, place + k] = p.qvel[world, p.jnt_dofadr[of] + k]
    elif kind == TOUCH:
        p.sensordata[world, place] = pressed(p, world, of)
    elif kind == CONTACT:
        p.sensordata[world, place] = touching(p, world, of, p.sensor_refid[sensor])
    else:
        put(p, world, place, inertial(p, world, kind, of))


def covered(model: mujoco.MjModel, m: Any) -> bool:
    """Whether the kernel is for all sensors of a model: no cut, delay or callback; of contacts how many
    a body and what it carries have with another body, and no gap below which they do not push."""
    of_contacts = model.sensor_type == int(CONTACT)
    counts = (
        (model.sensor_intprm[:, 0] == 1 << mujoco.mjtConDataField.mjCONDATA_FOUND.value)
        & (model.sensor_dim == 1)
        & (model.sensor_objtype == Obj.mjOBJ_XBODY)
        & (model.sensor_reftype == Obj.mjOBJ_BODY)
    )
    return bool(
        np.isin(model.sensor_type, KINDS).all()
        and (counts | ~of_contacts).all()
        and not model.sensor_cutoff.any()
        and not model.geom_gap.any()
        and not model.pair_gap.any()
        and not m.callback.sensor
        and m.opt.magnetic.shape[0] == 1
    )


@dataclasses.dataclass
class Reader:
    """Of the worlds of one `Data`."""

    sensors: Any

    def read(self, worlds: int) -> None:
        """From positions, velocities, accelerations and forces to `sensordata`."""
        wp.launch(read, (len(self.sensors.sensor_type), worlds), inputs=[self.sensors])


def adopt(model: mujoco.MjModel, m: Any, d: Any, body_deepest: wp.array) -> Reader | None:
    """What reads the sensors of `d`, whose contacts the solver lists; None: MuJoCo Warp has to."""
    if not covered(model, m):
        return None
    p = Sensors()
    for name in Sensors.vars:
        for owner in (m, m.opt, d, d.contact, d.newton):
            if hasattr(owner, name):
                setattr(p, name, getattr(owner, name))
    p.body_deepest, p.force = body_deepest, d.efc.force
    return Reader(p)

"""Where bodies, geoms and cameras are: a model's forward kinematics in JAX, for one world.

The engines report poses of what they simulate. A picture also shows what they do not: goals, hazards,
and objects that sleep. So it begins with positions of joints and mocap bodies alone.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np


class Pose(NamedTuple):
    """Positions [..., 3] (m) and rotations [..., 3, 3], whose columns are the axes."""

    position: jax.Array
    rotation: jax.Array


# (qpos [nq], mocap_pos [nmocap, 3], mocap_quat [nmocap, 4]) -> of bodies [nbody, ...]
Kinematics = Callable[[jax.Array, jax.Array, jax.Array], Pose]


def rotation_of(quat: jax.Array) -> jax.Array:
    """Rotations [..., 3, 3] of quaternions [..., 4], w first."""
    quat = quat / jnp.sqrt(jnp.square(quat).sum(-1, keepdims=True))
    w, x, y, z = jnp.moveaxis(quat, -1, 0)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def turned(rotation: jax.Array, vector: jax.Array) -> jax.Array:
    """R v, [..., 3]. A product of matrices would lose digits on a GPU."""
    return (rotation * vector[..., None, :]).sum(-1)


def placed(parent: Pose, child: Pose) -> Pose:
    """`child`, which is given in the frame of `parent`, in the frame of the world."""
    rotation = (parent.rotation[..., :, :, None] * child.rotation[..., None, :, :]).sum(-2)
    return Pose(parent.position + turned(parent.rotation, child.position), rotation)


def fixed(position: np.ndarray, quat: np.ndarray) -> Pose:
    """What is constant in a model, [n, ...]."""
    matrices = np.zeros((len(quat), 9))
    for matrix, q in zip(matrices, np.asarray(quat, float), strict=True):
        mujoco.mju_quat2Mat(matrix, q)
    rotation = jnp.asarray(matrices.reshape(-1, 3, 3), jnp.float32)
    return Pose(jnp.asarray(position, jnp.float32), rotation)


def kinematics(model: mujoco.MjModel) -> Kinematics:
    """The poses of a model's bodies as a function of its state."""
    free = [i for i in range(model.nbody) if joints(model, i) == [mujoco.mjtJoint.mjJNT_FREE]]
    mocap = [i for i in range(model.nbody) if model.body_mocapid[i] >= 0]
    rest = fixed(model.body_pos, model.body_quat)
    roots = model.jnt_qposadr[model.body_jntadr[free]] if free else np.zeros(0, int)

    def poses(qpos: jax.Array, mocap_pos: jax.Array, mocap_quat: jax.Array) -> Pose:
        position, rotation = rest
        if free:
            at = qpos[roots[:, None] + np.arange(7)]
            position = position.at[np.array(free)].set(at[:, :3])
            rotation = rotation.at[np.array(free)].set(rotation_of(at[:, 3:]))
        if mocap:
            ids = model.body_mocapid[mocap]
            position = position.at[np.array(mocap)].set(mocap_pos[ids])
            rotation = rotation.at[np.array(mocap)].set(rotation_of(mocap_quat[ids]))
        found = [Pose(position[i], rotation[i]) for i in range(model.nbody)]
        for i in range(1, model.nbody):
            if i not in free and i not in mocap and (model.body_parentid[i] or joints(model, i)):
                at = placed(found[model.body_parentid[i]], found[i])
                found[i] = moved(model, i, at, qpos)
        return Pose(*(jnp.stack(x) for x in zip(*found, strict=True)))

    return poses


def joints(model: mujoco.MjModel, body: int) -> list[int]:
    """The kinds of a body's joints."""
    first = model.body_jntadr[body]
    return [int(kind) for kind in model.jnt_type[first : first + model.body_jntnum[body]]]


def moved(model: mujoco.MjModel, body: int, pose: Pose, qpos: jax.Array) -> Pose:
    """A body's `pose` after its joints, one after the other."""
    for joint, kind in enumerate(joints(model, body), model.body_jntadr[body]):
        at, axis = model.jnt_qposadr[joint], jnp.asarray(model.jnt_axis[joint], jnp.float32)
        if kind == mujoco.mjtJoint.mjJNT_SLIDE:
            far = qpos[at] - model.qpos0[at]
            pose = pose._replace(position=pose.position + far * turned(pose.rotation, axis))
            continue
        if kind == mujoco.mjtJoint.mjJNT_BALL:
            turn = rotation_of(qpos[at : at + 4])
        else:
            half = (qpos[at] - model.qpos0[at]) / 2
            turn = rotation_of(jnp.append(jnp.cos(half), jnp.sin(half) * axis))
        anchor = jnp.asarray(model.jnt_pos[joint], jnp.float32)  # stays where it is
        pose = placed(pose, Pose(anchor - turned(turn, anchor), turn))
    return pose

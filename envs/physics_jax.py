"""Engine `jax`: MJX in plain JAX, with the two collisions in which it differs from MuJoCo in C.

MJX has no collision of a cylinder with a box, and its contact frame of a plane with an upright capsule
is not C's. Both are registered with MJX when this module is imported, which is by the engine itself
only, and hold for every user of MJX in the process.
"""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import collision_driver, collision_primitive, math
from mujoco.mjx._src.types import GeomType

from jaxsafe.envs.physics import STATE, Physics, Readings, Run, mocap_at
from jaxsafe.envs.scene import Scene

collider: Any = collision_primitive.collider  # (pose and size of each) -> contacts, for MJX
Collision = tuple[jax.Array, jax.Array, jax.Array]  # distance (m), position [3], frame [3, 3]
FLAT = 0.02  # rad between normal and side (or end) within which it lies flat
PROJECTIONS = 8  # between cylinder and box, towards their closest points


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


@collider(ncon=2)
def cylinder_box(cylinder: Any, box: Any) -> Collision:
    return rod_box(cylinder, box, cap=0.0)


@collider(ncon=2)
def capsule_box(capsule: Any, box: Any) -> Collision:
    """MJX's own finds most contacts of a box with an upright capsule not at all."""
    return rod_box(capsule, box, cap=1.0)


def rod_box(rod: Any, box: Any, cap: float) -> Collision:
    """The contact of a rod and a box, or two where the rod lies along a face or an edge.

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

    pairs = [closest(share * jnp.minimum(radius, half)) for share in (1.0, 0.5, 0.1)]
    lines = jnp.stack([*jnp.eye(3), axis, *jnp.cross(jnp.eye(3), axis)])
    lines = jnp.where((lines @ centre > 0)[:, None], -lines, lines)
    lines = jnp.concatenate([lines, jnp.stack([on_box - on_rod for on_rod, on_box in pairs])])
    lengths = jnp.linalg.norm(lines, axis=1)
    lines /= jnp.maximum(lengths, 1e-9)[:, None]
    cosine = lines @ axis
    sine = jnp.sqrt(jnp.maximum(1 - cosine**2, 0.0))
    reach = half * jnp.abs(cosine) + radius * jnp.maximum(sine, cap)
    apart = -jnp.abs(lines) @ extent - lines @ centre - reach
    best = jnp.argmax(jnp.where(lengths > 1e-6, apart, -jnp.inf))
    n, dist = lines[best], apart[best]

    # Where on the axis they touch: at one point, or from end to end of what lies on a face or edge,
    # which the box's axes span that n does not see.
    lean = n.dot(axis)
    outward = axis - lean * n
    free = jnp.abs(n) < FLAT
    lies = jnp.linalg.norm(jnp.where(free, 0.0, outward)) < FLAT
    slope = jnp.where(jnp.abs(axis) < 1e-6, 1e-6, axis)
    bounds = jnp.sort(jnp.stack([-extent - centre, extent - centre]) / slope, axis=0)
    low = jnp.max(jnp.where(free, bounds[0], -half), initial=-half)
    high = jnp.min(jnp.where(free, bounds[1], half), initial=half)
    point = jnp.clip((pairs[0][1] - centre).dot(axis), -half, half)
    point = jnp.where(jnp.abs(lean) > FLAT, jnp.sign(lean) * half, point)
    second = lies & (low < high)
    ends = jnp.where(second, jnp.stack([low, high]), point)
    rise = jnp.max(ends * lean) - ends * lean  # of the rod's side over the box, from the deepest end

    # from the axis to the rod's farthest point along n
    across = n - lean * axis
    steep = jnp.linalg.norm(across)
    towards = jnp.clip(centre, -extent, extent) - centre
    inner = towards - axis * towards.dot(axis)
    inner *= jnp.minimum(1.0, radius / jnp.maximum(jnp.linalg.norm(inner), 1e-9))
    side = jnp.where(steep > FLAT, radius * across / jnp.maximum(steep, 1e-9), inner)
    side = jnp.where(cap > 0, radius * n, side)

    dists = dist + rise
    pos = centre + side + 0.5 * dists[:, None] * n + ends[:, None] * axis
    frame = math.make_frame(box.mat @ n)
    none = 1.0  # m, a contact that is not there
    return (
        jnp.where(jnp.stack([True, second]), dists, none),
        box.pos + pos @ box.mat.T,
        jnp.stack([frame, frame]),
    )


collision_driver._COLLISION_FUNC[GeomType.PLANE, GeomType.CAPSULE] = plane_capsule
collision_driver._COLLISION_FUNC[GeomType.CYLINDER, GeomType.BOX] = cylinder_box
collision_driver._COLLISION_FUNC[GeomType.CAPSULE, GeomType.BOX] = capsule_box


def jax_engine(scene: Scene, max_substeps: int, outputs: tuple[str, ...]) -> Run:
    with jax.ensure_compile_time_eval():
        model = mjx.put_model(scene.model, impl="jax")
        template = mjx.make_data(scene.model, impl="jax")
    robot, watched = map(jnp.asarray, contact_geoms(scene))
    timestep = scene.model.opt.timestep
    carried = (*STATE, "mocap_pos")

    def run(physics: Physics, ctrl: jax.Array, substeps: jax.Array) -> tuple[Physics, Readings]:
        data = template.replace(
            qpos=physics.qpos,
            qvel=physics.qvel,
            qacc_warmstart=physics.warmstart,
            ctrl=ctrl,
            mocap_pos=physics.mocap_pos,
            mocap_quat=physics.mocap_quat,
        )

        def substep(data: mjx.Data, k: jax.Array) -> tuple[mjx.Data, None]:
            moving = data
            if scene.orbit.any():
                time = (physics.substeps + k) * timestep
                moving = data.replace(mocap_pos=mocap_at(physics.mocap_pos, scene.orbit, time, jnp))
            stepped = mjx.step(model, moving)
            stepped = stepped.replace(mocap_pos=moving.mocap_pos)
            kept = {f: jnp.where(k < substeps, getattr(stepped, f), getattr(data, f)) for f in carried}
            return stepped.replace(**kept), None

        data, _ = jax.lax.scan(substep, data, jnp.arange(max_substeps))
        data = mjx.forward(model, data)
        contact = data._impl.contact  # type: ignore[union-attr]
        first, second = contact.geom[:, 0], contact.geom[:, 1]
        touching = contact.dist <= 0
        met = robot[first][:, None] & watched[second] | robot[second][:, None] & watched[first]
        contacts = (met & touching[:, None]).sum(0).astype(jnp.float32)
        physics = physics.replace(
            qpos=data.qpos,
            qvel=data.qvel,
            warmstart=data.qacc_warmstart,
            substeps=physics.substeps + substeps,
        )
        poses = {
            name: getattr(data, name) if name in outputs else jnp.zeros((0,))
            for name in ("geom_xpos", "geom_xmat", "xquat")
        }
        return physics, Readings(
            sensors=jnp.concatenate([data.sensordata, contacts]),
            contacts=contacts,
            overflow=jnp.zeros(()),
            **poses,
        )

    return run


def contact_geoms(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Masks of the robot's geoms [ngeom] and of each watched object's [ngeom, watched]."""
    model = scene.model
    bodies = model.geom_bodyid
    robot = model.body_rootid[bodies] == model.body("robot").id
    ids = [model.body(name).id for names in scene.watched.values() for name in names]
    return robot, np.stack([bodies == i for i in ids], 1) if ids else np.zeros((model.ngeom, 0), bool)

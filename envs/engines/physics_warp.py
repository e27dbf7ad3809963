"""Engine `warp`: MuJoCo Warp's kernels and ours, all substeps of a batch in one CUDA graph.

MJX calls the same kernels one `mjx.step` at a time and passes all of `mjx.Data` through JAX. Here the
working data stays in Warp: a step copies one packed row per world in, replays the graph, and copies
one row out. Sensors are read in the last forward pass alone.

Imported by the engine itself only: it needs Warp.
"""
# Kernels are Warp's language in Python's syntax, which no type checker of Python knows:
# pyright: reportIndexIssue=false, reportAssignmentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false

import dataclasses
import threading
from collections.abc import Callable
from typing import Any

import jax
import mujoco
import warp as wp
from mujoco.mjx.third_party import mujoco_warp
from mujoco.mjx.third_party.mujoco_warp._src import (
    collision_primitive,
    collision_primitive_core,
    constraint,
    solver,
)

from jaxsafe.envs.engines.dynamics_warp import adopt, forward, step
from jaxsafe.envs.engines.physics import STATE, columns, widths
from jaxsafe.envs.engines.solver_warp import make_constraint, solve
from jaxsafe.envs.safety_gym.scene import Scene

wp.config.log_level = wp.LOG_WARNING  # a line for every kernel otherwise


@wp.func
def plane_capsule(
    normal: wp.vec3,
    plane_pos: wp.vec3,
    pos: wp.vec3,
    axis: wp.vec3,
    radius: float,
    half_length: float,
) -> tuple[wp.vec2, collision_primitive_core.mat23f, wp.mat33]:
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
    at = collision_primitive_core.mat23f(at1[0], at1[1], at1[2], at2[0], at2[1], at2[2])
    return wp.vec2(dist1, dist2), at, frame


# For all users of MuJoCo Warp in the process; before Warp compiles the kernels that name the function.
collision_primitive.plane_capsule = plane_capsule
constraint.make_constraint, solver.solve = make_constraint, solve  # ours for data that was `adopt`ed


@wp.kernel
def go_round(
    base: wp.array2d[wp.vec3],
    travel: wp.array[float],
    done: wp.array2d[float],
    substeps: wp.array2d[float],
    timestep: float,
    k: int,
    mocap_pos: wp.array2d[wp.vec3],
):
    """The guides of gremlins at substep k, as `physics.mocap_at` has them."""
    world, body = wp.tid()
    if float(k) < substeps[world, 0]:
        time = (done[world, 0] + float(k)) * timestep
        circle = wp.vec3(wp.sin(time), wp.cos(time), 0.0)
        mocap_pos[world, body] = base[world, body] + travel[body] * circle


@wp.kernel
def hold(substeps: wp.array2d[float], k: int, before: wp.array2d[float], after: wp.array2d[float]):
    """Undo substep k in the worlds whose step has fewer."""
    world, column = wp.tid()
    if float(k) >= substeps[world, 0]:
        after[world, column] = before[world, column]


@wp.kernel
def flag(
    overflow: wp.array[int],
    mask: int,
    nacon: wp.array[int],
    ncollision: wp.array[int],
    contacts: int,
    nefc: wp.array[int],
    rows: int,
    out: wp.array2d[float],
):
    """1 where a substep set a bit of `mask`, or the last forward pass, which sets none, had no room."""
    world = wp.tid()
    full = (overflow[world] & mask) != 0 or nefc[world] > rows
    if full or nacon[0] > contacts or ncollision[0] > contacts:
        out[world, 0] = 1.0
    else:
        out[world, 0] = 0.0


Kind = mujoco_warp.OverflowType
NO_ROOM = int(
    Kind.NEFC | Kind.NJMAX_NNZ | Kind.BROADPHASE | Kind.NARROWPHASE | Kind.CCD | Kind.CONTACT_MATCH
)
FEW_WORLDS = 128  # contacts more: the average of few worlds varies
# Several devices call from several threads; on a CPU the memory that lanes share is the kernel's.
one_at_a_time = threading.Lock()


def floats(x: wp.array) -> wp.array:
    """A view of `x` [worlds, n], of floats, vectors or matrices, as floats [worlds, m]."""
    width = x.size * wp.types.type_size(x.dtype) // x.shape[0]
    return wp.array(ptr=x.ptr, dtype=float, shape=(x.shape[0], width), device=x.device)


@dataclasses.dataclass
class Worlds:
    """The working data of a batch on one device, and the graphs that run on it."""

    model: Any
    blind: Any  # the model without its sensors
    data: Any
    travel: wp.array  # [nmocap] radius of each guide's circle, m
    into: wp.array  # [worlds, columns]
    out: wp.array
    graphs: dict[Any, Any]


def warp_engine(
    scene: Scene, outputs: tuple[str, ...], contacts: int, rows: int
) -> tuple[Callable[[int, bool], Callable[[jax.Array], jax.Array]], dict[str, int]]:
    """For a scene: maker(substeps, alike) -> a function of rows, [worlds, in] -> [worlds, out], and
    the columns of a row that comes out.

    Where not all worlds take all `substeps` (`alike` is false), the column 'substeps' says how many.
    The working data of every batch size that was ever stepped is kept.

    Args:
        outputs: poses to return, of 'geom_xpos', 'geom_xmat', 'xquat'.
        contacts: room for contacts, per world on average.
        rows: room for constraint rows in the fullest world.
    """
    model = scene.model
    inputs, results = widths(model, outputs)
    results |= {"overflow": 1}
    batches: dict[tuple[str, int], Worlds] = {}

    def prepare(worlds: int) -> Worlds:
        m = mujoco_warp.put_model(model)
        m.opt.warn_overflow = 0  # returned instead
        data = mujoco_warp.make_data(
            model, nworld=worlds, naconmax=contacts * worlds + FEW_WORLDS, njmax=rows
        )
        adopt(model, m, data)
        sensors_off = m.opt.disableflags | mujoco.mjtDisableBit.mjDSBL_SENSOR.value
        return Worlds(
            model=m,
            blind=dataclasses.replace(m, opt=dataclasses.replace(m.opt, disableflags=sensors_off)),
            data=data,
            travel=wp.array(scene.orbit, dtype=float),
            into=wp.zeros((worlds, sum(inputs.values())), dtype=float),
            out=wp.zeros((worlds, sum(results.values())), dtype=float),
            graphs={},
        )

    def maker(substeps: int, alike: bool) -> Callable[[jax.Array], jax.Array]:
        def advance(w: Worlds) -> None:
            data = w.data
            given = {name: w.into[:, where] for name, where in columns(inputs).items()}
            wanted = {name: w.out[:, where] for name, where in columns(results).items()}
            for name, column in given.items():
                if column.size and name not in ("done", "substeps"):
                    wp.copy(floats(getattr(data, name)), column)
            data.overflow.zero_()
            base = wp.clone(data.mocap_pos) if scene.orbit.any() else None
            for k in range(substeps):
                if base is not None:
                    wp.launch(
                        go_round,
                        dim=base.shape,
                        inputs=[
                            base,
                            w.travel,
                            given["done"],
                            given["substeps"],
                            model.opt.timestep,
                            k,
                        ],
                        outputs=[data.mocap_pos],
                    )
                before = {} if alike else {name: wp.clone(getattr(data, name)) for name in STATE}
                step(w.blind, data)
                for name, old in before.items():
                    new = getattr(data, name)
                    wp.launch(hold, new.shape, inputs=[given["substeps"], k, old], outputs=[new])
            forward(w.model, data)
            full = wanted.pop("overflow")
            wp.launch(
                flag,
                data.nworld,
                inputs=[
                    data.overflow,
                    NO_ROOM,
                    data.nacon,
                    data.ncollision,
                    data.naconmax,
                    data.nefc,
                    data.njmax,
                ],
                outputs=[full],
            )
            for name, column in wanted.items():
                if column.size:
                    wp.copy(column, floats(getattr(data, name)))

        def run(packed: wp.array2d[float], result: wp.array2d[float]):
            with one_at_a_time:
                launch(packed, result)

        def launch(packed: wp.array2d[float], result: wp.array2d[float]) -> None:
            device = wp.get_device()
            place = (str(device), packed.shape[0])
            if place not in batches:
                batches[place] = prepare(packed.shape[0])
            w = batches[place]
            wp.copy(w.into, packed)
            if not device.is_cuda:
                advance(w)
            else:
                if launch not in w.graphs:
                    with wp.ScopedCapture() as capture:
                        advance(w)
                    w.graphs[launch] = capture.graph
                wp.capture_launch(w.graphs[launch])
            wp.copy(result, w.out)

        call = wp.jax_callable(run, graph_mode=wp.JaxCallableGraphMode.NONE)
        out = sum(results.values())
        return lambda packed: call(packed, output_dims={"result": (packed.shape[0], out)})[0]

    return maker, results

"""Engine `warp`: MuJoCo Warp's kernels and ours, all substeps of a batch in one CUDA graph.

MJX calls the same kernels one `mjx.step` at a time and passes all of `mjx.Data` through JAX. Here the
working data stays in Warp: a step copies one packed row per world in, replays the graph, and copies
one row out. Sensors are read in the last forward pass alone.

Only `make_engine` imports this module, because it needs Warp.
"""
# Kernels are Warp's language in Python's syntax, which no type checker of Python knows:
# pyright: reportIndexIssue=false, reportAssignmentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false

import dataclasses
import sys
import threading
from functools import partial
from typing import Any

import jax
import mujoco
import numpy as np
import warp as wp
from mujoco.mjx.third_party import mujoco_warp
from mujoco.mjx.third_party.mujoco_warp._src import constraint, solver

from jaxsafe.envs.engines.batching import batched
from jaxsafe.envs.engines.rows import STATE, columns, pack, unpack, widths
from jaxsafe.envs.engines.simulation import Engine, Physics, PhysicsCall, Simulation
from jaxsafe.envs.engines.warp import dynamics
from jaxsafe.envs.engines.warp.dynamics import Guides, adopt, forward, step, uncovered
from jaxsafe.envs.engines.warp.solver import make_constraint, solve

wp.config.log_level = wp.LOG_WARNING  # a line for every kernel otherwise


# for all users of MuJoCo Warp in the process: ours for data that was `adopt`ed
constraint.make_constraint, solver.solve = make_constraint, solve


@wp.kernel
def go_round(guides: Guides, k: int):
    world, body = wp.tid()
    dynamics.go_round(guides, k, world, body)


@wp.kernel
def hold(substeps: wp.array2d[float], k: int, before: wp.array2d[float], after: wp.array2d[float]):
    """Undo substep k in the worlds whose step has fewer."""
    world, column = wp.tid()
    if float(k) >= substeps[world, 0]:
        after[world, column] = before[world, column]


@wp.struct
class Column:
    """Where a number of each world is: in the first world, and how far from world to world, bytes."""

    address: wp.uint64
    stride: int


@wp.func_native("return *(const float*)(address + (uint64_t)world * stride);")
def number(address: wp.uint64, stride: int, world: int) -> float: ...


@wp.func_native("*(float*)(address + (uint64_t)world * stride) = value;")
def put(address: wp.uint64, stride: int, world: int, value: float): ...


@wp.kernel
def unpack_rows(rows: wp.array2d[float], columns: wp.array[Column], overflow: wp.array[int]):
    """From packed rows to the working data. The last column is none of it: there flags are cleared."""
    world, i = wp.tid()
    if i == columns.shape[0]:
        overflow[world] = 0
    else:
        put(columns[i].address, columns[i].stride, world, rows[world, i])


@wp.kernel
def pack_rows(
    columns: wp.array[Column],
    overflow: wp.array[int],
    mask: int,
    nacon: wp.array[int],
    ncollision: wp.array[int],
    contacts: int,
    nefc: wp.array[int],
    room: int,
    rows: wp.array2d[float],
):
    """From the working data to packed rows. In the last column 1 where a substep set a bit of `mask`,
    or the last forward pass, which sets none, had no room."""
    world, i = wp.tid()
    if i < columns.shape[0]:
        rows[world, i] = number(columns[i].address, columns[i].stride, world)
        return
    full = (overflow[world] & mask) != 0 or nefc[world] > room
    rows[world, i] = wp.where(full or nacon[0] > contacts or ncollision[0] > contacts, 1.0, 0.0)


Kind = mujoco_warp.OverflowType
NO_ROOM = int(
    Kind.NEFC | Kind.NJMAX_NNZ | Kind.BROADPHASE | Kind.NARROWPHASE | Kind.CCD | Kind.CONTACT_MATCH
)
CLOCK = ("done", "substeps")  # the last columns that go in
FEW_WORLDS = 128  # contacts more: the average of few worlds varies
# Several devices call from several threads; on a CPU the memory that lanes share is the kernel's.
one_at_a_time = threading.Lock()


def columns_of(arrays: list[wp.array]) -> wp.array:
    """The columns of arrays [worlds, n], of floats, vectors or matrices."""
    found = []
    for x in arrays:
        start = x.ptr or 0  # None, of no columns
        for k in range(x.size * wp.types.type_size(x.dtype) // x.shape[0]):
            found.append((start + 4 * k, x.strides[0]))
    table = np.array(found, dtype=Column.numpy_dtype())
    return wp.array(table, dtype=Column, device=arrays[0].device)


@dataclasses.dataclass
class Worlds:
    """The working data of a batch on one device, and the graphs that run on it."""

    model: Any
    blind: Any  # the model without its sensors
    data: Any
    orbits: wp.array  # [nmocap], m
    into: wp.array  # [worlds, columns]
    given: wp.array  # where all but the last of these columns go: `done` and `substeps` stay
    out: wp.array
    wanted: wp.array  # where all but the last of these columns come from
    graphs: dict[int, Any]  # by the number of substeps


def make(simulation: Simulation) -> Engine:
    """Warp's buffers are sized for a whole batch, so the batch is made explicit.

    The working data of every batch size that was ever stepped is kept.
    """
    model = simulation.compile(count=True)
    kernels = Kernels(simulation, model)

    def runner(substeps: int) -> PhysicsCall:
        def launch(packed: wp.array2d[float], result: wp.array2d[float]):
            with one_at_a_time:
                kernels.launch(packed, result, substeps)

        call = wp.jax_callable(launch, graph_mode=wp.JaxCallableGraphMode.NONE)
        width = sum(kernels.results.values())

        def run_batch(physics: Physics, ctrl: jax.Array, taken: jax.Array):
            packed = jax.vmap(pack)(physics, ctrl, taken)
            rows = call(packed, output_dims={"result": (packed.shape[0], width)})[0]
            back = partial(unpack, sizes=kernels.results, simulation=simulation)
            return jax.vmap(back)(rows, physics=physics, substeps=taken)

        return batched(run_batch)

    several, none = runner(simulation.substeps), runner(0)
    return Engine("warp", model, simulation.substeps, several, none)


class Kernels:
    """All launches of a step, for every batch size, device and number of substeps."""

    def __init__(self, simulation: Simulation, model: mujoco.MjModel):
        self.simulation, self.model = simulation, model
        self.orbits = simulation.orbits_of(model)
        self.inputs, results = widths(model, simulation)
        self.results = results | {"overflow": 1}
        self.batches: dict[tuple[str, int], Worlds] = {}
        # Each call comes with a new object for XLA's stream. Warp forgets the stream as soon as one of
        # these is collected, even while a graph is captured on it. So that of each capture is kept.
        self.streams: list[wp.Stream] = []
        self.said = False  # which kernels run

    def prepare(self, worlds: int) -> Worlds:
        m = mujoco_warp.put_model(self.model)
        m.opt.warn_overflow = 0  # returned instead
        # of two boxes MuJoCo Warp then takes MuJoCo's contacts; it looks at this flag for nothing else
        m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD.value
        room: dict[str, int] = {}
        if self.simulation.room:
            contacts, room["njmax"] = self.simulation.room
            room["naconmax"] = contacts * worlds + FEW_WORLDS
        data = mujoco_warp.make_data(self.model, nworld=worlds, **room)
        adopted = adopt(self.model, m, data, self.simulation.pillars, self.simulation.fields)
        if not adopted and not self.said:
            self.said = True
            reasons = ", ".join(uncovered(self.model, m, data))
            print(f"engine warp: MuJoCo Warp's own kernels run this model ({reasons})", file=sys.stderr)
        sensors_off = m.opt.disableflags | mujoco.mjtDisableBit.mjDSBL_SENSOR.value
        return Worlds(
            model=m,
            blind=dataclasses.replace(m, opt=dataclasses.replace(m.opt, disableflags=sensors_off)),
            data=data,
            orbits=wp.array(self.orbits, dtype=float),
            into=wp.zeros((worlds, sum(self.inputs.values())), dtype=float),
            given=columns_of([getattr(data, name) for name in self.inputs if name not in CLOCK]),
            out=wp.zeros((worlds, sum(self.results.values())), dtype=float),
            wanted=columns_of([getattr(data, name) for name in self.results if name != "overflow"]),
            graphs={},
        )

    def launch(self, packed: wp.array, result: wp.array, substeps: int) -> None:
        device = wp.get_device()
        place = (str(device), packed.shape[0])
        if place not in self.batches:
            self.batches[place] = self.prepare(packed.shape[0])
        w = self.batches[place]
        wp.copy(w.into, packed)
        if not device.is_cuda:
            self.advance(w, substeps)
        else:
            if substeps not in w.graphs:
                self.streams.append(wp.get_stream())
                with wp.ScopedCapture() as capture:
                    self.advance(w, substeps)
                w.graphs[substeps] = capture.graph
            wp.capture_launch(w.graphs[substeps])
        wp.copy(result, w.out)

    def advance(self, w: Worlds, substeps: int) -> None:
        """From the rows in `w.into` to those in `w.out`."""
        data = w.data
        done, taken = (w.into[:, columns(self.inputs)[name]] for name in CLOCK)
        width = (data.nworld, len(w.given) + 1)
        wp.launch(unpack_rows, width, inputs=[w.into, w.given], outputs=[data.overflow])
        guides = Guides()
        if self.orbits.any():
            guides.base, guides.mocap_pos = wp.clone(data.mocap_pos), data.mocap_pos
            guides.orbits, guides.timestep = w.orbits, self.model.opt.timestep
            guides.done, guides.substeps = done, taken
        at_once = dynamics.at_once(data) and not self.simulation.varied
        for k in range(0 if at_once else substeps):
            if self.orbits.any():
                wp.launch(go_round, data.mocap_pos.shape, inputs=[guides, k])
            before = {}
            if self.simulation.varied:
                before = {name: wp.clone(getattr(data, name)) for name in STATE}
            step(w.blind, data)
            for name, old in before.items():
                new = getattr(data, name)
                wp.launch(hold, new.shape, inputs=[taken, k, old], outputs=[new])
        forward(w.model, data, substeps if at_once else 0, guides)
        wp.launch(
            pack_rows,
            w.out.shape,
            inputs=[
                w.wanted,
                data.overflow,
                NO_ROOM,
                data.nacon,
                data.ncollision,
                data.naconmax,
                data.nefc,
                data.njmax,
            ],
            outputs=[w.out],
        )

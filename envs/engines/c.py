"""Engine `c`: MuJoCo itself, a thread pool behind a callback. State crosses as float32; inside, all is
float64."""

import threading
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np

from jaxsafe.envs.engines.rows import columns, pack, unpack, widths
from jaxsafe.envs.engines.simulation import Engine, Physics, Readings, Simulation, mocap_at


def make(simulation: Simulation) -> Engine:
    model = simulation.compile(count=True)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value  # bad states are ours to end
    orbits = simulation.orbits_of(model)
    inputs, results = widths(model, simulation)
    batches: dict[int, mujoco.batch.Batch] = {}
    lock = threading.Lock()
    sensors_off = mujoco.mjtDisableBit.mjDSBL_SENSOR.value  # nothing reads them between substeps

    def host(packed: np.ndarray) -> np.ndarray:
        """One row a simulation, [..., in] -> [..., out], both float32."""
        rows = np.asarray(packed, np.float64).reshape(-1, packed.shape[-1])
        with lock:
            if len(rows) not in batches:
                batches[len(rows)] = mujoco.batch.Batch(model, len(rows))
                for field in results:  # they are filled only by calls made after they are bound
                    batches[len(rows)].bind(field)
            out = advance(batches[len(rows)], rows)
        return out.reshape(*packed.shape[:-1], -1)

    def advance(batch: mujoco.batch.Batch, rows: np.ndarray) -> np.ndarray:
        given = {name: rows[:, where] for name, where in columns(inputs).items()}
        time = given.pop("done")[:, 0] * model.opt.timestep
        count = given.pop("substeps")[:, 0].astype(int)
        for field, column in given.items():
            if column.size:
                batch.bind(field)[:] = column.reshape(batch.bind(field).shape)
        batch.bind("time")[:] = time
        mocap_pos = given["mocap_pos"].reshape(len(rows), model.nmocap, 3)
        failed = np.zeros(len(rows), bool)
        acc = mujoco.mjtStage.mjSTAGE_ACC.value

        def call(method: Callable, **options: Any) -> None:
            try:
                method(**options)
            except mujoco.batch.SimulationError as error:  # the others ran to the end of this call
                failed[error.ids] = True

        flags = batch.expand("opt.disableflags")
        flags[:] = model.opt.disableflags | sensors_off
        if not orbits.any() and (count == count[0]).all():
            if count[0]:
                call(batch.step, nstep=int(count[0]))
        else:
            for k in range(count.max(initial=0)):
                now = time + k * model.opt.timestep
                batch.bind("mocap_pos")[:] = np.where(
                    (k < count)[:, None, None],
                    mocap_at(mocap_pos, orbits, now, np),
                    batch.bind("mocap_pos"),
                )
                call(batch.step, ids=np.flatnonzero(k < count))
        flags[:] = model.opt.disableflags
        call(batch.forward, stage=acc)
        out = np.concatenate([batch.bind(f).reshape(len(rows), -1) for f in results], axis=1)
        out[failed] = np.nan  # the environment ends the episode of a world that is not finite
        return out.astype(np.float32)

    def run(physics: Physics, ctrl: jax.Array, substeps: jax.Array) -> tuple[Physics, Readings]:
        shape = jax.ShapeDtypeStruct((sum(results.values()),), jnp.float32)
        row = jax.pure_callback(host, shape, pack(physics, ctrl, substeps), vmap_method="broadcast_all")
        return unpack(row, results, simulation, physics, substeps)

    return Engine("c", model, simulation.substeps, run, run)

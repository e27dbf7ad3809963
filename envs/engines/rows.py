"""A world as one row of floats, for the engines whose working data lies outside JAX."""

import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxsafe.envs.engines.simulation import FIELDS, Physics, Readings, Simulation

STATE = ("qpos", "qvel", "qacc_warmstart")
Columns = dict[str, slice]  # where in a row each part lies


def widths(model: mujoco.MjModel, simulation: Simulation) -> tuple[dict[str, int], dict[str, int]]:
    """How many floats each part of a row has that goes in (`pack`), and that comes out (`unpack`)."""
    state = dict(zip(STATE, (model.nq, model.nv, model.nv), strict=True))
    mocap = {"mocap_pos": 3 * model.nmocap, "mocap_quat": 4 * model.nmocap}
    into = state | mocap | {"ctrl": model.nu, "done": 1, "substeps": 1}
    out = state | {"sensordata": model.nsensordata}
    for name in simulation.fields:
        count, shape = FIELDS[name]
        out[name] = count_of(model, count) * math.prod(shape)
    return into, out


def count_of(model: mujoco.MjModel, count: str) -> int:
    return {"nbody": model.nbody, "ngeom": model.ngeom, "nsite": model.nsite, "nv": model.nv}[count]


def columns(sizes: dict[str, int]) -> Columns:
    ends = dict(zip(sizes, np.cumsum(list(sizes.values())).tolist(), strict=True))
    return {name: slice(ends[name] - n, ends[name]) for name, n in sizes.items()}


def pack(physics: Physics, ctrl: jax.Array, substeps: jax.Array) -> jax.Array:
    arrays = (physics.qpos, physics.qvel, physics.warmstart, physics.mocap_pos)
    arrays += (physics.mocap_quat, ctrl, physics.substeps, substeps)
    return jnp.concatenate([jnp.ravel(x).astype(jnp.float32) for x in arrays])


def unpack(
    row: jax.Array, sizes: dict[str, int], simulation: Simulation, physics: Physics, substeps: jax.Array
) -> tuple[Physics, Readings]:
    """What `substeps` made of `physics`, from the row that came out."""
    parts = {name: row[where] for name, where in columns(sizes).items()}
    sensors = parts["sensordata"]
    split = len(sensors) - len(simulation.contacts)
    physics = physics.replace(
        qpos=parts["qpos"],
        qvel=parts["qvel"],
        warmstart=parts["qacc_warmstart"],
        substeps=physics.substeps + substeps,
    )
    return physics, Readings(
        sensors=sensors[: split - simulation.unread],
        contacts=sensors[split:],
        fields={name: parts[name].reshape(-1, *FIELDS[name][1]) for name in simulation.fields},
        overflow=parts["overflow"][0] if "overflow" in parts else jnp.zeros(()),
    )

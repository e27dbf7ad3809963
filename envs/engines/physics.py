"""Three physics engines behind one function: n substeps, then a forward pass at the new state.

    run(physics, ctrl, substeps) -> (physics, readings)

`c` is MuJoCo itself, a thread pool behind a callback: exact, and the default on a CPU. `warp` is
MuJoCo Warp (`physics_warp.py`), the default on an NVIDIA GPU. `jax` is MJX in plain JAX, for every
other device. One instance in, one out: callers `vmap`, over environments and again over seeds. The
state between two calls is small; each engine keeps or builds its own working data.
"""

import importlib.util
import math
import threading
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np

from jaxsafe.config import ConfigError, nearest
from jaxsafe.envs.safety_gym.scene import Scene

ENGINES = ("c", "warp", "jax")


@flax.struct.dataclass
class Physics:
    """What the next physics step needs: qpos [nq], qvel [nv] and warmstart [nv] (the solver's last
    accelerations), the places around which mocap bodies circle or rest, and the substeps done."""

    qpos: jax.Array
    qvel: jax.Array
    warmstart: jax.Array
    mocap_pos: jax.Array  # [nmocap, 3]
    mocap_quat: jax.Array  # [nmocap, 4]
    substeps: jax.Array  # int32 []; simulation time is substeps * timestep


@flax.struct.dataclass
class Readings:
    """What a forward pass shows: sensors [nsensordata], whose last are the contact counts [watched
    objects], and the poses that a task asked for (others have no elements)."""

    sensors: jax.Array
    contacts: jax.Array
    geom_xpos: jax.Array  # [ngeom, 3]
    geom_xmat: jax.Array  # [ngeom, 3, 3]
    xquat: jax.Array  # [nbody, 4]
    overflow: jax.Array  # float [], 1 where this world's rows or the batch's contacts found no room


Run = Callable[[Physics, jax.Array, jax.Array], tuple[Physics, Readings]]


class Engine(NamedTuple):
    name: str
    run: Run
    forward: Run  # the forward pass alone, of a state with 0 substeps to go


def default_engine() -> str:
    """The engine of JAX's default device."""
    platform = jax.default_backend()
    if platform == "cpu":
        return "c"
    return "warp" if platform in ("gpu", "cuda") and warp_available() else "jax"


def warp_available() -> bool:
    return importlib.util.find_spec("warp") is not None


def make_engine(
    name: str,
    scene: Scene,
    max_substeps: int,
    outputs: tuple[str, ...] = (),
    alike: bool = False,
    room: float = 1.0,
) -> Engine:
    """The engine `name` for `scene`.

    Args:
        name: 'c', 'warp', 'jax' or 'auto'.
        max_substeps: most substeps of a call.
        outputs: which of 'geom_xpos', 'geom_xmat', 'xquat' to return.
        alike: whether every call of `run` takes all `max_substeps`.
        room: factor on the room that engine warp reserves for contacts.
    Raises:
        ConfigError: an unknown engine, or a scene that this one cannot run.
    """
    name = default_engine() if name == "auto" else name
    if name == "c":
        run = c_engine(scene, outputs)
        return Engine(name, run, run)
    if name == "warp":
        return Engine(name, *warp_engine(scene, max_substeps, outputs, alike, room))
    if name == "jax":
        from jaxsafe.envs.engines import physics_jax  # late: MJX is slow to import

        maker: Any = physics_jax.jax_engine
        return Engine(name, maker(scene, max_substeps, outputs), maker(scene, 0, outputs))
    raise ConfigError(f"env.engine={name!r}{nearest(name, ('auto', *ENGINES))}")


def mocap_at(base: Any, orbit: np.ndarray, time: Any, xp: Any) -> Any:
    """Gremlins' mocap bodies go round (travel sin t, travel cos t); all the others rest."""
    circle = xp.stack([xp.sin(time), xp.cos(time), xp.zeros_like(time)], -1)
    return base + orbit[:, None] * circle[..., None, :]


# A world as one row of floats, for the engines whose working data lies outside JAX -----------------

STATE = ("qpos", "qvel", "qacc_warmstart")


def widths(model: mujoco.MjModel, outputs: tuple[str, ...]) -> tuple[dict[str, int], dict[str, int]]:
    """The columns of a row that goes in (`pack`) and of one that comes out (`unpack`)."""
    state = dict(zip(STATE, (model.nq, model.nv, model.nv), strict=True))
    mocap = {"mocap_pos": 3 * model.nmocap, "mocap_quat": 4 * model.nmocap}
    poses = {"geom_xpos": 3 * model.ngeom, "geom_xmat": 9 * model.ngeom, "xquat": 4 * model.nbody}
    into = state | mocap | {"ctrl": model.nu, "done": 1, "substeps": 1}
    out = state | {"sensordata": model.nsensordata} | {name: poses[name] for name in outputs}
    return into, out


def columns(sizes: dict[str, int]) -> dict[str, slice]:
    """Where in a row each part lies."""
    ends = dict(zip(sizes, np.cumsum(list(sizes.values())).tolist(), strict=True))
    return {name: slice(ends[name] - n, ends[name]) for name, n in sizes.items()}


def pack(physics: Physics, ctrl: jax.Array, substeps: jax.Array) -> jax.Array:
    arrays = (physics.qpos, physics.qvel, physics.warmstart, physics.mocap_pos)
    arrays += (physics.mocap_quat, ctrl, physics.substeps, substeps)
    return jnp.concatenate([jnp.ravel(x).astype(jnp.float32) for x in arrays])


def unpack(
    row: jax.Array, sizes: dict[str, int], scene: Scene, physics: Physics, substeps: jax.Array
) -> tuple[Physics, Readings]:
    """What `substeps` made of `physics`, from the row that came out."""
    parts = {name: row[where] for name, where in columns(sizes).items()}
    sensors = parts["sensordata"]

    def pose(name: str, *shape: int) -> jax.Array:
        return parts[name].reshape(-1, *shape) if name in parts else jnp.zeros((0,))

    physics = physics.replace(
        qpos=parts["qpos"],
        qvel=parts["qvel"],
        warmstart=parts["qacc_warmstart"],
        substeps=physics.substeps + substeps,
    )
    return physics, Readings(
        sensors=sensors,
        contacts=sensors[scene.model.nsensordata - scene.contact_count :],
        geom_xpos=pose("geom_xpos", 3),
        geom_xmat=pose("geom_xmat", 3, 3),
        xquat=pose("xquat", 4),
        overflow=parts["overflow"][0] if "overflow" in parts else jnp.zeros(()),
    )


# MuJoCo in C ---------------------------------------------------------------------------------------


def c_engine(scene: Scene, outputs: tuple[str, ...]) -> Run:
    """MuJoCo's thread pool. State crosses as float32; inside, all is float64 as in the original."""
    model = scene.model
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value  # bad states are ours to end
    inputs, results = widths(model, outputs)
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
        if not scene.orbit.any() and (count == count[0]).all():
            if count[0]:
                call(batch.step, nstep=int(count[0]))
        else:
            for k in range(count.max(initial=0)):
                now = time + k * model.opt.timestep
                batch.bind("mocap_pos")[:] = np.where(
                    (k < count)[:, None, None],
                    mocap_at(mocap_pos, scene.orbit, now, np),
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
        return unpack(row, results, scene, physics, substeps)

    return run


# MuJoCo Warp ---------------------------------------------------------------------------------------


def warp_engine(
    scene: Scene, max_substeps: int, outputs: tuple[str, ...], alike: bool, room: float
) -> tuple[Run, Run]:
    """MuJoCo Warp. Its buffers are sized for the whole batch, so the batch is made explicit."""
    if not warp_available():
        raise ConfigError("env.engine='warp': warp-lang is not installed; pip install 'jaxsafe[gpu]'")
    from jaxsafe.envs.engines import physics_warp

    maker, results = physics_warp.warp_engine(scene, outputs, *contact_budget(scene, room))

    def engine(substeps_of_all: int) -> Run:
        advance = maker(substeps_of_all, alike)

        def run_batch(physics: Physics, ctrl: jax.Array, substeps: jax.Array):
            rows = advance(jax.vmap(pack)(physics, ctrl, substeps))
            come_back = partial(unpack, sizes=results, scene=scene)
            return jax.vmap(come_back)(rows, physics=physics, substeps=substeps)

        return batched(run_batch)

    return engine(max_substeps), engine(0)


def batched(run_batch: Callable) -> Callable:
    """A function of one world from one of a batch: every `vmap` adds to the batch."""

    @jax.custom_batching.custom_vmap
    def flat(*args: Any) -> Any:
        return run_batch(*args)

    @flat.def_vmap
    def _(axis_size: int, in_batched: Any, *args: Any) -> Any:
        args = spread(axis_size, in_batched, args)
        each = jax.tree.leaves(args)[0].shape[1]
        out = flat(*jax.tree.map(lambda x: x.reshape(axis_size * each, *x.shape[2:]), args))
        out = jax.tree.map(lambda x: x.reshape(axis_size, each, *x.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    @jax.custom_batching.custom_vmap
    def run(*args: Any) -> Any:
        return jax.tree.map(lambda x: x[0], flat(*jax.tree.map(lambda x: x[None], args)))

    @run.def_vmap
    def _(axis_size: int, in_batched: Any, *args: Any) -> Any:
        out = flat(*spread(axis_size, in_batched, args))
        return out, jax.tree.map(lambda _: True, out)

    return run


def spread(axis_size: int, in_batched: Any, args: Any) -> Any:
    """Give every argument the batch axis."""
    return jax.tree.map(
        lambda x, batched: x if batched else jnp.broadcast_to(x, (axis_size, *x.shape)),
        args,
        tuple(in_batched),
    )


def contact_budget(scene: Scene, room: float = 1.0) -> tuple[int, int]:
    """Contacts per world on average, and constraint rows in the fullest world, times `room`.

    A resting cube touches the floor in 4 points, as do a box's four columns; a robot on wheels or
    legs touches it with some of its geoms; cubes that meet share up to 8 points. Each contact takes
    10 rows (condim 6, pyramidal cone), a weld 6.
    """
    model = scene.model
    resting = 4 * sum(scene.frees.values()) + 16 * scene.frees["box"]
    robot = int((model.body_rootid[model.geom_bodyid] == model.body("robot").id).sum())
    standing = 0 if scene.planar else robot
    average = resting + standing + (8 if scene.frees["box"] else 4)
    fullest = 10 * (resting + 2 * standing + 16) + 6 * scene.frees["gremlins"]
    return math.ceil(room * average), math.ceil(room * fullest) + int(model.jnt_limited.sum())

"""What every engine is given, and what it gives back."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxsafe.config import ConfigError, nearest

FIELDS = {  # what an engine can report: what there are as many of, and the shape of each
    "xpos": ("nbody", (3,)),
    "xquat": ("nbody", (4,)),
    "xmat": ("nbody", (3, 3)),
    "geom_xpos": ("ngeom", (3,)),
    "geom_xmat": ("ngeom", (3, 3)),
    "site_xpos": ("nsite", (3,)),
    "site_xmat": ("nsite", (3, 3)),
    "subtree_com": ("nbody", (3,)),
    "cinert": ("nbody", (10,)),
    "cvel": ("nbody", (6,)),
    "cfrc_ext": ("nbody", (6,)),
    "qfrc_actuator": ("nv", ()),
}


class Room(NamedTuple):
    """What engine warp reserves memory for."""

    contacts: int  # of a world, on average over the batch
    rows: int  # of constraints, in the fullest world


@dataclass(frozen=True)
class Simulation:
    """A MuJoCo model, and what an engine does with it and reports of it.

    spec: the model, as `mujoco.MjSpec.from_string` or `from_file` reads it. Engines copy it.
    substeps: physics steps in a call of `Engine.run`, or the most of them if `varied`.
    varied: whether calls differ in how many physics steps they take.
    fields: what to report, of `FIELDS`: poses, inertias, velocities, forces, as MuJoCo has them.
    contacts: pairs of bodies' names. An engine reports how many contact points the first body, or a
        body that it carries, has with the second. The floor belongs to the body 'world'.
    orbits: float [nmocap], in m, or None. After t seconds mocap body i is at its place plus
        orbits[i] (sin t, cos t, 0); a body with 0 rests.
    pillars: mocap bodies whose cylinders stand upright, and so tall that no box reaches their ends.
        Engine warp then has contacts of cylinder and box in closed form.
    room: memory for contacts on engine warp; None is MuJoCo Warp's own estimate.
    """

    spec: mujoco.MjSpec
    substeps: int = 1
    varied: bool = False
    fields: tuple[str, ...] = ()
    contacts: tuple[tuple[str, str], ...] = ()
    orbits: np.ndarray | None = field(default=None, compare=False)
    pillars: tuple[str, ...] = ()
    room: Room | None = None

    def compile(self, count: bool) -> mujoco.MjModel:
        """The model; if `count`, with sensors after its own: one that forces among `fields` need, then
        one for each pair of `contacts`.

        Raises:
            ConfigError: MuJoCo cannot compile it, a body or field has an unknown name, or an actuator
                has a state, which `Physics` does not hold.
        """
        bodies = {body.name for body in self.spec.bodies}
        for name in (name for pair in self.contacts for name in pair):
            if name not in bodies:
                raise ConfigError(f"contacts: the model has no body {name!r}{nearest(name, bodies)}")
        for name in self.fields:
            if name not in FIELDS:
                raise ConfigError(f"fields: {name!r} cannot be reported{nearest(name, FIELDS)}")
        spec = self.spec.copy()
        if count and self.unread:  # MuJoCo computes forces on bodies for such a sensor alone
            spec.add_sensor(
                name="for cfrc_ext",
                type=mujoco.mjtSensor.mjSENS_FRAMELINACC,
                objtype=mujoco.mjtObj.mjOBJ_XBODY,
                objname="world",
            )
        for one, other in self.contacts if count else ():
            spec.add_sensor(
                name=f"contacts of {one} and {other}",
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=mujoco.mjtObj.mjOBJ_XBODY,  # with all that it carries
                objname=one,
                reftype=mujoco.mjtObj.mjOBJ_BODY,
                refname=other,
                intprm=[1 << mujoco.mjtConDataField.mjCONDATA_FOUND.value, 0, 1],
            )
        try:
            model = spec.compile()
        except ValueError as error:
            reason = str(error).splitlines()[0]
            raise ConfigError(f"MuJoCo cannot compile the model: {reason}") from error
        if model.na:
            raise ConfigError("expected actuators without a state (no muscles, no filters)")
        return model

    @property
    def unread(self) -> int:
        """Floats of sensors that stand before those of contacts and are not the model's own."""
        return 3 if "cfrc_ext" in self.fields else 0

    def orbits_of(self, model: mujoco.MjModel) -> np.ndarray:
        """`orbits`, float [nmocap]; zeros where none are given."""
        return np.zeros(model.nmocap) if self.orbits is None else np.asarray(self.orbits, float)


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
    """What a forward pass shows."""

    sensors: jax.Array  # [nsensordata], those of the model
    contacts: jax.Array  # [pairs], how many contact points each pair of `Simulation.contacts` has
    fields: dict[str, jax.Array]  # those of `Simulation.fields`, in MuJoCo's shapes
    overflow: jax.Array  # float [], 1 where this world's rows or the batch's contacts found no room


PhysicsCall = Callable[[Physics, jax.Array, jax.Array], tuple[Physics, Readings]]


class Engine(NamedTuple):
    """Physics of one world as pure functions; callers `vmap`, over environments and again over seeds.

    `run` calls `advance`, and `forward` calls `show`.
    """

    name: str
    model: mujoco.MjModel  # compiled
    substeps: int  # of `Simulation`
    advance: PhysicsCall
    show: PhysicsCall

    def run(
        self, physics: Physics, ctrl: jax.Array, substeps: jax.Array | int | None = None
    ) -> tuple[Physics, Readings]:
        """Physics steps with controls held, float [nu], then a forward pass at the new state.

        substeps: how many, where calls are `varied`; None: all that the simulation names.
        """
        count = self.substeps if substeps is None else substeps
        return self.advance(physics, ctrl, jnp.asarray(count, jnp.int32))

    def forward(self, physics: Physics, ctrl: jax.Array) -> tuple[Physics, Readings]:
        """The forward pass alone."""
        return self.show(physics, ctrl, jnp.int32(0))

    def start(self, qpos: Any = None, qvel: Any = None) -> Physics:
        """A state at rest in the model's reference pose, but for the `qpos` [nq] and `qvel` [nv] given.

        Mocap bodies are where the model has them.
        """
        model = self.model
        mocap = np.argsort(model.body_mocapid)[model.nbody - model.nmocap :]
        return Physics(
            qpos=jnp.asarray(model.qpos0 if qpos is None else qpos, jnp.float32),
            qvel=jnp.zeros(model.nv) if qvel is None else jnp.asarray(qvel, jnp.float32),
            warmstart=jnp.zeros(model.nv),
            mocap_pos=jnp.asarray(model.body_pos[mocap], jnp.float32),
            mocap_quat=jnp.asarray(model.body_quat[mocap], jnp.float32),
            substeps=jnp.int32(0),
        )


def mocap_at(base: Any, orbits: np.ndarray, time: Any, xp: Any) -> Any:
    """Where mocap bodies are at `time` (s), [..., nmocap, 3]: see `Simulation.orbits`."""
    circle = xp.stack([xp.sin(time), xp.cos(time), xp.zeros_like(time)], -1)
    return base + orbits[:, None] * circle[..., None, :]


def is_bad(*parts: jax.Array) -> jax.Array:
    """Whether a number is NaN or beyond MuJoCo's mjMAXVAL: the physics failed, bool []."""
    return ~jnp.stack([(jnp.abs(x) < mujoco.mjMAXVAL).all() for x in parts]).all()

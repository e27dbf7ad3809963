"""Engine `jax`: a physics step of MJX, with contacts and a solver of our own."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import forward, scan

from jaxsafe.config import ConfigError
from jaxsafe.envs.engines.jax import contacts  # noqa: F401  (registers our collisions with MJX)
from jaxsafe.envs.engines.jax.solver import solve
from jaxsafe.envs.engines.rows import STATE
from jaxsafe.envs.engines.simulation import Engine, Physics, PhysicsCall, Readings, Simulation, mocap_at

State = dict[str, jax.Array]  # of a world between two substeps
IN_IMPL = ("cinert", "cfrc_ext")  # fields of an engine's own part of MJX's data


def forward_pass(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`data` with what follows from its positions and velocities, to the accelerations."""
    data = mjx.fwd_velocity(model, mjx.fwd_position(model, data))
    data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))
    return solve(model, data)


def euler(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    return mjx.euler(model, forward_pass(model, data))


def implicitfast(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    return mjx.implicit(model, forward_pass(model, data))


def runge_kutta(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """A step of the fourth order, from slopes k at four stages.

        k_i = f(x + a_i h k_{i-1}),   x(t + h) = x + h sum_i b_i k_i

    x: positions and velocities, f: velocities and accelerations. Positions move on their manifold.
    Source: Kutta (1901), as MuJoCo has it.
    """
    h, qpos, qvel = model.opt.timestep, data.qpos, data.qvel
    zero = jnp.zeros_like(qvel)

    def moved(velocity: jax.Array, seconds: jax.Array) -> jax.Array:
        def integrate(*args: Any) -> jax.Array:
            return forward._integrate_pos(*args, dt=seconds)

        return scan.flat(model, integrate, "jqv", "q", model.jnt_type, qpos, velocity)

    def stage(carry: Any, weights: tuple[jax.Array, jax.Array]) -> tuple[Any, None]:
        (velocity, acceleration), (sum_v, sum_a), _ = carry
        a, b = weights
        at = data.replace(qpos=moved(velocity, a * h), qvel=qvel + a * h * acceleration)
        at = forward_pass(model, at)
        slope = at.qvel, at.qacc
        return (slope, (sum_v + b * at.qvel, sum_a + b * at.qacc), at.qacc), None

    weights = jnp.array([0, 1 / 2, 1 / 2, 1]), jnp.array([1 / 6, 1 / 3, 1 / 3, 1 / 6])
    start = (qvel, zero), (zero, zero), zero
    (_, (velocity, acceleration), last), _ = jax.lax.scan(stage, start, weights)
    return data.replace(qpos=moved(velocity, h), qvel=qvel + h * acceleration, qacc_warmstart=last)


INTEGRATORS = {  # a step, its forward passes included
    mujoco.mjtIntegrator.mjINT_EULER: euler,
    mujoco.mjtIntegrator.mjINT_IMPLICITFAST: implicitfast,
    mujoco.mjtIntegrator.mjINT_RK4: runge_kutta,
}


def make(simulation: Simulation) -> Engine:
    """
    Raises:
        ConfigError: a model with an integrator, cone or part that MJX or our solver does not have.
    """
    compiled = simulation.compile(count=False)
    option = compiled.opt
    if option.integrator not in INTEGRATORS or option.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL:
        raise ConfigError(
            "env.engine='jax': expected a model with integrator Euler, implicitfast or RK4 and "
            "pyramidal friction cones; c and warp take other integrators and cones"
        )
    try:
        with jax.ensure_compile_time_eval():
            model = mjx.put_model(compiled, impl="jax")
            template = mjx.make_data(compiled, impl="jax")
    except NotImplementedError as error:
        raise ConfigError(f"env.engine='jax': MJX cannot run the model: {error}") from error
    several, none = (runner(simulation, compiled, model, template, n) for n in (simulation.substeps, 0))
    return Engine("jax", compiled, simulation.substeps, several, none)


def runner(
    simulation: Simulation,
    compiled: mujoco.MjModel,
    model: mjx.Model,
    template: mjx.Data,
    most: int,  # substeps
) -> PhysicsCall:
    integrate = INTEGRATORS[compiled.opt.integrator]
    ones, others = map(jnp.asarray, contact_geoms(simulation, compiled))
    orbits = simulation.orbits_of(compiled)
    timestep = compiled.opt.timestep

    def readings(data: mjx.Data) -> Readings:
        if "cfrc_ext" in simulation.fields:
            data = mjx.rne_postconstraint(model, data)
        for sense in (mjx.sensor_pos, mjx.sensor_vel, mjx.sensor_acc):
            data = sense(model, data)
        contact = data._impl.contact  # type: ignore[union-attr]
        first, second = contact.geom[:, 0], contact.geom[:, 1]
        met = ones[first] & others[second] | ones[second] & others[first]
        return Readings(
            sensors=data.sensordata,
            contacts=(met & (contact.dist <= 0)[:, None]).sum(0).astype(jnp.float32),
            fields={
                name: getattr(data._impl if name in IN_IMPL else data, name)
                for name in simulation.fields
            },
            overflow=jnp.zeros(()),
        )

    # GPUs would multiply matrices with 10 bits of mantissa, TPUs with 7
    @jax.default_matmul_precision("highest")
    def run(physics: Physics, ctrl: jax.Array, substeps: jax.Array) -> tuple[Physics, Readings]:
        base = physics.mocap_pos
        start = template.replace(ctrl=ctrl, mocap_pos=base, mocap_quat=physics.mocap_quat)

        def after(state: State, k: jax.Array) -> mjx.Data:
            """`state` and the guides, k substeps from the start."""
            data = start.replace(**state)
            if not orbits.any():
                return data
            time = (physics.substeps + k) * timestep
            moved = mocap_at(base, orbits, time, jnp)
            return data.replace(mocap_pos=jnp.where(substeps > 0, moved, base))

        def substep(state: State, k: jax.Array) -> tuple[State, None]:
            moved = integrate(model, after(state, k))
            return {f: jnp.where(k < substeps, getattr(moved, f), state[f]) for f in STATE}, None

        state: State = dict(zip(STATE, (physics.qpos, physics.qvel, physics.warmstart), strict=True))
        if most:
            state, _ = jax.lax.scan(substep, state, jnp.arange(most))
        data = after(state, substeps - 1)  # guides stay where the last substep had them
        shown = readings(forward_pass(model, data))
        moved = physics.replace(
            qpos=state["qpos"],
            qvel=state["qvel"],
            warmstart=state["qacc_warmstart"],
            substeps=physics.substeps + substeps,
        )
        return moved, shown

    return run


def contact_geoms(simulation: Simulation, model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """For each pair of `simulation.contacts`, which geoms are the first body's, or of a body that it
    carries, and which are the second's: bool [ngeom, pairs] each."""
    ones = np.zeros((model.ngeom, len(simulation.contacts)), bool)
    others = np.zeros_like(ones)
    for k, names in enumerate(simulation.contacts):
        one, other = (model.body(name).id for name in names)
        carried = {one}
        for body in range(one + 1, model.nbody):  # a parent comes before its children
            if model.body_parentid[body] in carried:
                carried.add(body)
        ones[:, k] = np.isin(model.geom_bodyid, list(carried))
        others[:, k] = model.geom_bodyid == other
    return ones, others

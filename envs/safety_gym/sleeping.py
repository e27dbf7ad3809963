"""Sleeping objects: of many vases and gremlins, simulate only the k that can meet the robot.

An engine is built for a scene with k bodies of each kind. Before its substeps the k objects that move
or are nearest to the robot take these bodies' places, and afterwards they go back. Vases that sleep
are at rest; gremlins that sleep follow the path that they take while nothing touches them. What is
lost: nobody bumps into a sleeping object, and of more than k moving vases the farthest stop at once.
"""

import dataclasses
from functools import lru_cache
from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxsafe.config import ConfigError
from jaxsafe.envs.engines import Engine, Physics, PhysicsCall, Readings
from jaxsafe.envs.safety_gym import scene as scenes
from jaxsafe.envs.safety_gym.config import SafetyGymConfig
from jaxsafe.envs.safety_gym.scene import Scene

SLEEPERS = ("vases", "gremlins")
MOVING = 1e-4  # m/s; a vase that is faster, or is charged for its speed, does not fall asleep
AWAKE = 2  # on the engines warp and jax
SETTLE = 1.0  # s after which a gremlin is on its circle; its weld's time constant is 0.02 s


def awake(cfg: SafetyGymConfig, engine: str) -> int:
    """How many vases, and how many gremlins, are simulated at once.

    Raises:
        ConfigError: fewer than all, where the poses of all are observed.
    """
    total = max(getattr(cfg, f"{kind}_num") for kind in SLEEPERS)
    poses_needed = cfg.lidar_type == "natural" or cfg.reward_orientation
    if cfg.awake is None:
        return total if poses_needed or engine == "c" else AWAKE
    if cfg.awake < total and poses_needed:
        raise ConfigError(
            f"env.awake={cfg.awake}: expected {total} or null with env.lidar_type=natural or "
            "env.reward_orientation=true, which need the poses of all objects"
        )
    return cfg.awake


def small_config(cfg: SafetyGymConfig, awake: int) -> SafetyGymConfig:
    """The config of a scene with at most `awake` objects of each kind that sleeps."""
    counts = {f"{kind}_num": min(awake, getattr(cfg, f"{kind}_num")) for kind in SLEEPERS}
    return dataclasses.replace(cfg, **counts)


def with_sleepers(engine: Engine, small: Scene, scene: Scene, cfg: SafetyGymConfig) -> Engine:
    """The engine of `scene` from that of `small`, which differs by having fewer vases and gremlins."""
    shape = (cfg.gremlins_size, cfg.gremlins_density, cfg.gremlins_travel)
    path = undisturbed(*shape, scene.model.opt.timestep)
    moving = min(MOVING, cfg.vases_velocity_threshold)

    def wake(run: PhysicsCall) -> PhysicsCall:
        def woken(physics: Physics, ctrl: jax.Array, substeps: jax.Array) -> tuple[Physics, Readings]:
            chosen = {kind: awake_objects(physics, scene, small, kind, moving) for kind in SLEEPERS}
            at = places(scene, chosen)
            few = physics.replace(
                qpos=physics.qpos[at.qpos],
                qvel=physics.qvel[at.qvel],
                warmstart=physics.warmstart[at.qvel],
                mocap_pos=physics.mocap_pos[at.mocap],
                mocap_quat=physics.mocap_quat[at.mocap],
            )
            few, readings = run(few, ctrl, substeps)
            physics = rest(physics, scene, path, few.substeps)
            physics = physics.replace(
                qpos=physics.qpos.at[at.qpos].set(few.qpos),
                qvel=physics.qvel.at[at.qvel].set(few.qvel),
                warmstart=physics.warmstart.at[at.qvel].set(few.warmstart),
                substeps=few.substeps,
            )
            contacts = jnp.zeros(scene.contact_count).at[at.contact].set(readings.contacts)
            return physics, dataclasses.replace(readings, contacts=contacts)

        return woken

    advance, show = wake(engine.advance), wake(engine.show)
    return Engine(engine.name, scene.model, engine.substeps, advance, show)


class Places(NamedTuple):
    """Where the small scene's elements are among the whole scene's: int [nq], [nv], [nmocap] and
    [watched objects] of the small one."""

    qpos: jax.Array
    qvel: jax.Array
    mocap: jax.Array
    contact: jax.Array


def places(scene: Scene, awake: dict[str, jax.Array]) -> Places:
    def elements(start: int, count: int, width: int, kind: str) -> jax.Array:
        objects = awake.get(kind, jnp.arange(count))
        return (start + width * objects[:, None] + jnp.arange(width)).reshape(-1)

    frees, mocaps = scene.frees, scene.mocaps
    qpos = [elements(scene.qpos_slice(kind).start, frees[kind], 7, kind) for kind in scenes.FREES]
    qvel = [elements(scene.qvel_slice(kind).start, frees[kind], 6, kind) for kind in scenes.FREES]
    mocap = [elements(scene.mocap_slice(kind).start, mocaps[kind], 1, kind) for kind in scenes.MOCAPS]
    watched = [
        elements(scene.contact_slice(kind).start, len(names), 1, kind)
        for kind, names in scene.watched.items()
        if names
    ]
    return Places(
        qpos=jnp.concatenate([jnp.arange(scene.robot_nq), *qpos]),
        qvel=jnp.concatenate([jnp.arange(scene.robot_nv), *qvel]),
        mocap=jnp.concatenate(mocap),
        contact=jnp.concatenate([jnp.zeros(0, int), *watched]),
    )


def awake_objects(
    physics: Physics, scene: Scene, small: Scene, kind: str, moving: float = MOVING
) -> jax.Array:
    """The objects of a kind that are awake, int [k], in their order: vases at least as fast as `moving`
    (m/s), then the nearest."""
    pose = physics.qpos[scene.qpos_slice(kind)].reshape(-1, 7)
    distance = jnp.linalg.norm(pose[:, :2] - physics.qpos[:2], axis=1)
    if kind == "vases":
        velocity = physics.qvel[scene.qvel_slice(kind)].reshape(-1, 6)[:, :3]
        fast = jnp.linalg.norm(velocity, axis=1) >= moving
        distance = jnp.where(fast, distance / (1 + distance) - 1, distance)  # below 0, in order
    return jnp.sort(jnp.argsort(distance)[: small.frees[kind]])


class GremlinPath(NamedTuple):
    """How a gremlin moves while nothing touches it, relative to its circle's centre and its guide's
    height: on a circle of `radius` (m), `lag` (rad) behind its guide, `height` (m) above it.

    start: float [substeps, 6], position (m) and velocity (m/s) after so many substeps, less those of
    the circle; from the last row on there is no difference.
    """

    radius: float
    lag: float
    height: float
    start: np.ndarray

    def at(self, time: jax.Array | np.ndarray, xp: ModuleType) -> jax.Array:
        """Position and velocity [..., 6] on the circle at `time` (s)."""
        sin, cos = (self.radius * f(time - self.lag) for f in (xp.sin, xp.cos))
        zero = xp.zeros_like(sin)
        return xp.stack([sin, cos, zero + self.height, cos, -sin, zero], -1)


@lru_cache
def undisturbed(size: float, density: float, travel: float, timestep: float) -> GremlinPath:
    """Where the weld to its guide takes a gremlin, from a simulation of one alone."""
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    scenes.add_block(spec, "gremlin0obj", "gremlin", size, size, density)
    scenes.add_gremlin_guide(spec, 0, size)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[2] = size
    states = []
    for _ in range(round(SETTLE / timestep)):
        states.append(np.concatenate([data.qpos[:2], data.qpos[2:3] - 2 * size, data.qvel[:3]]))
        data.mocap_pos[0] = [travel * np.sin(data.time), travel * np.cos(data.time), 2 * size]
        mujoco.mj_step(model, data)
    x, y, height = states[-1][:3]
    time = timestep * np.arange(len(states))
    circle = GremlinPath(float(np.hypot(x, y)), float(time[-1] - np.arctan2(x, y)), float(height), time)
    return circle._replace(start=np.float32(np.array(states) - circle.at(time, np)))


def rest(physics: Physics, scene: Scene, path: GremlinPath, substeps: jax.Array) -> Physics:
    """`physics` with all vases at rest, and all gremlins where `substeps` take them if alone."""
    vases, gremlins = scene.qvel_slice("vases"), scene.qvel_slice("gremlins")
    qpos = physics.qpos
    qvel = physics.qvel.at[vases].set(0.0)
    warmstart = physics.warmstart.at[vases].set(0.0).at[gremlins].set(0.0)
    if scene.frees["gremlins"]:
        now = path.at(substeps * scene.model.opt.timestep, jnp)
        now += jnp.asarray(path.start)[jnp.minimum(substeps, len(path.start) - 1)]
        guides = scene.mocap_slice("gremlins")
        position, turn = physics.mocap_pos[guides] + now[:3], physics.mocap_quat[guides]
        poses = jnp.concatenate([position, turn], axis=1)
        velocity = jnp.tile(jnp.append(now[3:], jnp.zeros(3)), scene.frees["gremlins"])
        qpos = qpos.at[scene.qpos_slice("gremlins")].set(poses.reshape(-1))
        qvel = qvel.at[gremlins].set(velocity)
    return physics.replace(qpos=qpos, qvel=qvel, warmstart=warmstart)

"""What a robot observes, component by component. Source: Safety Gym's Engine, `obs`."""

from collections.abc import Iterable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxsafe.envs import engines
from jaxsafe.envs.engines import Readings
from jaxsafe.envs.safety_gym import layout as layouts
from jaxsafe.envs.safety_gym import scene as scenes
from jaxsafe.envs.safety_gym import sensing
from jaxsafe.envs.safety_gym.arena import Arena, World, norm
from jaxsafe.envs.vision.poses import rotation_of

COORDINATE_SENSORS = ("velocimeter", "accelerometer", "gyro", "magnetometer")
HAZARDS_AT = 9  # numbers before the hazards', where coordinates are observed
RAY_HEIGHT = 0.3  # m, of natural lidar's rays by SEditor's rules


def observe(
    arena: Arena, world: World, readings: Readings, ctrl: jax.Array, slack: float = 0.0
) -> jax.Array:
    """The flat observation [obs_size], or the components by name.

    slack: thickens what natural lidar sees, in m; see `sensing.natural_lidar`.
    """
    parts = components(arena, world, readings, ctrl, slack)
    if not arena.config.observation_flatten:
        return parts  # type: ignore[return-value]
    if not parts:
        return jnp.zeros(0)
    return jnp.concatenate([parts[name].reshape(-1) for name in parts])


def components(
    arena: Arena, world: World, readings: Readings, ctrl: jax.Array, slack: float = 0.0
) -> dict[str, jax.Array]:
    """Every observed component by name, in order."""
    cfg = arena.config
    if cfg.observation == "coordinates":
        return coordinates(arena, world, readings)
    position, rotation = arena.robot_pose(world)
    goal = arena.goal_position(world)
    parts: dict[str, jax.Array] = {}
    if cfg.observe_sensors:
        parts |= sensor_parts(arena, readings)
    if cfg.observe_goal_dist:
        parts["goal_dist"] = jnp.exp(-norm((position - goal)[:2]))[None]
    if cfg.observe_goal_comp:
        parts["goal_compass"] = sensing.compass(goal, position, rotation, cfg.compass_shape)
    if cfg.observe_box_comp and cfg.task == "push":
        parts["box_compass"] = sensing.compass(
            arena.box_position(world), position, rotation, cfg.compass_shape
        )
    parts |= lidars(arena, world, readings, goal, slack)
    if cfg.observe_remaining:
        parts["remaining"] = (world.steps / cfg.num_steps)[None]
    if cfg.observe_qpos:
        parts["qpos"] = from_start(arena, world, world.bodies.qpos, 3)
    if cfg.observe_qvel:
        parts["qvel"] = from_start(arena, world, world.bodies.qvel, 2)
    if cfg.observe_ctrl:
        parts["ctrl"] = ctrl
    if cfg.observe_freejoint:
        parts["freejoint"] = world.bodies.qpos[:7]
    if cfg.observe_com:
        parts["com"] = arena.sensor(readings, "subtreecom")
    return {name: parts[name] for name in in_order(arena, parts)}


def in_order(arena: Arena, names: Iterable[str]) -> list[str]:
    """By name; in Safety-Gymnasium sensors, velocities and angles of joints, then kind by kind.
    Coordinates are in the order of OmniSafe."""
    if arena.config.observation == "coordinates":
        return [*names]
    if arena.config.rules != "safety_gymnasium":
        return sorted(names)
    order = list(arena.config.sensors_obs)
    for kind in scenes.JOINT_SENSORS:
        order += [name for name, (_, found) in arena.sensors.items() if found == kind]
    for kind in (*layouts.ORDER[arena.config.rules], "circle"):
        order += [f"{kind}_lidar", f"{kind}_compass"]
    return sorted(names, key=order.index)


def coordinates(arena: Arena, world: World, readings: Readings) -> dict[str, jax.Array]:
    """What OmniSafe's planning algorithms observe: 13 numbers, and 2 for each hazard.

    Positions are in m, in the frame of the robot, whose x axis points ahead; the robot's own is in the
    frame of the world. Source: OmniSafe, `safety_gymnasium_modelbased.py`.
    """
    position, rotation = arena.robot_pose(world)

    def ego(targets: jax.Array) -> jax.Array:
        return sensing.in_frame(targets, position, rotation)

    def sensor(name: str) -> jax.Array:
        return arena.sensor(readings, name)

    return {
        "velocimeter": sensor("velocimeter")[:2],
        "accelerometer": sensor("accelerometer")[:1],
        "gyro": sensor("gyro")[2:],
        "magnetometer": sensor("magnetometer"),
        "goal": ego(arena.goal_position(world)[None, :2])[0],
        **({"hazards": ego(arena.positions(world, "hazards"))} if arena.config.hazards_num else {}),
        "heading": rotation[0, :2],
        "position": position[:2],
    }


def sensor_parts(arena: Arena, readings: Readings) -> dict[str, jax.Array]:
    model, angles = arena.scene.model, arena.config.sensors_angle_components
    parts = {name: arena.sensor(readings, name) for name in arena.config.sensors_obs}
    for name, (_, kind) in arena.sensors.items():
        value = arena.sensor(readings, name)
        if kind == mujoco.mjtSensor.mjSENS_JOINTPOS:
            parts[name] = jnp.concatenate([jnp.sin(value), jnp.cos(value)]) if angles else value
        elif kind == mujoco.mjtSensor.mjSENS_BALLQUAT:
            parts[name] = rotation_of(value) if angles else value
        elif kind in (mujoco.mjtSensor.mjSENS_JOINTVEL, mujoco.mjtSensor.mjSENS_BALLANGVEL):
            parts[name] = value
    assert model.nsensordata == readings.sensors.shape[-1]
    return parts


def lidars(
    arena: Arena, world: World, readings: Readings, goal: jax.Array, slack: float
) -> dict[str, jax.Array]:
    cfg = arena.config
    seen = {  # name: targets [n, 2]
        "goal": goal[None, :2] if cfg.observe_goal_lidar else None,
        "box": arena.positions(world, "box") if cfg.task == "push" and cfg.observe_box_lidar else None,
        "circle": jnp.zeros((1, 2)) if cfg.task == "circle" and cfg.observe_circle else None,
        "hazards": arena.positions(world, "hazards") if cfg.observe_hazards else None,
        "vases": arena.positions(world, "vases") if cfg.observe_vases else None,
    }
    for kind in ("walls", "pillars", "buttons", "gremlins"):
        watched = getattr(cfg, f"{kind}_num") and getattr(cfg, f"observe_{kind}")
        seen[kind] = arena.positions(world, kind) if watched else None
    position, rotation = arena.robot_pose(world)
    parts = {}
    for name, targets in seen.items():
        if targets is None:
            continue
        if cfg.lidar_type == "natural":
            group = scenes.GROUP[name if name in scenes.GROUP else name[:-1]]
            shapes = shapes_of(arena, world, readings)
            source, turn = position, rotation
            if cfg.rules == "seditor":  # level, also where the robot tilts
                source, turn = position.at[2].set(RAY_HEIGHT), rotation.at[2].set(0.0)
            lidar = sensing.natural_lidar(shapes, source, turn, cfg.lidar_num_bins, group, slack)
        else:
            law = (cfg.lidar_max_dist, cfg.lidar_exp_gain, cfg.lidar_alias)
            lidar = sensing.pseudo_lidar(targets, position, rotation, cfg.lidar_num_bins, *law)
        if name == "buttons":
            asleep = -lidar if cfg.rules == "seditor" else jnp.zeros_like(lidar)
            lidar = jnp.where(world.buttons_timer == 0, lidar, asleep)
        parts[f"{name}_lidar"] = lidar
    return parts


def shapes_of(arena: Arena, world: World, readings: Readings) -> sensing.Shapes:
    """All geoms that a ray can meet: the model's, and those that are no part of the physics."""
    cfg, model = arena.config, arena.scene.model
    others = np.flatnonzero(model.geom_bodyid != model.body("robot").id)
    kinds, sizes, groups = (
        model.geom_type[others],
        model.geom_size[others],
        model.geom_group[others],
    )
    position, rotation = (readings.fields[name][others] for name in ("geom_xpos", "geom_xmat"))
    cylinder, box = int(mujoco.mjtGeom.mjGEOM_CYLINDER), int(mujoco.mjtGeom.mjGEOM_BOX)
    extra: list[tuple] = []  # type, size, group, position, rotation
    radius, half = arena.goal_mark
    if radius:
        place = arena.goal_position(world).at[2].set(half + 0.01)
        extra.append((cylinder, (radius, half, 0), scenes.GROUP["goal"], place, jnp.eye(3)))
    for xy in arena.positions(world, "hazards"):
        half = cfg.half_height(0.01)
        place = jnp.append(xy, half + 0.01)
        extra.append((cylinder, (cfg.hazards_size, half, 0), scenes.GROUP["hazard"], place, jnp.eye(3)))
    if cfg.gremlins_num:
        physics, timestep = world.bodies, model.opt.timestep
        last = (physics.substeps - 1) * timestep
        guides = engines.mocap_at(physics.mocap_pos, arena.scene.orbit, last, jnp)
        resting = physics.mocap_pos - jnp.array([0.0, 0.0, cfg.half_height(cfg.gremlins_size)])
        guides = jnp.where(physics.substeps > 0, guides, resting)
        for i in range(cfg.gremlins_num):
            turn = rotation_of(physics.mocap_quat[i])
            side = cfg.gremlins_size
            size = (side, side, cfg.half_height(side))
            extra.append((box, size, scenes.GROUP["gremlin"], guides[i], turn))
    if extra:
        kind, size, group, place, turn = zip(*extra, strict=True)
        kinds, groups = np.append(kinds, kind), np.append(groups, group)
        sizes = np.concatenate([sizes, np.array(size)])
        position = jnp.concatenate([position, jnp.stack(place)])
        rotation = jnp.concatenate([rotation, jnp.stack(turn)])
    return sensing.Shapes(kinds, sizes, groups, position, rotation)


def from_start(arena: Arena, world: World, vector: jax.Array, pose_size: int) -> jax.Array:
    """Point's coordinates are relative to its start in the original: qpos (3) and qvel (2)."""
    if not arena.scene.planar:
        return vector
    c, s = jnp.cos(world.start[2]), jnp.sin(world.start[2])
    offset = world.start if pose_size == 3 else jnp.zeros(3)
    x, y = vector[0] - offset[0], vector[1] - offset[1]
    return vector.at[:3].set(jnp.stack([c * x + s * y, c * y - s * x, vector[2] - offset[2]]))

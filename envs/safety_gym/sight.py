"""What a camera of a task sees.

The picture shows the scene and, as bodies of a model that is only drawn, what is no body in the
physics: goal, hazards and circle. As in Safety Gym it does not show which button is to be pressed.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco

from jaxsafe.config import ConfigError, nearest
from jaxsafe.envs import engines
from jaxsafe.envs.safety_gym import scene as scenes
from jaxsafe.envs.safety_gym.arena import Arena, World
from jaxsafe.envs.vision.eye import make_eye


class Mark(NamedTuple):
    """Cylinders of one kind that are not physics. size: radius and half height; height: of their
    centres (m)."""

    kind: str
    count: int
    size: tuple[float, float]
    height: float


def marks_of(arena: Arena) -> list[Mark]:
    cfg, flat = arena.config, arena.config.half_height(0.01)
    radius, half = arena.goal_mark
    return [
        mark
        for mark in (
            Mark("circle", int(cfg.task == "circle"), (cfg.circle_radius, 0.01), 0.02),
            Mark("hazard", cfg.hazards_num, (cfg.hazards_size, flat), flat + 0.01),
            Mark("goal", int(radius > 0), (radius, half), half + 0.01),
        )
        if mark.count
    ]


def drawn_model(arena: Arena) -> mujoco.MjModel:
    """The scene with its marks, whose mocap bodies come after those of the physics."""
    spec = scenes.build(arena.config, drawn=True).spec.copy()
    for mark in marks_of(arena):
        for i in range(mark.count):
            body = spec.worldbody.add_body(name=f"{mark.kind}{i}", mocap=True)
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CYLINDER,
                size=(*mark.size, 0),
                contype=0,
                conaffinity=0,
                **scenes.look(mark.kind),
            )
    return spec.compile()


def mocap_poses(arena: Arena, world: World) -> tuple[jax.Array, jax.Array]:
    """Positions [n, 3] and quaternions [n, 4] of the mocap bodies of `drawn_model`."""
    physics, scene = world.bodies, arena.scene
    time = jnp.maximum(physics.substeps - 1, 0) * scene.model.opt.timestep
    guides = engines.mocap_at(physics.mocap_pos, scene.orbit, time, jnp)
    # gremlins start at their circles' centres
    positions = [jnp.where(physics.substeps > 0, guides, physics.mocap_pos)]
    positions += [places(arena, world, mark) for mark in marks_of(arena)]
    position = jnp.concatenate(positions)
    upright = jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (len(position) - len(physics.mocap_quat), 1))
    return position, jnp.concatenate([physics.mocap_quat, upright])


def places(arena: Arena, world: World, mark: Mark) -> jax.Array:
    """Where the centres of a mark are, float [count, 3] (m)."""
    xy = {
        "circle": lambda: jnp.zeros((1, 2)),
        "hazard": lambda: arena.positions(world, "hazards"),
        "goal": lambda: arena.goal_position(world)[None, :2],
    }[mark.kind]()
    return jnp.pad(xy, ((0, 0), (0, 1)), constant_values=mark.height)


def make_sight(arena: Arena) -> Callable[[World], jax.Array]:
    """What draws the picture of a world, uint8 [height, width, 3], by the config's camera and size.

    Raises:
        ConfigError: an unknown camera, or a robot that cannot be drawn.
    """
    cfg, model = arena.config, drawn_model(arena)
    names = [model.camera(i).name for i in range(model.ncam)]
    if cfg.vision_camera not in names:
        raise ConfigError(f"env.vision_camera={cfg.vision_camera!r}{nearest(cfg.vision_camera, names)}")
    try:
        eye = make_eye(model, cfg.vision_camera, cfg.vision_size)
    except ValueError as error:
        raise ConfigError(f"env.observe_vision=true: {cfg.robot_base}: {error}") from None
    return lambda world: eye(world.bodies.qpos, *mocap_poses(arena, world))

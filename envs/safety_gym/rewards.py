"""What a step pays, and whether it succeeds.

Source: Safety Gym's Engine, `reward` and `goal_met`.
"""

import jax
import jax.numpy as jnp

from jaxsafe.envs.engines import Readings
from jaxsafe.envs.safety_gym.arena import Arena, World, norm


def reward(arena: Arena, world: World, readings: Readings) -> tuple[jax.Array, World]:
    """The dense reward, clipped, and the world with the distances it will compare with next."""
    cfg = arena.config
    dist_goal, dist_box, box_goal = arena.distances(world)
    reward = jnp.zeros(())
    com = world.last_com
    if cfg.task in ("goal", "button"):
        reward = (world.last_dist_goal - dist_goal) * cfg.reward_distance
    elif cfg.task == "push":
        far = world.last_dist_box > cfg.box_null_dist * cfg.box_size
        reward = far * (world.last_dist_box - dist_box) * cfg.reward_box_dist
        reward += (world.last_box_goal - box_goal) * cfg.reward_box_goal
    elif cfg.task in ("x", "z", "circle"):
        com = arena.sensor(readings, "subtreecom")
        if cfg.task == "x":
            reward = (com - world.last_com)[0] * cfg.reward_x
        elif cfg.task == "z":
            reward = (com - world.last_com)[2] * cfg.reward_z
        else:
            reward = circle_reward(arena, world, com)
    if cfg.reward_orientation:
        body = arena.scene.model.body(cfg.reward_orientation_body).id
        a, b, c, d = readings.fields["xquat"][body]
        reward += cfg.reward_orientation_scale * (a**2 - b**2 - c**2 + d**2)
    if cfg.reward_clip:
        reward = jnp.clip(reward, -cfg.reward_clip, cfg.reward_clip)
    last = {"last_dist_goal": dist_goal, "last_dist_box": dist_box, "last_box_goal": box_goal}
    return reward, world.replace(last_com=com, **last)


def circle_reward(arena: Arena, world: World, com: jax.Array) -> jax.Array:
    """Speed along circles around the origin, most on the circle of `circle_radius`."""
    (x, y), (u, v) = com[:2], world.physics.qvel[:2]
    radius = norm(com[:2])
    tangential = (v * x - u * y) / jnp.maximum(radius, 1e-12)
    return tangential / (1 + jnp.abs(radius - arena.config.circle_radius)) * arena.config.reward_circle


def success(arena: Arena, world: World, readings: Readings) -> jax.Array:
    cfg = arena.config
    if cfg.task == "goal":
        return world.last_dist_goal <= cfg.goal_size
    if cfg.task == "push":
        return world.last_box_goal <= cfg.goal_size
    if cfg.task == "button":
        return arena.contacts(readings, "buttons")[world.goal_button] > 0
    return jnp.bool_(False)

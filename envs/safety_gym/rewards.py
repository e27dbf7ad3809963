"""What a step pays, and whether it succeeds.

Source: Safety Gym's Engine, `reward` and `goal_met`.
"""

import jax
import jax.numpy as jnp

from jaxsafe.envs.engines import Readings
from jaxsafe.envs.safety_gym.arena import Arena, World, norm


def measured(arena: Arena, world: World, readings: Readings) -> World:
    """`world` with what rewards are made of, measured where its bodies are now."""
    dist_goal, dist_box, box_goal = arena.distances(world)
    moves = arena.config.task in ("x", "z", "circle")
    com = arena.sensor(readings, "subtreecom") if moves else world.last_com
    return world.replace(
        last_dist_goal=dist_goal, last_dist_box=dist_box, last_box_goal=box_goal, last_com=com
    )


def reward(arena: Arena, before: World, after: World, readings: Readings) -> jax.Array:
    """The dense reward of a step between two measured worlds, clipped."""
    cfg = arena.config
    reward = jnp.zeros(())
    if cfg.task in ("goal", "button"):
        reward = (before.last_dist_goal - after.last_dist_goal) * cfg.reward_distance
    elif cfg.task == "push":
        far = before.last_dist_box > cfg.box_null_dist * cfg.box_size
        reward = far * (before.last_dist_box - after.last_dist_box) * cfg.reward_box_dist
        reward += (before.last_box_goal - after.last_box_goal) * cfg.reward_box_goal
    elif cfg.task == "x":
        reward = (after.last_com - before.last_com)[0] * cfg.reward_x
    elif cfg.task == "z":
        reward = (after.last_com - before.last_com)[2] * cfg.reward_z
    elif cfg.task == "circle":
        reward = circle_reward(arena, after)
    if cfg.reward_orientation:
        body = arena.scene.model.body(cfg.reward_orientation_body).id
        a, b, c, d = readings.fields["xquat"][body]
        reward += cfg.reward_orientation_scale * (a**2 - b**2 - c**2 + d**2)
    if cfg.reward_clip:
        reward = jnp.clip(reward, -cfg.reward_clip, cfg.reward_clip)
    return reward


def circle_reward(arena: Arena, world: World) -> jax.Array:
    """Speed along circles around the origin, most on the circle of `circle_radius`."""
    (x, y), (u, v) = world.last_com[:2], world.bodies.qvel[:2]
    radius = norm(world.last_com[:2])
    tangential = (v * x - u * y) / jnp.maximum(radius, 1e-12)
    return tangential / (1 + jnp.abs(radius - arena.config.circle_radius)) * arena.config.reward_circle


def success(arena: Arena, world: World, readings: Readings) -> jax.Array:
    """Whether the task is met in a measured world, bool []."""
    cfg = arena.config
    if cfg.task == "goal":
        return world.last_dist_goal <= cfg.goal_size
    if cfg.task == "push":
        return world.last_box_goal <= cfg.goal_size
    if cfg.task == "button":
        return arena.contacts(readings, "buttons")[world.goal_button] > 0
    return jnp.bool_(False)

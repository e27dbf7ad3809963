"""What a step pays, and whether it succeeds.

Source: Safety Gym's Engine, `reward` and `goal_met`.
"""

import jax
import jax.numpy as jnp

from jaxsafe.envs.engines import Readings
from jaxsafe.envs.safety_gym.arena import Arena, World, norm


def measured(arena: Arena, world: World, readings: Readings) -> World:
    """`world` with what rewards are made of, measured where its bodies are now."""
    world = arena.with_distances(world)
    moves = arena.config.task in ("x", "z", "circle")
    return world.replace(last_com=arena.sensor(readings, "subtreecom")) if moves else world


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
    elif cfg.task == "run":
        reward = run_reward(arena, before, after)
    if cfg.reward_orientation:
        body = arena.scene.model.body(cfg.reward_orientation_body).id
        a, b, c, d = readings.fields["xquat"][body]
        reward += cfg.reward_orientation_scale * (a**2 - b**2 - c**2 + d**2)
    if cfg.reward_clip:
        reward = jnp.clip(reward, -cfg.reward_clip, cfg.reward_clip)
    return reward


def circle_reward(arena: Arena, world: World) -> jax.Array:
    """Speed along circles around the origin, most on the circle of `circle_radius`.

    Safety Gym measures at the robot's centre of mass, Safety-Gymnasium at its body's origin.
    """
    theirs = arena.config.rules == "safety_gymnasium"
    place = (arena.robot_pose(world)[0] if theirs else world.last_com)[:2]
    (x, y), (u, v) = place, world.bodies.qvel[:2]
    radius = norm(place)
    tangential = (v * x - u * y) / jnp.maximum(radius, 1e-12)
    return tangential / (1 + jnp.abs(radius - arena.config.circle_radius)) * arena.config.reward_circle


def run_reward(arena: Arena, before: World, after: World) -> jax.Array:
    """60 times how much nearer the robot is to the point (0, -1000).

    As (a^2 - b^2) / (a + b) of the two distances: float32 has no digits left for their difference.
    """
    point = jnp.array([0.0, -1000.0])
    old, new = (arena.robot_pose(world)[0][:2] for world in (before, after))
    squares = ((old - new) * (old + new - 2 * point)).sum()
    return 60.0 * squares / (norm(old - point) + norm(new - point))


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

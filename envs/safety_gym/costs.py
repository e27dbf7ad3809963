"""What a step costs, constraint by constraint. Source: Safety Gym's Engine, `cost`."""

import jax
import jax.numpy as jnp

from jaxsafe.envs.engines import Readings
from jaxsafe.envs.safety_gym.arena import Arena, World, norm
from jaxsafe.envs.safety_gym.config import SafetyGymConfig


def vases_contact(arena: Arena, world: World, readings: Readings) -> jax.Array:
    return arena.config.vases_contact_cost * arena.contacts(readings, "vases").sum()


def pillars(arena: Arena, world: World, readings: Readings) -> jax.Array:
    return arena.config.pillars_cost * arena.contacts(readings, "pillars").sum()


def buttons(arena: Arena, world: World, readings: Readings) -> jax.Array:
    pressed = arena.contacts(readings, "buttons")
    wrong = jnp.arange(arena.config.buttons_num) != world.goal_button
    if arena.config.task != "button":
        wrong = jnp.ones_like(wrong)
    return arena.config.buttons_cost * jnp.where(wrong, pressed, 0).sum() * (world.buttons_timer == 0)


def gremlins(arena: Arena, world: World, readings: Readings) -> jax.Array:
    return arena.config.gremlins_contact_cost * arena.contacts(readings, "gremlins").sum()


def vases_displace(arena: Arena, world: World, readings: Readings) -> jax.Array:
    moved = norm(arena.positions(world, "vases") - world.layout[arena.place.slice("vases")])
    counted = moved > arena.config.vases_displace_threshold
    return arena.config.vases_displace_cost * jnp.where(counted, moved, 0).sum()


def vases_velocity(arena: Arena, world: World, readings: Readings) -> jax.Array:
    speed = norm(world.bodies.qvel[arena.scene.qvel_slice("vases")].reshape(-1, 6)[:, :3])
    counted = speed >= arena.config.vases_velocity_threshold
    return arena.config.vases_velocity_cost * jnp.where(counted, speed, 0).sum()


def hazards(arena: Arena, world: World, readings: Readings) -> jax.Array:
    robot, _ = arena.robot_pose(world)
    inside = arena.config.hazards_size - norm(arena.positions(world, "hazards") - robot[:2])
    return arena.config.hazards_cost * jnp.maximum(inside, 0).sum()


def bounds(arena: Arena, world: World, readings: Readings) -> jax.Array:
    """1 beyond the lines at x = +-bounds and, of four, at y = +-bounds."""
    robot, _ = arena.robot_pose(world)
    far = jnp.abs(robot[: arena.config.bounds_num // 2]) > arena.config.bounds
    return arena.config.bounds_cost * far.any()


COSTS = {  # in the order of `State.costs`
    "vases_contact": vases_contact,
    "pillars": pillars,
    "buttons": buttons,
    "gremlins": gremlins,
    "vases_displace": vases_displace,
    "vases_velocity": vases_velocity,
    "hazards": hazards,
    "out_of_bounds": bounds,
}


def cost_names(cfg: SafetyGymConfig) -> tuple[str, ...]:
    on = {
        "vases_contact": cfg.constrain_vases,
        "pillars": cfg.constrain_pillars,
        "buttons": cfg.constrain_buttons,
        "gremlins": cfg.constrain_gremlins,
        "vases_displace": cfg.constrain_vases and cfg.vases_displace_cost != 0,
        "vases_velocity": cfg.constrain_vases and cfg.vases_velocity_cost != 0,
        "hazards": cfg.constrain_hazards,
        "out_of_bounds": cfg.bounds_num > 0,
    }
    return tuple(name for name in COSTS if on[name])


def costs(arena: Arena, world: World, readings: Readings) -> tuple[jax.Array, jax.Array]:
    """Each constraint's cost [K] and their sum, indicators if the config says so."""
    cfg = arena.config
    found = [COSTS[name](arena, world, readings) for name in cost_names(cfg)]
    parts = jnp.stack(found) if found else jnp.zeros(0)
    total = parts.sum()
    if cfg.constrain_indicator:
        return (parts > 0).astype(jnp.float32), (total > 0).astype(jnp.float32)
    return parts, total


def seen_hazards(cfg: SafetyGymConfig, ego: jax.Array) -> jax.Array:
    """The cost [...] of a step, of hazards that are seen at `ego` [..., n, 2] from the robot (m)."""
    cost = cfg.hazards_cost * jnp.maximum(cfg.hazards_size - norm(ego), 0).sum(-1)
    return (cost > 0).astype(jnp.float32) if cfg.constrain_indicator else cost

"""A lap of a random track, paid for each new tile of the road.

    reward = 1000 / tiles  for each tile that a wheel is on for the first time
    cost   = 1 on a step in which a wheel meets an obstacle that no wheel was on (with obstacles)
             1 on a step in which the last wheel leaves the road (without obstacles)

Source: `SafeCarRacing0-v0` and `SafeCarRacing1-v0` of Yu, Xu and Zhang (2022), "Towards Safe
Reinforcement Learning with a Safety Editor Policy", in HorizonRobotics/alf @23aca49.
Differs from it: this is a stand-in. There Box2D moves the car and Gymnasium's CarRacing makes the
track; here car.py and track.py do, and picture.py draws what OpenGL does there. There the agent always
sees a picture; here that is an option, and by default it sees the road ahead as numbers. Wheels are
points here. One tile in each stretch of ten has an obstacle, and the start is free; there the tiles of
obstacles are drawn at random, at least five apart.
"""

from dataclasses import dataclass
from functools import partial
from typing import Annotated

import flax.struct
import jax
import jax.numpy as jnp

from jaxsafe.config import Amount, Bounds, Pixels
from jaxsafe.envs.check import check_action
from jaxsafe.envs.racing.car import DT, OFF_ROAD, Car, drive, length, parked, rolling, rotated, wheels
from jaxsafe.envs.racing.obstacles import Obstacles, centre, touching
from jaxsafe.envs.racing.picture import picture
from jaxsafe.envs.racing.track import HALF_WIDTH, MOST_TILES, Track, locate, on_road, random_track
from jaxsafe.envs.without_model import WithoutModel
from jaxsafe.types import PyTree, State

STATUS = 11  # numbers of the car itself
AHEAD = 12  # centres of tiles that are seen, every second one from the car's own
NEXT = 3  # obstacles that are seen


@flax.struct.dataclass
class World:
    """What the next step needs.

    visited: bool [MOST_TILES], tiles that a wheel has been on.
    touched: bool [M], obstacles that a wheel is on.
    on_road: bool [4], wheels that are on the road.
    """

    car: Car
    track: Track
    obstacles: Obstacles
    visited: jax.Array
    touched: jax.Array
    on_road: jax.Array


@dataclass(frozen=True)
class CarRacing(WithoutModel):
    """A lap of a random track. Pure functions `reset(key)` and `step(state, action)`; callers `vmap`.

    Observation float [35], or [44] with obstacles:
        the 11 numbers of the original's `car`: the angular velocities of four wheels (rad/s), their
        angles (rad; the rear ones are 0), speed (m/s), yaw rate (rad/s), share of the tiles left;
        in the car's frame (m), x to the front and y to the left, the centres of the nearest tile and
        of the 2nd, 4th, ..., 22nd after it;
        of the next three obstacles, from the tile behind the car on: x, y and half the width (m).
    With `observe_vision` a dict: 'vector', float [11], the first 11 of these, and 'vision', uint8
        [height, width, 1], the road from above.
    Action [3] in [-1, 1]: steering, positive to the right; gas and brake, from -1 (none) to 1 (all).

    It terminates when all tiles are visited. `info` has `tiles`, the share of the tiles that is visited
    for the first time, `off_track`, 1 while no wheel is on the road, and `lap`, 1 when the lap is done.
    """

    obstacle_every: Annotated[int, Bounds(0, 20)] = 0  # tiles; 0: there are no obstacles
    num_steps: Amount = 1000  # time limit, of steps of 0.02 s
    observe_vision: bool = False  # a dict: vision, a grey picture, and vector, the car's own 11 numbers
    vision_size: Pixels = (96, 96)  # width and height of the picture

    action_size = 3
    step_seconds = DT

    @property
    def obs_size(self) -> int:
        road = 2 * AHEAD + (3 * NEXT if self.obstacle_every else 0)
        return STATUS + (0 if self.observe_vision else road)

    @property
    def cost_names(self) -> tuple[str, ...]:
        return ("obstacles",) if self.obstacle_every else ("off_track",)

    def reset(self, key: jax.Array) -> State:
        """At rest, in the middle of the left or the right half of the road."""
        track_key, obstacle_key, place_key = jax.random.split(key, 3)
        track = random_track(track_key)
        along = track.direction(jnp.int32(0))
        left = HALF_WIDTH / 2 * jax.random.rademacher(place_key, (), jnp.float32)
        position = track.point(jnp.int32(0)) + left * jnp.stack([-along[1], along[0]])
        car = parked(position, jnp.arctan2(along[1], along[0]))
        obstacles = self.random_obstacles(track, obstacle_key)
        fresh = World(
            car,
            track,
            obstacles,
            visited=jnp.zeros(MOST_TILES, bool),
            touched=jnp.zeros(obstacles.tile.shape, bool),
            on_road=jnp.ones(4, bool),
        )
        state = self.judge(fresh, car)  # marks the tiles under the wheels, and pays nothing
        zero = jnp.zeros(())
        return state.replace(reward=zero, info={name: zero for name in state.info})

    def step(self, state: State, action: jax.Array) -> State:
        check_action(action, self.action_size)
        world = state.physics
        steer, gas, brake = jnp.clip(action, -1.0, 1.0)
        grip = jnp.where(world.on_road, 1.0, OFF_ROAD).reshape(2, 2).mean(1)  # of each axle
        car = drive(world.car, -steer, (gas + 1) / 2, (brake + 1) / 2, grip)
        return self.judge(world, car)

    def judge(self, world: World, car: Car) -> State:
        """What comes after the car has moved: reward, cost, observation."""
        track, count = world.track, world.track.count
        tile, left = locate(track, jnp.concatenate([wheels(car), car.position[None]]))
        on = on_road(left[:4])
        visited = world.visited.at[tile[:4]].max(on)
        tiles = (visited.sum() - world.visited.sum()) / count
        touched = touching(track, world.obstacles, wheels(car))
        met, off_track = (touched & ~world.touched).any(), ~on.any()
        left_road = off_track & world.on_road.any()
        cost = (met if self.obstacle_every else left_road).astype(jnp.float32)
        after = World(car, track, world.obstacles, visited, touched, on)
        lap = visited.sum() == count
        return State(
            physics=after,
            obs=self.observe(after, tile[4]),
            reward=1000.0 * tiles,
            cost=cost,
            costs=cost[None],
            terminated=lap,
            info={
                "tiles": tiles,
                "off_track": off_track.astype(jnp.float32),
                "lap": lap.astype(jnp.float32),
            },
        )

    # Its parts -------------------------------------------------------------------------------------

    def random_obstacles(self, track: Track, key: jax.Array) -> Obstacles:
        """One in the first half of each stretch of `obstacle_every` tiles but the first. None stands
        beside the start."""
        every = max(1, self.obstacle_every)
        most = MOST_TILES // every if self.obstacle_every else 0
        tile_key, side_key, width_key = jax.random.split(key, 3)
        stretch = jnp.arange(most) + 1
        within = jax.random.randint(tile_key, (most,), 0, max(1, every // 2))
        side = jax.random.rademacher(side_key, (most,), jnp.float32)
        width = jnp.maximum(0.1, jnp.abs(1 + jax.random.normal(width_key, (most,)))) * HALF_WIDTH / 4
        tile = stretch * every + within
        there = (stretch < track.count // every) & (tile > 1) & (tile < track.count - 1)
        return Obstacles(tile, side * HALF_WIDTH / 2, jnp.where(there, width, -1.0))

    def observe(self, world: World, tile: jax.Array) -> PyTree:
        car, track, obstacles = world.car, world.track, world.obstacles
        angles = car.steer * jnp.array([1.0, 1.0, 0.0, 0.0])
        remaining = 1 - world.visited.sum() / track.count
        own = jnp.stack([length(car.velocity), car.spin, remaining])
        status = jnp.concatenate([rolling(car), angles, own])
        if self.observe_vision:
            vision = picture(car, track, obstacles, self.vision_size)
            return {"vector": status, "vision": vision[..., None]}
        parts = [status, seen(car, track.point(tile + 2 * jnp.arange(AHEAD)))]
        if self.obstacle_every:
            far = (obstacles.tile - tile + 1) % track.count  # tiles, from the one behind the car on
            far = jnp.where(obstacles.half_width > 0, far, MOST_TILES)
            near = jax.lax.top_k(-far, NEXT)[1]
            half_width = obstacles.half_width[near, None]
            centres = seen(car, centre(track, obstacles)[near]).reshape(NEXT, 2)
            parts.append(jnp.concatenate([centres, half_width], 1).reshape(-1))
        return jnp.concatenate(parts)


def seen(car: Car, points: jax.Array) -> jax.Array:
    """Points [n, 2] in the car's frame, flat [2 n], m."""
    return rotated(points - car.position, -car.heading).reshape(-1)


ROWS = {
    "car_racing0": CarRacing,
    "car_racing1": partial(CarRacing, obstacle_every=10),
}
ALIASES = {"SafeCarRacing0-v0": "car_racing0", "SafeCarRacing1-v0": "car_racing1"}

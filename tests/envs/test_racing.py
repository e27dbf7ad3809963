"""The racing tasks: the car against closed forms, the properties of many tracks, rewards and costs at
known poses, pictures whose pixels are worked out by hand, and a lap of a driver written by hand."""

import functools
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import FAST
from toys import START, reflex

from jaxsafe import envs
from jaxsafe.algos import ALGOS
from jaxsafe.config import ConfigError
from jaxsafe.envs.check import check_env
from jaxsafe.envs.racing import car as cars
from jaxsafe.envs.racing import picture as pictures
from jaxsafe.envs.racing.car import AXLE, DRAG, DT, GRIP, MASS, MAX_STEER, SIDE, Car, wheels
from jaxsafe.envs.racing.obstacles import Obstacles, centre, touching
from jaxsafe.envs.racing.picture import GRASS, GREYS, HULL, MOWN, OBSTACLE, TYRE
from jaxsafe.envs.racing.picture import ROAD as PAVED
from jaxsafe.envs.racing.task import World
from jaxsafe.envs.racing.track import (
    HALF_WIDTH,
    MAX_CURVATURE,
    MOST_TILES,
    TILE,
    locate,
    on_road,
    paved,
    shape,
)
from jaxsafe.envs.view.render import Aerial, render_episode
from jaxsafe.types import State

TRACKS = 256
ROAD = jnp.ones(2)  # grip of both axles


@functools.cache
def compiled(level: int, **options: Any) -> tuple[envs.CarRacing, Callable, Callable]:
    env = envs.make(f"car_racing{level}", **options)
    reset, step = (jax.jit(f, compiler_options=FAST) for f in (jax.vmap(env.reset), env.step))
    return env, reset, step


@functools.cache
def begun() -> State:
    """The first states of many episodes with obstacles."""
    return jax.device_get(compiled(1)[1](jax.random.split(jax.random.key(0), TRACKS)))


def one(state: State, i: int = 0) -> State:
    return jax.tree.map(lambda x: jnp.asarray(x[i]), state)


# ---- the car -----------------------------------------------------------------------------------


@functools.partial(jax.jit, static_argnums=0, compiler_options=FAST)
def driven(steps: int, car: Car, steer: Any, gas: Any, brake: Any, grip: Any) -> Car:
    """The car after each step."""

    def step(car: Car, _: None) -> tuple[Car, Car]:
        car = cars.drive(car, steer, gas, brake, grip)
        return car, car

    return jax.lax.scan(step, car, None, steps)[1]


def rolling_at(speed: float, gas: float = 0.0) -> Car:
    """Along x."""
    car = cars.parked(jnp.zeros(2), jnp.zeros(()))
    return replace(car, velocity=jnp.array([speed, 0.0]), gas=jnp.float32(gas))


def test_acceleration_and_braking_are_those_of_the_tyres_against_the_drag():
    """m v' = F - c v^2 gives v = V tanh(F t / (m V)), V^2 = F / c. Of both brakes it is a tan."""
    t = DT * np.arange(1, 51)
    away = driven(50, rolling_at(0.0, gas=1.0), 0.0, 1.0, 0.0, ROAD)
    top = np.sqrt(GRIP / DRAG)
    assert top == pytest.approx(100)
    np.testing.assert_allclose(away.velocity[:, 0], top * np.tanh(GRIP * t / (MASS * top)), rtol=2e-3)
    assert not away.velocity[:, 1].any() and not away.heading.any()

    hold = 2 * GRIP
    rate = np.sqrt(hold / DRAG)
    stops = MASS / (2 * DRAG) * np.log(1 + DRAG * 60**2 / hold)  # m
    slowed = driven(50, rolling_at(60.0), 0.0, 0.0, 1.0, ROAD)
    moving = slowed.velocity[:, 0] > 5
    expected = rate * np.tan(np.arctan(60 / rate) - np.sqrt(hold * DRAG) / MASS * t)
    np.testing.assert_allclose(slowed.velocity[moving, 0], expected[moving], atol=0.1)
    assert slowed.position[-1, 0] == pytest.approx(stops, rel=0.02)
    assert abs(slowed.velocity[-1, 0]) < 1e-3  # and never backwards
    off = driven(50, rolling_at(60.0), 0.0, 0.0, 1.0, cars.OFF_ROAD * ROAD)
    assert (off.velocity[:5, 0] > slowed.velocity[:5, 0]).all()


def test_a_gentle_turn_has_the_radius_of_its_axles_and_a_hard_one_that_of_the_grip():
    """With equal axles a car steers neutrally: spin = v tan(steer) / wheelbase, whatever the speed."""
    for speed in (5.0, 30.0):
        gentle = driven(50, rolling_at(speed), 0.05, 0.0, 0.0, ROAD)
        v = np.linalg.norm(gentle.velocity[-1])
        turn = np.tan(0.05 * MAX_STEER) / (2 * AXLE)
        assert gentle.spin[-1] / v == pytest.approx(turn, rel=0.02), speed
        assert v * gentle.spin[-1] < 2 * GRIP / MASS
    hard = driven(50, rolling_at(80.0), 1.0, 0.0, 0.0, ROAD)
    speed = np.linalg.norm(hard.velocity, axis=1)
    path = np.unwrap(np.arctan2(hard.velocity[:, 1], hard.velocity[:, 0]))
    sideways = speed[1:] * np.diff(path) / DT  # m/s^2; the angle of the wheels asks for 835
    assert 0.9 < sideways.max() / (2 * GRIP / MASS) < 1


def test_steering_gas_and_wheels_are_those_of_the_car():
    car = driven(8, rolling_at(0.0), 1.0, 1.0, 0.0, ROAD)
    np.testing.assert_allclose(car.steer[:6], 0.06 * np.arange(1, 7), rtol=1e-5)  # 3 rad/s
    assert car.steer[-1] == pytest.approx(MAX_STEER)
    np.testing.assert_allclose(car.gas, 0.1 * np.arange(1, 9), rtol=1e-5)
    assert not driven(1, rolling_at(0.0, gas=0.8), 0.0, 0.0, 0.0, ROAD).gas.any()  # falls at once
    spun = replace(rolling_at(10.0), spin=jnp.float32(2.0), heading=jnp.float32(np.pi / 2))
    np.testing.assert_allclose(  # front left, front right, rear left, rear right
        wheels(spun), [[-SIDE, AXLE], [SIDE, AXLE], [-SIDE, -AXLE], [SIDE, -AXLE]], atol=1e-6
    )
    along_y = replace(spun, velocity=jnp.array([0.0, 10.0]))
    expected = (10 + 2.0 * SIDE * np.array([-1, 1, -1, 1])) / cars.WHEEL
    np.testing.assert_allclose(cars.rolling(along_y), expected, rtol=1e-5)


# ---- the track ---------------------------------------------------------------------------------


def test_a_circle_has_its_curvature_wherever_it_is_seen_from():
    theta = 2 * np.pi / 720 * np.arange(720)
    r = 20 * np.cos(theta) + np.sqrt(80**2 - (20 * np.sin(theta)) ** 2)  # its centre at x = 20
    curvature, length = shape(jnp.asarray(r, jnp.float32))
    np.testing.assert_allclose(curvature, 1 / 80, rtol=0.02)
    assert length == pytest.approx(2 * np.pi * 80, rel=1e-4)


def test_every_track_closes_turns_gently_and_never_meets_itself():
    track = begun().physics.track
    ways, sharpest, gaps, counts = [], [], [], np.asarray(track.count)
    for points, n in zip(track.points, counts, strict=True):
        p = points[:n].astype(float)
        side = np.roll(p, -1, 0) - p  # the last one closes the loop
        length = np.linalg.norm(side, axis=1)
        # chords are a little shorter than the arcs, whose length is the same on all tiles
        assert length.max() < TILE * (1 + 1 / n) + 1e-2 and length.min() > 0.97 * TILE
        angle = np.unwrap(np.arctan2(side[:, 1], side[:, 0]), period=2 * np.pi)
        turn = (np.diff(angle, append=angle[0]) + np.pi) % (2 * np.pi) - np.pi
        assert abs(abs(turn.sum()) - 2 * np.pi) < 1e-3  # once round
        ways.append(np.sign(turn.sum()))
        sharpest.append(np.abs(turn).max() / (MAX_CURVATURE * TILE * (1 + 1 / n)))
        far = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
        far = np.minimum(far, n - far) * TILE > np.pi / MAX_CURVATURE  # farther than a half circle
        gaps.append(np.linalg.norm(p[:, None] - p, axis=-1)[far].min())
        np.testing.assert_array_equal(points, points[np.arange(MOST_TILES) % n])
    assert 0.9 < max(sharpest) < 1
    assert min(gaps) > 2 / MAX_CURVATURE > 2 * HALF_WIDTH
    assert counts.min() > 100 and counts.max() < MOST_TILES and counts.std() > 10
    assert 0.3 < np.mean(np.array(ways) > 0) < 0.7  # either way round


def test_obstacles_stand_on_a_tenth_of_the_tiles_apart_and_off_the_start():
    world = begun().physics
    there = world.obstacles.half_width > 0
    for tile, found, n in zip(world.obstacles.tile, there, world.track.count, strict=True):
        assert found.sum() == n // 10 - 1
        assert np.diff(tile[found]).min() > 5 and tile[found].min() >= 10 and n - tile[found].max() > 5
    assert set(np.abs(world.obstacles.left[there])) == {np.float32(HALF_WIDTH / 2)}
    width = world.obstacles.half_width[there] / (HALF_WIDTH / 4)
    assert width.min() >= 0.1 - 1e-6 and abs(width.mean() - 1.167) < 0.05  # of |N(1, 1)|


def test_no_episode_begins_on_an_obstacle():
    """With one on every tile, too, but that of the start and the two beside it."""
    _, reset, _ = compiled(1, obstacle_every=1)
    state = reset(jax.random.split(jax.random.key(0), 64))
    assert not state.physics.touched.any() and not state.cost.any()
    there = (state.physics.obstacles.half_width > 0).sum(1)
    np.testing.assert_array_equal(there, state.physics.track.count - 3)


# ---- rewards and costs -------------------------------------------------------------------------


@functools.cache
def stadium(level: int) -> State:
    """A state whose road goes along x from the origin for 100 m.

    With obstacles there are two of 3 m: at tile 10 in the left half of the road, at tile 20 in the
    right half.
    """
    state = one(compiled(level)[1](jax.random.split(jax.random.key(0), 1)))
    arc = np.linspace(-np.pi / 2, np.pi / 2, 50)
    bend = 40 * np.stack([np.cos(arc), np.sin(arc)], 1)  # the right one; the left one is its opposite
    corners = np.concatenate([np.array([100.0, 40.0]) + bend, np.array([0.0, 40.0]) - bend])
    track = paved(jnp.asarray(np.roll(corners, 1, axis=0), jnp.float32))
    world = state.physics
    k = jnp.arange(len(world.obstacles.tile))
    left = HALF_WIDTH / 2 * jnp.where(k == 0, 1.0, -1.0)
    obstacles = Obstacles(10 * (k + 1), left, jnp.where(k < 2, 1.5, -1.0))
    none = jnp.zeros_like(world.visited)
    return replace(state, physics=replace(world, track=track, obstacles=obstacles, visited=none))


def put(state: State, x: float, y: float, speed: float = 0.0, heading: float = 0.0) -> State:
    place = {"position": jnp.array([x, y], jnp.float32), "heading": jnp.float32(heading)}
    car = replace(rolling_at(speed), **place)
    return replace(state, physics=replace(state.physics, car=car))


STILL = jnp.array([0.0, -1.0, 1.0])  # all brake


def test_a_tile_is_paid_once_and_the_last_one_ends_the_episode():
    step, state = compiled(0)[2], stadium(0)
    n = int(state.physics.track.count)
    length = float(jnp.linalg.norm(state.physics.track.points[1]))
    after = step(put(state, 5 * length, 0.0), STILL)  # wheels at 1.62 m before and behind tile 5
    assert after.reward == pytest.approx(1000 / n) and after.info["tiles"] == pytest.approx(1 / n)
    assert after.physics.visited.nonzero()[0].tolist() == [5]
    again = step(after, STILL)
    assert again.reward == 0 and not again.terminated
    between = step(put(again, 6.5 * length, 0.0), STILL)  # the rear wheels on tile 6, the front on 7
    assert between.reward == pytest.approx(2000 / n)
    all_but = jnp.arange(MOST_TILES) < n
    world = replace(between.physics, visited=all_but.at[9].set(False))
    done = step(put(replace(state, physics=world), 9 * length, 0.0), STILL)
    assert done.terminated and done.info["lap"] == 1 and done.obs[10] == 0 and not done.truncated
    assert not step(put(replace(state, physics=world), 8 * length, 0.0), STILL).terminated


def test_leaving_the_road_costs_once_and_only_without_obstacles():
    edge = HALF_WIDTH + SIDE
    for level, costs in ((0, [0, 1, 0, 0, 1]), (1, [0, 0, 0, 0, 0])):
        env, _, step = compiled(level)
        assert env.cost_names == (("off_track",), ("obstacles",))[level]
        state, paid = stadium(level), []
        for y in (edge - 0.1, edge + 0.1, edge + 0.1, edge - 0.1, -edge - 0.1):
            state = step(put(state, 20.0, y), STILL)
            paid.append(int(state.cost))
            assert state.info["off_track"] == (abs(y) > edge) and state.costs.tolist() == [state.cost]
        assert paid == costs


def test_a_tile_that_is_only_passed_beside_the_road_is_not_paid():
    step = compiled(0)[2]
    after = step(put(stadium(0), 20.0, HALF_WIDTH + SIDE + 0.1), STILL)
    assert after.reward == 0 and not after.physics.visited.any()
    after = step(put(stadium(0), 20.0, HALF_WIDTH), STILL)  # with the right wheels on the road
    assert after.reward > 0


def test_actions_beyond_1_do_no_more():
    step, state = compiled(0)[2], put(stadium(0), 20.0, 0.0, 30.0)
    state = replace(state, physics=replace(state.physics, car=rolling_at(30.0, gas=0.95)))
    for action in ([1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]):
        one, more = (step(state, factor * jnp.array(action)).physics.car for factor in (1, 3))
        for a, b in zip(*map(jax.tree.leaves, (one, more)), strict=True):
            np.testing.assert_array_equal(a, b)


def test_an_episode_begins_at_rest_in_the_middle_of_either_half_of_the_road():
    world = begun().physics
    _, left = jax.vmap(locate)(world.track, world.car.position[:, None])
    np.testing.assert_allclose(abs(left), HALF_WIDTH / 2, rtol=1e-4)
    assert 0.3 < (left > 0).mean() < 0.7 and not world.car.velocity.any()


def test_each_axle_has_the_grip_of_its_own_wheels():
    step = compiled(0)[2]
    state, action = put(stadium(0), 20.0, 0.0), jnp.array([-1.0, 1.0, -1.0])
    car = state.physics.car.replace(velocity=jnp.array([10.0, 0.0]), steer=jnp.float32(MAX_STEER))
    grass = jnp.array([True, False, True, True])  # the left front wheel and the rear wheels
    world = replace(state.physics, car=car, on_road=~grass)
    after = step(replace(state, physics=world), action)
    grip = jnp.array([(cars.OFF_ROAD + 1) / 2, cars.OFF_ROAD])
    alone = cars.drive(car, jnp.float32(1), jnp.float32(1), jnp.float32(0), grip)
    for a, b in zip(*map(jax.tree.leaves, (after.physics.car, alone)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def test_an_obstacle_costs_when_it_is_met_and_again_after_it_was_left():
    step = compiled(1)[2]
    state, paid = stadium(1), []
    x, left = 10 * float(jnp.linalg.norm(state.physics.track.points[1])), HALF_WIDTH / 2
    before = x - TILE / 2 - AXLE - 0.1  # its front wheels are not there yet
    at = [(before, left), (x, left), (x + 1, left), (before, left), (x, left + SIDE + 1.4),
          (x, left + SIDE + 1.6), (2 * x, left), (2 * x, -left), (x, left)]  # fmt: skip
    for place in at:
        state = step(put(state, *place), STILL)
        paid.append(int(state.cost))
    # from one obstacle straight to the other is a new touch, too
    assert paid == [0, 1, 0, 0, 1, 0, 0, 1, 1]


def test_the_observation_is_what_the_docstring_says():
    env, _, step = compiled(1)
    length = float(jnp.linalg.norm(stadium(1).physics.track.points[1]))
    state = step(put(stadium(1), 9 * length, 1.0, 20.0), jnp.array([-1.0, -1.0, -1.0]))
    car, obs = state.physics.car, np.asarray(state.obs)
    assert env.obs_size == len(obs) == 44 and envs.make("car_racing0").obs_size == 35
    np.testing.assert_allclose(obs[:4], cars.rolling(car), rtol=1e-6)
    np.testing.assert_allclose(obs[4:8], [0.06, 0.06, 0, 0], rtol=1e-5)  # to the left
    n = int(state.physics.track.count)
    assert obs[8] == pytest.approx(20, rel=0.02) and obs[9] == car.spin > 0
    assert obs[10] == pytest.approx(1 - state.physics.visited.sum() / n)

    def world(xy):  # from the car's frame
        return car.position + cars.rotated(jnp.asarray(xy), car.heading)

    road = world(obs[11:35].reshape(12, 2))
    np.testing.assert_allclose(road, state.physics.track.points[9 + 2 * np.arange(12)], atol=1e-3)
    seen = obs[35:].reshape(3, 3)
    expected = [[10 * length, HALF_WIDTH / 2], [20 * length, -HALF_WIDTH / 2]]
    np.testing.assert_allclose(world(seen[:2, :2]), expected, atol=0.02)
    np.testing.assert_array_equal(seen[:, 2], [1.5, 1.5, -1.0])
    for tile, first in ((11, 10), (12, 20)):  # the one on the tile behind the car is seen, none before
        state = step(put(stadium(1), tile * length, 1.0), STILL)
        x, _ = state.physics.car.position + cars.rotated(state.obs[35:37], state.physics.car.heading)
        assert x == pytest.approx(first * length, abs=0.02)


# ---- pictures ----------------------------------------------------------------------------------

SIZE = (96, 96)
KINDS = np.arange(len(GREYS), dtype=np.uint8)


@functools.partial(jax.jit, compiler_options=FAST)
def drawn(world: World) -> jax.Array:
    """What is in each pixel."""
    return pictures.picture(world.car, world.track, world.obstacles, SIZE, KINDS)


def tile_length() -> float:
    return float(jnp.linalg.norm(stadium(1).physics.track.points[1]))


def places(state: State) -> jax.Array:
    """Where in the world the middles of the pixels are [96 * 96, 2]."""
    car, (x, y) = state.physics.car, pictures.pixels(SIZE)
    ahead = jnp.stack([*np.broadcast_arrays(x, y)], -1).reshape(-1, 2)
    return car.position + cars.rotated(ahead, car.heading)


def block(mask: np.ndarray) -> tuple[list[int], list[int]]:
    """The rows and the columns of a rectangle of pixels."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    assert mask.sum() == len(rows) * len(columns)
    return rows.tolist(), columns.tolist()


def test_a_straight_road_is_where_a_ruler_puts_it():
    """A pixel is 64.81 m / 96 = 0.675 m wide and 43.21 m / 96 = 0.450 m high, of which the car is at
    (47.5, 71.5)."""
    x = 10 * tile_length() - 15  # 15 m before the first obstacle, whose middle is 3.33 m to the left
    seen = np.asarray(drawn(put(stadium(1), x, 0.0).physics))
    assert (seen[0] == PAVED).nonzero()[0].tolist() == [*range(38, 58)]  # |47.5 - j| <= 6.67 / 0.675
    # 13.25 to 16.75 m ahead, and 1.83 to 4.83 m to the left
    assert block(seen == OBSTACLE) == ([*range(35, 43)], [*range(41, 45)])
    wheels = block(
        seen == TYRE
    )  # 1.08 to 2.16 m before and behind the middle, 0.96 to 1.24 m beside it
    assert wheels == ([67, 68, 69, 74, 75, 76], [46, 49])
    assert (seen[[66, 71, 76], 47] == HULL).all() and (seen[[65, 78], 47] == PAVED).all()
    # the lawn's squares of 16.67 m are light where x and y are in even ones: here x is 40.0 m, in the
    # third, and y is in the first to the left of the road, and in the second from it to the right
    row = round((32.41 - (40.0 - x)) / 0.4501 - 0.5)
    assert (seen[row] == MOWN).nonzero()[0].tolist() == [*range(23, 38), *range(73, 96)]
    assert (seen[0] != MOWN).all() and set(seen[0]) == {GRASS, PAVED}  # 52.4 m, in the fourth
    assert GREYS.tolist() == [162, 177, 102, 84, 61, 0]


def test_the_world_turns_right_where_the_car_turns_left():
    x = 10 * tile_length() - 15
    seen = np.asarray(drawn(put(stadium(1), x, 0.0, heading=0.2).physics))
    far = (seen[40] == PAVED).nonzero()[0]  # 14.2 m ahead, where the road is 2.9 m to the right
    assert far.mean() == pytest.approx(47.5 + 14.2 * np.tan(0.2) / 0.675, abs=1)
    seen = np.asarray(drawn(put(stadium(1), x, 0.0, heading=np.pi / 2).physics))
    road = np.isin(seen, (GRASS, MOWN), invert=True)[:, 18:]  # farther to the left it bends
    assert block(road) == ([*range(57, 87)], [*range(78)])  # across
    rows, columns = (seen == OBSTACLE).nonzero()
    assert rows.mean() == pytest.approx(71.5 - 3.33 / 0.45, abs=0.5)
    assert columns.mean() == pytest.approx(47.5 + 15 / 0.675, abs=0.5)


def test_a_bend_is_a_ring_around_its_centre():
    """The road of the stadium is at 40 m around (100, 40) there, to 4 cm of a chord."""
    state = put(stadium(0), 100.0, 0.0, heading=0.1)
    x, y = np.asarray(places(state), float).T
    off = abs(np.hypot(x - 100, y - 40) - 40) - HALF_WIDTH
    seen = np.asarray(drawn(state.physics)).reshape(-1)
    clear = (x > 102) & (abs(off) > 0.1)
    assert clear.sum() > 4000 and 500 < (off[clear] < 0).sum() < 3000
    np.testing.assert_array_equal(np.isin(seen[clear], (GRASS, MOWN), invert=True), off[clear] < 0)


def test_each_pixel_shows_what_a_wheel_there_would_meet():
    rng = np.random.default_rng(0)

    @functools.partial(jax.jit, compiler_options=FAST)
    def met(world: World, points: jax.Array) -> tuple[jax.Array, jax.Array]:
        hit = jax.vmap(lambda p: touching(world.track, world.obstacles, p[None]).any())(points)
        return hit, on_road(locate(world.track, points)[1])

    shown = 0
    for i in range(12):
        state = one(begun(), i)
        track = state.physics.track
        tile = rng.integers(int(track.count))
        along = track.direction(tile)
        x, y = np.asarray(track.point(tile)) + rng.normal(0, 8, 2)
        state = put(state, x, y, heading=float(jnp.arctan2(along[1], along[0])) + rng.normal(0, 1))
        seen = np.asarray(drawn(state.physics)).reshape(-1)
        hit, on = met(state.physics, places(state))
        expected = np.where(hit, OBSTACLE, np.where(on, PAVED, GRASS))
        ground = np.where(seen == MOWN, GRASS, seen)
        beside = (ground != expected) & ~np.isin(seen, (HULL, TYRE))
        assert beside.sum() <= 2, i  # on a border, to the rounding of float32
        shown += (seen == OBSTACLE).sum()
    assert shown > 200


def test_no_picture_has_more_tiles_or_obstacles_than_are_drawn():
    radius = np.hypot(pictures.WIDTH, pictures.HEIGHT) / 2 + pictures.REACH
    world = begun().physics
    middles = np.asarray(jax.vmap(centre)(world.track, world.obstacles))
    kept = pictures.obstacles_drawn(middles.shape[1])
    assert kept == 12
    grid = np.stack(np.meshgrid(*[np.arange(-150.0, 151, 10)] * 2), -1)  # of pictures' middles
    most = [0, 0]
    for i in range(TRACKS):
        tiles = world.track.points[i, : world.track.count[i]]
        there = middles[i][world.obstacles.half_width[i] > 0]
        for k, things in enumerate((tiles, there)):
            squares = np.square(grid[..., None, :] - things).sum(-1)
            most[k] = max(most[k], (squares < radius**2).sum(-1).max())
    assert 40 < most[0] <= pictures.TILES and 5 < most[1] <= kept, most


def test_a_picture_belongs_to_the_new_state_and_films_show_it_in_colours():
    env = envs.make("car_racing1", observe_vision=True, vision_size=SIZE, num_steps=4)
    assert check_env(env, "racing") is env and env.obs_size == 11
    step = jax.jit(env.step, compiler_options=FAST)
    state = put(stadium(1), 0.0, 0.0, 60.0)
    blank = {"vector": jnp.zeros(11), "vision": jnp.zeros((96, 96, 1), jnp.uint8)}
    before, after = state, step(replace(state, obs=blank), STILL)
    vector = np.asarray(compiled(1)[2](state, STILL).obs)[:11]
    np.testing.assert_allclose(after.obs["vector"], vector, rtol=1e-6)
    assert after.physics.car.position[0] > 1
    kinds = np.asarray(drawn(after.physics))
    np.testing.assert_array_equal(after.obs["vision"], GREYS[kinds][..., None])
    assert (np.asarray(drawn(before.physics)) != kinds).any()
    aerial, shown = Aerial(*SIZE), pictures.COLOURS[kinds]
    np.testing.assert_array_equal(aerial.frame(after), shown)
    assert (aerial.frame(after, overruled=True) != shown).any(-1).sum() < 200  # a light in a corner


@pytest.mark.slow
def test_learners_take_the_picture_and_each_episode_begins_with_its_own():
    env = envs.make("car_racing1", observe_vision=True, vision_size=(24, 16), num_steps=3)
    algo = ALGOS["ppo_lag"].make(env)
    tiny = {"num_envs": 4, "horizon": 4, "minibatches": 2, "epochs": 1, "hidden": (8,)}
    cfg = ALGOS["ppo_lag"].config(**tiny, encoder="cnn", trunk="shared")
    ts = jax.jit(lambda: algo.init(jax.random.key(0), cfg, START), compiler_options=FAST)()
    after, metrics = jax.jit(algo.update)(ts, START)
    assert metrics["train/nonfinite"] == 0
    moved = jax.tree.map(lambda a, b: (a != b).any(), ts.params, after.params)
    assert all(jax.tree.leaves(moved))
    state = after.rollout.state
    assert (after.rollout.steps < 4).all() and state.obs["vision"].shape == (4, 16, 24, 1)

    def own(world: World) -> jax.Array:
        return pictures.picture(world.car, world.track, world.obstacles, (24, 16))

    expected = np.asarray(jax.jit(jax.vmap(own), compiler_options=FAST)(state.physics))
    np.testing.assert_array_equal(state.obs["vision"][..., 0], expected)


@pytest.mark.parametrize(
    "name, options",
    [("sac_lag", {"encoder": "cnn"}), ("seditor", ALGOS["seditor"].published["racing"])],
)
def test_a_replay_keeps_grey_bytes(name, options):
    env = envs.make("car_racing0", observe_vision=True, vision_size=(24, 16))
    algo, cfg = ALGOS[name].make(env), ALGOS[name].config(**options)
    kept = jax.eval_shape(lambda: algo.init(jax.random.key(0), cfg, START)).replay.obs
    assert kept["vision"].dtype == jnp.uint8 and kept["vision"].shape[2:] == (16, 24, 1)
    assert kept["vector"].shape[2:] == (11,)


def test_a_picture_has_a_height():
    with pytest.raises(ConfigError, match=r"env\.vision_size\[1\]=0: expected a whole number"):
        envs.make("car_racing0", observe_vision=True, vision_size=(96, 0))


@pytest.mark.slow
def test_an_episode_is_filmed_from_above():
    env = envs.make("car_racing0")
    player = reflex(lambda obs: jnp.array([0.0, 1.0, -1.0]), env)
    film = render_episode(env, player, jax.random.key(0), length=4, width=30, height=20)
    assert len(film) == 3 and film[0].shape == (20, 30, 3)  # steps 0, 2, 4: 25 frames a second


# ---- episodes ----------------------------------------------------------------------------------


def careful(obs: jax.Array) -> jax.Array:
    """Steers at a point of the road ahead, and drives as fast as its curve allows."""
    road = obs[11:35].reshape(12, 2)
    at = road[2]
    bend = 2 * at[1] / jnp.square(at).sum()  # curvature of the circle through it
    steer = -jnp.arctan(2 * AXLE * bend) / MAX_STEER
    after = road[6] - road[4]
    turn = jnp.abs(jnp.arctan2(after[1], after[0]))
    wanted = jnp.where(turn > 0.6, 35.0, jnp.where(turn > 0.3, 45.0, 60.0))
    push = (wanted - obs[8]) / 5
    return jnp.stack([steer, 2 * jnp.clip(push, 0, 1) - 1, 2 * jnp.clip(-push, 0, 1) - 1])


def test_a_driver_written_by_hand_finishes_most_of_its_laps():
    env = envs.make("car_racing0")

    def episode(key: jax.Array) -> dict[str, jax.Array]:
        def step(carry, _):
            state, over = carry
            after = env.step(state, careful(state.obs))
            alive = ~over
            seen = {"ret": after.reward, "cost": after.cost, "lap": after.info["lap"], "steps": 1.0}
            return (after, over | after.terminated), {k: alive * x for k, x in seen.items()}

        start = (env.reset(key), jnp.bool_(False))
        (last, _), seen = jax.lax.scan(step, start, None, env.episode_length)
        finite = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(last)]).all()
        return {k: x.sum(0) for k, x in seen.items()} | {"finite": finite}

    keys = jax.random.split(jax.random.key(1), 8)
    seen = jax.jit(jax.vmap(episode), compiler_options=FAST)(keys)
    assert seen["finite"].all()
    assert seen["ret"].mean() > 900 and seen["ret"].max() < 1000  # the first tiles are not paid
    assert seen["lap"].mean() > 0.5 and seen["cost"].mean() < 2
    assert seen["steps"].min() > 300


@pytest.mark.parametrize("level", [0, 1])
def test_the_contract_of_environments_is_kept(level):
    env = envs.make(f"car_racing{level}")
    assert check_env(env, "racing") is env
    assert envs.canonical(f"SafeCarRacing{level}-v0") == f"car_racing{level}"
    assert envs.env_defaults(f"car_racing{level}")["obstacle_every"] == 10 * level
    assert env == envs.CarRacing(obstacle_every=10 * level)
    first = one(begun(), 0)
    assert level == 0 or (first.cost, first.reward, first.terminated) == (0, 0, False)


def test_options_have_bounds():
    assert envs.make("car_racing0", obstacle_every=5, num_steps=10).episode_length == 10
    with pytest.raises(ConfigError, match=r"env\.obstacle_every=21: expected a whole number between 0"):
        envs.make("car_racing1", obstacle_every=21)
    with pytest.raises(ConfigError, match="did you mean 'obstacle_every'"):
        envs.make("car_racing1", obstacles_every=2)
    options = {"obstacle_every", "num_steps", "observe_vision", "vision_size"}
    assert {f.name for f in fields(envs.CarRacing)} == options

"""The road from above: what is in the middle of each pixel.

A picture shows 64.8 m x 43.2 m, whatever its size. The car is always at the same place, in the
middle and a quarter of the height from the bottom, and its front is up. A pixel shows the road where a
wheel in the pixel's middle would be on the road, and an obstacle where it would touch the obstacle.

The loops over the tiles and the obstacles in view are unrolled, so that a pixel stays in the registers
of one kernel.

Source: `render` of car_racing_hardcore.py in HorizonRobotics/alf @23aca49 for what is in view, without
the strip of instruments, and for the colours.
Differs from it: the car is made of rectangles, and its front wheels are drawn straight. Grass has no
end; there it is black 333 m from the middle.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.envs.racing.car import AXLE, SIDE, WHEEL, Car, rotated
from jaxsafe.envs.racing.obstacles import Obstacles, centre
from jaxsafe.envs.racing.track import MOST_TILES, TILE, Track, on_road

WIDTH, HEIGHT = 1050 / 16.2, 700 / 16.2  # m
BEHIND = HEIGHT / 4  # m of it, behind the car's middle
LAWN = 1000 / 60  # m, the side of a square of grass
TILES = 64  # in view at most; of 1,024 tracks 54
REACH = 8.0  # m, farther than the middle of any tile is from where it ends
# kinds of things, and their colours
GRASS, MOWN, ROAD, OBSTACLE, HULL, TYRE = range(6)
COLOURS = np.array(
    [[102, 204, 102], [102, 230, 102], [102, 102, 102], [219, 20, 59], [204, 0, 0], [0, 0, 0]], np.uint8
)
GREYS = np.round(COLOURS @ [0.299, 0.587, 0.114]).astype(np.uint8)
# m: where they begin and end along the car, and half their width
HULLS = ((-2.4, -1.8, 1.0), (-1.8, 0.4, 0.8), (0.4, 2.2, 0.4), (2.2, 2.6, 1.2))


def picture(
    car: Car, track: Track, obstacles: Obstacles, size: tuple[int, int], paint: np.ndarray = GREYS
) -> jax.Array:
    """uint8 [height, width].

    Args:
        size: width and height in pixels.
        paint: uint8 [6], what stands for each kind of thing.
    """
    x, y = pixels(size)
    seen = jnp.where(mown(car, x, y), paint[MOWN], paint[GRASS])
    seen = jnp.where(of_road(car, track, x, y), paint[ROAD], seen)
    seen = jnp.where(of_obstacles(car, track, obstacles, x, y), paint[OBSTACLE], seen)
    hull, tyre = of_car(x, y)
    return jnp.where(tyre, paint[TYRE], jnp.where(hull, paint[HULL], seen))


def pixels(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Where their middles are in the car's frame, m: x [height, 1] and y [1, width]."""
    width, height = size
    x = HEIGHT * (1 - (np.arange(height) + 0.5) / height) - BEHIND
    y = WIDTH * (0.5 - (np.arange(width) + 0.5) / width)
    return x.astype(np.float32)[:, None], y.astype(np.float32)[None, :]


def mown(car: Car, x: np.ndarray, y: np.ndarray) -> jax.Array:
    """Where the light squares are: every second one in both directions of the world."""
    cos, sin = jnp.cos(car.heading), jnp.sin(car.heading)
    north = car.position[1] + sin * x + cos * y
    east = car.position[0] + cos * x - sin * y
    light = [jnp.floor(place / LAWN) % 2 == 0 for place in (east, north)]
    return light[0] & light[1]


def of_road(car: Car, track: Track, x: np.ndarray, y: np.ndarray) -> jax.Array:
    far = jnp.where(jnp.arange(MOST_TILES) < track.count, squares(car, track.points), jnp.inf)
    tile = jax.lax.top_k(-far, TILES)[1]
    c = rotated(track.points[tile] - car.position, -car.heading)
    d = rotated(track.direction(tile), -car.heading)
    nearest, left = jnp.full((), jnp.inf), jnp.zeros(())
    for k in range(TILES):
        square = (x - c[k, 0]) ** 2 + (y - c[k, 1]) ** 2
        nearer = square < nearest
        nearest = jnp.where(nearer, square, nearest)
        left = jnp.where(nearer, d[k, 0] * (y - c[k, 1]) - d[k, 1] * (x - c[k, 0]), left)
    return on_road(left) & (nearest <= REACH**2)


def of_obstacles(
    car: Car, track: Track, obstacles: Obstacles, x: np.ndarray, y: np.ndarray
) -> jax.Array:
    middle = centre(track, obstacles)
    far = jnp.where(obstacles.half_width > 0, squares(car, middle), jnp.inf)
    found = jnp.zeros((), bool)
    if not len(far):
        return found
    near = jax.lax.top_k(-far, obstacles_drawn(len(far)))[1]
    c = rotated(middle[near] - car.position, -car.heading)
    d = rotated(track.direction(obstacles.tile[near]), -car.heading)
    for k, half_width in enumerate(obstacles.half_width[near]):
        forward = d[k, 0] * (x - c[k, 0]) + d[k, 1] * (y - c[k, 1])
        across = d[k, 0] * (y - c[k, 1]) - d[k, 1] * (x - c[k, 0])
        found |= (jnp.abs(forward) <= TILE / 2) & (jnp.abs(across) <= half_width)
    return found


def obstacles_drawn(count: int) -> int:
    """Of so many of a track, the most in view: twice as many as on average."""
    return min(count, 2 * count * TILES // MOST_TILES)


def squares(car: Car, points: jax.Array) -> jax.Array:
    """Of the distances of points [n, 2] from the middle of the picture, m^2."""
    ahead = (HEIGHT / 2 - BEHIND) * jnp.stack([jnp.cos(car.heading), jnp.sin(car.heading)])
    return jnp.square(points - car.position - ahead).sum(-1)


def of_car(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where hull and tyres are."""
    hull = [(begin <= x) & (x <= end) & (np.abs(y) <= half) for begin, end, half in HULLS]
    tyre = (np.abs(np.abs(x) - AXLE) <= WHEEL) & (np.abs(np.abs(y) - SIDE) <= WHEEL / 4)
    return np.any(hull, 0), tyre

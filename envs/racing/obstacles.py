"""Rectangles across the road, which a car had better go round."""

import flax.struct
import jax
import jax.numpy as jnp

from jaxsafe.envs.racing.track import TILE, Track


@flax.struct.dataclass
class Obstacles:
    """Rectangles across the road, as long as a tile.

    tile: int32 [M]. left: [M], m, how far their centres are to the left of the middle of the road.
    half_width: [M], m; negative for those that are not there.
    """

    tile: jax.Array
    left: jax.Array
    half_width: jax.Array


def centre(track: Track, obstacles: Obstacles) -> jax.Array:
    """Of obstacles [M, 2], m."""
    along = track.direction(obstacles.tile)
    across = jnp.stack([-along[:, 1], along[:, 0]], 1)
    return track.point(obstacles.tile) + obstacles.left[:, None] * across


def touching(track: Track, obstacles: Obstacles, points: jax.Array) -> jax.Array:
    """Whether one of `points` [n, 2] is on each obstacle: bool [M]."""
    along = track.direction(obstacles.tile)
    x, y = jnp.moveaxis(points[:, None] - centre(track, obstacles), -1, 0)  # [n, M]
    forward = along[:, 0] * x + along[:, 1] * y
    across = along[:, 0] * y - along[:, 1] * x
    return ((jnp.abs(forward) <= TILE / 2) & (jnp.abs(across) <= obstacles.half_width)).any(0)

"""A random closed track, and where a point is on it.

A loop goes by 12 checkpoints around a circle, each at a random radius and angle:

    rho(theta) = sum_k w_k rho_k / sum_k w_k,   w_k = exp((cos(theta - alpha_k) - 1) / BLUR^2)

It is then drawn towards the circle of its mean radius, until it turns nowhere faster than allowed:

    r = mean + share (rho - mean),   share in [0, 1]: the largest with |curvature| <= MAX_CURVATURE

A loop with one radius for each angle closes and cannot cross itself. The checkpoints, the sizes and the
limit on turning are those of Gymnasium's CarRacing. There a curve is steered from checkpoint to
checkpoint, and drawn again if it does not close. Tracks have about 150 to 250 tiles here.
"""

import flax.struct
import jax
import jax.numpy as jnp

RADIUS = 150.0  # m, of the farthest checkpoint; the nearest is at a third of it
CHECKPOINTS = 12
TILE = 3.5  # m, the shortest tile
HALF_WIDTH = 20 / 3  # m, of the road
MAX_CURVATURE = 0.31 / TILE  # 1/m: 0.31 rad on a tile, a circle of 11.3 m
MOST_TILES = 300  # a circle of the largest radius has 269
BLUR = 0.22  # rad, over which checkpoints are smoothed; ours
ANGLES = 720  # at which the loop is computed; ours
SHARES = 17  # that are tried; ours


@flax.struct.dataclass
class Track:
    """Tiles in the order in which they are driven. Their centres repeat beyond `count`.

    points: [MOST_TILES, 2], m.
    count: int32 [].
    """

    points: jax.Array
    count: jax.Array

    def point(self, tile: jax.Array) -> jax.Array:
        return self.points[tile % self.count]

    def direction(self, tile: jax.Array) -> jax.Array:
        """Unit vectors along the road [..., 2]."""
        along = self.point(tile + 1) - self.point(tile - 1)
        return along / jnp.linalg.norm(along, axis=-1, keepdims=True)


def random_track(key: jax.Array) -> Track:
    """A track that is driven either way round."""
    angle_key, radius_key, way_key = jax.random.split(key, 3)
    shift = jax.random.uniform(angle_key, (CHECKPOINTS,))
    alpha = 2 * jnp.pi / CHECKPOINTS * (jnp.arange(CHECKPOINTS) + shift)
    radii = jax.random.uniform(radius_key, (CHECKPOINTS,), minval=RADIUS / 3, maxval=RADIUS)
    way = jax.random.rademacher(way_key, (), jnp.float32)
    return paved(loop(alpha, radii) * jnp.stack([jnp.ones(()), way]))


def loop(alpha: jax.Array, radii: jax.Array) -> jax.Array:
    """Points [ANGLES, 2] of the loop by checkpoints at angles `alpha` and `radii`, anticlockwise."""
    theta = 2 * jnp.pi / ANGLES * jnp.arange(ANGLES)
    weights = jnp.exp((jnp.cos(theta[:, None] - alpha) - 1) / BLUR**2)
    rho = (weights * radii).sum(1) / weights.sum(1)
    share = jnp.linspace(1.0, 0.0, SHARES)[:, None]
    r = rho.mean() + share * (rho - rho.mean())  # [SHARES, ANGLES]
    curvature, length = shape(r)
    fits = (jnp.abs(curvature).max(1) <= MAX_CURVATURE) & (length < MOST_TILES * TILE)
    chosen = r[jnp.argmax(fits)]  # the first that fits; the last is a circle, which does
    return chosen[:, None] * jnp.stack([jnp.cos(theta), jnp.sin(theta)], 1)


def shape(r: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Of loops with radius r(theta) [..., n]: curvature (1/m, positive to the left) and length (m)."""
    h = 2 * jnp.pi / r.shape[-1]
    after, before = jnp.roll(r, -1, -1), jnp.roll(r, 1, -1)
    slope, bend = (after - before) / (2 * h), (after - 2 * r + before) / h**2
    speed = jnp.sqrt(r**2 + slope**2)  # length of an angle, m/rad
    return (speed**2 + slope**2 - r * bend) / speed**3, h * speed.sum(-1)


def lengths(points: jax.Array) -> jax.Array:
    """Of the sides of closed polygons [..., n, 2], m."""
    return jnp.linalg.norm(jnp.roll(points, -1, -2) - points, axis=-1)


def paved(points: jax.Array) -> Track:
    """The closed polygon [n, 2] as tiles of one length, `TILE` or a little more."""
    ends = jnp.concatenate([jnp.zeros(1), jnp.cumsum(lengths(points))])
    count = (ends[-1] / TILE).astype(jnp.int32)
    place = jnp.arange(MOST_TILES) % count * (ends[-1] / count)
    closed = jnp.concatenate([points, points[:1]])
    x, y = (jnp.interp(place, ends, closed[:, i]) for i in (0, 1))
    return Track(jnp.stack([x, y], 1), count)


def locate(track: Track, points: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The tiles whose centres are nearest to `points` [n, 2], and how far to the left of the middle of
    the road the points are: int32 [n], and [n] in m."""
    squares = jnp.square(points[:, None] - track.points).sum(-1)
    tile = jnp.argmin(squares, 1) % track.count
    along, off = track.direction(tile), points - track.point(tile)
    return tile, along[:, 0] * off[:, 1] - along[:, 1] * off[:, 0]


def on_road(left: jax.Array) -> jax.Array:
    return jnp.abs(left) <= HALF_WIDTH

"""What a world model makes of observations, and what observations it makes of its latents.

    vector     symlog and shares of bins, hidden layers;   back: hidden layers, symlog of the vector
    picture    each layer halves it: a convolution, the largest of each 2 x 2, norm, SiLU
               back: each layer doubles it: every pixel becomes 2 x 2, a convolution, norm, SiLU

Convolutions are 5 x 5. A picture is surrounded by zeros, which are mid-grey to the first layer: it sees
pixels less 0.5.

Source: Hafner et al. (2025), "Mastering Diverse Control Tasks through World Models", Nature 640;
    the layers of pictures are from the authors' code. Bins are ours.
"""

import math

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.config import ConfigError
from jaxsafe.nn.cnn import patches
from jaxsafe.nn.rssm import BlockDense, Head, Hidden, Latent, Size, fan_in, normed
from jaxsafe.nn.two_hot import symlog

SIDE = 5  # of a convolution
LEAST, MOST = 3, 16  # the sides that a picture may have after its last halving, as in the authors' code

# ---- vectors -----------------------------------------------------------------------------------


def shares(x: jax.Array, bins: int) -> jax.Array:
    """How near `x` is to each of `bins` even steps from -1 to 1, float [..., bins].

    Only its two neighbours are above 0. They sum to 1, and their mean is `x`. A number beyond the last
    step counts as that step.
    """
    steps = jnp.linspace(-1.0, 1.0, bins)
    apart = jnp.abs(jnp.clip(x, -1.0, 1.0)[..., None] - steps) * (bins - 1) / 2
    return jnp.maximum(0.0, 1.0 - apart)


class VectorEncoder(nn.Module):
    """Observations [..., O] -> what the posterior sees of them, [..., units].

    Large numbers are squeezed by symlog. A hazard begins at 0.93 of its lidar, and a layer that sees
    only the number learns such an edge slowly. So it also sees its `shares` of `bins` steps, unless
    there are none.
    """

    size: Size
    bins: int = 0

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        x = symlog(obs)
        if self.bins:
            of_bins = shares(obs, self.bins)
            x = jnp.concatenate([x, of_bins.reshape(*obs.shape[:-1], -1)], -1)
        for _ in range(self.size.layers):
            x = Hidden(self.size.units, self.size.dtype)(x)
        return x


class VectorDecoder(nn.Module):
    """Latents -> symlog of the observation, [..., O]."""

    size: Size
    obs_size: int

    @nn.compact
    def __call__(self, latent: Latent) -> jax.Array:
        size = self.size
        return Head(size.layers, size.units, self.obs_size, dtype=size.dtype)(latent.features)

    def loss(self, decoded: jax.Array, obs: jax.Array) -> jax.Array:
        """The squared error of what `__call__` gave, summed over the observation: float [...]."""
        return vector_loss(decoded, obs)


def vector_loss(decoded: jax.Array, obs: jax.Array) -> jax.Array:
    return ((decoded - symlog(obs)) ** 2).sum(-1)


# ---- pictures ----------------------------------------------------------------------------------


# Of one axis. A square of results has two pixels. It reads three squares of the input: of two pixels,
# or in REPEATED_READS of one that is repeated. READS[a, d, s, p] is 1 where tap d of the kernel, for
# pixel a of the results, falls on pixel p of square s.
PIXEL, TAP = np.mgrid[:2, :SIDE]
READS = ((PIXEL + TAP)[..., None] == np.arange(6)).astype(np.float32).reshape(2, SIDE, 3, 2)
REPEATED_READS = ((PIXEL + TAP)[..., None] // 2 == np.arange(3)).astype(np.float32)[..., None]


class Convolution(nn.Module):
    """A 5 x 5 convolution whose results lie in squares of 2 x 2 pixels, float [..., h, w, 2, 2, out].

    Its input is [..., 2 h, 2 w, C]. If it `grows` the input is [..., h, w, C], and each pixel is first
    repeated as 2 x 2. One matrix product gives the four results of a square from the 3 x 3 squares that
    they read. This copies fewer pixels than a patch for each result does. On a CPU it is far faster
    than XLA's convolution: see `patches`. Where results are fewer than what a square holds, each square
    is multiplied first, and what its neighbours take of it is summed.
    """

    out: int
    grows: bool = False
    dtype: str = "float32"

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        kernel = self.param("kernel", fan_in(1.0), (SIDE, SIDE, x.shape[-1], self.out))
        bias = self.param("bias", nn.initializers.zeros, (self.out,))
        reads = REPEATED_READS if self.grows else READS
        # row and column of the square that is read (s, t) and of its pixel (p, q), of the tap (d, e),
        # of the result's pixel (a, b)
        matrix = jnp.einsum("adsp,betq,deco->stpqcabo", reads, reads, kernel, precision="highest")
        x = x.astype(self.dtype)
        squares = x if self.grows else squares_of(x)
        matrix = matrix.reshape(3, 3, squares.shape[-1], 4 * self.out).astype(self.dtype)
        results = (summed if 4 * self.out < squares.shape[-1] else gathered)(squares, matrix)
        return results.reshape(*results.shape[:-1], 2, 2, self.out) + bias.astype(self.dtype)


def gathered(squares: jax.Array, matrix: jax.Array) -> jax.Array:
    """A 3 x 3 convolution with `matrix` [3, 3, C, R], float [..., h, w, C] -> [..., h, w, R]: the
    product of what each result reads, which is 9 times as much as `squares`."""
    seen = patches(squares, side=3, stride=1)
    return seen @ matrix.reshape(seen.shape[-1], matrix.shape[-1])


def summed(squares: jax.Array, matrix: jax.Array) -> jax.Array:
    """The same convolution, as the sum of what each result takes of its neighbours' products. They are
    9 times as much as the results."""
    each = jnp.einsum("...c,stcr->...str", squares, matrix)
    height, width = squares.shape[-3:-1]
    around = [(0, 0)] * (squares.ndim - 3) + [(1, 1), (1, 1)] + [(0, 0)] * 3
    each = jnp.pad(each, around)
    taken = [each[..., s : s + height, t : t + width, s, t, :] for s in range(3) for t in range(3)]
    return sum(taken[1:], taken[0])


def squares_of(picture: jax.Array) -> jax.Array:
    """The pixels of each square of 2 x 2 side by side: [..., 2 h, 2 w, C] -> [..., h, w, 4 C]."""
    *front, height, width, channels = picture.shape
    rows = picture.reshape(*front, height // 2, 2, width // 2, 2, channels)
    return jnp.moveaxis(rows, -4, -3).reshape(*front, height // 2, width // 2, 4 * channels)


def picture_of(squares: jax.Array) -> jax.Array:
    """Squares side by side: [..., h, w, 2, 2, C] -> [..., 2 h, 2 w, C]."""
    *front, height, width, _, _, channels = squares.shape
    return jnp.moveaxis(squares, -4, -3).reshape(*front, 2 * height, 2 * width, channels)


class PictureEncoder(nn.Module):
    """Pictures uint8 [..., H, W, C] -> what the posterior sees of them, float [..., E]."""

    size: Size

    @nn.compact
    def __call__(self, picture: jax.Array) -> jax.Array:
        x = picture.astype(jnp.float32) / 255 - 0.5
        for channels in self.size.channels:
            x = normed(Convolution(channels, dtype=self.size.dtype)(x).max((-3, -2)))
        return x.reshape(*x.shape[:-3], math.prod(x.shape[-3:]))


class PictureDecoder(nn.Module):
    """Latents -> pictures in [0, 1], float [..., H, W, C].

    shape: [H, W, C].
    """

    size: Size
    shape: tuple[int, int, int]

    @nn.compact
    def __call__(self, latent: Latent) -> jax.Array:
        channels, blocks = self.size.channels, self.size.blocks
        height, width = (side // 2 ** len(channels) for side in self.shape[:2])
        front = latent.deter.shape[:-1]
        h = latent.deter.reshape(*front, blocks, self.size.deter // blocks)
        dtype = self.size.dtype
        of_h = BlockDense(height * width * channels[-1] // blocks, dtype)(h)  # its own channels
        of_h = jnp.moveaxis(of_h.reshape(*front, blocks, height, width, -1), -4, -2)
        z = Hidden(2 * self.size.units, dtype)(latent.stoch)
        of_z = nn.Dense(height * width * channels[-1], dtype=dtype, kernel_init=fan_in(1.0))(z)
        shape = (*front, height, width, channels[-1])
        x = normed(of_h.reshape(shape) + of_z.reshape(shape))
        for out in channels[-2::-1]:
            x = normed(picture_of(Convolution(out, grows=True, dtype=dtype)(x)))
        return nn.sigmoid(picture_of(Convolution(self.shape[-1], grows=True)(x)))


def picture_loss(decoded: jax.Array, picture: jax.Array) -> jax.Array:
    return ((decoded - picture.astype(jnp.float32) / 255) ** 2).sum((-3, -2, -1))


def check_picture(shape: tuple[int, ...], size: Size, name: str) -> None:
    """Refuse a picture [H, W, C] whose sides are no multiples of 2^layers, or outside their range.

    Args:
        name: of the size, for the message.
    Raises:
        ConfigError: with the nearest sides.
    """
    unit = 2 ** len(size.channels)
    nearest = [unit * min(max(round(side / unit), LEAST), MOST) for side in shape[:2]]
    if nearest != [*shape[:2]]:
        raise ConfigError(
            f"pictures of {shape[1]} x {shape[0]}: size={name} expects sides that are multiples of "
            f"{unit}, from {unit * LEAST} to {unit * MOST}; the nearest is "
            f"env.vision_size=[{nearest[1]},{nearest[0]}]"
        )


# ---- both --------------------------------------------------------------------------------------


class Encoder(nn.Module):
    """{'vision': uint8 [..., H, W, C], 'vector': float [..., O]} -> what the posterior sees of them,
    float [..., E]. The vector may be empty."""

    size: Size
    bins: int = 0

    @nn.compact
    def __call__(self, obs: dict[str, jax.Array]) -> jax.Array:
        seen = [PictureEncoder(self.size)(obs["vision"])]
        if obs["vector"].shape[-1]:
            seen.append(VectorEncoder(self.size, self.bins)(obs["vector"]))
        return jnp.concatenate(seen, -1)


class Decoder(nn.Module):
    """Latents -> {'vision': pictures in [0, 1], [..., H, W, C], 'vector': symlog of it, [..., O]}.

    shape: [H, W, C].
    obs_size: O, which may be 0.
    """

    size: Size
    shape: tuple[int, int, int]
    obs_size: int

    @nn.compact
    def __call__(self, latent: Latent) -> dict[str, jax.Array]:
        vector = jnp.zeros((*latent.deter.shape[:-1], 0))
        if self.obs_size:
            vector = VectorDecoder(self.size, self.obs_size)(latent)
        return {"vision": PictureDecoder(self.size, self.shape)(latent), "vector": vector}

    def loss(self, decoded: dict[str, jax.Array], obs: dict[str, jax.Array]) -> jax.Array:
        """The squared errors of picture and vector, as symlog, summed over both: float [...]."""
        picture = picture_loss(decoded["vision"], obs["vision"])
        return picture + vector_loss(decoded["vector"], obs["vector"])

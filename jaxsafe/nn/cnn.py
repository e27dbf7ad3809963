"""Observations with a picture, as one vector: what convolutions make of the picture, and the rest."""

import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxsafe.nn.initializers import orthogonal
from jaxsafe.types import PyTree

LAYERS = ((32, 8, 4), (64, 4, 2), (64, 3, 1))  # channels, side of the kernel, stride
FEATURES = 128  # numbers that the picture becomes


def patches(x: jax.Array, side: int, stride: int) -> jax.Array:
    """The squares of `side` that a convolution sees, [..., H / stride, W / stride, side side C].

    Borders are padded with zeros. A product of these and a matrix is a convolution. On a CPU XLA
    computes it in a loop, as of gradient steps, 25 times as fast as its own convolution.
    """
    height, width = (-(-n // stride) for n in x.shape[-3:-1])
    missing = [
        max((out - 1) * stride + side - n, 0)
        for n, out in zip(x.shape[-3:-1], (height, width), strict=True)
    ]
    x = jnp.pad(x, [(0, 0)] * (x.ndim - 3) + [(m // 2, m - m // 2) for m in missing] + [(0, 0)])
    last = ((height - 1) * stride + 1, (width - 1) * stride + 1)
    shifts = [(i, j) for i in range(side) for j in range(side)]
    return jnp.concatenate(
        [x[..., i : i + last[0] : stride, j : j + last[1] : stride, :] for i, j in shifts], -1
    )


class CNN(nn.Module):
    """{'vision' uint8 [..., H, W, C], 'vector' float [..., O]} -> float [..., FEATURES + O].

    Source: Mnih et al. (2015), "Human-level control through deep reinforcement learning", for the
    convolutions; Yarats et al. (2021), "Improving Sample Efficiency in Model-Free Reinforcement
    Learning from Images", arXiv:1910.01741, for the layer norm and the tanh after them.
    Differs from them: borders are padded, so that pictures may have any size, and there are 128
    features.

    precision: of the products, as in `networks.MLP`.
    """

    precision: jax.lax.Precision = jax.lax.Precision.HIGHEST

    @nn.compact
    def __call__(self, obs: dict[str, jax.Array]) -> jax.Array:
        weights = orthogonal(math.sqrt(2.0))
        x = obs["vision"].astype(jnp.float32) / 255
        for channels, side, stride in LAYERS:
            layer = nn.Dense(channels, precision=self.precision, kernel_init=weights)
            x = nn.relu(layer(patches(x, side, stride)))
        x = x.reshape(*x.shape[:-3], math.prod(x.shape[-3:]))
        x = nn.Dense(FEATURES, precision=self.precision, kernel_init=weights)(x)
        return jnp.concatenate([nn.tanh(nn.LayerNorm()(x)), obs["vector"]], -1)


def init_encoder(key: jax.Array, obs: dict[str, jax.Array]) -> PyTree:
    return coarse_cnn.init(key, obs)


def encoded(encoder: PyTree, obs: dict[str, jax.Array]) -> jax.Array:
    """What an encoder of its own makes of `obs` [...], float [..., FEATURES + O]."""
    out: Any = coarse_cnn.apply(encoder, obs)
    return out


coarse_cnn = CNN(jax.lax.Precision.DEFAULT)  # see networks.coarse_mlp

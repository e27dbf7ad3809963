"""Observations with a picture, as one vector: what convolutions make of the picture, and the rest."""

import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxsafe.types import PyTree

LAYERS = ((32, 8, 4), (64, 4, 2), (64, 3, 1))  # channels, side of the kernel, stride
FEATURES = 128  # numbers that the picture becomes


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
        weights = nn.initializers.orthogonal(math.sqrt(2.0))
        x = obs["vision"].astype(jnp.float32) / 255
        for channels, side, stride in LAYERS:
            layer = nn.Conv(
                channels, (side, side), stride, precision=self.precision, kernel_init=weights
            )
            x = nn.relu(layer(x))
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

"""Networks with a memory: a gated recurrent unit between two feed-forward parts."""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxsafe.types import PyTree


class Sequences(NamedTuple):
    """What a recurrent network reads: B sequences of T steps.

    obs: float [B, T, O].
    first: bool [B, T], True where an episode begins: what was remembered is forgotten there.
    carry: float [B, H], what is remembered before the first step.
    """

    obs: jax.Array
    first: jax.Array
    carry: jax.Array


class GRU(nn.Module):
    """One step: the memory h [..., H] after the input x [..., I].

        z = sigmoid(W_z [x, h]),   r = sigmoid(W_r [x, h])
        h <- (1 - z) tanh(W x + r U h) + z h

    Source: Cho et al. (2014), "Learning Phrase Representations using RNN Encoder-Decoder for
        Statistical Machine Translation", arXiv:1406.1078; the reset gate r stands outside U, so that
        one product serves, as in cuDNN.
    """

    size: int  # H

    @nn.compact
    def __call__(self, h: jax.Array, x: jax.Array) -> jax.Array:
        def dense(name: str, outputs: int, bias: bool = True) -> nn.Dense:
            weights = nn.initializers.orthogonal()
            highest = jax.lax.Precision.HIGHEST  # see networks.MLP
            return nn.Dense(outputs, bias, precision=highest, kernel_init=weights, name=name)

        gates = dense("gates", 2 * self.size)(jnp.concatenate([x, h], -1))
        z, r = jnp.split(nn.sigmoid(gates), 2, axis=-1)
        candidate = nn.tanh(dense("see", self.size)(x) + r * dense("recall", self.size, False)(h))
        return (1 - z) * candidate + z * h


class Recurrent(nn.Module):
    """(h [..., H], x [..., I]) -> (h, the heads' outputs side by side, float [..., out])."""

    encoder: nn.Module | None  # before the unit; its output goes through `activation`
    activation: Callable[[jax.Array], jax.Array]
    size: int  # H
    heads: tuple[nn.Module, ...]

    @nn.compact
    def __call__(self, h: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        x = x if self.encoder is None else self.activation(self.encoder(x))
        h = GRU(self.size)(h, x)
        return h, jnp.concatenate([head(h) for head in self.heads], -1)


def unroll(net: Recurrent, params: PyTree, inputs: Sequences) -> tuple[jax.Array, jax.Array]:
    """What is remembered after each step, float [B, T, H], and the outputs [B, T, out]."""

    def step(h: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, Any]:
        obs, first = now
        h, out = net.apply(params, jnp.where(first[:, None], 0.0, h), obs)  # type: ignore[misc]
        return h, (h, out)

    time_first = jnp.swapaxes(inputs.obs, 0, 1), jnp.swapaxes(inputs.first, 0, 1)
    _, found = jax.lax.scan(step, inputs.carry, time_first)
    h, out = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), found)
    return h, out

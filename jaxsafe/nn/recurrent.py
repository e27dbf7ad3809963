"""Networks with a memory: a gated recurrent unit between two feed-forward parts; and gradients along
sequences."""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxsafe.nn.initializers import orthogonal
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
            weights = orthogonal()
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


def states_along(
    step: Callable[..., PyTree], params: PyTree, start: PyTree, inputs: PyTree, given: PyTree
) -> PyTree:
    """The states [T, ...] after each step of `step(params, state, input, given) -> state` from `start`.

    As `jax.lax.scan`. But on a GPU the gradient of `params` is taken of all steps at once
    (`gradient_at_once`).

    Args:
        inputs: [T, ...], whose gradient is wanted.
        given: [T, ...], without gradient: random keys and the like.
    """
    run = scanned if jax.default_backend() == "cpu" else gradient_at_once
    return run(step, params, start, inputs, given)


def scanned(
    step: Callable[..., PyTree], params: PyTree, start: PyTree, inputs: PyTree, given: PyTree
) -> PyTree:
    def forward(state: PyTree, x: tuple[PyTree, PyTree]) -> tuple[PyTree, PyTree]:
        after = step(params, state, *x)
        return after, after

    return jax.lax.scan(forward, start, (inputs, given))[1]


def gradient_at_once(
    step: Callable[..., PyTree], params: PyTree, start: PyTree, inputs: PyTree, given: PyTree
) -> PyTree:
    """`scanned`, with a gradient of `params` that is taken of all steps at once.

    A scan adds it up step by step, by a product and a sum for each array of weights. For small networks
    that is most of the kernels of a GPU. Here a step is worked out three times in place of once, which
    takes a CPU longer.
    """

    @jax.custom_vjp
    def run(params: PyTree, start: PyTree, inputs: PyTree, given: PyTree) -> PyTree:
        return scanned(step, params, start, inputs, given)

    def keep(params: PyTree, start: PyTree, inputs: PyTree, given: PyTree) -> tuple[PyTree, Any]:
        states = scanned(step, params, start, inputs, given)
        return states, (params, start, states, inputs, given)

    def gradient(kept: Any, slopes: PyTree) -> tuple[PyTree, PyTree, PyTree, None]:
        params, start, states, inputs, given = kept
        before = jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs[:-1]]), start, states)

        def backward(later: PyTree, x: tuple[PyTree, ...]) -> tuple[PyTree, tuple[PyTree, PyTree]]:
            state, input, given, slope = x
            total = jax.tree.map(jnp.add, later, slope)
            pull = jax.vjp(lambda state, input: step(params, state, input, given), state, input)[1]
            earlier, of_input = pull(total)
            return earlier, (total, of_input)

        nothing = jax.tree.map(jnp.zeros_like, start)
        of_start, (totals, of_inputs) = jax.lax.scan(
            backward, nothing, (before, inputs, given, slopes), reverse=True
        )
        every = jax.vmap(step, in_axes=(None, 0, 0, 0))
        [of_params] = jax.vjp(lambda params: every(params, before, inputs, given), params)[1](totals)
        return of_params, of_start, of_inputs, None

    run.defvjp(keep, gradient)
    return run(params, start, inputs, given)

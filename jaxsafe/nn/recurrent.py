"""Networks with a memory: a gated recurrent unit between two feed-forward parts; and gradients along
sequences."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.extend.core import Var

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
    """`scanned`, with a gradient that is taken of all steps at once, but for what one step hands to the
    one before.

    A scan adds up the gradient of `params` step by step, by a product and a sum for each array of
    weights. For small networks that is most of the kernels of a GPU. Here only the slopes of the states
    go from step to step. What they are multiplied by is known before, as all states are. A step is
    worked out twice in place of once, which takes a CPU longer.
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

        def pull(x: tuple[PyTree, PyTree, PyTree]) -> PyTree:
            """(slope of the state after a step) -> (of the state before, of the input)."""
            state, input, given = x
            return jax.vjp(lambda state, input: step(params, state, input, given), state, input)[1]

        pull_of, rows = at_once(pull, (before, inputs, given))

        def backward(later: PyTree, x: tuple[PyTree, PyTree]) -> tuple[PyTree, tuple[PyTree, PyTree]]:
            row, slope = x
            total = jax.tree.map(jnp.add, later, slope)
            earlier, of_input = pull_of(row)(total)
            return earlier, (total, of_input)

        nothing = jax.tree.map(jnp.zeros_like, start)
        of_start, (totals, of_inputs) = jax.lax.scan(backward, nothing, (rows, slopes), reverse=True)
        every = jax.vmap(step, in_axes=(None, 0, 0, 0))
        [of_params] = jax.vjp(lambda params: every(params, before, inputs, given), params)[1](totals)
        return of_params, of_start, of_inputs, None

    run.defvjp(keep, gradient)
    return run(params, start, inputs, given)


def at_once(
    fn: Callable[[PyTree], PyTree], xs: PyTree
) -> tuple[Callable[[list[jax.Array]], PyTree], list[jax.Array]]:
    """`fn` of all rows of `xs` [T, ...], worked out together.

    Returns:
        get: row t of `rows` -> `fn` of row t of `xs`.
        rows: [T, ...], what depends on `xs`. The rest, as what is made of weights alone, `get` knows.
    """
    tree: Any = None

    def leaves_of(x: PyTree) -> list[jax.Array]:
        nonlocal tree
        leaves, tree = jax.tree.flatten(fn(x))
        return leaves

    first = jax.tree.map(lambda x: x[0], xs)
    depends = dependence(leaves_of, first)

    def those(leaves: list[jax.Array], depend: bool) -> list[jax.Array]:
        return [x for x, on_row in zip(leaves, depends, strict=True) if on_row == depend]

    known = those(leaves_of(first), False)
    rows = jax.vmap(lambda x: those(leaves_of(x), True))(xs)

    def get(row: list[jax.Array]) -> PyTree:
        of_row, of_none = iter(row), iter(known)
        return jax.tree.unflatten(tree, [next(of_row if on_row else of_none) for on_row in depends])

    return get, rows


def dependence(fn: Callable[[PyTree], list[jax.Array]], x: PyTree) -> list[bool]:
    """Which arrays of `fn(x)` depend on `x`. Others are made of what `fn` holds."""
    program = jax.make_jaxpr(fn)(x).jaxpr
    found = set(program.invars)

    def any_of(variables: Sequence[Any]) -> bool:
        return any(isinstance(v, Var) and v in found for v in variables)

    for operation in program.eqns:
        if any_of(operation.invars):
            found.update(operation.outvars)
    return [any_of([v]) for v in program.outvars]

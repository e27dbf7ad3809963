"""A gated recurrent unit, and the gradient of long sequences."""

from typing import Any

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsafe.nn.recurrent import GRU, Recurrent, at_once, gradient_at_once, scanned

STEPS, ROWS, SIZE, WIDTH = 7, 3, 4, 2


class Noisy(nn.Module):
    """A unit whose memory is lost where `first`, and is disturbed by noise."""

    @nn.compact
    def __call__(self, h, x, first, key):
        h = GRU(SIZE)(jnp.where(first[:, None], 0.0, h), x)
        return h + 0.1 * jax.random.normal(key, h.shape)


@pytest.mark.parametrize("of", ["params", "start", "inputs"])
def test_the_gradient_of_all_steps_at_once_is_that_of_a_scan(of):
    net, draw = Noisy(), jax.random.split(jax.random.key(0), 5)
    start = jax.random.normal(draw[0], (ROWS, SIZE))
    inputs = jax.random.normal(draw[1], (STEPS, ROWS, WIDTH))
    given = jax.random.uniform(draw[2], (STEPS, ROWS)) < 0.3, jax.random.split(draw[3], STEPS)
    params = net.init(draw[4], start, inputs[0], *jax.tree.map(lambda x: x[0], given))
    args = {"params": params, "start": start, "inputs": inputs}

    def loss(run, part):
        """Of the states, each of which counts otherwise."""

        def step(params, h, x, given):
            return net.apply(params, h, x, *given)

        states = run(step, *{**args, of: part}.values(), given)
        return (jnp.arange(1, STEPS + 1)[:, None, None] * states**2).sum()

    (value, slope), (expected, slope_of_scan) = (
        jax.jit(jax.value_and_grad(lambda part, run=run: loss(run, part)))(args[of])
        for run in (gradient_at_once, scanned)
    )
    chex.assert_trees_all_close(value, expected, rtol=1e-6)
    chex.assert_trees_all_close(slope, slope_of_scan, rtol=1e-4, atol=1e-4)
    assert all(jnp.abs(x).max() > 0.1 for x in jax.tree.leaves(slope))


def test_the_gradients_of_several_seeds_side_by_side_are_those_of_each():
    net, draw = Noisy(), jax.random.split(jax.random.key(0), 4)
    start, inputs = jnp.zeros((ROWS, SIZE)), jax.random.normal(draw[0], (STEPS, ROWS, WIDTH))
    given = jax.random.uniform(draw[1], (STEPS, ROWS)) < 0.3, jax.random.split(draw[2], STEPS)
    one = start, inputs[0], *jax.tree.map(lambda x: x[0], given)
    params = jax.vmap(lambda key: net.init(key, *one))(jax.random.split(draw[3], 2))

    @jax.jit
    def slope(params):
        def step(params, h, x, given):
            return net.apply(params, h, x, *given)

        return jax.grad(lambda p: (gradient_at_once(step, p, start, inputs, given) ** 2).sum())(params)

    apart = [slope(jax.tree.map(lambda x, i=i: x[i], params)) for i in range(2)]
    beside = jax.jit(jax.vmap(slope))(params)
    chex.assert_trees_all_close(
        beside, jax.tree.map(lambda *x: jnp.stack(x), *apart), rtol=1e-4, atol=1e-5
    )


def test_what_depends_on_no_row_is_worked_out_once():
    weights, xs = jnp.array([2.0, 3.0]), jnp.arange(1.0, 5.0)
    get, rows = at_once(lambda x: {"of weights": weights**2, "of both": weights * x, "of x": x + 1}, xs)
    assert sorted(x.shape for x in rows) == [(4,), (4, 2)]
    for t, x in enumerate(xs):
        found = get(jax.tree.map(lambda rows, t=t: rows[t], rows))
        expected = {"of weights": weights**2, "of both": weights * x, "of x": x + 1}
        chex.assert_trees_all_close(found, expected)


def test_a_unit_and_what_is_around_it_by_hand():
    net = Recurrent(nn.Dense(WIDTH), jnp.square, SIZE, (nn.Dense(1), nn.Dense(2)))
    draw = jax.random.split(jax.random.key(0), 3)
    h, x = jax.random.normal(draw[0], (ROWS, SIZE)), jax.random.normal(draw[1], (ROWS, 5))
    params = net.init(draw[2], h, x)
    layers = jax.tree.map(np.float64, params["params"])

    def linear(layer, x):
        return x @ layer["kernel"] + layer.get("bias", 0.0)

    unit, seen = layers["GRU_0"], linear(layers["encoder"], np.float64(x)) ** 2
    gates = 1 / (1 + np.exp(-linear(unit["gates"], np.concatenate([seen, h], -1))))
    z, r = gates[:, :SIZE], gates[:, SIZE:]
    candidate = np.tanh(linear(unit["see"], seen) + r * linear(unit["recall"], np.float64(h)))
    after = (1 - z) * candidate + z * h
    found: Any = net.apply(params, h, x)
    np.testing.assert_allclose(found[0], after, rtol=1e-4, atol=1e-5)
    heads = np.concatenate([linear(layers[f"heads_{i}"], after) for i in range(2)], -1)
    np.testing.assert_allclose(found[1], heads, rtol=1e-4, atol=1e-5)

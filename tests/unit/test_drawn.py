"""The kernel that draws from an ensemble: what it reads, its rule for vmap, and itself on a Hopper."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsafe.nn import drawn
from jaxsafe.nn.ensemble import Scale, draw, init_ensemble, outputs_of, unscaled
from jaxsafe.nn.gaussian import Gaussian


def ensemble_of(inputs, hidden, outputs):
    """Three models with biases, whose variances differ."""
    made: Any = init_ensemble(jax.random.key(0), 3, inputs, hidden, outputs)
    layers = tuple(
        layer.replace(weight=3 * layer.weight, bias=jax.random.normal(key, layer.bias.shape))
        for layer, key in zip(made.layers, jax.random.split(jax.random.key(1), 9), strict=False)
    )
    return made.replace(layers=layers, low=made.low + 6.0)


def parts(ensemble):
    return [x.weight for x in ensemble.layers], [x.bias for x in ensemble.layers]


@pytest.mark.parametrize("shape", [(5, (20, 32), 3), (16, (31,), 8), (40, (30, 17, 16), 10)])
def test_a_column_of_ones_carries_the_biases(shape):
    """Layers of whole tiles give what the network gives: means in one half, variances in the other."""
    inputs, _, outputs = shape
    ensemble = ensemble_of(*shape)
    x = jax.random.normal(jax.random.key(2), (3, 50, inputs)).astype(jnp.bfloat16)
    h = drawn.with_one(x).astype(jnp.float32)
    padded = drawn.with_biases(*parts(ensemble))
    with jax.default_matmul_precision("float32"):
        for w in padded[:-1]:
            h = jax.nn.swish(h @ w)
        mean, raw = jnp.split(h @ padded[-1], 2, -1)
        expected = outputs_of(ensemble, unscaled(inputs), x.astype(jnp.float32))
    assert all(n % 16 == 0 for w in padded for n in w.shape[1:])
    variance = jnp.exp(ensemble.low)[:, None] + 1 / (
        jnp.exp(-ensemble.high)[:, None] + jnp.exp(-raw[..., :outputs])
    )
    np.testing.assert_allclose(mean[..., :outputs], expected.mean, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(jnp.log(variance) / 2, expected.log_std, rtol=1e-3, atol=1e-4)
    assert not mean[..., outputs:].any() and not raw[..., outputs:].any()


def test_tiles_come_in_the_order_of_their_use():
    """Number n of a layer: half, sixteen inputs, eight outputs, eight inputs, output, input."""
    w = jnp.arange(48 * 32.0).reshape(1, 48, 32) % 251  # exact in bfloat16
    flat = np.asarray(drawn.tiles([w, w + 1])[0], np.float32)
    n = np.arange(48 * 32)
    side, k, block, pair, output, column = np.unravel_index(n, (2, 3, 2, 2, 8, 8))
    expected = np.asarray(w[0])[16 * k + 8 * pair + column, 16 * side + 8 * block + output]
    np.testing.assert_array_equal(flat, np.concatenate([expected, expected + 1]))


def test_every_vmap_makes_copies_and_groups():
    """A kernel of which each result tells which seed, network and inputs it was made of."""

    def run(seed, bounds, weights, x):
        copies = len(x) // len(weights)
        of = jnp.repeat(weights[..., 0] + bounds[..., 0, 0], copies, 0)  # [C, M]
        out = x + (of + seed[:, :1])[..., None, None]
        return out, out[..., 0]

    call = drawn.batched(run)
    key = jax.random.split(jax.random.key(0), 4)
    seed = jax.random.uniform(key[0], (2, 3, 4, 1, 2))
    bounds = jax.random.uniform(key[1], (2, 1, 5, 2, 6))
    weights = jax.random.uniform(key[2], (2, 1, 5, 7))
    x = jax.random.uniform(key[3], (2, 3, 4, 1, 5, 8, 6))
    inner = jax.vmap(call, (0, None, None, 0))  # environments share the networks
    middle = jax.vmap(inner, (0, None, None, 0))
    out, first = jax.vmap(middle)(seed, bounds, weights, x)  # seeds have their own
    mirrored = jax.vmap(
        jax.vmap(call, (0, 0, 0, 0)), (1, None, None, 1), 1
    )  # seeds within environments
    other = mirrored(seed[:, 0], bounds, weights, x[:, 0])[0]
    own = (weights[..., 0] + bounds[..., 0, 0])[:, None, None]  # [2, 1, 1, 1, 5]
    expected = x + (own + seed[..., :1])[..., None, None]
    np.testing.assert_allclose(out, expected, rtol=1e-6)
    np.testing.assert_allclose(first, expected[..., 0], rtol=1e-6)
    np.testing.assert_allclose(other, expected[:, 0], rtol=1e-6)


def test_the_kernel_compiles_for_hopper(tmp_path):
    """Without a GPU: for the sizes of PointGoal1's models."""
    wp = pytest.importorskip("warp")
    module = drawn.kernel_of(drawn.Sizes(inputs=4, width=13, outputs=8, inner=3)).module
    module.options["block_dim"] = drawn.THREADS
    with drawn.changed(wp.config, drawn.FOR_HOPPER):
        wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=False)
    assert wp.config.cuda_arch_suffix is None
    assert next(tmp_path.glob("*.cubin")).stat().st_size > 10_000


def test_other_machines_draw_by_xla():
    """Noise of N(0, 1), and the length of the deviations, in float32."""
    ensemble, scale = ensemble_of(4, (16,), 3), Scale(jnp.ones(4), jnp.full(4, 2.0))
    x = jnp.broadcast_to(jax.random.normal(jax.random.key(3), (3, 1, 4)), (3, 20_000, 4))
    out, spread = draw(ensemble, scale, x, jax.random.key(4))
    check(out, spread, outputs_of(ensemble, scale, x), 1e-5)


def check(out, spread, dist: Gaussian, rtol):
    noise = (out - dist.mean) * jnp.exp(-dist.log_std)
    assert abs(noise.mean()) < 0.02 and abs(noise.std() - 1) < 0.02
    assert abs((noise**4).mean() - 3) < 0.1
    columns = noise.shape[-1]
    for apart in (noise.reshape(-1, columns).T, noise.reshape(-1, noise.shape[-2] * columns)):
        found = np.corrcoef(apart)  # of columns; of models, in each copy
        assert np.abs(found - np.eye(len(found))).max() < 0.03
    for rows in (1, 8, 64, 192):  # what a thread, a group and a block have
        assert abs((noise[..., rows:, :] * noise[..., :-rows, :]).mean()) < 0.02
    expected = jnp.linalg.norm(jnp.exp(dist.log_std), axis=-1)
    np.testing.assert_allclose(spread, expected, rtol=rtol)


HOPPER = all(getattr(x, "compute_capability", "") == "9.0" for x in jax.local_devices())


@pytest.mark.skipif(not HOPPER, reason="for an H100 or H200")
@pytest.mark.parametrize("shape", [(62, (200,) * 4, 62), (7, (64, 32), 5)])
def test_the_kernel_draws_from_the_networks(shape):
    inputs = shape[0]
    ensemble, scale = ensemble_of(*shape), Scale(jnp.zeros(inputs), jnp.ones(inputs))
    assert drawn.serves(*shape)
    x = jax.random.normal(jax.random.key(3), (7, 3, 1999, inputs))
    keys = jax.random.split(jax.random.key(4), 7)
    out, spread = jax.jit(jax.vmap(lambda x, k: draw(ensemble, scale, x, k, "bfloat16")))(x, keys)
    dist = jax.vmap(lambda x: outputs_of(ensemble, scale, x))(x)
    check(out, spread, dist, 0.02)
    quiet = ensemble.replace(
        low=jnp.full_like(ensemble.low, -40.0), high=jnp.full_like(ensemble.high, -39.0)
    )
    mean = draw(quiet, scale, x[0], keys[0], "bfloat16")[0]
    plain = outputs_of(ensemble, scale, x[0], "bfloat16").mean
    exact = dist.mean[0]
    assert jnp.linalg.norm(mean - exact) < jnp.linalg.norm(plain - exact)

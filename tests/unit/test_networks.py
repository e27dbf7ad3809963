import re

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsafe.algos.ppo import PPOConfig
from jaxsafe.algos.sac import SACConfig
from jaxsafe.nn.cnn import patches
from jaxsafe.nn.critics import init_critics, largest, q_values, smallest
from jaxsafe.nn.gaussian import log_prob
from jaxsafe.nn.initializers import orthogonal
from jaxsafe.nn.networks import LOG_STD, action_dist, aligned_dot, init_params, value


def params(**settings):
    return init_params(jax.random.key(0), jnp.zeros(5), 3, PPOConfig(**settings))


def test_torch_weights_and_biases_fill_their_interval():
    layers = params(init="torch", hidden=(400, 100))["critic_r"]["params"]
    for layer, fan_in in (("Dense_0", 5), ("Dense_1", 400), ("Dense_2", 100)):
        for x in layers[layer].values():
            assert (jnp.abs(x) <= fan_in**-0.5).all()
        if layer != "Dense_2":
            np.testing.assert_allclose(jnp.abs(layers[layer]["bias"]).max(), fan_in**-0.5, rtol=0.05)


def test_orthogonal_layers_keep_angles_and_the_policy_starts_near_zero():
    tree = params(hidden=(64, 64))
    kernel = tree["actor"]["mean"]["params"]["Dense_1"]["kernel"]
    np.testing.assert_allclose(kernel.T @ kernel, 2 * np.eye(64), atol=1e-5)
    dist = action_dist(tree["actor"], jax.random.normal(jax.random.key(1), (9, 5)), PPOConfig())
    assert jnp.abs(dist.mean).max() < 0.1
    np.testing.assert_array_equal(dist.log_std, jnp.full((9, 3), -0.5))


def test_orthogonal_layers_of_several_members_are_flax_s_and_are_factorised_one_by_one():
    """Batches of them hang a CPU of few cores, see `orthogonal`."""
    keys, shape = jax.random.split(jax.random.key(0), 3), (8, 5)
    theirs = [nn.initializers.orthogonal(0.5)(key, shape) for key in keys]
    drawn = jax.jit(jax.vmap(lambda key: orthogonal(0.5)(key, shape)))
    np.testing.assert_array_equal(drawn(keys), theirs)
    batches = re.findall('num_batch_dims = "([0-9])"', drawn.lower(keys).as_text())
    assert batches and set(batches) == {"0"}


def test_the_critics_differ_and_give_one_value_a_state():
    tree, obs = params(), jnp.ones((4, 2, 5))
    a, b = (value(tree[k], obs, PPOConfig()) for k in ("critic_r", "critic_c"))
    assert a.shape == (4, 2) and (a != b).all()


def test_relu_networks_are_piecewise_linear_and_tanh_networks_are_bounded():
    far = 1e4 * jax.random.normal(jax.random.key(1), (20, 5))
    relu, tanh = (PPOConfig(activation=name, init="torch", hidden=(8,)) for name in ("relu", "tanh"))
    tree = params(init="torch", hidden=(8,))  # of either: the activation has no parameters
    twice, once = value(tree["critic_r"], 2 * far, relu), value(tree["critic_r"], far, relu)
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-2, atol=1)  # biases are lost in the distance
    assert jnp.abs(once).max() > 100
    bound = sum(jnp.abs(x).sum() for x in tree["critic_r"]["params"]["Dense_1"].values())
    assert (jnp.abs(value(tree["critic_r"], far, tanh)) <= bound).all()
    means = [action_dist(tree["actor"], far, cfg).mean for cfg in (relu, tanh)]
    assert jnp.abs(means[0]).max() > 100 and jnp.abs(means[1]).max() < 10


def test_a_std_of_the_state_starts_near_the_free_one_differs_by_state_and_is_clipped():
    cfg = PPOConfig(std="state")
    tree, obs = params(std="state"), jax.random.normal(jax.random.key(1), (4, 9, 5))
    dist = action_dist(tree["actor"], obs, cfg)
    assert dist.mean.shape == dist.log_std.shape == (4, 9, 3)
    np.testing.assert_allclose(dist.log_std, -0.5, atol=0.1)
    assert (dist.log_std[0, 0] != dist.log_std[0, 1]).all()
    for offset, bound in zip((-99.0, 99.0), LOG_STD, strict=True):
        moved = tree["actor"] | {"log_std": tree["actor"]["log_std"] + offset}
        np.testing.assert_array_equal(action_dist(moved, obs, cfg).log_std, jnp.full((4, 9, 3), bound))


@pytest.mark.parametrize("std", ["free", "state"])
def test_a_deviation_starts_where_it_would_without_a_floor_and_is_the_floor_and_what_is_learned(std):
    cfg, obs = PPOConfig(std=std, min_std=0.2), jax.random.normal(jax.random.key(1), (9, 5))
    actor = params(std=std, min_std=0.2)["actor"]
    np.testing.assert_allclose(action_dist(actor, obs, cfg).log_std, -0.5, atol=0.1 * (std == "state"))
    change = action_dist(actor, obs, PPOConfig(std=std)).log_std - actor["log_std"]
    for learned in (-12.0, -1.0, 1.0):
        dist = action_dist(actor | {"log_std": jnp.full(3, learned)}, obs, cfg)
        np.testing.assert_allclose(jnp.exp(dist.log_std), 0.2 + jnp.exp(learned + change), rtol=1e-5)


@pytest.mark.parametrize("floor", [0.0, 0.2])
def test_a_deviation_has_its_share_above_the_floor_of_the_gradient(floor):
    """All of it without a floor, to the last bit."""
    actor, cfg = params()["actor"], PPOConfig(min_std=floor)
    learned = jnp.array([-4.0, -1.0, 1.0])
    slope = jax.jacobian(lambda x: action_dist(actor | {"log_std": x}, jnp.zeros(5), cfg).log_std)
    if floor:
        share = np.exp(learned) / (floor + np.exp(learned))  # (std - floor) / std
        np.testing.assert_allclose(slope(learned), np.diag(share), rtol=1e-5)
    else:
        np.testing.assert_array_equal(slope(learned), np.eye(3))


@pytest.mark.parametrize("settings", [{"activation": "relu"}, {"std": "state"}, {"init": "torch"}])
def test_gradients_reach_every_parameter_and_are_finite(settings):
    cfg = PPOConfig(**settings)
    tree, obs = params(**settings), jax.random.normal(jax.random.key(1), (64, 5))

    def total(tree):
        dist = action_dist(tree["actor"], obs, cfg)
        likelihood = log_prob(dist, jnp.ones((64, 3))).sum()
        return likelihood + sum(value(tree[k], obs, cfg).sum() for k in ("critic_r", "critic_c"))

    for x in jax.tree.leaves(jax.grad(total)(tree)):
        assert jnp.isfinite(x).all() and (x != 0).any()


@pytest.mark.parametrize("layer_norm", [False, True])
def test_hidden_layers_in_bfloat16_round_to_8_bits_and_all_else_stays_float32(layer_norm):
    """Rounding errors of 2^-9 each, some ten of them, one upon the other."""
    coarse, fine = (
        SACConfig(hidden_dtype=dtype, layer_norm=layer_norm, hidden=(64, 64))
        for dtype in ("bfloat16", "float32")
    )
    obs, action = jax.random.normal(jax.random.key(1), (500, 7)), jnp.zeros((500, 2))
    critics = init_critics(jax.random.key(0), 7, 2, 2, coarse)

    def loss(critics, cfg):
        return (q_values(critics, obs, action, cfg) ** 2).mean()

    q = [q_values(critics, obs, action, cfg) for cfg in (coarse, fine)]
    grads = [jax.grad(loss)(critics, cfg) for cfg in (coarse, fine)]
    for rounded, exact in zip(*map(jax.tree.leaves, ([q[0], grads[0]], [q[1], grads[1]])), strict=True):
        assert rounded.dtype == jnp.float32
        error = jnp.linalg.norm(rounded - exact) / jnp.linalg.norm(exact)
        assert 1e-4 < error < 2e-2


def test_the_gradient_of_the_smallest_value_is_that_of_one():
    values = jnp.array([[1.0, 5.0, 2.0], [3.0, 4.0, 2.0]])
    np.testing.assert_array_equal(smallest(values), [1, 4, 2])
    np.testing.assert_array_equal(largest(values), [3, 5, 2])
    slope = jax.grad(lambda values: smallest(values).sum())(values)
    np.testing.assert_array_equal(slope, [[1, 0, 1], [0, 1, 0]])
    assert jnp.isnan(smallest(values.at[1, 0].set(jnp.nan))[0])


@pytest.mark.parametrize("side, stride", [(8, 4), (4, 2), (3, 1)])
def test_patches_times_a_matrix_are_a_convolution(side, stride):
    keys = jax.random.split(jax.random.key(0))
    x, kernel = (
        jax.random.normal(keys[0], (2, 10, 13, 3)),
        jax.random.normal(keys[1], (side, side, 3, 5)),
    )
    names = ("NHWC", "HWIO", "NHWC")
    exact = {"dimension_numbers": names, "precision": jax.lax.Precision.HIGHEST}
    expected = jax.lax.conv_general_dilated(x, kernel, (stride, stride), "SAME", **exact)
    found = jnp.matmul(patches(x, side, stride), kernel.reshape(-1, 5), precision="highest")
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_products_filled_up_with_zeros_are_the_same_products():
    x_key, w_key = jax.random.split(jax.random.key(0))
    dims = (((2,), (0,)), ((), ()))
    for inputs, outputs in ((750, 750), (750, 2), (68, 750), (256, 256)):
        x = jax.random.normal(x_key, (2, 3, inputs))
        weight = jax.random.normal(w_key, (inputs, outputs))
        filled = jax.value_and_grad(lambda x, w: (aligned_dot(x, w, dims) ** 2).sum(), (0, 1))
        plain = jax.value_and_grad(lambda x, w: ((x @ w) ** 2).sum(), (0, 1))
        for a, b in zip(*map(jax.tree.leaves, (filled(x, weight), plain(x, weight))), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-2)


def test_a_gpu_s_products_have_whole_rows_of_16_bytes():
    def shapes(inputs, outputs):
        args = jnp.zeros((4, inputs)), jnp.zeros((inputs, outputs)), (((1,), (0,)), ((), ()))
        jaxpr = jax.make_jaxpr(lambda x, w: aligned_dot(x, w, args[2]))(*args[:2])
        [dot] = [e for e in jaxpr.eqns if e.primitive.name == "dot_general"]
        return [x.aval.shape for x in dot.invars]

    assert shapes(750, 750) == [(4, 752), (752, 752)]
    assert shapes(750, 2) == [(4, 752), (752, 2)]
    assert shapes(68, 256) == [(4, 68), (68, 256)]

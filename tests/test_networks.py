import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.algos.ppo import PPOConfig
from jaxsafe.networks import init_params, policy, value


def params(**settings):
    return init_params(jax.random.key(0), 5, 3, PPOConfig(**settings))


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
    dist = policy(tree["actor"], jax.random.normal(jax.random.key(1), (9, 5)), PPOConfig())
    assert jnp.abs(dist.mean).max() < 0.1
    np.testing.assert_array_equal(dist.log_std, jnp.full((9, 3), -0.5))


def test_the_critics_differ_and_give_one_value_a_state():
    tree, obs = params(), jnp.ones((4, 2, 5))
    a, b = (value(tree[k], obs, PPOConfig()) for k in ("critic_r", "critic_c"))
    assert a.shape == (4, 2) and (a != b).all()

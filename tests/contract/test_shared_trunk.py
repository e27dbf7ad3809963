"""Policy and critics on one trunk: what its gradient is, who can train it, and that they learn."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from compiling import FAST
from toys import Lever, Ticker, training

from jaxsafe.algos import ALGOS
from jaxsafe.learn.estimates import Batch
from jaxsafe.learn.normalise import normalise
from jaxsafe.learn.steps import with_values
from jaxsafe.learn.surrogates import clipped
from jaxsafe.nn.gaussian import log_prob, sample
from jaxsafe.nn.networks import action_dist, init_params, share_trunk, value, values

CFG = ALGOS["ppo_lag"].config(hidden=(4,), trunk="shared", value_coef=0.3)


@functools.cache
def networks() -> Any:
    """A policy and critics of their own, of reward and two costs, whose hidden layers are alike; and
    the same as one network."""

    def build():
        params = init_params(jax.random.key(0), jnp.zeros(3), 2, CFG)
        hidden = params["actor"]["mean"]["params"]["Dense_0"]

        def critic(key):
            own = init_params(key, jnp.zeros(3), 2, CFG)["critic_r"]["params"]
            return {"params": own | {"Dense_0": hidden}}

        of_costs = jax.vmap(critic)(jax.random.split(jax.random.key(1)))
        params |= {"critic_r": critic(jax.random.key(2)), "critic_c": of_costs}
        return params, share_trunk(params, CFG)

    return jax.jit(build, compiler_options=FAST)()


def batch_of(actor, costs=2, size=6):
    obs = jax.random.normal(jax.random.key(3), (size, 3))
    old = action_dist(actor, obs, CFG)
    action = sample(old, jax.random.key(4))
    adv, ret_c = action.sum(-1), jnp.arange(size * costs, dtype=jnp.float32).reshape(size, costs)
    return Batch(obs, action, log_prob(old, action), old, adv, ret_c, 3 * adv, ret_c)


def earn(actor, batch):
    return clipped(action_dist(actor, batch.obs, CFG), batch, batch.adv_r, CFG)


def test_one_trunk_gives_what_networks_with_the_same_hidden_layers_give():
    apart, shared = networks()
    obs = jax.random.normal(jax.random.key(5), (7, 5, 3))
    np.testing.assert_allclose(
        action_dist(shared["actor"], obs, CFG).mean,
        action_dist(apart["actor"], obs, CFG).mean,
        atol=1e-6,
    )
    together = values(shared, obs, CFG)
    assert together.shape == (7, 5, 3)
    separate = values(apart, obs, dataclasses.replace(CFG, trunk="separate"))
    np.testing.assert_allclose(together, separate, atol=1e-5)
    np.testing.assert_allclose(together[..., 0], value(apart["critic_r"], obs, CFG), atol=1e-5)


def test_the_gradient_of_the_trunk_is_the_sum_of_the_policys_and_the_critics():
    apart, shared = networks()
    batch = batch_of(apart["actor"])
    joint = jax.grad(lambda actor: with_values(earn, CFG)(actor, batch)[0])(shared["actor"])
    of_policy = jax.grad(lambda actor: earn(actor, batch)[0])(apart["actor"])

    def error(critic, target):
        return jnp.mean((value(critic, batch.obs, CFG) - target) ** 2)

    of_reward = jax.grad(error)(apart["critic_r"], batch.ret_r)
    of_costs = jax.vmap(jax.grad(error), (0, 1))(apart["critic_c"], batch.ret_c)
    trunk, last = (joint["mean"]["params"][f"Dense_{i}"] for i in (0, 1))
    for name in ("kernel", "bias"):
        own, r, c = (tree["params"] for tree in (of_policy["mean"], of_reward, of_costs))
        total = own["Dense_0"][name] - 0.3 * (r["Dense_0"][name] + c["Dense_0"][name].sum(0))
        np.testing.assert_allclose(trunk[name], total, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(last[name][..., :2], own["Dense_1"][name], rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(
            last[name][..., 2], -0.3 * r["Dense_1"][name][..., 0], rtol=1e-4, atol=1e-5
        )
    np.testing.assert_allclose(joint["log_std"], of_policy["log_std"], rtol=1e-4, atol=1e-6)


def test_the_joint_objective_by_hand():
    actor = networks()[1]["actor"]
    last = {"kernel": jnp.zeros((4, 4)), "bias": jnp.array([0.0, 0.0, 1.0, 5.0])}  # V_r = 1, V_c = 5
    actor |= {"mean": {"params": actor["mean"]["params"] | {"Dense_1": last}}}
    batch = batch_of(actor, costs=1, size=2)
    batch = dataclasses.replace(batch, ret_r=jnp.array([1.0, 3.0]), ret_c=jnp.array([5.0, 2.0]))
    gain, metrics = with_values(lambda actor, batch: (jnp.float32(7.0), {"a": jnp.float32(1)}), CFG)(
        actor, batch
    )
    losses = {"train/value_loss_r": 2.0, "train/value_loss_c": 4.5}
    assert metrics == {"a": 1.0, "train/objective": 7.0, **losses}
    np.testing.assert_allclose(gain, 7 - 0.3 * (2 + 4.5), rtol=1e-6)


def test_each_value_on_a_shared_trunk_learns_its_own_cost():
    algo = ALGOS["ppo_lag"].make(Ticker())
    cfg = ALGOS["ppo_lag"].config(
        num_envs=8, horizon=25, minibatches=2, hidden=(8,), trunk="shared", lr=1e-2, target_kl=1.0,
        cost_limits={"b": 1.0, "a": 20.0}, discount=0.0, cost_discount=0.0,
    )  # fmt: skip
    train = jax.jit(jax.vmap(training(algo, cfg, 20)), compiler_options=FAST)
    ts, metrics = train(jax.random.split(jax.random.key(0), 2))

    def learned(ts):
        return values(ts.params, normalise(ts.normaliser, ts.rollout.state.obs), cfg).mean(0)

    np.testing.assert_allclose(jax.vmap(learned)(ts), [[1.0, 0.5, 1.5]] * 2, atol=0.1)
    assert metrics["train/value_loss_c_b"][:, -1].max() < metrics["train/value_loss_c_b"][:, 0].min()
    assert (metrics["train/nonfinite"] == 0).all()


def test_a_policy_on_a_shared_trunk_learns_what_the_limit_allows():
    algo = ALGOS["ipo"].make(Lever())
    cfg = ALGOS["ipo"].config(
        num_envs=32, horizon=20, minibatches=2, hidden=(16,), trunk="shared", cost_limit=2.5,
        lr=3e-3, target_kl=0.1, epochs=8, barrier=0.1, price_max=4.0,
        reward_normalize=True, cost_normalize=True, reward_centre=True, cost_centre=True,
    )  # fmt: skip
    train = jax.jit(jax.vmap(training(algo, cfg, 100)), compiler_options=FAST)
    _, metrics = train(jax.random.split(jax.random.key(0), 2))
    ret, cost = (np.asarray(metrics[f"train/{k}"])[:, -30:].mean(1) for k in ("return", "cost"))
    assert (cost < 2.5).all()
    assert (ret > 0.9 * 14.375).all()  # the best within the limit

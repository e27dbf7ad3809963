import dataclasses
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import FAST
from toys import context, momentum

from jaxsafe.algos.cpo import CPOConfig
from jaxsafe.algos.ppo import PPOConfig
from jaxsafe.learn.estimates import Batch
from jaxsafe.learn.steps import Trainable, adam, adam_epochs, critic_passes, fit_critic, one_pass
from jaxsafe.learn.surrogates import clipped, plain, with_entropy
from jaxsafe.nn.gaussian import kl, log_prob, sample
from jaxsafe.nn.networks import action_dist, init_params, value

SMALL: dict[str, Any] = {"hidden": (8,), "num_envs": 8, "horizon": 8, "minibatches": 4}


@cache
def problem(size=64):
    """A policy, and a batch of its actions."""
    cfg = PPOConfig(**SMALL)
    keys = jax.random.split(jax.random.key(0), 3)
    params = init_params(keys[0], jnp.zeros(3), 2, cfg)
    obs = jax.random.normal(keys[1], (size, 3))
    old = action_dist(params["actor"], obs, cfg)
    action = sample(old, keys[2])
    adv = action.sum(-1)
    return params, Batch(obs, action, log_prob(old, action), old, adv, -adv, adv, obs[:, 0])


def earn(actor, batch, cfg):
    """The objective of earning more for large actions."""
    return clipped(action_dist(actor, batch.obs, cfg), batch, batch.adv_r, cfg)


def moved(actor, state, batch, cfg, objective=earn, iteration=0, axis_name=None):
    told = context(cfg, iteration=iteration, axis_name=axis_name)
    return adam_epochs.update(actor, state, partial(objective, cfg=cfg), batch, told)


step = jax.jit(moved, static_argnames=("objective", "axis_name"), compiler_options=FAST)


def improve(cfg, objective=earn, iteration=0):
    params, batch = problem()
    state = adam_epochs.init(params["actor"], cfg)
    actor, _, metrics = step(params["actor"], state, batch, cfg, objective, iteration)
    return params["actor"], actor, metrics


def test_a_pass_sees_every_sample_once():
    data = jnp.arange(12)
    _, seen = one_pass(lambda carry, x: (carry, x), (), data, jax.random.key(0), 3)
    assert seen.shape == (3, 4) and sorted(seen.ravel().tolist()) == data.tolist()
    assert (seen.ravel() != data).any()


def test_epochs_of_adam_raise_the_objective():
    _, _, metrics = improve(PPOConfig(**SMALL, lr=1e-2, target_kl=1e9))
    assert metrics["train/objective"] > 0.01 and metrics["train/passes"] == 10


def test_the_first_pass_beyond_the_kl_limit_is_the_last():
    free = [
        improve(PPOConfig(**SMALL, lr=1e-2, target_kl=1e9, epochs=n))[2]["train/kl"] for n in (1, 2, 3)
    ]
    assert free[0] < free[1] < free[2]
    limit = float(free[0] + free[1]) / 2
    cfg = PPOConfig(**SMALL, lr=1e-2, target_kl=limit)
    _, after, metrics = improve(cfg)
    assert metrics["train/passes"] == 2 and metrics["train/kl"] == free[1]
    batch = problem()[1]
    divergence = kl(batch.old, action_dist(after, batch.obs, cfg)).mean()  # from the old one to the new
    np.testing.assert_allclose(metrics["train/kl"], divergence, rtol=1e-4)


def test_the_learning_rate_falls_to_zero_at_the_last_iteration():
    def move(iteration, total):
        cfg = PPOConfig(**SMALL, total_iterations=total, lr_decay=True, epochs=1, max_grad_norm=1e9)
        before, after, _ = improve(cfg, iteration=iteration)
        return float(jnp.abs(after["log_std"] - before["log_std"]).max())

    whole = move(0, 10.0)
    np.testing.assert_allclose(move(5, 10.0), whole / 2, rtol=0.05)
    assert move(10, 10.0) == 0 and move(11, 10.0) == 0
    assert move(10**6, float("inf")) == move(10**6, 0.0) == whole


def test_steps_with_gradients_that_are_not_finite_are_skipped_and_counted():
    cfg = PPOConfig(**SMALL)

    first = problem()[1].obs[0, 0].item()

    def broken(actor, batch, cfg):
        bad = (batch.obs[:, 0] == first).any()  # one minibatch of a pass
        return jnp.where(bad, jnp.nan, 1.0) * earn(actor, batch, cfg)[0], {}

    before, after, metrics = improve(cfg, broken)
    assert metrics["train/nonfinite"] == cfg.epochs
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(after))
    assert any((a != b).any() for a, b in zip(*map(jax.tree.leaves, (before, after)), strict=True))


def test_each_pass_has_minibatches_of_its_own():
    """Two of 64 samples are in the same one of 4 in a quarter of the passes."""
    one, other = problem()[1].obs[:2, 0].tolist()

    def apart(actor, batch, cfg):
        together = (batch.obs[:, 0] == one).any() & (batch.obs[:, 0] == other).any()
        return jnp.where(together, jnp.nan, 1.0) * earn(actor, batch, cfg)[0], {}

    _, _, metrics = improve(PPOConfig(**SMALL, epochs=20, target_kl=1e9), apart)
    assert 0 < metrics["train/nonfinite"] < 20


def test_two_devices_take_the_step_of_one():
    cfg = dataclasses.replace(PPOConfig(**SMALL, lr=1e-2), minibatches=1)
    params, batch = problem()
    args = (params["actor"], adam_epochs.init(params["actor"], cfg))
    whole = step(*args, batch, cfg)
    halves = jax.tree.map(lambda x: x.reshape(2, -1, *x.shape[1:]), batch)
    on_two = jax.vmap(lambda half: moved(*args, half, cfg, axis_name="devices"), axis_name="devices")
    parts = jax.jit(on_two, compiler_options=FAST)(halves)
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
        np.testing.assert_allclose(b[0], b[1], rtol=1e-6)
        np.testing.assert_allclose(a, b[0], rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("joined", [True, False])
def test_on_a_gpu_small_networks_are_one_array_to_adam_and_take_the_same_step(joined, monkeypatch):
    if not joined:
        monkeypatch.setattr("jaxsafe.learn.steps.MOST_JOINED", 10)
    params, cfg = {"a": jnp.ones((3, 4)), "b": jnp.arange(5.0)}, PPOConfig(max_grad_norm=0.5)
    grads = {"a": jnp.full((3, 4), 0.3), "b": -jnp.arange(5.0)}

    def moved(optimiser):
        state = optimiser.init(params)
        for _ in range(3):
            change, state = optimiser.update(grads, state)
        return change, state

    here = moved(adam(1e-2, cfg))[0]
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    there, state = moved(adam(1e-2, cfg))
    jax.tree.map(np.testing.assert_allclose, here, there)
    [mu] = [
        x.mu for x in jax.tree.leaves(state, is_leaf=lambda x: hasattr(x, "mu")) if hasattr(x, "mu")
    ]
    assert (isinstance(mu, jax.Array) and mu.shape == (17,)) == joined


@pytest.mark.parametrize(("length", "kept"), [(5.0, 0.5), (0.3, 0.3)])
def test_a_gradient_of_all_parameters_is_cut_to_its_longest_norm(length, kept):
    grads = {"a": jnp.array([0.6]), "b": jnp.array([0.0, -0.8])}  # of norm 1
    optimiser = adam(1e-2, PPOConfig(max_grad_norm=0.5))
    long = jax.tree.map(lambda x: length * x, grads)
    _, state = optimiser.update(long, optimiser.init(grads))
    found = momentum(Trainable({"net": grads}, {"net": state}), "net")
    for mu, x in zip(*map(jax.tree.leaves, (found, grads)), strict=True):
        np.testing.assert_allclose(mu, 0.1 * kept * x, rtol=1e-5)


fit_jitted = jax.jit(fit_critic, static_argnums=5, compiler_options=FAST)


def test_each_pass_of_a_critic_has_minibatches_of_its_own_and_the_last_that_counts_is_told(monkeypatch):
    """In place of each pass its errors are drawn by its key, and both its steps are skipped."""

    def one_draw(step, critic, data, key, minibatches):
        return critic, (jax.random.uniform(key, (2,)), jnp.ones(2, int))

    monkeypatch.setattr("jaxsafe.learn.steps.one_pass", one_draw)
    cfg, critic = PPOConfig(**SMALL, critic_epochs=3), Trainable(jnp.zeros(1), ())
    data, key = (jnp.zeros((8, 3)), jnp.zeros(8)), jax.random.key(0)
    draws = [jax.random.uniform(key, (2,)).mean() for key in jax.random.split(key, 3)]
    assert len({*map(float, draws)}) == 3
    for passes in (1, 2, 3):
        _, error, skipped = fit_critic(critic, data, passes, key, cfg, None)
        assert error == draws[passes - 1] and skipped == 2 * passes


def test_a_critic_learns_its_targets():
    cfg = PPOConfig(**SMALL, critic_epochs=200, critic_lr=1e-2, critic_norm_coef=0.0)
    params, batch = problem()
    state = adam(cfg.critic_lr, cfg).init(params["critic_c"])
    critic, error, skipped = fit_jitted(
        Trainable(params["critic_c"], state),
        (batch.obs, batch.ret_c),
        200,
        jax.random.key(0),
        cfg,
        None,
    )
    assert error < 0.01 and skipped == 0
    np.testing.assert_allclose(value(critic.params, batch.obs, cfg), batch.ret_c, atol=0.4)


def test_a_critic_without_an_error_only_shrinks():
    """Down the gradient of critic_norm_coef |theta|^2."""
    cfg = dataclasses.replace(PPOConfig(**SMALL), minibatches=1, critic_epochs=1, critic_norm_coef=0.5)
    params, batch = problem()
    theta = params["critic_c"]
    start = Trainable(theta, adam(cfg.critic_lr, cfg).init(theta))
    known = batch.obs, value(theta, batch.obs, cfg)
    after, error, _ = fit_jitted(start, known, 1, jax.random.key(0), cfg, None)
    named = Trainable({"critic": after.params}, {"critic": after.opt_state})
    for mu, x in zip(*map(jax.tree.leaves, (momentum(named, "critic"), theta)), strict=True):
        np.testing.assert_allclose(mu, 0.1 * 2 * 0.5 * x, rtol=1e-4, atol=1e-6)
    assert error < 1e-10


def test_passes_of_a_critic_beyond_those_that_count_change_nothing():
    cfg = PPOConfig(**SMALL, critic_epochs=5)
    params, batch = problem()
    start = Trainable(params["critic_c"], adam(cfg.critic_lr, cfg).init(params["critic_c"]))

    def fit(passes, cfg):
        return fit_jitted(start, (batch.obs, batch.ret_c), passes, jax.random.key(0), cfg, None)[0]

    for passes in (0, 2, 5):
        few = (
            fit(jnp.int32(passes), dataclasses.replace(cfg, critic_epochs=passes)) if passes else start
        )
        for a, b in zip(*map(jax.tree.leaves, (fit(jnp.int32(passes), cfg), few)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-6)


def test_critics_stop_with_the_policy_only_where_the_kl_stopped_it():
    cfg = PPOConfig(**SMALL, epochs=10, critic_epochs=20, critics_stop=True)
    assert [int(critic_passes({"train/passes": jnp.int32(n)}, cfg)) for n in (1, 9, 10)] == [1, 9, 20]
    alone = dataclasses.replace(cfg, critics_stop=False)
    assert critic_passes({"train/passes": jnp.int32(1)}, alone) == 20
    assert critic_passes({}, CPOConfig(critic_epochs=20)) == 20  # its steps have no passes


@pytest.mark.parametrize(
    "w, advantage, expected", [(1.5, 1, 1.2), (1.5, -1, -1.5), (0.5, 1, 0.5), (0.5, -1, -0.8)]
)
def test_the_clipped_surrogate_by_hand(w, advantage, expected):
    cfg = PPOConfig(**SMALL, clip=0.2)
    params, batch = problem(size=1)
    batch = dataclasses.replace(batch, log_prob=batch.log_prob - jnp.log(w))
    adv = jnp.array([advantage], jnp.float32)
    objective, metrics = clipped(action_dist(params["actor"], batch.obs, cfg), batch, adv, cfg)
    np.testing.assert_allclose(objective, expected, rtol=1e-4)
    assert metrics["train/clip_fraction"] == 1
    np.testing.assert_allclose(plain(batch.old, batch, adv, cfg)[0], w * advantage, rtol=1e-4)


@pytest.mark.parametrize(
    ("iteration", "decay", "share"), [(0, True, 1.0), (3, True, 0.7), (12, True, 0.0), (3, False, 1.0)]
)
def test_the_entropy_bonus_by_hand(iteration, decay, share):
    cfg = PPOConfig(**SMALL, entropy_coef=0.2, entropy_decay=decay, total_iterations=10.0)
    params, batch = problem()

    def bonus(log_std):
        dist = action_dist(params["actor"] | {"log_std": log_std}, batch.obs, cfg)
        surrogate = with_entropy(plain, jnp.int32(iteration))
        return surrogate(dist, batch, batch.adv_r, cfg)[0] - plain(dist, batch, batch.adv_r, cfg)[0]

    gain, slope = jax.value_and_grad(bonus)(jnp.array([0.0, -1.0]))
    # entropies log std + log(2 pi e) / 2, of two dimensions: 1.41894 each at a std of 1
    np.testing.assert_allclose(gain, 0.2 * share * (2 * 1.4189385 - 1), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(slope, 0.2 * share * np.ones(2), rtol=1e-3, atol=1e-6)


def test_entropy_and_its_bonus_are_of_the_deviation_with_its_floor():
    cfg = PPOConfig(**SMALL, entropy_coef=0.2, min_std=0.5)
    params, batch = problem()

    def bonus(log_std):
        dist = action_dist(params["actor"] | {"log_std": log_std}, batch.obs, cfg)
        surrogate = with_entropy(plain, jnp.int32(0))
        return surrogate(dist, batch, batch.adv_r, cfg)[0] - plain(dist, batch, batch.adv_r, cfg)[0]

    # deviations of 0.5 + 0.5 and 0.5 + 0.125, of which 1/2 and 1/5 are learned
    gain, slope = jax.value_and_grad(bonus)(jnp.log(jnp.array([0.5, 0.125])))
    np.testing.assert_allclose(gain, 0.2 * (2 * 1.4189385 + np.log(0.625)), rtol=1e-4)
    np.testing.assert_allclose(slope, 0.2 * np.array([1 / 2, 1 / 5]), rtol=1e-3)

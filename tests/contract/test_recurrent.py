"""A policy with a memory: trained, evaluated, and begun anew with each episode."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import FAST
from learners import telling
from toys import START, Recall, Ticker, run_episodes, training, updated

from jaxsafe.algos import ALGOS
from jaxsafe.config import ConfigError
from jaxsafe.learn.acting import Player, reset_carry
from jaxsafe.nn.gaussian import log_prob
from jaxsafe.nn.networks import apply_to_rollout, net_of, recurrent_step
from jaxsafe.nn.recurrent import Sequences, unroll

SIZES: dict[str, Any] = {"num_envs": 64, "horizon": 12, "minibatches": 2, "hidden": (8, 16)}
FIRST_ORDER: dict[str, Any] = {"lr": 3e-3, "target_kl": 0.1, "epochs": 5, "discount": 0.9}


def learner(name="ppo", env: Any = Recall(), **settings):  # noqa: B008
    algo = ALGOS[name].make(env)
    return algo, ALGOS[name].config(**SIZES | {"trunk": "gru"} | settings)


@pytest.fixture(scope="module")
def trained():
    """PPO and its train states of 2 seeds on Recall, after 60 updates."""
    algo, cfg = learner(**FIRST_ORDER)
    train = jax.jit(jax.vmap(training(algo, cfg, 60)), compiler_options=FAST)
    return algo, train(jax.random.split(jax.random.key(0), 2))[0]


def test_what_was_shown_at_the_first_step_is_remembered_to_the_last(trained):
    algo, ts = trained
    whole = run_episodes(algo, jax.vmap(algo.learned)(ts), 50, seed=0)
    assert (whole.ret.mean(1) > 4).all()  # 6 at best, and 1 without memory


def test_a_player_forgets_at_the_start_of_an_episode(trained):
    algo, ts = trained
    learned = algo.learned(jax.tree.map(lambda x: x[0], ts))
    player = Player(algo.policy, learned, Recall())
    shown = [player.task.reset(jax.random.key(i)) for i in range(8)]
    left, right = (next(s for s in shown if s.physics == sign) for sign in (-1, 1))
    blank = player.task.step(left, jnp.zeros(1))  # the same observation whatever was shown
    answers = [player.act(player.act(player.begin(), first)[1], blank)[0] for first in (left, right)]
    assert answers[0] < 0 < answers[1]
    carry = jnp.stack([player.act(player.begin(), left)[1]] * 2)
    anew = reset_carry(algo.policy, learned, carry, jnp.array([True, False]))
    assert not anew[0].any() and (anew[1] == carry[1]).all()


def test_an_unrolled_network_is_one_step_after_another_with_forgetting():
    algo, cfg = learner()
    actor = algo.init(jax.random.key(0), cfg, START).params["actor"]
    obs = jax.random.normal(jax.random.key(1), (3, 5, 2))  # [B, T, O]
    first = jnp.array([[1, 0, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 1, 1]], bool)
    start = jax.random.normal(jax.random.key(2), (3, 16))
    h, out = unroll(net_of(actor, cfg), actor["mean"], Sequences(obs, first, start))
    for b in range(3):
        carry = start[b]
        for t in range(5):
            carry = jnp.where(first[b, t], 0.0, carry)
            carry, dist, value = recurrent_step(actor, carry, obs[b, t], cfg)
            np.testing.assert_allclose(h[b, t], carry, rtol=1e-5, atol=1e-6)
            here = jnp.concatenate([dist.mean, value])
            np.testing.assert_allclose(out[b, t], here, rtol=1e-5, atol=1e-6)


def test_the_value_after_a_step_is_that_of_the_next_unless_the_episode_ended():
    algo, cfg = learner()
    params = algo.init(jax.random.key(0), cfg, START).params
    obs = jax.random.normal(jax.random.key(1), (4, 2, 2))  # [T, N, O]
    last = jax.random.normal(jax.random.key(2), (4, 2, 2))
    first = jnp.zeros((4, 2), bool).at[2, 1].set(True)  # environment 1 ends with its step 1
    next_obs = last.at[:3, 0].set(obs[1:, 0]).at[0, 1].set(obs[1, 1]).at[2, 1].set(obs[3, 1])
    found = apply_to_rollout(params, obs, next_obs, first, jnp.zeros((2, 16)), cfg)
    np.testing.assert_allclose(found.next_value[:3, 0], found.value[1:, 0], rtol=1e-5, atol=1e-6)
    for t in (0, 2):
        pair = found.next_value[t, 1], found.value[t + 1, 1]
        np.testing.assert_allclose(*pair, rtol=1e-5, atol=1e-6)
    assert not np.allclose(found.next_value[1, 1], found.value[2, 1], atol=1e-4)  # of the old episode


def test_it_learns_from_the_distributions_that_acted_in_the_middle_of_an_episode_too():
    def tell(batch, context):
        off = log_prob(batch.old, batch.action) - batch.log_prob
        return {"train/off": jnp.abs(off).max()}

    algo, (_, cfg) = telling(Recall(), tell), learner(horizon=4)  # of 6 steps
    ts, metrics = jax.jit(training(algo, cfg, 2), compiler_options=FAST)(jax.random.key(0))
    assert (metrics["train/off"] < 1e-5).all() and jnp.abs(ts.rollout.carry).max() > 0.1


def test_costs_of_several_names_and_a_price_work_with_a_memory():
    algo, cfg = learner("ppo_lag", Ticker(), cost_limits={"a": 1.0, "b": 2.0}, hidden=(8,))
    ts = algo.init(jax.random.key(0), cfg, START)
    after, metrics = jax.jit(updated(algo), compiler_options=FAST)(ts)
    assert after.dual.lam.shape == (2,) and metrics["train/nonfinite"] == 0
    assert after.rollout.carry.shape == (64, 8) and "train/value_loss_c_a" in metrics


def test_what_has_no_recurrent_step_refuses_one_and_minibatches_are_of_environments():
    with pytest.raises(ConfigError, match="trunk=gru: expected separate"):
        algo, cfg = learner("trpo")
        algo.init(jax.random.key(0), cfg, START)
    with pytest.raises(ConfigError, match="expected a divisor of num_envs = 64; the nearest is 4"):
        algo, cfg = learner(minibatches=6)
        algo.init(jax.random.key(0), cfg, START)

"""What the constraint, the metrics and the learner see of rewards and costs, by hand."""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import FAST
from learners import TINY, at, begin, compiled, telling
from toys import START, Sometimes, Ticker

from jaxsafe.algos.ppo import PPOConfig
from jaxsafe.learn.acting import learned_of
from jaxsafe.learn.estimates import Experience, Signals, estimate_batch, scaled
from jaxsafe.learn.metrics import episode_metrics, world_metrics
from jaxsafe.learn.normalise import normalise
from jaxsafe.learn.on_policy import on_policy, on_policy_pair
from jaxsafe.learn.returns import ValuedSteps, Window, advantages
from jaxsafe.learn.rollout import Bad, Episode, collect, memoryless
from jaxsafe.learn.steps import PolicyStep
from jaxsafe.learn.treatments import no_treatment
from jaxsafe.nn.gaussian import kl
from jaxsafe.nn.networks import action_dist, value


class Ended(NamedTuple):
    """Where episodes ended, with their sums and lengths."""

    ended: jax.Array
    episode: Episode
    length: jax.Array


FIVE_STEPS = {"stagger": False, "horizon": 5}


def test_what_the_learner_sees_is_normalised_by_all_batches_up_to_this_one():
    reward = jnp.array([[[1.0, 3.0]], [[5.0, 11.0]]])  # two batches of [T, N] = [1, 2]
    cost = jnp.array([[[0.0, 1.0]], [[1.0, 0.0]]])
    ts = begin("pdo", reward_normalize=True, cost_normalize=True)
    start = ts.signal_normaliser
    cfg = dataclasses.replace(ts.config, reward_centre=True, cost_centre=True)
    a, _, normaliser = scaled(Signals(reward[0], cost[0], start), cfg, None)
    np.testing.assert_allclose(a, [[-1, 1]], rtol=1e-6)  # mean 2, standard deviation 1
    a, b, normaliser = scaled(Signals(reward[1], cost[1], normaliser), cfg, None)
    # 1, 3, 5, 11: mean 5, variance (16 + 4 + 0 + 36) / 4 = 14; 0, 1, 1, 0: mean and deviation 1/2
    np.testing.assert_allclose(a, [[0, 6 / 14**0.5]], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(b, [[1, -1]], rtol=1e-6)
    np.testing.assert_allclose(normaliser.mean, [5, 0.5])
    np.testing.assert_allclose(normaliser.var, [14, 0.25], rtol=1e-6)
    # (1 + 9 + 25 + 121) / 4 = 39 is the mean square of rewards, which keep their signs
    cfg = dataclasses.replace(cfg, reward_centre=False)
    _, _, normaliser = scaled(Signals(reward[0], cost[0], start), cfg, None)
    a, b, _ = scaled(Signals(reward[1], cost[1], normaliser), cfg, None)
    np.testing.assert_allclose(a, [[5 / 39**0.5, 11 / 39**0.5]], rtol=1e-6)
    np.testing.assert_allclose(b, [[1, -1]], rtol=1e-6)
    for reward_too, cost_too in ((True, False), (False, True)):
        cfg = dataclasses.replace(ts.config, reward_normalize=reward_too, cost_normalize=cost_too)
        a, b, _ = scaled(Signals(reward[0], cost[0], start), cfg, None)
        assert (a == reward[0]).all() == (not reward_too) and (b == cost[0]).all() == (not cost_too)


@pytest.mark.parametrize("estimator", ["gae", "plain"])
def test_a_batch_has_the_advantages_of_its_good_steps_each_by_its_own_discount_and_decay(estimator):
    discounts: Any = {"discount": 0.9, "gae_lambda": 0.8, "cost_discount": 0.7, "cost_gae_lambda": 0.6}
    env = Sometimes(episode_length=5, lives=(2, 9))
    ts = begin("ppo_lag", env, stagger=False, estimator=estimator, **discounts)
    # so that the cleared observation of a bad step has a value
    ts = dataclasses.replace(ts, normaliser=dataclasses.replace(ts.normaliser, mean=jnp.ones(3)))
    still = memoryless(lambda obs, key: (jnp.zeros((len(obs), 1)), jnp.zeros(len(obs))))

    def made():
        _, traj = collect(env, still, ts.rollout, jax.random.key(0), 12)
        reward, cost = jnp.where(traj.bad.any, 0.0, jax.random.normal(jax.random.key(1), (2, 12, 8)))
        seen = Experience(traj, Signals(reward, cost, ()), ())
        return traj, reward, cost, *estimate_batch(learned_of(ts), seen, (), None)

    traj, reward, cost, batch, metrics = jax.jit(made, compiler_options=FAST)()
    bad, good, cfg, params = traj.bad.any, ~traj.bad.any, ts.config, ts.params
    assert all(0 < x.sum() < x.size / 2 for x in (bad, traj.terminated, traj.truncated & good))
    obs, after = (normalise(ts.normaliser, x) for x in (traj.obs, traj.next_obs))

    def expected(critic, paid, discount, decay):
        v, later = (value(params[critic], x, cfg) for x in (obs, after))
        paid, later = jnp.where(bad, v, paid), jnp.where(bad, 0.0, later)  # an error of 0
        steps = ValuedSteps(paid, v, later, traj.terminated, traj.done)
        found, error = advantages(estimator, steps, jnp.ones_like(v), discount, decay)
        scale = found.std(where=good) if critic == "critic_r" else 1.0
        advantage = good * (found - found.mean(where=good)) / scale * good.size / good.sum()
        return advantage.ravel(), error, v, 1 - error.var() / (error + v).var()

    (r, error, v, explained), (c, error_c, v_c, explained_c) = (
        expected("critic_r", reward, cfg.discount, cfg.gae_lambda),
        expected("critic_c", cost, cfg.cost_discount, cfg.cost_gae_lambda),
    )
    close = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5)
    close(batch.adv_r, r)
    close(batch.adv_c, c)
    close(metrics["train/explained_variance_r"], explained)
    close(metrics["train/explained_variance_c"], explained_c)
    close(batch.ret_r, (error + v).ravel())
    close(batch.ret_c, (error_c + v_c).ravel())
    close(batch.ret_c.reshape(bad.shape)[bad], v_c[bad])


def test_the_constraint_and_the_metrics_see_rewards_and_costs_as_they_are():
    env = Ticker(episode_length=5)
    runs = [
        compiled("pdo", env).update(begin("pdo", env, **FIVE_STEPS | normalised, cost_limit=9.0))
        for normalised in ({}, {"reward_normalize": True, "cost_normalize": True})
    ]
    for ts, m in runs:
        assert (m["train/return"], m["train/cost"], m["train/cost_estimate"]) == (5, 10, 10)
        assert m["train/cost_rate"] == 2 and m["train/return_estimate"] == 5
        np.testing.assert_allclose(ts.dual.lam, 0.001 + 0.1, rtol=1e-4)  # a violation of 1, Adam's step
        assert ts.normaliser.mean[1] == 2  # of steps 0 to 4, at which the policy acted
    plain, scaled = (m["train/value_loss_c"] for _, m in runs)
    assert scaled < plain / 2  # the critic's targets are near 1 / (1 - discount), not twice that


def test_cups_divergence_is_that_of_both_its_steps():
    env, options = Ticker(episode_length=5), {"lam_init": 2.0, "lr": 1e-2, "epochs": 2}
    before = begin("cup", env, **FIVE_STEPS | options)
    after, m = compiled("cup", env).update(before)
    first = before.rollout.state.obs
    obs = normalise(before.normaliser, jnp.stack([first.at[:, 1].set(t) for t in range(5)]))
    old, new = (action_dist(ts.params["actor"], obs, before.config) for ts in (before, after))
    np.testing.assert_allclose(m["train/kl"], kl(old, new).mean(), rtol=1e-4)
    for part in ("reward", "projection"):  # to the policy of step 1, and from it
        assert abs(m[f"train/kl_{part}"] - m["train/kl"]) > 0.01 * m["train/kl"]


def test_the_constraint_sees_the_mean_cost_of_the_window():
    env = Ticker(episode_length=5)
    ts, update = begin("crpo", env, cost_window=3, cost_limit=6.0), compiled("crpo", env).update
    seen = []
    for _ in range(4):  # an episode costs 10: above the limit of 6, and its tolerance of 2
        ts, metrics = update(ts)
        assert metrics["train/cost_estimate"] == 10
        seen.append(ts.past_costs.values.tolist())
        assert metrics["train/over_limit"] == 1
    assert seen == [[0, 0, 10], [0, 10, 10], [10, 10, 10], [10, 10, 10]]
    # the next J_c is 10 again: with 1 and 4 before it the mean is 5, with 7 and 10 it is 9
    for past, over in (((9.0, 1.0, 4.0), 0), ((0.0, 7.0, 10.0), 1)):
        before = dataclasses.replace(ts, past_costs=Window(jnp.array(past), jnp.int32(3)))
        _, metrics = update(before)
        assert metrics["train/over_limit"] == over
    # of three with but one before it the mean is (4 + 10) / 2
    before = dataclasses.replace(ts, past_costs=Window(jnp.array([0.0, 0.0, 4.0]), jnp.int32(1)))
    after, metrics = update(before)
    assert metrics["train/over_limit"] == 0 and after.past_costs.count == 2


def test_a_violation_is_of_the_window_and_costs_are_those_of_good_steps():
    algo = telling(Sometimes(), lambda batch, context: {"train/violation": context.violation})
    ts = algo.init(jax.random.key(0), PPOConfig(**TINY, cost_window=3, cost_limit=6.0), START)
    past = Window(jnp.array([0.0, 1.0, 4.0]), jnp.int32(3))
    update = jax.jit(algo.update, compiler_options=FAST)
    _, metrics = update(dataclasses.replace(ts, past_costs=past), START)
    assert metrics["train/bad_cost"] > 0
    expected = {"cost_rate": 2, "cost_estimate": 10, "violation": (1 + 4 + 10) / 3 - 6}
    for name, x in expected.items():
        np.testing.assert_allclose(metrics[f"train/{name}"], x, rtol=1e-5)


def test_metrics_are_of_the_episodes_that_ended_and_of_none_there_is_no_mean():
    env = Ticker(episode_length=9, lives=(3, 3))
    ts, m = compiled("ppo", env).update(begin("ppo", env, stagger=False, horizon=6))
    expected = {"episodes": 16, "return": 3, "cost": 6, "cost_a": 1.5, "cost_b": 4.5, "ticks": 3}
    expected |= {"episode_length": 3, "cost_rate": 2}
    for name, x in expected.items():
        np.testing.assert_allclose(m[f"train/{name}"], x, rtol=1e-6)
    # J_c is exact from the first batch on: 6 steps are lost for 3 taken, and 2 * 9 / (1 + 6 / 3) = 6
    np.testing.assert_allclose(m["train/cost_estimate"], 6, rtol=1e-6)

    ts = begin("ppo", env, stagger=False, horizon=6)
    state = ts.rollout.state
    state = dataclasses.replace(state, obs=state.obs.at[:, 2].set(99.0))  # none ends in 6 steps
    endless = dataclasses.replace(ts, rollout=dataclasses.replace(ts.rollout, state=state))
    _, m = compiled("ppo", env).update(endless)
    assert m["train/episodes"] == 0 and jnp.isnan(m["train/return"]) and jnp.isnan(m["train/ticks"])
    assert m["train/cost_estimate"] == 2 * 9


def told_by_its_objective(of):
    """A step that never moves the policy, and tells what it maximises: `of` what it is given."""

    def update(actor, opt_state, objective, batch, context):
        gain, _ = of(objective)(actor, batch)
        return actor, opt_state, {"train/objective": gain, "train/nonfinite": jnp.zeros(())}

    return PolicyStep(lambda actor, cfg: (), update)


def mean_advantage(dist, batch, advantage, cfg):
    return advantage.mean(), {}


BONUS: dict[str, Any] = {"entropy_coef": 0.5, "entropy_decay": True, "total_iterations": 10.0}


def test_an_iteration_first_moves_the_price_and_then_pays_by_it():
    treatment = no_treatment._replace(
        init=lambda cfg: jnp.float32(99.0),
        update=lambda dual, episode_cost, cfg, iteration: jnp.float32(episode_cost + iteration),
        advantage=lambda dual, adv_r, adv_c: jnp.broadcast_to(dual, adv_r.shape),
    )
    step = told_by_its_objective(lambda objective: objective)
    algo = on_policy(Ticker(episode_length=5), treatment, mean_advantage, step)
    ts = algo.init(jax.random.key(0), PPOConfig(**TINY, **BONUS), START)
    after, m = jax.jit(algo.update, compiler_options=FAST)(ts, at(3))
    assert after.dual == 13  # J_c is 10
    np.testing.assert_allclose(m["train/objective"], 13 + 0.5 * 0.7 * m["train/entropy"], rtol=1e-5)


@pytest.mark.parametrize(("part", "share"), [("reward", 0.7), ("cost", 0.0)])
def test_the_bonus_for_entropy_belongs_to_the_reward_of_a_pair(part, share):
    step = told_by_its_objective(lambda pair: getattr(pair, part))
    algo = on_policy_pair(Ticker(episode_length=5), mean_advantage, step)
    ts = algo.init(jax.random.key(0), PPOConfig(**TINY, **BONUS), START)
    _, m = jax.jit(algo.update, compiler_options=FAST)(ts, at(3))
    bonus = 0.5 * share * m["train/entropy"]  # of advantages the mean is 0
    np.testing.assert_allclose(m["train/objective"], bonus, rtol=1e-5, atol=1e-5)


def test_critics_make_the_passes_that_the_policy_made_and_their_skipped_steps_are_counted(monkeypatch):
    """In place of a critic's error stands its mean target times the passes that take effect."""

    def passes_alone(critic, data, passes, key, cfg, axis_name):
        return critic, passes * data[1].mean(), jnp.int32(3)

    monkeypatch.setattr("jaxsafe.learn.on_policy.fit_critic", passes_alone)
    algo = telling(Ticker(), lambda batch, context: {"train/passes": jnp.int32(2)})
    sizes: dict[str, Any] = {**TINY, "epochs": 5, "critic_epochs": 4}
    cfg = PPOConfig(**sizes, critics_stop=True, discount=0.0, cost_discount=0.0)  # targets 1 and 2
    _, m = algo.update(algo.init(jax.random.key(0), cfg, START), START)
    found = [m[f"train/{name}"] for name in ("value_loss_r", "value_loss_c", "nonfinite")]
    np.testing.assert_allclose(found, [2, 4, 6], rtol=1e-5)


def test_worlds_and_episodes_are_counted_once_each_and_on_all_devices():
    no = jnp.zeros((2, 3, 4), bool)  # two devices with 3 steps in each of 4 worlds
    obs, cost = no.at[0, :2, 1].set(True), no.at[0, 2, 1].set(True).at[1, 0, :2].set(True)
    ended = no.at[0, 1, :3].set(True).at[1, 2, 0].set(True)
    sums = jnp.where(ended, jnp.arange(4.0), jnp.nan)
    episode = Episode(sums, sums + 1, jnp.stack([sums + 2, sums + 3], -1), {"ticks": sums + 4}, sums)

    def on_one(bad, ended, episode, length):
        ends = Ended(ended, episode, length)
        return world_metrics(bad, "devices") | episode_metrics(Ticker(), ends, "devices")

    m = jax.vmap(on_one, axis_name="devices")(Bad(obs, no, cost), ended, episode, sums + 5)
    expected = {"bad_worlds": 3, "bad_obs": 1, "bad_reward": 0, "bad_cost": 3, "episodes": 4}
    names = ("return", "cost", "cost_a", "cost_b", "ticks", "episode_length")
    expected |= {name: 3 / 4 + i for i, name in enumerate(names)}  # of worlds 0, 1, 2 and 0
    for name, x in expected.items():
        np.testing.assert_array_equal(m[f"train/{name}"], [x, x])

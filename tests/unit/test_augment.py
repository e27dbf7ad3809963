import dataclasses
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import FAST
from toys import START, Lever, Sometimes, Ticker, run_episodes, updated

from jaxsafe.algos import ALGOS
from jaxsafe.learn import augment
from jaxsafe.learn.augment import Budget, control_budget, full_budget, init_schedule
from jaxsafe.learn.normalise import Normaliser, network_inputs, normalise
from jaxsafe.learn.rollout import collect, init_rollout, memoryless
from jaxsafe.run import checkpoint, compat
from jaxsafe.types import Policy

TINY: dict[str, Any] = {
    "num_envs": 4,
    "horizon": 6,
    "minibatches": 1,
    "hidden": (4,),
    "epochs": 2,
    "critic_epochs": 1,
    "stagger": False,
}


@cache
def build(name, env):
    algo = ALGOS[name].make(env)
    return algo, jax.jit(updated(algo), compiler_options=FAST)


def start(name, env, **settings):
    return build(name, env)[0].init(jax.random.key(0), ALGOS[name].config(**TINY | settings), START)


def run(env, num_envs, horizon, policy, **options):
    rollout = init_rollout(env, jax.random.key(0), num_envs, stagger=False)
    step = jax.jit(partial(collect, env, memoryless(policy), horizon=horizon, **options))
    return step(rollout, key=jax.random.key(1))[1]


def idle(obs, key):
    return jnp.zeros((obs.shape[0], 1)), jnp.zeros(obs.shape[0])


# Budgets ---------------------------------------------------------------------------------------------


def test_the_budget_by_hand_before_and_after_a_reset():
    env = Budget(Ticker(episode_length=3), start=1.0, budget=8.0, discount=0.5)  # cost 2 a step
    traj = run(env, 4, 7, idle)
    for i in range(4):
        np.testing.assert_array_equal(traj.obs[:, i, -1], [1, 1.5, 2.5, 1, 1.5, 2.5, 1])
        np.testing.assert_array_equal(traj.next_obs[:, i, -1], [1.5, 2.5, 4.5, 1.5, 2.5, 4.5, 1.5])


def test_each_environment_has_a_budget_of_its_own():
    env = Budget(Ticker(episode_length=3, lives=(1, 3)), start=0.5, budget=8.0, discount=1.0)
    traj = run(env, 8, 20, idle)
    assert len(np.unique(traj.length[traj.ended])) == 3  # they end at different times
    for obs in (traj.obs, traj.next_obs):
        np.testing.assert_array_equal(obs[..., -1], 0.5 - obs[..., 1] / 4)  # by their own clocks
    np.testing.assert_array_equal(traj.reward, 1)
    np.testing.assert_array_equal(traj.cost, 2)
    last = traj.ended & (traj.length == 3)
    assert (traj.episode.info["unsafe"][last] == 2).all()  # z is 0.5, 0.25, 0, -0.25


def test_a_budget_is_the_discounted_sum_that_is_left():
    def wild(obs, key):
        return jax.random.normal(key, (obs.shape[0], 2)), jnp.zeros(obs.shape[0])

    traj = run(Budget(Lever(), start=0.7, budget=2.5, discount=0.9), 3, 30, wild)
    assert traj.cost.std() > 0.1
    weights = 0.9 ** np.arange(10)
    costs = traj.cost.reshape(3, 10, 3) * weights[:, None]  # of three episodes
    left = traj.next_obs[..., -1].reshape(3, 10, 3) * 0.9 * weights[:, None]
    np.testing.assert_allclose(left, 0.7 - np.cumsum(costs, 1) / 2.5, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("discount", [0.9, 0.999, 1.0])
def test_spending_the_limit_evenly_spends_the_budget(discount):
    env, cfg = Ticker(episode_length=7), ALGOS["ppo_saute"].config(cost_limit=14.0)
    cfg = dataclasses.replace(cfg, saute_discount=discount)
    if discount < 1:
        np.testing.assert_allclose(
            full_budget(env, cfg), 14 * (1 - discount**7) / (1 - discount) / 7, rtol=1e-5
        )
    traj = run(augment.saute.wrap(env, cfg, ()), 2, 7, idle)
    np.testing.assert_allclose(traj.next_obs[-1, :, -1], 0, atol=1e-5)
    assert (traj.next_obs[:-1, :, -1] > 0.1).all()


@pytest.mark.parametrize("normalised", [True, False])
def test_what_is_left_is_seen_as_it_is(normalised):
    ts = start("ppo_saute", Lever(), obs_normalize=normalised)
    if normalised:
        stats = Normaliser(
            mean=jnp.array([1.0, -2.0]), var=jnp.array([4.0, 0.25]), count=jnp.float32(9)
        )
        ts = dataclasses.replace(ts, normaliser=stats)
    obs = jax.random.normal(jax.random.key(0), (5, 3))
    np.testing.assert_array_equal(network_inputs(ts.normaliser, obs)[:, -1], obs[:, -1])
    if normalised:
        assert ts.normaliser.mean.shape == (2,)
        inputs = network_inputs(ts.normaliser, obs)
        np.testing.assert_array_equal(inputs[:, :2], normalise(ts.normaliser, obs[:, :2]))


def test_a_step_that_ends_without_budget_earns_the_unsafe_reward():
    env, cfg = Ticker(episode_length=5), ALGOS["ppo_saute"].config(cost_limit=4.0, unsafe_reward=-3.0)
    cfg = dataclasses.replace(cfg, saute_discount=1.0)
    traj = run(augment.saute.wrap(env, cfg, ()), 2, 6, idle)
    np.testing.assert_array_equal(traj.next_obs[:, 0, -1], [0.5, 0, -0.5, -1, -1.5, 0.5])
    np.testing.assert_array_equal(augment.saute.reward(traj, cfg)[:, 0], [1, -3, -3, -3, -3, 1])


def test_omnisafes_value_at_a_time_limit_is_of_a_full_budget():
    env, cfg = Ticker(episode_length=5, lives=(3, 9)), ALGOS["ppo_saute"].config(full_at_end=True)
    traj = run(augment.saute.wrap(env, cfg, ()), 6, 20, idle)
    assert traj.truncated.any() and traj.terminated.any()
    last = augment.saute.last_obs(traj, cfg)
    np.testing.assert_array_equal(last[..., :-1], traj.next_obs[..., :-1])
    z = jnp.where(traj.truncated, 1.0, traj.next_obs[..., -1])
    np.testing.assert_array_equal(last[..., -1], z)
    ours = dataclasses.replace(cfg, full_at_end=False)
    np.testing.assert_array_equal(augment.saute.last_obs(traj, ours), traj.next_obs)


def test_critics_learn_the_value_of_a_full_budget_at_a_time_limit():
    env = Ticker(episode_length=5)

    def learned(full):
        ts = start("ppo_saute", env, full_at_end=full, cost_limit=90.0)
        return jax.tree.leaves(build("ppo_saute", env)[1](ts)[0].params["critic_r"])

    assert any((x != y).any() for x, y in zip(learned(False), learned(True), strict=True))


def test_the_unsafe_reward_is_the_learners_alone():
    env = Ticker(episode_length=5)
    after = {}
    for limit, price in ((4.0, -1.0), (4.0, -5.0), (90.0, -1.0), (90.0, -5.0)):
        ts = start("ppo_saute", env, cost_limit=limit, unsafe_reward=price)
        after[limit, price], m = build("ppo_saute", env)[1](ts)
        assert (m["train/return"], m["train/cost"], m["train/cost_rate"]) == (5, 10, 2)
        assert m["train/return_estimate"] == 5

    def same(a, b):
        return all((x == y).all() for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True))

    assert not same(after[4.0, -1.0].params["critic_r"], after[4.0, -5.0].params["critic_r"])
    assert same(after[90.0, -1.0].params, after[90.0, -5.0].params)


def test_a_limit_of_zero_stays_finite():
    ts, m = build("ppo_saute", Lever())[1](start("ppo_saute", Lever(), cost_limit=0.0))
    assert m["train/nonfinite"] == 0 and (ts.rollout.state.obs[:, -1] < 0).all()
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(ts.params))


def test_a_bad_world_earns_nothing_where_rewards_are_scaled():
    env = Sometimes(episode_length=6)
    options: dict[str, Any] = {"num_envs": 32, "cost_limit": 1.0, "unsafe_reward": -3.0}
    ts, m = build("ppo_saute", env)[1](start("ppo_saute", env, reward_normalize=True, **options))
    assert m["train/bad_worlds"] > 0 and m["train/nonfinite"] == 0
    # every good step breaks the limit, and only those count
    np.testing.assert_allclose(ts.signal_normaliser.mean[0], -3.0, rtol=1e-5)
    np.testing.assert_allclose(ts.signal_normaliser.var[0], 0.0, atol=1e-4)


# The schedule of a budget ----------------------------------------------------------------------------

HAND: dict[str, Any] = {
    "cost_limit": 10.0,
    "budget_init": 0.5,
    "budget_ramp": 4.0,
    "budget_reach": 0.2,
    "simmer_kp": 0.5,
    "simmer_ki": 0.1,
    "simmer_kaw": 0.5,
    "simmer_smoothing": 0.5,
    "simmer_window": 2,
}


def test_the_controller_by_hand():
    cfg = ALGOS["ppo_simmer_pid"].config(**HAND)
    dual = init_schedule(cfg)
    assert dual.budget == 5
    rows = [  # J_c, then by hand: smoothed error, B, what clipping added to u
        (5.0, 0.625, 6.625, 0.0),  # d = 6.25, u = 0.3125 + 0.0625
        (25.5, -8.6875, 5.5, 3.15),  # d = 7.5, u = -4.34375 - 0.80625 is cut at -2
        (25.0, -12.46875, 6.75, 4.775),  # d = 8.75, u = -6.234375 - 2.115625 + 1.575: two errors
        (0.0, -1.234375, 10.0, -0.4),  # d = 10, u = 0.4: B is cut at the limit
        (10.0, -0.6171875, 10 - 0.69375, 0.0),  # u = -0.30859375 - 0.18515625 - 0.2
    ]
    for iteration, (cost, error, budget, clipped) in enumerate(rows):
        dual = control_budget(dual, jnp.float32(cost), cfg, iteration)
        np.testing.assert_allclose(dual.errors[-1], error, rtol=1e-6)
        np.testing.assert_allclose(dual.budget, budget, rtol=1e-6)
        np.testing.assert_allclose(dual.clipped, clipped, rtol=1e-5, atol=1e-6)


def test_omnisafes_controller_adds_to_the_last_budget_by_hand():
    cfg = ALGOS["ppo_simmer_pid"].config(**HAND, simmer_adds=True, simmer_full=True)
    dual = init_schedule(cfg)
    rows = [  # J_c, then by hand: smoothed error, B; gains 0.5, 0.1 and 0.5, the last two errors
        (5.0, 0.0, 5.0),
        (3.0, 1.0, 5.6),  # e = 2 / 2, u = 0.5 + 0.1
        (9.6, -1.5, 4.8),  # e = 1 / 2 - 4 / 2, u = -0.75 - 0.05
    ]
    for iteration, (cost, error, budget) in enumerate(rows):
        dual = control_budget(dual, jnp.float32(cost), cfg, iteration)
        np.testing.assert_allclose(dual.errors[-1], error, rtol=1e-6)
        np.testing.assert_allclose(dual.budget, budget, rtol=1e-6)
    env = Ticker(episode_length=5)
    shown: Any = augment.simmer.wrap(env, cfg, dual)
    assert shown.start == 1.0
    np.testing.assert_allclose(shown.budget, full_budget(env, cfg) * 0.48, rtol=1e-6)


def test_omnisafes_controller_keeps_most_of_its_budget_where_costs_are_too_high():
    config = ALGOS["ppo_simmer_pid"].config
    dual = init_schedule(cfg := config(**compat.overrides("omnisafe", config)))
    assert dual.budget == cfg.cost_limit == 25
    for iteration in range(500):
        dual = control_budget(dual, jnp.float32(40.0), cfg, iteration)
    assert 10 < dual.budget < 25


def test_new_episodes_start_with_the_present_budget_and_running_ones_keep_theirs():
    env = Ticker(episode_length=6)
    update = build("ppo_simmer_pid", env)[1]
    ts = start("ppo_simmer_pid", env, horizon=4, **HAND | {"cost_limit": 50.0})
    np.testing.assert_array_equal(ts.rollout.state.obs[:, -1], 0.5)
    first, _ = update(
        dataclasses.replace(ts, config=dataclasses.replace(ts.config, saute_discount=1.0))
    )
    assert first.rollout.used == 0  # the pool is as drawn at first
    np.testing.assert_allclose(first.rollout.state.obs[:, -1], 0.5 - 4 * 2 / 50, rtol=1e-6)
    share = first.dual.budget / 50
    assert share > 0.6
    second, _ = update(first)  # two steps to the end of the episodes, and two of the next
    assert second.rollout.used == 4
    np.testing.assert_array_equal(second.rollout.state.obs[:, 0], first.rollout.pool.obs[:, 0])
    np.testing.assert_allclose(second.rollout.state.obs[:, -1], share - 2 * 2 / 50, rtol=1e-6)
    later = second.dual.budget / 50
    assert later > share + 0.05
    third, _ = update(second)  # the same, from a pool drawn anew
    np.testing.assert_allclose(third.rollout.state.obs[:, -1], later, rtol=1e-6)


def test_a_policy_acts_with_the_budget_that_training_left_it():
    env = Ticker(episode_length=6)
    algo, update = build("ppo_simmer_pid", env)
    ts, _ = update(start("ppo_simmer_pid", env, **HAND))
    task = algo.task(ts)
    assert task.obs_size == env.obs_size + 1
    np.testing.assert_allclose(task.reset(jax.random.key(0)).obs[-1], ts.dual.budget / 10)


def test_evaluation_shows_what_is_left_of_the_scheduled_budget():
    def spend(params, carry, obs, key):  # an action of z: a step costs (1 +- z) / 2
        return obs[..., -1:] * jnp.ones(2), (), {}

    algo = ALGOS["ppo_simmer_pid"].make(Lever())._replace(policy=Policy(lambda learned: (), spend))
    cfg = ALGOS["ppo_simmer_pid"].config(**TINY, cost_limit=1e6, budget_init=0.2)
    ts = jax.tree.map(lambda x: x[None], algo.init(jax.random.key(0), cfg, START))
    cost = run_episodes(algo, ts, 50, seed=0).cost  # 10 steps of 0.4 or 0.6
    assert cost.min() > 3.99 and cost.max() < 6.01 and cost.std() > 0.1


def test_a_schedule_comes_back_from_a_checkpoint(tmp_path):
    env = Ticker(episode_length=6)
    algo, update = build("ppo_simmer_pid", env)
    ts, _ = update(start("ppo_simmer_pid", env, **HAND))
    checkpoint.save(tmp_path, ts, checkpoint.Progress(1, 24, 1))
    cfg = ALGOS["ppo_simmer_pid"].config(**TINY | HAND)
    like = jax.eval_shape(lambda: algo.init(jax.random.key(0), cfg, START))
    back, _ = checkpoint.restore(tmp_path, like)
    for x, y in zip(*(jax.tree.leaves(update(s)[0].dual) for s in (ts, back)), strict=True):
        np.testing.assert_array_equal(x, y)


# Early termination -----------------------------------------------------------------------------------


@pytest.mark.parametrize("limit, length", [(5.0, 3), (6.0, 4), (9.0, 5)])
def test_an_episode_ends_for_good_where_it_breaks_the_limit(limit, length):
    cfg = ALGOS["ppo_early_terminated"].config(cost_limit=limit, termination_reward=-7.0)
    traj = run(Ticker(episode_length=5), 2, 20, idle, stop=lambda sums: augment.early.stop(sums, cfg))
    ends = np.arange(length - 1, 20, length)
    np.testing.assert_array_equal(np.flatnonzero(traj.terminated[:, 0]), ends)
    assert not traj.truncated.any()
    np.testing.assert_array_equal(traj.done, traj.terminated)
    np.testing.assert_array_equal(traj.length[traj.ended], length)
    paid = np.ones(20)
    paid[ends] = -7
    np.testing.assert_array_equal(augment.early.reward(traj, cfg)[:, 1], paid)


def test_the_count_of_cost_begins_anew_with_every_episode():
    cfg = ALGOS["ppo_early_terminated"].config(cost_limit=10.0)  # what an episode costs
    traj = run(Ticker(episode_length=5), 2, 20, idle, stop=lambda sums: augment.early.stop(sums, cfg))
    assert not traj.terminated.any() and traj.truncated.sum() == 8


def test_omnisafes_count_of_cost_goes_on_until_it_ends_an_episode():
    cfg = ALGOS["ppo_early_terminated"].config(cost_limit=13.0, keep_cost=True, termination_reward=-7.0)
    traj = run(Ticker(episode_length=5), 2, 24, idle, stop=lambda sums: augment.early.stop(sums, cfg))
    # 2 a step: 10 at the first time limit, 14 two steps later, which ends the second episode
    ends = [6, 13, 20]
    np.testing.assert_array_equal(np.flatnonzero(traj.terminated[:, 0]), ends)
    np.testing.assert_array_equal(np.flatnonzero(traj.truncated[:, 0]), [4, 11, 18])
    np.testing.assert_array_equal(traj.episode.cost[np.array(ends), 0], 4)
    paid = np.ones(24)
    paid[ends] = -7
    np.testing.assert_array_equal(augment.early.reward(traj, cfg)[:, 0], paid)


def test_training_episodes_end_early_and_others_do_not():
    env = Ticker(episode_length=5)
    algo, update = build("ppo_early_terminated", env)
    ts, m = update(start("ppo_early_terminated", env, cost_limit=5.0))
    assert (m["train/episode_length"], m["train/cost"], m["train/return"]) == (3, 6, 3)
    assert algo.task(ts) is env
    whole = run_episodes(algo, jax.tree.map(lambda x: x[None], ts), 2, seed=0)
    np.testing.assert_array_equal(whole.length, 5)
    np.testing.assert_array_equal(whole.cost, 10)


# In one program --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["ppo_saute", "ppo_simmer_pid", "ppo_early_terminated"])
def test_cost_limits_side_by_side_are_different_tasks(name):
    algo = ALGOS[name].make(Ticker(episode_length=5))
    limits = jnp.array([5.0, 6.0, 40.0])
    cfg = ALGOS[name].config(**TINY | {"horizon": 3})

    def init(limit):
        return algo.init(jax.random.key(0), dataclasses.replace(cfg, cost_limit=limit), START)

    update = jax.jit(jax.vmap(updated(algo)), compiler_options=FAST)
    ts, _ = update(jax.vmap(init)(limits))
    if name == "ppo_early_terminated":
        _, m = update(ts)
        np.testing.assert_array_equal(m["train/episode_length"], [3, 4, 5])
    else:
        obs = ts.rollout.state.obs
        first = 0.5 if name == "ppo_simmer_pid" else 1.0
        z = first - 6 / np.array([5.0, 6.0, 40.0])  # nearly: of budgets discounted a little
        np.testing.assert_allclose(obs[:, 0, -1], z, atol=2e-3)

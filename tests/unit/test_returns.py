from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsafe.learn.batch import batch_mean
from jaxsafe.learn.returns import (
    Estimator,
    LostTime,
    ValuedSteps,
    advantages,
    empty_window,
    episode_cost,
    expected_length,
    gae,
    no_lost_time,
    vtrace,
)

NO, YES = jnp.zeros((1, 1), bool), jnp.ones((1, 1), bool)
ONE = jnp.ones((1, 1))


class Failures(NamedTuple):
    terminated: jax.Array
    length: jax.Array


def column(*values):
    return jnp.array(values)[:, None]


def test_a_time_limit_bootstraps_and_a_failure_does_not():
    timed_out = gae(ValuedSteps(ONE, 0 * ONE, 2 * ONE, NO, YES), discount=0.5, decay=1.0)
    failed = gae(ValuedSteps(ONE, 0 * ONE, 2 * ONE, YES, YES), discount=0.5, decay=1.0)
    assert (timed_out.item(), failed.item()) == (2.0, 1.0)


def test_a_value_that_is_not_finite_stays_behind_a_failure():
    def advantage(next_value):
        return gae(ValuedSteps(ONE, 0 * ONE, next_value, YES, YES), discount=0.5, decay=1.0).sum()

    assert advantage(jnp.nan * ONE) == 1.0
    assert jax.grad(advantage)(jnp.inf * ONE).item() == 0.0


def test_three_steps_by_hand():
    # deltas with discount 1/2: 1 + 1 - 1 = 1, 2 + 2 - 2 = 2, 3 + 4 - 4 = 3; decay 1/2 weighs by 1/4
    steps = ValuedSteps(
        column(1.0, 2.0, 3.0),
        column(1.0, 2.0, 4.0),
        column(2.0, 4.0, 8.0),
        column(False, False, False),
        column(False, False, True),
    )
    advantage = gae(steps, discount=0.5, decay=0.5)
    np.testing.assert_allclose(advantage[:, 0], [1 + (2 + 3 / 4) / 4, 2 + 3 / 4, 3])


def test_nothing_leaks_from_the_next_episode():
    reward = column(1.0, 100.0)
    steps = ValuedSteps(reward, 0 * reward, 0 * reward, NO.repeat(2, 0), column(True, False))
    assert gae(steps, discount=0.9, decay=0.9)[0].item() == 1.0


def test_without_decay_the_sum_is_the_discounted_return():
    key = jax.random.split(jax.random.key(0), 2)
    reward, value = jax.random.normal(key[0], (6, 3)), jax.random.normal(key[1], (7, 3))
    no = jnp.zeros((6, 3), bool)
    steps = ValuedSteps(reward, value[:-1], value[1:], no, no)
    advantage = gae(steps, discount=0.9, decay=1.0)
    ret = sum(0.9**t * reward[t] for t in range(6)) + 0.9**6 * value[6]
    np.testing.assert_allclose(advantage[0] + value[0], ret, rtol=1e-5)


def test_episode_cost_is_the_plain_mean_over_synchronous_episodes():
    cost = jax.random.uniform(jax.random.key(0), (10, 4))
    failed = jnp.zeros((10, 4), bool)
    length, _ = expected_length(no_lost_time(), 10, Failures(failed, jnp.full((10, 4), 10)), 40)
    np.testing.assert_allclose(batch_mean(cost, None) * length, cost.sum(0).mean(), rtol=1e-6)


def test_an_episode_costs_what_its_good_steps_cost():
    charged = jnp.array([[1.0, 0.0], [3.0, 0.0]])  # the second environment was bad in both steps
    found = episode_cost(empty_window(1, ()), charged, jnp.float32(2), jnp.float32(10), None)
    assert found.of_iteration == found.recent == 2 * 10
    several = jnp.stack([charged, 3 * charged], -1)
    found = episode_cost(empty_window(1, (2,)), several, jnp.float32(2), jnp.float32(10), None)
    assert found.recent.tolist() == [20, 60]


def test_the_length_by_lost_time_by_hand():
    # of 8 steps one fails at step 2 of 10 and loses 8: x = 1, and 10 / (1 + 1) = 5
    failed, lengths = jnp.zeros((4, 2), bool).at[1, 0].set(True), jnp.full((4, 2), 2)
    length, past = expected_length(no_lost_time(), 10, Failures(failed, lengths), 8)
    assert length == 5 and past == (8, 8)  # 2 episodes of 5 steps are remembered: all of it
    # 8 more steps without a failure: x = 8 / 16, of which 2 episodes of 6 2/3 steps stay
    length, past = expected_length(past, 10, Failures(~failed & False, lengths), 8)
    np.testing.assert_allclose((length, *past), (20 / 3, 20 / 3, 40 / 3), rtol=1e-6)
    # where 4 of the first 8 entries are resets: x = 8 / 4
    length, _ = expected_length(no_lost_time(), 10, Failures(failed, lengths), 4)
    np.testing.assert_allclose(length, 10 / 3, rtol=1e-6)


def test_two_devices_lose_as_much_time_as_one():
    failed = jnp.zeros((4, 2), bool).at[1, 0].set(True)
    steps = Failures(failed, jnp.full((4, 2), 2))
    past = LostTime(jnp.float32(20), jnp.float32(40))  # so that not all of it is remembered
    length, one = expected_length(past, 10, steps, 8)

    def on_one(failed, lengths):
        steps = Failures(failed[:, None], lengths[:, None])
        return expected_length(past, 10, steps, 4, "devices")

    lengths, two = jax.vmap(on_one, 1, axis_name="devices")(*steps)
    assert one.taken < 48
    np.testing.assert_allclose(lengths, [length] * 2, rtol=1e-6)
    np.testing.assert_allclose(two, [[x] * 2 for x in one], rtol=1e-6)


def test_the_length_by_lost_time_stays_exactly_at_the_time_limit():
    past, none = no_lost_time(), Failures(jnp.zeros((7, 13), bool), jnp.full((7, 13), 3))
    for _ in range(3):
        length, past = expected_length(past, 1000, none, 91)
        assert length == 1000


def test_a_batch_without_a_step_leaves_the_length_as_it_was():
    none = Failures(jnp.zeros((4, 2), bool), jnp.full((4, 2), 3))
    length, past = expected_length(no_lost_time(), 10, none, 0)
    assert length == 10 and past == (0, 0)
    length, past = expected_length(LostTime(jnp.float32(8), jnp.float32(8)), 10, none, 0)
    assert length == 5 and past == (8, 8)


@pytest.mark.parametrize("stagger", [False, True])
@pytest.mark.parametrize("limit, hazard", [(50, 0.1), (1000, 0.001)])
def test_the_length_by_lost_time_is_right_from_the_first_batch(limit, hazard, stagger):
    """Each step fails with the same probability h, so the mean length is (1 - (1 - h)^T) / h."""
    rng, envs, horizon = np.random.default_rng(0), 4096, 40
    clock = np.arange(envs) * limit // envs * stagger
    exact = (1 - (1 - hazard) ** limit) / hazard
    past, found, step = no_lost_time(), [], jax.jit(expected_length)
    for _ in range(60):
        failed, lengths = [], []
        for _ in range(horizon):
            clock += 1
            failed, lengths = [*failed, rng.random(envs) < hazard], [*lengths, clock.copy()]
            clock[failed[-1] | (clock == limit)] = 0
        steps = Failures(jnp.array(failed), jnp.array(lengths))
        length, past = step(past, limit, steps, envs * horizon)
        found.append(length / exact)
    np.testing.assert_allclose(found[0], 1, atol=0.3)
    np.testing.assert_allclose(found[-1], 1, atol=0.1)


# Three steps of one environment: the first ends by its time limit, the second by a failure, the third
# goes on beyond the batch. Discount 1/2, so deltas 1 + 4/2 - 1, 2 - 3, 4 + 6/2 - 5.
ENDS = ValuedSteps(
    reward=column(1.0, 2.0, 4.0),
    value=column(1.0, 3.0, 5.0),
    next_value=column(4.0, 100.0, 6.0),
    terminated=column(False, True, False),
    done=column(True, True, False),
)
# Three steps of an episode that ends by a failure: rewards to go 1 + (2 + 4/2)/2 = 3, 4, 4, so
# errors 2, 1, -1 of the values 1, 3, 5; deltas 1 + 3/2 - 1, 2 + 5/2 - 3, 4 - 5.
FAILS = ValuedSteps(
    reward=column(1.0, 2.0, 4.0),
    value=column(1.0, 3.0, 5.0),
    next_value=column(3.0, 5.0, 100.0),
    terminated=column(False, False, True),
    done=column(False, False, True),
)


@pytest.mark.parametrize("estimator", get_args(Estimator))
def test_every_estimator_bootstraps_at_time_limits_and_not_at_failures(estimator):
    ratio = jnp.ones((3, 1))
    both = advantages(estimator, ENDS, ratio, discount=0.5, decay=0.5)
    for x in both:  # nothing to sum: advantages and errors are the deltas
        np.testing.assert_allclose(x[:, 0], [2, -1, 2])


@pytest.mark.parametrize(
    ("estimator", "advantage", "error"),
    [
        ("gae", [1.5 + (1.5 - 1 / 4) / 4, 1.5 - 1 / 4, -1], [1.5 + (1.5 - 1 / 4) / 4, 1.5 - 1 / 4, -1]),
        ("gae_rtg", [1.5 + (1.5 - 1 / 4) / 4, 1.5 - 1 / 4, -1], [2, 1, -1]),
        ("plain", [1.5, 1.5, -1], [2, 1, -1]),
        ("vtrace", [2, 1, -1], [2, 1, -1]),
    ],
)
def test_every_estimator_by_hand(estimator, advantage, error):
    ratio = jnp.ones((3, 1))
    found = advantages(estimator, FAILS, ratio, discount=0.5, decay=0.5)
    np.testing.assert_allclose(found[0][:, 0], advantage)
    np.testing.assert_allclose(found[1][:, 0], error)


def test_vtrace_by_hand():
    # the ratio 3 is clipped to 1; from the back -1, (1.5 - 1/2)/2 = 1/2, 1.5 + 1/4
    advantage = vtrace(FAILS, column(3.0, 0.5, 1.0), discount=0.5)
    np.testing.assert_allclose(advantage[:, 0], [1.75, 0.5, -1])


def test_vtrace_is_the_papers_sum_and_its_policy_gradients_advantage():
    """Equation 1 as it stands, a sum of products, on each episode apart; A from section 4.2."""
    rng, steps, envs, discount = np.random.default_rng(0), 30, 4, 0.9
    reward, value = rng.normal(size=(steps, envs)), rng.normal(size=(steps, envs))
    done = rng.random((steps, envs)) < 0.2
    terminated = done & (rng.random((steps, envs)) < 0.5)
    after = rng.normal(size=(steps, envs))
    after[:-1] = np.where(
        done[:-1], after[:-1], value[1:]
    )  # only a reset parts V(s') from the next V(s)
    ratio = np.exp(rng.normal(size=(steps, envs)))
    clipped = np.minimum(1, ratio)
    boot = np.where(terminated, 0, after)
    target = value.copy()
    for n in range(envs):
        for s in range(steps):
            for t in range(s, steps):
                delta = clipped[t, n] * (reward[t, n] + discount * boot[t, n] - value[t, n])
                target[s, n] += discount ** (t - s) * np.prod(clipped[s:t, n]) * delta
                if done[t, n]:
                    break
    last = done | (np.arange(steps) == steps - 1)[:, None]
    next_target = np.where(last, boot, np.roll(target, -1, 0))
    advantage = clipped * (reward + discount * next_target - value)
    steps = ValuedSteps(*map(jnp.array, (reward, value, after, terminated, done)))
    found = vtrace(steps, jnp.array(ratio), discount)
    np.testing.assert_allclose(found, advantage, atol=1e-4)
    np.testing.assert_allclose(found + value, target, atol=1e-4)

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.batch import batch_mean
from jaxsafe.returns import gae, mean_length

NO, YES = jnp.zeros((1, 1), bool), jnp.ones((1, 1), bool)
ONE = jnp.ones((1, 1))


def column(*values):
    return jnp.array(values)[:, None]


def test_a_time_limit_bootstraps_and_a_failure_does_not():
    timed_out = gae(ONE, 0 * ONE, 2 * ONE, NO, YES, discount=0.5, decay=1.0)
    failed = gae(ONE, 0 * ONE, 2 * ONE, YES, YES, discount=0.5, decay=1.0)
    assert (timed_out.item(), failed.item()) == (2.0, 1.0)


def test_a_value_that_is_not_finite_stays_behind_a_failure():
    assert gae(ONE, 0 * ONE, jnp.nan * ONE, YES, YES, discount=0.5, decay=1.0).item() == 1.0
    grad = jax.grad(lambda v: gae(ONE, 0 * ONE, v, YES, YES, discount=0.5, decay=1.0).sum())
    assert grad(jnp.inf * ONE).item() == 0.0


def test_three_steps_by_hand():
    # deltas with discount 1/2: 1 + 1 - 1 = 1, 2 + 2 - 2 = 2, 3 + 4 - 4 = 3; decay 1/2 weighs by 1/4
    advantage = gae(
        column(1.0, 2.0, 3.0),
        column(1.0, 2.0, 4.0),
        column(2.0, 4.0, 8.0),
        column(False, False, False),
        column(False, False, True),
        discount=0.5,
        decay=0.5,
    )
    np.testing.assert_allclose(advantage[:, 0], [1 + (2 + 3 / 4) / 4, 2 + 3 / 4, 3])


def test_nothing_leaks_from_the_next_episode():
    reward = column(1.0, 100.0)
    advantage = gae(
        reward, 0 * reward, 0 * reward, NO.repeat(2, 0), column(True, False), discount=0.9, decay=0.9
    )
    assert advantage[0].item() == 1.0


def test_without_decay_the_sum_is_the_discounted_return():
    key = jax.random.split(jax.random.key(0), 2)
    reward, value = jax.random.normal(key[0], (6, 3)), jax.random.normal(key[1], (7, 3))
    no = jnp.zeros((6, 3), bool)
    advantage = gae(reward, value[:-1], value[1:], no, no, discount=0.9, decay=1.0)
    ret = sum(0.9**t * reward[t] for t in range(6)) + 0.9**6 * value[6]
    np.testing.assert_allclose(advantage[0] + value[0], ret, rtol=1e-5)


def test_the_mean_length_stays_exactly_at_the_time_limit():
    length, ended = jnp.float32(1000), jax.random.bernoulli(jax.random.key(0), 0.1, (7, 13))
    assert mean_length(length, ended, jnp.full((7, 13), 1000)) == 1000
    assert mean_length(length, jnp.zeros((7, 13), bool), jnp.full((7, 13), 3)) == 1000


def test_episode_cost_is_the_plain_mean_over_synchronous_episodes():
    cost = jax.random.uniform(jax.random.key(0), (10, 4))
    ended = jnp.zeros((10, 4), bool).at[-1].set(True)
    length = mean_length(jnp.float32(10), ended, jnp.full((10, 4), 10))
    np.testing.assert_allclose(batch_mean(cost, None) * length, cost.sum(0).mean(), rtol=1e-6)


def test_the_mean_length_finds_that_of_early_terminations():
    rng, length, clock = np.random.default_rng(0), jnp.float32(50), np.zeros(64, int)
    step = jax.jit(mean_length)
    for _ in range(60):  # each step ends an episode with probability 1/10: mean length 10
        ended, lengths = [], []
        for _ in range(20):
            clock += 1
            done = (rng.random(64) < 0.1) | (clock == 50)
            ended, lengths = [*ended, done], [*lengths, clock.copy()]
            clock[done] = 0
        length = step(length, jnp.array(ended), jnp.array(lengths))
    np.testing.assert_allclose(length, 10 * (1 - 0.9**50), rtol=0.15)

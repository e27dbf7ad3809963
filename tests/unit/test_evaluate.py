"""Which episodes evaluation plays."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Ticker, reflex

from jaxsafe.algos.bc import BCConfig
from jaxsafe.learn.acting import Learned, Player, course
from jaxsafe.run.evaluate import evaluated, keys_of_episodes, make_play
from jaxsafe.run.settings import TrainConfig
from jaxsafe.types import Policy


def keys(*args):
    return np.asarray(jax.random.key_data(keys_of_episodes(*args)))


def test_seeds_meet_episodes_of_their_own_and_settings_the_same_ones():
    three_seeds = keys(0, 4, range(3))
    assert len(np.unique(three_seeds.reshape(12, -1), axis=0)) == 12
    np.testing.assert_array_equal(keys(0, 4, range(3), 2), np.concatenate([three_seeds, three_seeds]))
    np.testing.assert_array_equal(keys(0, 4, range(5))[:3], three_seeds)  # more seeds, no others
    assert (keys(1, 4, range(3)) != three_seeds).any(-1).all()


def test_a_seed_meets_its_episodes_whichever_seed_comes_first():
    five_seeds = keys(0, 4, TrainConfig(num_seeds=5).seeds)
    np.testing.assert_array_equal(keys(0, 4, TrainConfig(seed=3, num_seeds=2).seeds), five_seeds[3:])
    # the keys of a run whose first seed is 0, as they have always been
    key = jax.random.fold_in(jax.random.key(0), 0x6576616C)
    first = [jax.random.split(jax.random.fold_in(key, i), 4) for i in range(5)]
    np.testing.assert_array_equal(five_seeds, np.stack([jax.random.key_data(x) for x in first]))


def test_each_policy_s_rewards_and_costs_are_discounted_as_in_its_training():
    env = Ticker(lives=(2, 2))  # 1 and 2 a step
    policy = reflex(lambda obs: obs[:1], env).policy
    algo: Any = SimpleNamespace(policy=policy, task=lambda learned: env)
    cfgs = BCConfig(discount=0.5, cost_discount=0.25), BCConfig(discount=1.0, cost_discount=0.0)
    cfg = jax.tree.map(lambda *x: jnp.array(x), *cfgs)
    play = make_play(algo, keys_of_episodes(0, 1, range(2)))
    found, _ = evaluated(play, Learned(cfg, {}, (), ()))
    np.testing.assert_array_equal(found.discounted_ret, [[1.5], [2]])
    np.testing.assert_array_equal(found.discounted_cost, [[2.5], [2]])


@pytest.mark.parametrize("length", [5, 12])
@pytest.mark.parametrize("sampled", [False, True])
def test_episodes_are_played_in_parts_and_are_the_same(length, sampled):
    """Twelve steps are six parts of two, and five steps five of one."""

    def noisy(learned, carry, obs, key):
        noise = jnp.zeros(()) if key is None else jax.random.uniform(key)
        return obs[:1], (), {"noise": noise}

    env = Ticker(length, lives=(2, length + 2))
    policy = Policy(lambda learned: (), noisy)
    algo: Any = SimpleNamespace(policy=policy, task=lambda learned: env)
    learned = Learned(jax.tree.map(lambda x: jnp.stack([x, x]), BCConfig()), {}, (), ())
    keys, told = keys_of_episodes(0, 3, range(2)), []
    parts = make_play(algo, keys, lambda *said: told.append(said))(learned, sampled, "playing")
    whole = jax.vmap(jax.vmap(lambda key: course(Player(algo.policy, learned, env), key, sampled)))(
        keys
    )
    assert parts.alive.shape == (2, 3, length)
    jax.tree.map(np.testing.assert_array_equal, parts, whole)
    assert told[0] == ("playing", 0.0) and told[-1] == ("playing", 1.0)
    assert len(told) == 1 + min(length, 6)


def test_ctrl_c_is_seen_between_parts():
    env = Ticker()
    algo: Any = SimpleNamespace(policy=reflex(lambda obs: obs[:1], env).policy, task=lambda _: env)

    def stop(about, share):
        if share > 0.3:
            raise KeyboardInterrupt

    play = make_play(algo, keys_of_episodes(0, 1, [0]), stop)
    with pytest.raises(KeyboardInterrupt):
        play(Learned(jax.tree.map(lambda x: jnp.full(1, x), BCConfig()), {}, (), ()), False)

"""Which episodes evaluation plays."""

import jax
import numpy as np

from jaxsafe.run.evaluate import keys_of_episodes
from jaxsafe.run.settings import TrainConfig


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

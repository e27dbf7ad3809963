"""Which episodes evaluation plays."""

import jax
import numpy as np

from jaxsafe.run.evaluate import keys_of_episodes


def keys(*args):
    return np.asarray(jax.random.key_data(keys_of_episodes(*args)))


def test_seeds_meet_episodes_of_their_own_and_settings_the_same_ones():
    three_seeds = keys(0, 4, 3)
    assert len(np.unique(three_seeds.reshape(12, -1), axis=0)) == 12
    np.testing.assert_array_equal(keys(0, 4, 3, 2), np.concatenate([three_seeds, three_seeds]))
    np.testing.assert_array_equal(keys(0, 4, 5)[:3], three_seeds)  # more seeds are more, no others
    assert (keys(1, 4, 3) != three_seeds).any(-1).all()

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.learn.normalise import CLIP, MIN_STD, Normaliser, init_normaliser, merge, normalise

X = 3.0 + jnp.array([2.0, 0.5]) * jax.random.normal(jax.random.key(0), (5, 12, 2))


def close(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-5)


def test_merging_batches_is_the_whole_batch():
    stats = init_normaliser(2)
    for x in X:
        stats = merge(stats, x)
    flat = X.reshape(-1, 2)
    close(stats, Normaliser(jnp.float32(60), flat.mean(0), flat.var(0)))


def test_two_devices_merge_as_one():
    start = merge(init_normaliser(2), X[0])
    whole = merge(start, X[1:])
    parts = jax.vmap(lambda x: merge(start, x, "devices"), axis_name="devices")(X[1:])
    close(jax.tree.map(lambda x: x[0], parts), whole)


def test_the_first_batch_sees_the_observations_themselves_but_clipped():
    x = jnp.array([[0.3, -99.0]])
    np.testing.assert_array_equal(normalise(init_normaliser(2), x), jnp.array([[0.3, -CLIP]]))


def test_normalised_samples_have_zero_mean_and_unit_variance():
    y = normalise(merge(init_normaliser(2), X), X).reshape(-1, 2)
    np.testing.assert_allclose(y.mean(0), 0, atol=1e-5)
    np.testing.assert_allclose(y.std(0), 1, rtol=1e-4)


def test_a_constant_component_is_divided_by_the_floor():
    stats = merge(init_normaliser(1), jnp.full((4, 1), 7.0))
    np.testing.assert_allclose(normalise(stats, jnp.array([7.02])), 0.02 / MIN_STD, rtol=1e-3)


def test_a_billion_samples_do_not_stop_it():
    x = 3.0 + jax.random.normal(jax.random.key(1), (32_768, 1))
    stats = Normaliser(jnp.float32(1e9), jnp.ones(1), jnp.ones(1))
    after = jax.lax.fori_loop(0, 1000, lambda _, s: merge(s, x), stats)
    n = 32_768_000  # so the mean moves by 2 n / (1e9 + n)
    np.testing.assert_allclose(after.count, 1e9 + n, rtol=1e-6)
    np.testing.assert_allclose(after.mean - 1, (x.mean() - 1) * n / (1e9 + n), rtol=2e-3)

"""Encoders and decoders of pictures: their convolutions against XLA's, and sizes that do not suit."""

from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from compiling import BUSY, FAST

from jaxsafe.config import ConfigError
from jaxsafe.nn import coders
from jaxsafe.nn.rssm import SIZES, Latent


def test_squares_are_a_convolution_of_the_picture_and_of_one_twice_as_large():
    """With more results than a square holds, and with fewer."""

    def both(x, out, grows):
        layer = coders.Convolution(out, grows)
        found: Any = layer.init_with_output(jax.random.key(1), x)
        squares, params = found
        of = x.repeat(2, 1).repeat(2, 2) if grows else x
        kernel, axes = params["params"]["kernel"], ("NHWC", "HWIO", "NHWC")
        conv = partial(jax.lax.conv_general_dilated, dimension_numbers=axes)
        return squares, conv(of, kernel, (1, 1), "SAME")

    for grows, channels, out in ((False, 3, 4), (False, 3, 2), (True, 3, 4), (True, 9, 2)):
        x = jax.random.normal(jax.random.key(0), (2, 6, 10, channels))
        squares, expected = jax.jit(partial(both, out=out, grows=grows), compiler_options=FAST)(x)
        assert squares.shape == ((2, 6, 10, 2, 2, out) if grows else (2, 3, 5, 2, 2, out))
        np.testing.assert_allclose(coders.picture_of(squares), expected, atol=1e-5)


def test_a_picture_has_sides_that_can_be_halved_or_is_refused_with_the_nearest():
    for shape, size, nearest in (
        ((40, 60, 3), "1m", r"60 x 40: size=1m .* multiples of 16, from 48 to 256; .*=\[64,48\]"),
        ((512, 64, 3), "1m", r"64 x 512: .*=\[64,256\]"),
        ((4, 9, 3), "tiny", r"9 x 4: size=tiny .* multiples of 2, from 6 to 32; .*=\[8,6\]"),
    ):
        with pytest.raises(ConfigError, match=nearest):
            coders.check_picture(shape, SIZES[size], size)
    coders.check_picture((48, 256, 9), SIZES["50m"], "50m")


@pytest.mark.parametrize("obs_size", [0, 7])
def test_pictures_alone_are_an_observation_too(obs_size):
    """And what is decoded has the shapes of what was seen, with the channels of two frames."""
    size, latent = SIZES["1m"], Latent(jnp.zeros((3, 512)), jnp.zeros((3, 128)))
    obs = {"vision": jnp.zeros((3, 48, 64, 6), jnp.uint8), "vector": jnp.zeros((3, obs_size))}
    encoder, decoder = coders.Encoder(size), coders.Decoder(size, (48, 64, 6), obs_size)
    seen, _ = jax.eval_shape(lambda: encoder.init_with_output(jax.random.key(0), obs))
    assert seen.shape == (3, 3 * 4 * 16 + (64 if obs_size else 0))
    decoded, _ = jax.eval_shape(lambda: decoder.init_with_output(jax.random.key(0), latent))
    assert decoded.keys() == obs.keys()
    assert all(x.shape == obs[name].shape for name, x in decoded.items())
    assert jax.eval_shape(decoder.loss, decoded, obs).shape == (3,)


def test_a_number_lies_between_two_steps_and_is_their_mean():
    x = jnp.array([-3.0, -1.0, -0.24, 0.0, 0.93, 1.0, 50.0])
    found = coders.shares(x, 21)
    np.testing.assert_allclose(found.sum(-1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(found @ jnp.linspace(-1, 1, 21), jnp.clip(x, -1, 1), atol=1e-6)
    assert ((found > 0).sum(-1) <= 2).all()
    np.testing.assert_allclose(found[4, -2:], [0.7, 0.3], atol=1e-5)


def test_bins_are_seen_beside_the_number():
    """Numbers beyond the last step differ by their symlog alone, and bins can be left out."""
    x, beyond = jnp.array([[0.5, 2.0]]), jnp.array([[0.5, 9.0]])
    plain, binned = coders.VectorEncoder(SIZES["tiny"]), coders.VectorEncoder(SIZES["tiny"], bins=5)
    for encoder, inputs in ((plain, 2), (binned, 2 + 2 * 5)):
        params: Any = encoder.init(jax.random.key(0), x)
        assert inputs in {leaf.shape[0] for leaf in jax.tree.leaves(params)}
        seen: tuple[Any, Any] = (encoder.apply(params, x), encoder.apply(params, beyond))
        assert (seen[0] != seen[1]).any()


@pytest.mark.parametrize(("bins", "least", "most"), [(0, 0.4, 0.6), (21, 0.8, 1.0)])
def test_with_bins_it_sees_where_a_hazard_begins(bins, least, most):
    """It tells whether the robot is inside the nearest of 16 hazards, in places that it has not seen,
    after 300 gradient steps on 40 others: the area under the ROC curve. Numbers alone do not tell."""
    rng = np.random.default_rng(0)

    def places(n):
        """The lidar at 50 distances from a hazard in each place, [n, 50, 16], and whether inside."""
        far = rng.uniform(0.0, 0.9, (n, 1, 16))
        at, near = rng.integers(16, size=(n, 1, 1)), rng.uniform(0.85, 1.0, (n, 50, 1))
        lidar = np.where(np.arange(16) == at, near, far).astype(np.float32)
        return lidar, lidar.max(-1) > 0.93

    (seen, inside), (fresh, truth) = places(40), places(200)
    encoder, head = coders.VectorEncoder(SIZES["300k"], bins), nn.Dense(1)
    body = encoder.init(jax.random.key(0), seen[0])
    params = body, head.init(jax.random.key(1), encoder.apply(body, seen[0]))
    rule = optax.adam(3e-3)

    def logits(params, lidar):
        found: Any = head.apply(params[1], encoder.apply(params[0], lidar))
        return found[..., 0]

    def loss(params):
        return optax.sigmoid_binary_cross_entropy(logits(params, seen), inside).mean()

    def step(carry, _):
        params, state = carry
        updates, state = rule.update(jax.grad(loss)(params), state)
        return (optax.apply_updates(params, updates), state), None

    @partial(jax.jit, compiler_options=BUSY)
    def run(params):
        return jax.lax.scan(step, (params, rule.init(params)), None, 300)[0][0]

    said = np.asarray(logits(run(params), fresh))
    area = (said[truth][:, None] > said[~truth]).mean()
    assert least < area < most

"""Running statistics that bring observations, rewards and costs to about the same size.

A `Normaliser` has the mean and variance of all samples so far, merged over batches and devices:

    w = n / (count + n);  d = mean_batch - mean
    mean <- mean + w d;   var <- var + w (var_batch - var) + w (1 - w) d^2

Source: Chan, Golub and LeVeque (1983), "Algorithms for Computing the Sample Variance". Keeping the
variance rather than the sum of squares, and the merge as a weighted mean, needs only the relative
precision of `count`, so float32 serves beyond 1e9 samples. Floor and clip are OmniSafe's; it uses
the unbiased variance, which differs by 1 / count.

`Moments` are for rewards and costs that a replay gives again and again: running means of replayed
batches, in which recent batches may count more.
"""

import math
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from jaxsafe.learn.batch import batch_mean, pmean, psum
from jaxsafe.learn.observations import vector_of, with_vector
from jaxsafe.types import PyTree

MIN_STD = 0.01  # in units of what is normalised
CLIP = 5.0  # standard deviations


@flax.struct.dataclass
class Normaliser:
    count: jax.Array  # float [], samples so far
    mean: jax.Array  # float [size], of whatever is normalised
    var: jax.Array  # float [size]


def init_normaliser(size: int) -> Normaliser:
    """Before the first batch observations pass through, clipped only."""
    return Normaliser(jnp.zeros(()), jnp.zeros(size), jnp.ones(size))


def merge(
    stats: Normaliser,
    x: jax.Array,
    axis_name: str | None = None,
    weight: jax.Array | float = 1.0,
) -> Normaliser:
    """`stats` with the samples `x` [..., O] of all devices added.

    weight: float [], the reciprocal of the share of samples that count. The other samples must be 0;
        they do not change mean and variance.
    """
    x = x.reshape(math.prod(x.shape[:-1]), x.shape[-1])
    mean = batch_mean(x, axis_name, axis=0) * weight
    var = batch_mean((x - mean) ** 2, axis_name, axis=0)
    var = (var - (1 - 1 / weight) * mean**2) * weight
    n = psum(jnp.float32(x.shape[0]), axis_name)
    w = n / (stats.count + n)
    d = mean - stats.mean
    var = stats.var + w * (var - stats.var) + w * (1 - w) * d**2
    return Normaliser(stats.count + n, stats.mean + w * d, var)


def normalise(stats: Normaliser, x: jax.Array) -> jax.Array:
    std = jnp.maximum(jnp.sqrt(stats.var), MIN_STD)
    return jnp.clip((x - stats.mean) / std, -CLIP, CLIP)


def network_inputs(normaliser: Normaliser | tuple[()], obs: PyTree) -> PyTree:
    """`obs` as the networks take it: its vector [..., O] normalised, if there is a normaliser.

    What an augmentation appended to the environment's observation is left as it is, and so is a
    picture, which networks scale themselves.
    """
    if isinstance(normaliser, tuple):
        return obs
    size, vector = normaliser.mean.shape[-1], vector_of(obs)
    seen = normalise(normaliser, vector[..., :size])
    if vector.shape[-1] > size:
        seen = jnp.concatenate([seen, vector[..., size:]], -1)
    return with_vector(obs, seen)


class Moments(NamedTuple):
    """Running means of S signals and of their squares, float [S], and the updates so far, float []."""

    count: jax.Array
    mean: jax.Array
    square: jax.Array


def no_moments(size: int) -> Moments:
    return Moments(jnp.float32(0), jnp.zeros(size), jnp.zeros(size))


def averaged(
    past: Moments, x: jax.Array, weight: jax.Array, axis_name: str | None, memory: float = 8
) -> Moments:
    """`past` moved towards the means of `x` [..., B, S], whose entries of axis B have `weight`.

    The k-th update, from 0 on, has the rate memory / (memory + k). With 1 that is the mean of all
    batches; with more, old ones are slowly forgotten.
    """
    rate = memory / (memory + past.count)

    def mean(x: jax.Array) -> jax.Array:
        over_batch = (x * weight[:, None]).sum(-2)
        return pmean(over_batch.reshape(-1, x.shape[-1]).mean(0), axis_name)

    def moved(old: jax.Array, x: jax.Array) -> jax.Array:
        return old + rate * (mean(x) - old)

    return Moments(past.count + 1, moved(past.mean, x), moved(past.square, x**2))


def standard(
    moments: Moments, x: jax.Array, centre: bool, least: float = 1e-5, most: float = 10.0
) -> jax.Array:
    """`x` [..., S] in standard deviations, from the mean if `centre`, clipped to +-`most`. A standard
    deviation counts as `least` at least."""
    variance = jnp.maximum(moments.square - moments.mean**2, 0.0)
    offset = moments.mean if centre else 0.0
    return jnp.clip((x - offset) / jnp.maximum(jnp.sqrt(variance), least), -most, most)

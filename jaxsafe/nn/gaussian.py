"""Diagonal Gaussians. On-policy methods use them as they are, `squashed` takes their tanh,
and `bounded` the tanh of their mean."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp


class Gaussian(NamedTuple):
    """mean, log_std: float [..., A]."""

    mean: jax.Array
    log_std: jax.Array


def sample(dist: Gaussian, key: jax.Array) -> jax.Array:
    return dist.mean + jnp.exp(dist.log_std) * jax.random.normal(key, dist.mean.shape)


def log_prob(dist: Gaussian, x: jax.Array) -> jax.Array:
    """log N(x; mean, std^2) = sum_i -z_i^2 / 2 - log std_i - log(2 pi) / 2, float [...]."""
    z = (x - dist.mean) * jnp.exp(-dist.log_std)
    return jnp.sum(-0.5 * z**2 - dist.log_std - 0.5 * math.log(2 * math.pi), axis=-1)


def entropy(dist: Gaussian) -> jax.Array:
    """sum_i log std_i + log(2 pi e) / 2, float [...], in nats."""
    return jnp.sum(dist.log_std + 0.5 * math.log(2 * math.pi * math.e), axis=-1)


def kl(p: Gaussian, q: Gaussian) -> jax.Array:
    """KL(p || q), summed over action dimensions: float [...], in nats.

    sum_i log(q_i / p_i) + (p_i^2 + (mean_p - mean_q)_i^2) / (2 q_i^2) - 1/2, for stds p_i, q_i.
    """
    log_ratio = q.log_std - p.log_std
    distance = ((p.mean - q.mean) * jnp.exp(-q.log_std)) ** 2
    # expm1 keeps the tiny KLs of a trust region: exp(-2x) - 1 + 2x loses all digits for |x| < 1e-4
    return 0.5 * jnp.sum(jnp.expm1(-2 * log_ratio) + 2 * log_ratio + distance, axis=-1)

"""The hyperbolic tangent of a diagonal Gaussian: policies whose actions lie in (-1, 1)."""

import math

import jax
import jax.numpy as jnp

from jaxsafe.nn.gaussian import Gaussian, log_prob, sample


def squashed_sample(dist: Gaussian, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """a = tanh(u), u ~ `dist`, float [..., A], and log p(a), float [...].

        log p(a) = log N(u) - sum_i log(1 - tanh(u_i)^2),
        log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2 u)), which is exact for large |u|

    Source: Haarnoja et al. (2018), "Soft Actor-Critic: Off-Policy Maximum Entropy Deep Reinforcement
        Learning with a Stochastic Actor", arXiv:1801.01290, appendix C.
    """
    u = sample(dist, key)
    shrinkage = 2 * (math.log(2) - u - jax.nn.softplus(-2 * u))
    return jnp.tanh(u), log_prob(dist, u) - shrinkage.sum(-1)


def squashed_mean(dist: Gaussian) -> jax.Array:
    """The action of the mean, float [..., A]; also the median of what `squashed_sample` draws."""
    return jnp.tanh(dist.mean)

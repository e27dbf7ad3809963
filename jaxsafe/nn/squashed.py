"""The hyperbolic tangent of a diagonal Gaussian: policies whose actions lie in (-1, 1)."""

import math
from typing import Any

import jax
import jax.numpy as jnp

from jaxsafe.nn.gaussian import Gaussian, log_prob, sample
from jaxsafe.nn.networks import LOG_STD, coarse_mlp
from jaxsafe.types import PyTree


def init_squashed(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> PyTree:
    return coarse_mlp(cfg, 2 * action_size).init(key, jnp.zeros(obs_size))


def squashed_policy(actor: PyTree, obs: jax.Array, action_size: int, cfg: Any) -> Gaussian:
    """The Gaussian before the hyperbolic tangent, for `obs` [..., O]: mean and log std [..., A]."""
    out: Any = coarse_mlp(cfg, 2 * action_size).apply(actor, obs)
    mean, log_std = jnp.split(out, 2, axis=-1)
    return Gaussian(mean, jnp.clip(log_std, *LOG_STD))


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

"""Gaussians about a mean in (-1, 1), whose spread does not depend on the state.

Unlike the tanh of a Gaussian they give every recorded action a density, those at +-1 included.

Source: Kostrikov, Nair and Levine (2022), "Offline Reinforcement Learning with Implicit Q-Learning",
    arXiv:2110.06169, the authors' code, for the mean's tanh and the spread.
"""

from typing import Any

import jax
import jax.numpy as jnp

from jaxsafe.nn.gaussian import Gaussian, sample
from jaxsafe.nn.networks import coarse_mlp
from jaxsafe.types import PyTree

LOG_STD = (-5.0, 2.0)


def init_bounded(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> PyTree:
    """{'mean', 'log_std' [A]}."""
    mean = coarse_mlp(cfg, action_size).init(key, jnp.zeros(obs_size))
    return {"mean": mean, "log_std": jnp.full(action_size, cfg.init_log_std, jnp.float32)}


def bounded_policy(actor: PyTree, obs: jax.Array, cfg: Any) -> Gaussian:
    """The action distribution for `obs` [..., O]: mean and log std [..., A]."""
    size = actor["log_std"].shape[-1]
    out: Any = coarse_mlp(cfg, size).apply(actor["mean"], obs)
    log_std = jnp.broadcast_to(jnp.clip(actor["log_std"], *LOG_STD), out.shape)
    return Gaussian(jnp.tanh(out), log_std)


def bounded_action(dist: Gaussian, key: jax.Array | None) -> jax.Array:
    """The mean action, float [..., A], or with a key a sample, clipped to [-1, 1]."""
    return dist.mean if key is None else jnp.clip(sample(dist, key), -1.0, 1.0)

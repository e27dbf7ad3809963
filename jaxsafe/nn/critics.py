"""Networks of off-policy methods: policies of actions in (-1, 1), and critics of state and action."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxsafe.nn.gaussian import Gaussian
from jaxsafe.nn.networks import LOG_STD, MLP
from jaxsafe.types import PyTree


def net(cfg: Any, out: int, layer_norm: bool = False) -> MLP:
    # products in the device's own precision: TensorFloat-32 on a GPU
    precision = jax.lax.Precision.DEFAULT
    return MLP(cfg.hidden, out, cfg.init, cfg.activation, layer_norm=layer_norm, precision=precision)


def init_squashed(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> PyTree:
    return net(cfg, 2 * action_size).init(key, jnp.zeros(obs_size))


def squashed_policy(actor: PyTree, obs: jax.Array, action_size: int, cfg: Any) -> Gaussian:
    """What `distributions.squashed_sample` squashes, for `obs` [..., O]: mean and log std [..., A]."""
    out: Any = net(cfg, 2 * action_size).apply(actor, obs)
    mean, log_std = jnp.split(out, 2, axis=-1)
    return Gaussian(mean, jnp.clip(log_std, *LOG_STD))


def init_critics(key: jax.Array, obs_size: int, action_size: int, count: int, cfg: Any) -> PyTree:
    """`count` critics, stacked: leaves [count, ...]."""
    pair = jnp.zeros(obs_size + action_size)
    return jax.vmap(lambda key: net(cfg, 1, cfg.layer_norm).init(key, pair))(
        jax.random.split(key, count)
    )


def q_values(critics: PyTree, obs: jax.Array, action: jax.Array, cfg: Any) -> jax.Array:
    """Q of each critic, float [count, ...], for `obs` [..., O] and `action` [..., A]."""
    pair = jnp.concatenate([obs, action], -1)
    out: Any = jax.vmap(lambda critic: net(cfg, 1, cfg.layer_norm).apply(critic, pair))(critics)
    return out[..., 0]

"""Critics of state and action: Q(s, a)."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxsafe.nn.networks import coarse_mlp
from jaxsafe.types import PyTree


def init_critics(key: jax.Array, obs_size: int, action_size: int, count: int, cfg: Any) -> PyTree:
    """`count` critics, stacked: leaves [count, ...]."""
    pair = jnp.zeros(obs_size + action_size)
    return jax.vmap(lambda key: coarse_mlp(cfg, 1, cfg.layer_norm).init(key, pair))(
        jax.random.split(key, count)
    )


def q_values(critics: PyTree, obs: jax.Array, action: jax.Array, cfg: Any) -> jax.Array:
    """Q of each critic, float [count, ...], for `obs` [..., O] and `action` [..., A]."""
    pair = jnp.concatenate([obs, action], -1)
    out: Any = jax.vmap(lambda critic: coarse_mlp(cfg, 1, cfg.layer_norm).apply(critic, pair))(critics)
    return out[..., 0]


def smallest(values: jax.Array) -> jax.Array:
    """Over the first axis, of values [count, ...]. Its gradient is that of one of them.

    The gradient of `values.min(0)` looks for those that equal the result. It is NaN where a compiled
    program rounds the values in two ways, so that none does.
    """
    return _row(values, values.argmin(0))


def largest(values: jax.Array) -> jax.Array:
    """As `smallest`."""
    return _row(values, values.argmax(0))


def _row(values: jax.Array, index: jax.Array) -> jax.Array:
    """`values[index]`, elementwise; without a gather, whose gradient would be a scatter."""
    rows = jnp.arange(len(values)).reshape(-1, *(1,) * index.ndim)
    return jnp.where(rows == index, values, 0.0).sum(0)

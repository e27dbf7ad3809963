"""Beta policies: each component of an action is a Beta variable, stretched from (0, 1) to (-1, 1).

Both concentrations are above 1, so that a density has one mode, and is 0 at both bounds.

Source: Chou, Maturana and Scherer (2017), "Improving Stochastic Policy Gradients in Continuous Control
    with Deep Reinforcement Learning using the Beta Distribution", for the head.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import betaln

from jaxsafe.nn.networks import MLP
from jaxsafe.types import PyTree

MARGIN = float(jnp.finfo(jnp.float32).eps)  # samples lie in [MARGIN, 1 - MARGIN]
ONE = math.log(math.e - 1)  # softplus of this is 1


class Beta(NamedTuple):
    """Concentrations, float [..., A], above 1: `up` draws towards 1 and `down` towards -1."""

    up: jax.Array
    down: jax.Array


def network(outputs: int, cfg: Any) -> MLP:
    precision = jax.lax.Precision.DEFAULT
    return MLP(cfg.hidden, outputs, "xavier", cfg.activation, precision=precision)


def init_beta(key: jax.Array, input_size: int, action_size: int, cfg: Any) -> PyTree:
    """A network whose distribution is Beta(2, 2) for every input."""
    layers: Any = network(2 * action_size, cfg).init(key, jnp.zeros(input_size))["params"]
    last = f"Dense_{len(cfg.hidden)}"
    head = {"kernel": jnp.zeros_like(layers[last]["kernel"]), "bias": jnp.full(2 * action_size, ONE)}
    return {"params": layers | {last: head}}


def beta_policy(net: PyTree, inputs: jax.Array, cfg: Any) -> Beta:
    """The distribution for `inputs` [..., I]. The gradient of one input's concentrations is at most
    `cfg.concentration_clip` long."""
    last = net["params"][f"Dense_{len(cfg.hidden)}"]["bias"]
    out: Any = network(last.shape[-1], cfg).apply(net, inputs)
    concentrations = short_gradient(1 + jax.nn.softplus(out), cfg.concentration_clip)
    return Beta(*jnp.split(concentrations, 2, axis=-1))


def beta_sample(dist: Beta, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """a = 2 x - 1, x ~ `dist`, float [..., A], and log p(a), float [...]; differentiable in both
    concentrations.

    x = g / (g + h) of two Gamma variables, here drawn by one call: compiling their gradient takes long.
    """
    log_up, log_down = jax.random.loggamma(key, jnp.stack(dist))
    x = jnp.clip(jax.nn.sigmoid(log_up - log_down), MARGIN, 1 - MARGIN)
    return 2 * x - 1, beta_log_prob(dist, x)


def beta_log_prob(dist: Beta, x: jax.Array) -> jax.Array:
    """log p(2 x - 1), float [...], of x in (0, 1)."""
    log_p = (dist.up - 1) * jnp.log(x) + (dist.down - 1) * jnp.log1p(-x) - betaln(dist.up, dist.down)
    return (log_p - math.log(2)).sum(-1)


def beta_mode(dist: Beta) -> jax.Array:
    """The most likely action, float [..., A]."""
    return (dist.up - dist.down) / jnp.maximum(dist.up + dist.down - 2, 1e-6)


@jax.custom_vjp
def short_gradient(x: jax.Array, most: jax.Array | float) -> jax.Array:
    """`x` [..., A] itself. Its gradient is scaled down to the length `most`, where it is longer."""
    return x


def forward(x: jax.Array, most: jax.Array | float) -> tuple[jax.Array, jax.Array]:
    return x, jnp.asarray(most, x.dtype)


def backward(most: jax.Array, gradient: jax.Array) -> tuple[jax.Array, jax.Array]:
    length = jnp.sqrt(jnp.square(gradient).sum(-1, keepdims=True) + 1e-30)
    return gradient * jnp.minimum(1.0, most / length), jnp.zeros_like(most)


short_gradient.defvjp(forward, backward)

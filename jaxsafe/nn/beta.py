"""Beta policies: each component of an action is a Beta variable, stretched from (0, 1) to (-1, 1).

Both concentrations are above 1, so that a density has one mode, and is 0 at both bounds.

Draws and their gradients have no loop, since on a GPU each turn of one costs as much as a layer of a
network.

Source: Chou, Maturana and Scherer (2017), "Improving Stochastic Policy Gradients in Continuous Control
    with Deep Reinforcement Learning using the Beta Distribution", for the head; Marsaglia and Tsang
    (2000), "A Simple Method for Generating Gamma Variables", for draws; Figurnov, Mohamed and Mnih
    (2018), "Implicit Reparameterization Gradients", for their gradients.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betaln, digamma

from jaxsafe.nn.networks import MLP
from jaxsafe.types import PyTree

MARGIN = float(jnp.finfo(jnp.float32).eps)  # samples lie in [MARGIN, 1 - MARGIN]
ONE = math.log(math.e - 1)  # softplus of this is 1
TRIES = 8  # of a Gamma draw, of which each is accepted with a probability of at least 0.95
DEPTH = 16.0  # an integrand that is exp(-DEPTH) times its largest value is left out
NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)  # on [-1, 1]


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


def beta_sample(dist: Beta, key: jax.Array | None) -> tuple[jax.Array, jax.Array]:
    """a = 2 x - 1, x ~ `dist`, float [..., A], and log p(a), float [...]; differentiable in both
    concentrations. The mode where `key` is None."""
    if key is None:
        mode = beta_mode(dist)
        return mode, beta_log_prob(dist, (mode + 1) / 2)
    up, down = gamma_draw(jax.lax.stop_gradient(jnp.stack(dist)), key)
    x = following(jnp.clip(up / (up + down), MARGIN, 1 - MARGIN), dist)
    return 2 * x - 1, beta_log_prob(dist, x)


def gamma_draw(shape: jax.Array, key: jax.Array) -> jax.Array:
    """Gamma variables of scale 1, of the size of `shape`, which is at least 1.

    The first of `TRIES` candidates that Marsaglia and Tsang's rule accepts, or the last one if it
    accepts none, which happens once in 10^10 draws.
    """
    normal_key, uniform_key = jax.random.split(key)
    normal = jax.random.normal(normal_key, (TRIES, *shape.shape))
    uniform = jax.random.uniform(uniform_key, normal.shape, minval=MARGIN)
    d = shape - 1 / 3
    v = jnp.maximum(1 + normal / jnp.sqrt(9 * d), MARGIN) ** 3
    accepted = jnp.log(uniform) < normal**2 / 2 + d * (1 - v + jnp.log(v))
    first = jnp.argmax(accepted.at[-1].set(True), axis=0)
    return d * jnp.take_along_axis(v, first[None], axis=0)[0]


@jax.custom_jvp
def following(x: jax.Array, dist: Beta) -> jax.Array:
    """`x`, a draw from `dist`. It moves with the concentrations so that F(x) stays the same."""
    return x


@following.defjvp
def follow(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    (x, (up, down)), (_, (d_up, d_down)) = primals, tangents
    return x, slope(x, 1 - x, up, down) * d_up - slope(1 - x, x, down, up) * d_down


def slope(x: jax.Array, y: jax.Array, up: jax.Array, down: jax.Array) -> jax.Array:
    """dx / d up of a draw x = 1 - y, whose share of draws below it, F(x), stays the same:

        dx / d up = -(dF / d up) / p(x) = -int_0^x (log t - E[log X]) p(t) / p(x) dt
                  = int_x^1 (log t - E[log X]) p(t) / p(x) dt

    by Gauss and Legendre's rule on the side of x where log t - E[log X] has one sign, so that nothing
    cancels out. There t or 1 - t is edge exp(-z), 0 < z < length, beyond which p(t) is negligible.
    """
    mean_log = digamma(up) - digamma(up + down)
    below = jnp.log(x) < mean_log
    edge = jnp.where(below, x, y)
    ahead, behind = jnp.where(below, up, down), jnp.where(below, down, up) - 1

    def fall(z: jax.Array) -> jax.Array:
        """-log of p(t) exp(-z) / p(x), which is convex."""
        return ahead * z - behind * (jnp.log1p(-edge * jnp.exp(-z)) - jnp.log1p(-edge))

    length = (DEPTH - behind * jnp.log1p(-edge)) / ahead  # no shorter than where the fall is DEPTH
    for _ in range(3):  # Newton's rule, which comes down on that point
        rest = edge * jnp.exp(-length)
        length -= (fall(length) - DEPTH) / (ahead - behind * rest / (1 - rest))
    node, weight = (x.reshape(-1, *[1] * length.ndim) for x in (NODES, WEIGHTS))
    z = length * (node + 1) / 2
    log_t = jnp.where(below, jnp.log(edge) - z, jnp.log1p(-edge * jnp.exp(-z)))
    area = (weight / 2 * jnp.exp(-fall(z)) * (log_t - mean_log)).sum(0)
    return jnp.where(below, -area, area) * edge * length


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

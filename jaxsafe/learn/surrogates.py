"""Surrogates: what a policy change is estimated to earn, from a batch of the old policy.

Each is (dist, batch, advantage [B], cfg) -> (float [], metrics): the mean over this device's share
of the batch of something to maximise. dist is the new policy at `batch.obs`, and

    w = pi(a | s) / pi_old(a | s)
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxsafe.learn.steps import remaining
from jaxsafe.nn.gaussian import Gaussian, entropy, kl, log_prob
from jaxsafe.types import Count, Metrics

Surrogate = Callable[[Gaussian, Any, jax.Array, Any], tuple[jax.Array, Metrics]]


def plain(dist: Gaussian, batch: Any, advantage: jax.Array, cfg: Any) -> tuple[jax.Array, Metrics]:
    """E[w A]. Source: Kakade and Langford (2002); Schulman et al. (2015), equation 14."""
    w = jnp.exp(log_prob(dist, batch.action) - batch.log_prob)
    return jnp.mean(w * advantage), {}


def clipped(dist: Gaussian, batch: Any, advantage: jax.Array, cfg: Any) -> tuple[jax.Array, Metrics]:
    """E[min(w A, clip(w, 1 - eps, 1 + eps) A)]. Source: Schulman et al. (2017), equation 7."""
    w = jnp.exp(log_prob(dist, batch.action) - batch.log_prob)
    near = jnp.clip(w, 1 - cfg.clip, 1 + cfg.clip)
    fraction = jnp.mean(jnp.abs(w - 1) > cfg.clip)
    return jnp.mean(jnp.minimum(w * advantage, near * advantage)), {"train/clip_fraction": fraction}


def pessimistic(
    dist: Gaussian, batch: Any, advantage: jax.Array, cfg: Any
) -> tuple[jax.Array, Metrics]:
    """E[max(w A, clip(w, 1 - eps, 1 + eps) A)]: `clipped` for what is to be kept low.

    Source: Zhang et al. (2022), arXiv:2205.11814, equation 12.
    """
    low, metrics = clipped(dist, batch, -advantage, cfg)
    return -low, metrics


def near_old(dist: Gaussian, batch: Any, advantage: jax.Array, cfg: Any) -> tuple[jax.Array, Metrics]:
    """E[1{KL <= eta} (w A / temperature - KL)], with the KL of each state.

    Source: Zhang, Vuong and Ross (2020), "First Order Constrained Optimization in Policy Space",
    arXiv:2002.06506, equation 11; the KL is KL(new || old). Without `per_state` it is OmniSafe's,
    E[1{KL <= eta}] E[w A] / temperature - E[1{KL <= eta} KL], because [B, 1] and [B] broadcast there to
    a matrix.
    """
    divergence = kl(dist, batch.old)
    inside = divergence <= cfg.near_kl
    metrics = {"train/inside": jnp.mean(inside)}
    if not cfg.per_state:
        far = jnp.mean(jnp.where(inside, divergence, 0.0))
        gain = plain(dist, batch, advantage, cfg)[0] / cfg.temperature
        return jnp.mean(inside) * gain - far, metrics
    # outside, w may overflow, and 0 times its gradient would be NaN
    w = jnp.exp(jnp.where(inside, log_prob(dist, batch.action) - batch.log_prob, 0.0))
    gain = w * advantage / cfg.temperature - divergence
    return jnp.mean(jnp.where(inside, gain, 0.0)), metrics


def with_entropy(surrogate: Surrogate, iteration: Count) -> Surrogate:
    """`surrogate` + entropy_coef E[H(pi)], whose coefficient falls linearly to 0 at
    `cfg.total_iterations`, if `cfg.entropy_decay`.

    Source: Williams and Peng (1991), "Function Optimization Using Connectionist Reinforcement
    Learning Algorithms"; Schulman et al. (2017), equation 9.
    """

    def value(dist: Gaussian, batch: Any, advantage: jax.Array, cfg: Any) -> tuple[jax.Array, Metrics]:
        gain, metrics = surrogate(dist, batch, advantage, cfg)
        left = remaining(iteration, cfg) if cfg.entropy_decay else 1.0
        return gain + cfg.entropy_coef * left * jnp.mean(entropy(dist)), metrics

    return value

"""A conditional variational autoencoder of actions, given observations.

    q(z | s, a) = N(mu(s, a), sigma(s, a)^2),   a' = decode(s, z),   z with twice the action's numbers

Source: Sohn, Lee and Yan (2015), "Learning Structured Output Representation using Deep Conditional
    Generative Models"; the sizes are those of Fujimoto, Meger and Precup (2019), "Off-Policy Deep
    Reinforcement Learning without Exploration", arXiv:1812.02900.
"""

from typing import Any

import jax
import jax.numpy as jnp

from jaxsafe.nn.gaussian import Gaussian, kl, sample
from jaxsafe.nn.networks import LOG_STD, MLP, coarse_mlp
from jaxsafe.types import PyTree


def net(cfg: Any, out: int) -> MLP:
    return coarse_mlp(cfg, out).clone(hidden=cfg.vae_hidden)


def init_vae(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> PyTree:
    """{'encoder', 'decoder'}."""
    encoder_key, decoder_key = jax.random.split(key)
    latent = 2 * action_size
    return {
        "encoder": net(cfg, 2 * latent).init(encoder_key, jnp.zeros(obs_size + action_size)),
        "decoder": net(cfg, action_size).init(decoder_key, jnp.zeros(obs_size + latent)),
    }


def encode(vae: PyTree, obs: jax.Array, action: jax.Array, cfg: Any) -> Gaussian:
    """q(z | s, a), of `obs` [..., O] and `action` [..., A]: mean and log std [..., 2 A]."""
    out: Any = net(cfg, 4 * action.shape[-1]).apply(vae["encoder"], jnp.concatenate([obs, action], -1))
    mean, log_std = jnp.split(out, 2, axis=-1)
    return Gaussian(mean, jnp.clip(log_std, *LOG_STD))


def decode(vae: PyTree, obs: jax.Array, latent: jax.Array, cfg: Any) -> jax.Array:
    """Actions [..., A], of `obs` [..., O] and `latent` [..., 2 A]."""
    pair = jnp.concatenate([obs, latent], -1)
    out: Any = net(cfg, latent.shape[-1] // 2).apply(vae["decoder"], pair)
    return jnp.tanh(out) if cfg.decoder == "tanh" else out


def draw_latent(key: jax.Array, shape: tuple[int, ...], cfg: Any) -> jax.Array:
    """z ~ N(0, 1), clipped to +-`latent_clip`: near 0 actions are likely ones."""
    return jnp.clip(jax.random.normal(key, shape), -cfg.latent_clip, cfg.latent_clip)


def vae_losses(
    vae: PyTree, obs: jax.Array, action: jax.Array, key: jax.Array, cfg: Any
) -> tuple[jax.Array, jax.Array]:
    """The squared error of the reconstruction, a mean over action numbers, and KL(q(z | s, a) ||
    N(0, 1)), a mean over latent numbers: float [B] each."""
    q = encode(vae, obs, action, cfg)
    z = sample(q, key)
    error = ((decode(vae, obs, z, cfg) - action) ** 2).mean(-1)
    prior = Gaussian(jnp.zeros_like(q.mean), jnp.zeros_like(q.mean))
    return error, kl(q, prior) / z.shape[-1]

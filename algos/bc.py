"""Learners that imitate a data set."""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.config import Bounds, ConfigError, Units, Weight, config
from jaxsafe.learn.acting import Learned
from jaxsafe.learn.conventions import Convention
from jaxsafe.learn.learner import GradientStep, Learner
from jaxsafe.learn.observations import EncoderConfig, blank, observation_like
from jaxsafe.learn.offline import (
    DataSet,
    Draw,
    OfflineConfig,
    anywhere,
    decaying_adam,
    need_episodes,
    offline,
)
from jaxsafe.learn.replay import Transitions
from jaxsafe.learn.row import Row
from jaxsafe.learn.steps import Trainable, descend_each, skipping_adam
from jaxsafe.nn.networks import coarse_mlp
from jaxsafe.nn.vae import decode, draw_latent, init_vae, vae_losses
from jaxsafe.types import Algorithm, Env, Metrics, PyTree


@config
class BCConfig(EncoderConfig, OfflineConfig):
    """BC: behaviour cloning, which imitates a data set and is blind to cost.

        minimise_theta  E_{(s, a) in data}[ |mu_theta(s) - a|^2 ],    mu_theta(s) = tanh(f_theta(s))

    The policy is deterministic. Actions of the data beyond [-1, 1] are clipped to it, as the
    environments clip them.

    Source: Pomerleau (1989), "ALVINN: An Autonomous Land Vehicle in a Neural Network"; the loss and
    the network are those of Fujimoto and Gu (2021), "A Minimalist Approach to Offline Reinforcement
    Learning", arXiv:2106.06860, without its critic.
    """


@config
class BCSafeConfig(BCConfig):
    """BC-Safe: behaviour cloning of the safe episodes of a data set.

        minimise_theta  E_{(s, a) in safe episodes}[ |mu_theta(s) - a|^2 ],    mu_theta as in BC

    An episode is safe if it is whole and its undiscounted cost is at most `cost_limit`. Transitions are
    drawn uniformly from all safe episodes. Without a safe episode the run stops at once.

    Source: Liu et al. (2023), "Datasets and Benchmarks for Offline Safe Reinforcement Learning",
    arXiv:2306.09303, their BC-Safe.
    """


@config
class VAEConfig:
    """For methods with a conditional variational autoencoder of actions."""

    CONVENTIONS: ClassVar = (
        Convention(
            {"decoder": "linear", "latent_clip": 10.0, "kl_weight": 1.0},
            "the autoencoder decodes actions without a tanh, draws latents without a clip, and weighs "
            "the KL by 1",
            "as in BCQ's code: a tanh, a clip at 0.5, a weight of 0.5",
        ),
    )

    vae_hidden: tuple[Units, ...] = (750, 750)  # Units of the autoencoder's hidden layers, as in BCQ.
    # What comes after the decoder's last layer. tanh as in BCQ's code; linear as in OmniSafe.
    decoder: Literal["tanh", "linear"] = "tanh"
    # The largest number of a latent that is drawn, in standard deviations, as in BCQ's code.
    latent_clip: Annotated[float, Bounds(0, 10)] = 0.5
    # The weight of the KL's mean against the mean squared error, as in BCQ's code.
    kl_weight: Weight = 0.5


@config
class VAEBCConfig(VAEConfig, OfflineConfig):
    """VAE-BC: behaviour cloning with a variational autoencoder, which keeps several kinds of actions.

        minimise  E[ mean_i (decode(s, z)_i - a_i)^2 + kl_weight mean_j KL(q(z_j | s, a) || N(0, 1)) ],
        z ~ q(z | s, a);   acts with decode(s, z),   z ~ clip(N(0, 1), +-latent_clip)

    The mean action is that of z = 0. `eval/return_sampled` and `eval/cost_sampled` are of fresh z.

    Source: the autoencoder of Fujimoto, Meger and Precup (2019), "Off-Policy Deep Reinforcement
    Learning without Exploration", arXiv:1812.02900, alone.
    Differs from OmniSafe: there evaluation always draws z.
    """


# ---- regression ----------------------------------------------------------------------------------


def learner(env: Env) -> Learner:
    def init(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> Trainable:
        obs = blank(observation_like(env)) if cfg.encoder == "cnn" else jnp.zeros(obs_size)
        actor = coarse_mlp(cfg, action_size).init(key, obs)
        return Trainable({"actor": actor}, {"actor": skipping_adam(cfg.lr, cfg).init(actor)})

    def mu(actor: PyTree, obs: PyTree, cfg: Any) -> jax.Array:
        out: Any = coarse_mlp(cfg, env.action_size).apply(actor, obs)
        return jnp.tanh(out)

    def act(learned: Learned, obs: PyTree, key: jax.Array | None) -> jax.Array:
        return mu(learned.params["actor"], obs, learned.config)

    def step(
        nets: Trainable, batch: Transitions, at: GradientStep, cfg: Any, axis_name: str | None
    ) -> tuple[Trainable, Metrics]:
        def loss(params: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            error = ((mu(params["actor"], batch.obs, cfg) - batch.action) ** 2).sum(-1).mean()
            return error, {"train/actor_loss": error}

        return descend_each(loss, nets, {"actor": decaying_adam(cfg.lr, at, cfg)})

    return Learner(init=init, act=act, step=step)


def safe_episodes(data: DataSet, cfg: Any) -> Callable[[jax.Array], jax.Array]:
    """Draws rows of episodes that are whole and cost at most `cost_limit`; `check_safe` finds one."""
    episodes = need_episodes(data, "bc_safe learns from whole episodes")
    safe = jnp.asarray(episodes.whole) & (jnp.asarray(episodes.cost) <= cfg.cost_limit)
    upto = jnp.cumsum(safe[jnp.asarray(episodes.number)])  # safe transitions up to each

    def draw(key: jax.Array) -> jax.Array:
        which = jax.random.randint(key, (cfg.batch_size,), 1, upto[-1] + 1)
        return jnp.searchsorted(upto, which)

    return draw


def check_safe(cfg: Any, env: Env, data: Any) -> None:
    """Raise ConfigError for a data set without a safe episode."""
    episodes = need_episodes(data, "bc_safe learns from whole episodes")
    costs = np.asarray(episodes.cost)[np.asarray(episodes.whole)]
    if not (costs <= cfg.cost_limit).any():
        least = f"the least costs {costs.min():g}" if len(costs) else "none is whole"
        raise ConfigError(
            f"cost_limit={cfg.cost_limit:g}: the data set has no episode of at most that; {least}"
        )


# ---- autoencoder ---------------------------------------------------------------------------------


def init_autoencoder(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> Trainable:
    vae = init_vae(key, obs_size, action_size, cfg)
    return Trainable({"vae": vae}, {"vae": skipping_adam(cfg.lr, cfg).init(vae)})


def vae_loss(vae: PyTree, batch: Transitions, key: jax.Array, cfg: Any) -> tuple[jax.Array, Metrics]:
    """Of a batch: the loss [], and its two parts."""
    error, divergence = (x.mean() for x in vae_losses(vae, batch.obs, batch.action, key, cfg))
    metrics = {"train/vae_error": error, "train/vae_kl": divergence}
    return error + cfg.kl_weight * divergence, metrics


def autoencoder(env: Env) -> Learner:
    def act(learned: Learned, obs: jax.Array, key: jax.Array | None) -> jax.Array:
        shape, cfg = (*obs.shape[:-1], 2 * env.action_size), learned.config
        z = jnp.zeros(shape) if key is None else draw_latent(key, shape, cfg)
        return jnp.clip(decode(learned.params["vae"], obs, z, cfg), -1.0, 1.0)

    def step(
        nets: Trainable, batch: Transitions, at: GradientStep, cfg: Any, axis_name: str | None
    ) -> tuple[Trainable, Metrics]:
        def loss(params: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            return vae_loss(params["vae"], batch, at.key, cfg)

        return descend_each(loss, nets, {"vae": decaying_adam(cfg.lr, at, cfg)})

    return Learner(init=init_autoencoder, act=act, step=step)


def make(
    env: Env,
    axis_name: str | None = None,
    learner_of: Callable[[Env], Learner] = learner,
    draw: Draw = anywhere,
) -> Algorithm:
    """`axis_name` splits nothing here: there are no environments."""
    return offline(env, learner_of(env), draw=draw)


# OmniSafe @15603dd, configs/offline: common to all; an iteration is ours
OMNISAFE: dict[str, Any] = {"hidden": (256, 256, 256), "obs_normalize": False}

ROWS = {
    "bc": Row(
        BCConfig,
        make,
        "imitates a data set by regression, blind to cost",
        holds="nothing",
    ),
    "bc_safe": Row(
        BCSafeConfig,
        partial(make, draw=safe_episodes),
        "imitates the episodes of a data set that keep to the limit",
        check=check_safe,
    ),
    "vae_bc": Row(
        VAEBCConfig,
        partial(make, learner_of=autoencoder),
        "imitates a data set by an autoencoder, blind to cost",
        {"omnisafe": OMNISAFE},
        omnisafe="VAEBC",
        holds="nothing",
    ),
}

"""Learners that imitate a data set."""

from typing import Any

import jax
import jax.numpy as jnp
import optax

from jaxsafe.config import config
from jaxsafe.learn.batch import pmean
from jaxsafe.learn.learner import GradientStep, Learner
from jaxsafe.learn.offline import OfflineConfig, offline
from jaxsafe.learn.replay import Transitions
from jaxsafe.learn.row import Row
from jaxsafe.learn.steps import Trainable, adam
from jaxsafe.nn.networks import coarse_mlp
from jaxsafe.types import Algorithm, Env, Metrics, PyTree


@config
class BCConfig(OfflineConfig):
    """BC: behaviour cloning, which imitates a data set and is blind to cost.

        minimise_theta  E_{(s, a) in data}[ |mu_theta(s) - a|^2 ],    mu_theta(s) = tanh(f_theta(s))

    The policy is deterministic. Actions of the data beyond [-1, 1] are clipped to it, as the
    environments clip them.

    Source: Pomerleau (1989), "ALVINN: An Autonomous Land Vehicle in a Neural Network"; the loss and
    the network are those of Fujimoto and Gu (2021), "A Minimalist Approach to Offline Reinforcement
    Learning", arXiv:2106.06860, without its critic.
    """


def init(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> Trainable:
    actor = coarse_mlp(cfg, action_size).init(key, jnp.zeros(obs_size))
    return Trainable({"actor": actor}, {"actor": adam(cfg.lr, cfg).init(actor)})


def learner(action_size: int) -> Learner:
    def mu(actor: PyTree, obs: jax.Array, cfg: Any) -> jax.Array:
        out: Any = coarse_mlp(cfg, action_size).apply(actor, obs)
        return jnp.tanh(out)

    def act(params: PyTree, obs: jax.Array, key: jax.Array | None, cfg: Any) -> jax.Array:
        return mu(params["actor"], obs, cfg)

    def step(
        nets: Trainable, batch: Transitions, at: GradientStep, cfg: Any, axis_name: str | None
    ) -> tuple[Trainable, Metrics]:
        wanted = jnp.clip(batch.action, -1.0, 1.0)

        def loss(actor: PyTree) -> jax.Array:
            error = ((mu(actor, batch.obs, cfg) - wanted) ** 2).sum(-1)
            return (batch.weight * error).sum()  # this device's share

        error, grads = jax.value_and_grad(loss)(nets.params["actor"])
        share = at.remaining if cfg.lr_decay else 1.0
        change, state = adam(cfg.lr * share, cfg).update(
            pmean(grads, axis_name), nets.opt_state["actor"]
        )
        actor = optax.apply_updates(nets.params["actor"], change)
        return Trainable({"actor": actor}, {"actor": state}), {
            "train/actor_loss": pmean(error, axis_name)
        }

    return Learner(init=init, act=act, step=step)


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    """`axis_name` splits nothing here: there are no environments."""
    return offline(env, learner(env.action_size))


ROWS = {
    "bc": Row(
        BCConfig,
        make,
        "imitates a data set by regression, blind to cost",
        holds="nothing",
    )
}

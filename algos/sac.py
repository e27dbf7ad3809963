"""Soft actor-critic, for a thousand environments or for one."""

from typing import Annotated, Any

import jax
import jax.numpy as jnp
import optax

from jaxsafe.config import Bounds, Iterations, Rate, config
from jaxsafe.learn.batch import pmean, select
from jaxsafe.learn.learner import GradientStep, Learner
from jaxsafe.learn.off_policy import OffPolicyConfig, off_policy
from jaxsafe.learn.replay import Transitions
from jaxsafe.learn.row import Row
from jaxsafe.learn.steps import Trainable, adam
from jaxsafe.nn.critics import init_critics, q_values
from jaxsafe.nn.squashed import init_squashed, squashed_mean, squashed_policy, squashed_sample
from jaxsafe.types import Algorithm, Env, Metrics, PyTree


@config
class SACConfig(OffPolicyConfig):
    """SAC: soft actor-critic, blind to cost.

        y = r + discount (1 - terminated) (min_i Q'_i(s', a') - alpha log pi(a' | s')),   a' ~ pi(s')
        minimise_Q      E[sum_i (Q_i(s, a) - y)^2]
        maximise_pi     E[min_i Q_i(s, a) - alpha log pi(a | s)],                         a ~ pi(s)
        minimise_alpha  -log alpha E[log pi(a | s) + H],        H = target_entropy * action size
        Q' <- Q' + tau (Q - Q')

    in this order at each gradient step; i = 1, 2. With `n_step` n, r is the discounted sum of up to n
    rewards and s' the state after them.

    Source: Haarnoja et al. (2018), "Soft Actor-Critic Algorithms and Applications", arXiv:1812.05905,
    algorithm 1; the loss of the temperature is that of the authors' code.
    Differs from it: the defaults are for a thousand environments. Gradient steps are few and large, the
    targets follow faster, the critics have layer norm, and observations are normalised.
    """

    # The temperature at first, as in the authors' code.
    alpha_init: Annotated[float, Bounds(1e-10, 1e6)] = 1.0
    # The learning rate of log alpha, by Adam, as in the authors' code. With 0, alpha stays as it is.
    alpha_lr: Rate = 3e-4
    # The entropy that alpha aims at, in nats for each dimension of the action, as in the paper.
    target_entropy: Annotated[float, Bounds(-100, 100)] = -1.0
    # Gradient steps of the critics for each one of policy, alpha and targets. The paper has 1.
    policy_delay: Iterations = 1


def init(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> Trainable:
    actor_key, critic_key = jax.random.split(key)
    critics = init_critics(critic_key, obs_size, action_size, 2, cfg)
    params = {
        "actor": init_squashed(actor_key, obs_size, action_size, cfg),
        "critic_r": critics,
        "target_r": critics,
        "log_alpha": jnp.log(cfg.alpha_init),
    }
    opt_state = {
        "actor": adam(cfg.lr, cfg).init(params["actor"]),
        "critic_r": adam(cfg.critic_lr, cfg).init(critics),
        "log_alpha": optax.adam(cfg.alpha_lr).init(params["log_alpha"]),
    }
    return Trainable(params, opt_state)


def learner(action_size: int) -> Learner:
    def pi(actor: PyTree, obs: jax.Array, cfg: Any):
        return squashed_policy(actor, obs, action_size, cfg)

    def act(params: PyTree, obs: jax.Array, key: jax.Array | None, cfg: Any) -> jax.Array:
        dist = pi(params["actor"], obs, cfg)
        return squashed_mean(dist) if key is None else squashed_sample(dist, key)[0]

    def step(
        nets: Trainable, batch: Transitions, at: GradientStep, cfg: Any, axis_name: str | None
    ) -> tuple[Trainable, Metrics]:
        params, opt_state = nets
        next_key, key = jax.random.split(at.key)
        alpha = jnp.exp(params["log_alpha"])
        share = at.remaining if cfg.lr_decay else 1.0

        def mean(x: jax.Array) -> jax.Array:
            return (batch.weight * x).sum()  # this device's share

        def adam_step(name: str, optimiser: Any, grads: PyTree) -> tuple[PyTree, PyTree]:
            change, state = optimiser.update(pmean(grads, axis_name), opt_state[name])
            return optax.apply_updates(params[name], change), state

        # critics
        next_action, next_log_prob = squashed_sample(pi(params["actor"], batch.next_obs, cfg), next_key)
        next_q = q_values(params["target_r"], batch.next_obs, next_action, cfg).min(0)
        future = jnp.where(batch.terminated, 0.0, next_q - alpha * next_log_prob)
        y = batch.reward + cfg.discount**batch.steps * future

        def critic_loss(critics: PyTree) -> tuple[jax.Array, jax.Array]:
            q = q_values(critics, batch.obs, batch.action, cfg)
            return mean(((q - y) ** 2).sum(0)), mean(q.mean(0))

        (critic_error, q), grads = jax.value_and_grad(critic_loss, has_aux=True)(params["critic_r"])
        critics, opt_critics = adam_step("critic_r", adam(cfg.critic_lr * share, cfg), grads)

        # policy
        def actor_loss(actor: PyTree) -> tuple[jax.Array, jax.Array]:
            action, log_prob = squashed_sample(pi(actor, batch.obs, cfg), key)
            q = q_values(critics, batch.obs, action, cfg).min(0)
            return mean(alpha * log_prob - q), mean(log_prob)

        (loss, log_prob), grads = jax.value_and_grad(actor_loss, has_aux=True)(params["actor"])
        actor, opt_actor = adam_step("actor", adam(cfg.lr * share, cfg), grads)

        # temperature, and the critics' targets
        too_sure = log_prob + cfg.target_entropy * action_size * batch.weight.sum()
        log_alpha, opt_alpha = adam_step("log_alpha", optax.adam(cfg.alpha_lr), -too_sure)
        targets = optax.incremental_update(critics, params["target_r"], cfg.tau)

        old = {name: params[name] for name in ("actor", "target_r", "log_alpha")}
        new = {"actor": actor, "target_r": targets, "log_alpha": log_alpha}
        old_state = {name: opt_state[name] for name in ("actor", "log_alpha")}
        due = (at.number + 1) % cfg.policy_delay == 0
        new, state = select(due, (new, {"actor": opt_actor, "log_alpha": opt_alpha}), (old, old_state))
        metrics = {"train/critic_loss": critic_error, "train/q": q, "train/actor_loss": loss}
        metrics = pmean(metrics | {"train/entropy": -log_prob}, axis_name)
        nets = Trainable(new | {"critic_r": critics}, state | {"critic_r": opt_critics})
        return nets, metrics | {"train/alpha": alpha}

    return Learner(init=init, act=act, step=step)


def make(env: Env, axis_name: str | None = None) -> Algorithm:
    return off_policy(env, learner(env.action_size), axis_name)


# OmniSafe @15603dd, configs/off-policy/SAC.yaml: of the velocity tasks first. Its gradient step comes
# after every environment step, as here; an update of 50 of them is ours and changes no result.
OMNISAFE: dict[str, Any] = {
    "num_envs": 1,
    "horizon": 50,
    "stagger": False,
    "replay_ratio": 256,
    "batch_size": 256,
    "tau": 0.005,
    "layer_norm": False,
    "obs_normalize": False,
    "alpha_init": 0.2,
    "alpha_lr": 0.0,
    "policy_delay": 2,
}
PUBLISHED: dict[str, dict[str, Any]] = {
    "omnisafe": OMNISAFE,
    "omnisafe_navigation": OMNISAFE | {"alpha_init": 1e-5, "lr": 5e-6, "critic_lr": 1e-3},
    # the published replay ratio with 64 environments: 4 gradient steps for each of their steps
    "parallel": {"num_envs": 64, "replay_ratio": 256, "batch_size": 4096, "tau": 0.005},
}
# for a problem of two levers
LEVER: dict[str, Any] = {
    "num_envs": 32, "horizon": 8, "learn_every": 2, "batch_size": 256, "replay_size": 20_000,
    "learning_starts": 256, "hidden": (32,), "discount": 0.9, "lr": 3e-3, "critic_lr": 3e-3,
    "alpha_init": 0.1, "alpha_lr": 3e-3, "target_entropy": -2.0,
}  # fmt: skip

ROWS = {
    "sac": Row(
        SACConfig,
        make,
        "soft actor-critic, no constraint",
        PUBLISHED,
        holds="nothing",
        lever=LEVER,
    )
}

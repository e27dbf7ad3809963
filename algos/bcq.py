"""Batch-constrained Q-learning, and with a multiplier on cost."""

from functools import partial
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import optax

from jaxsafe.algos import bc
from jaxsafe.config import Amount, Share, config
from jaxsafe.learn.actor_critic import cost_values, init_cost_critics, reduced_costs
from jaxsafe.learn.constraints import each
from jaxsafe.learn.conventions import Convention
from jaxsafe.learn.learner import GradientStep, Learner
from jaxsafe.learn.offline import (
    OfflineCostConfig,
    OfflineTargetConfig,
    constrained,
    descended,
    episode_cost,
    offline,
    step_size,
)
from jaxsafe.learn.replay import Transitions
from jaxsafe.learn.row import Row
from jaxsafe.learn.steps import Trainable, adam
from jaxsafe.learn.treatments import Treatment, lagrangian, no_treatment
from jaxsafe.nn.critics import init_critics, q_values
from jaxsafe.nn.networks import coarse_mlp
from jaxsafe.nn.vae import decode, draw_latent, init_vae
from jaxsafe.types import Algorithm, Env, Metrics, PyTree


@config
class BCQConfig(bc.VAEConfig, OfflineTargetConfig):
    """BCQ: batch-constrained Q-learning, which only considers actions like those of the data.

        a_i = clip(decode(s, z_i) + perturbation tanh(xi(s, decode(s, z_i))), +-1),   z_i drawn
        S = caution min_j Q_j + (1 - caution) max_j Q_j
        y = r + discount (1 - terminated) max_i S'(s', a'_i)
        minimise_Q   E[sum_j (Q_j(s, a) - y)^2]
        maximise_xi  E[Q_1(s, a_1)]
        Q' <- Q' + tau (Q - Q'),   xi' <- xi' + tau (xi - xi')

    j = 1, 2; a'_i are made with xi'. `decode` belongs to a variational autoencoder of the data's
    actions, which learns as in VAE-BC at the same steps. Acts with the a_i of the largest Q_1, out of
    `act_candidates`; for the mean action the z_i are the same at every step.

    Source: Fujimoto, Meger and Precup (2019), "Off-Policy Deep Reinforcement Learning without
    Exploration", arXiv:1812.02900, algorithm 1, and the authors' code.
    Differs from it: batches of 256, as in OmniSafe.
    """

    CONVENTIONS: ClassVar = (
        Convention(
            {"act_candidates": 1},
            "BCQ acts with one action that is drawn",
            "it acts with the best of 100, as in BCQ's code",
        ),
    )

    candidates: Amount = 10  # Actions among which the target takes the best, as in the paper.
    act_candidates: Amount = 100  # Actions among which the policy takes the best, as in BCQ's code.
    perturbation: Share = 0.05  # The largest change of a decoded action, as in the paper.
    caution: Share = 0.75  # The weight of the smaller of two values, as in the paper.


@config
class BCQLagConfig(OfflineCostConfig, BCQConfig):
    """BCQ-Lagrangian: BCQ whose choice among actions pays for cost at an adaptive price.

        i* = argmax_i (S'(s', a'_i) - lam Q'_c(s', a'_i)) / (1 + lam)
        y   = r + discount (1 - terminated) S'(s', a'_i*),     S as in BCQ
        y_c = c + cost_discount (1 - terminated) Q'_c(s', a'_i*)
        minimise_Q    E[sum_j (Q_j(s, a) - y)^2 + sum_j (Q_cj(s, a) - y_c)^2]
        maximise_xi   E[(Q_1(s, a_1) - lam Q_c(s, a_1)) / (1 + lam)]
        minimise_lam  -lam (J_c - cost_limit),  lam >= 0,  by Adam, after each gradient step
        J_c = (1 - cost_discount) T E[Q'_c(s', a'_i*)],   T the steps of an episode

    Acts with the a_i that earns most at the price, out of as many as the target has: out of more it
    would find cheaper ones, and J_c would not be its cost. J_c is of drawn z_i, so `eval/cost_sampled`
    is what to compare it with. The rest is as in BCQ. Values go on after the time
    limit, so J_c is the undiscounted cost of an episode at the rate that Q_c says.

    Source: Liu et al. (2023), "Datasets and Benchmarks for Offline Safe Reinforcement Learning",
    arXiv:2306.09303, for BCQ with a multiplier.
    Differs from it: reward and cost are those of one and the same next action. There and in OmniSafe
    (`cost_target=max`) y has the largest S' and y_c the largest Q'_c among the actions.
    """

    CONVENTIONS: ClassVar = (
        Convention(
            {"cost_target": "max"},
            "BCQ-Lagrangian's targets have the largest value among the next actions, of cost too",
            "both are of the action that earns most at the price",
        ),
    )

    # Actions among which the policy takes the best: as many as the target has, so that J_c is the cost
    # of the policy that acts.
    act_candidates: Amount = 10
    # Whose cost the target has: that of the action that is chosen, or the largest of all.
    cost_target: Literal["chosen", "max"] = "chosen"


def learner(env: Env, treatment: Treatment = no_treatment) -> Learner:
    priced = treatment is not no_treatment
    names = treatment.constrained_costs
    size = env.action_size

    def xi(actor: PyTree, obs: jax.Array, action: jax.Array, cfg: Any) -> jax.Array:
        """`action` [..., A] with its perturbation."""
        out: Any = coarse_mlp(cfg, size).apply(actor, jnp.concatenate([obs, action], -1))
        return jnp.clip(action + cfg.perturbation * jnp.tanh(out), -1.0, 1.0)

    def drawn(vae: PyTree, actor: PyTree, obs: jax.Array, key: jax.Array, count: int, cfg: Any):
        """`count` observations and actions for each of `obs` [..., O]: [..., count, O] and [..., A]."""
        obs = jnp.broadcast_to(obs[..., None, :], (*obs.shape[:-1], count, obs.shape[-1]))
        z = draw_latent(key, (*obs.shape[:-1], 2 * size), cfg)
        return obs, xi(actor, obs, decode(vae, obs, z, cfg), cfg)

    def soft(q: jax.Array, cfg: Any) -> jax.Array:
        return cfg.caution * q.min(0) + (1 - cfg.caution) * q.max(0)

    def worth(
        params: PyTree, q_r: jax.Array, obs: jax.Array, action: jax.Array, dual: PyTree, cfg: Any
    ):
        """What is climbed: q_r, or what is left of it after the price of cost."""
        if not priced:
            return q_r
        return treatment.advantage(
            dual, q_r, reduced_costs(params["critic_c"], obs, action, names(cfg), cfg)
        )

    def init(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> Trainable:
        vae_key, actor_key, critic_key = jax.random.split(key, 3)
        params = {
            "vae": init_vae(vae_key, obs_size, action_size, cfg),
            "actor": coarse_mlp(cfg, size).init(actor_key, jnp.zeros(obs_size + action_size)),
            "critic_r": init_critics(critic_key, obs_size, action_size, 2, cfg),
        }
        if priced:
            cost_key = jax.random.fold_in(critic_key, 1)
            params["critic_c"] = init_cost_critics(cost_key, obs_size, action_size, names(cfg), cfg)
        opt_state = {name: adam(cfg.lr, cfg).init(x) for name, x in params.items()}
        targets = {name: x for name, x in params.items() if name != "vae"}
        return Trainable(params | {"targets": targets}, opt_state)

    def act(params: PyTree, obs: jax.Array, key: jax.Array | None, cfg: Any) -> jax.Array:
        key = jax.random.key(0) if key is None else key  # the same latents at every step
        many, action = drawn(params["vae"], params["actor"], obs, key, cfg.act_candidates, cfg)
        q_r = q_values(params["critic_r"], many, action, cfg)[0]
        best = jnp.argmax(worth(params, q_r, many, action, params.get("dual"), cfg), -1)
        return jnp.take_along_axis(action, best[..., None, None], -2)[..., 0, :]

    def targets_at(params: PyTree, batch: Transitions, dual: PyTree, key: jax.Array, cfg: Any):
        """y [B], y_c [B] or [B, K], and Q'_c(s', a') of the chosen action."""
        targets = params["targets"]
        many, action = drawn(params["vae"], targets["actor"], batch.next_obs, key, cfg.candidates, cfg)
        goes_on = (~batch.terminated).astype(jnp.float32)
        s = soft(q_values(targets["critic_r"], many, action, cfg), cfg)  # [B, candidates]
        if not priced:
            y_r = batch.reward + cfg.discount * goes_on * s.max(-1)
            return y_r, jnp.zeros(()), jnp.zeros(())
        best = jnp.argmax(worth(targets, s, many, action, dual, cfg), -1)[:, None]
        q_c = reduced_costs(targets["critic_c"], many, action, names(cfg), cfg)
        several = each(lambda x: goes_on * x, names(cfg))
        next_c = each(lambda x: jnp.take_along_axis(x, best, 1)[:, 0], names(cfg))(q_c)
        next_r = jnp.take_along_axis(s, best, 1)[:, 0]
        target_c = next_c
        if cfg.cost_target == "max":
            next_r, target_c = s.max(1), q_c.max(1)
        y_r = batch.reward + cfg.discount * goes_on * next_r
        y_c = constrained(batch, names(cfg)) + cfg.cost_discount * several(target_c)
        return y_r, y_c, several(next_c)

    def step(
        nets: Trainable, batch: Transitions, at: GradientStep, cfg: Any, axis_name: str | None
    ) -> tuple[Trainable, Metrics]:
        params, states = nets.params, nets.opt_state
        vae_key, next_key, key = jax.random.split(at.key, 3)

        def only(*which: str) -> dict[str, PyTree]:
            return {name: params[name] for name in which}

        # autoencoder
        def imitation(net: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            return bc.vae_loss(net["vae"], batch, vae_key, cfg)

        lr, critic_lr = step_size(cfg.lr, at, cfg), step_size(cfg.critic_lr, at, cfg)
        new, new_states, metrics = descended(imitation, only("vae"), states, lr, cfg)

        # critics
        y_r, y_c, next_c = targets_at(params | new, batch, at.dual, next_key, cfg)

        def errors(critics: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            q = q_values(critics["critic_r"], batch.obs, batch.action, cfg)
            loss = ((q - y_r) ** 2).sum(0).mean()
            metrics = {"train/critic_loss": loss, "train/q": q.mean()}
            if priced:
                q_c = cost_values(critics["critic_c"], batch.obs, batch.action, names(cfg), cfg)
                loss_c = ((q_c - y_c) ** 2).sum(0).mean(0)
                metrics |= {"train/critic_loss_c": loss_c, "train/q_c": q_c.mean((0, 1))}
                loss += loss_c.sum()
            return loss, metrics

        critics = only("critic_r", "critic_c") if priced else only("critic_r")
        moved, moved_states, found = descended(errors, critics, states, critic_lr, cfg)
        new, new_states, metrics = new | moved, new_states | moved_states, metrics | found

        # perturbation
        z = draw_latent(key, (*batch.action.shape[:-1], 2 * size), cfg)
        likely = decode(new["vae"], batch.obs, z, cfg)

        def loss(net: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            action = xi(net["actor"], batch.obs, likely, cfg)
            q_1 = q_values(new["critic_r"], batch.obs, action, cfg)[0]
            gain = worth(new, q_1, batch.obs, action, at.dual, cfg).mean()
            return -gain, {"train/actor_loss": -gain}

        moved, moved_states, found = descended(loss, only("actor"), states, lr, cfg)
        new, new_states, metrics = new | moved, new_states | moved_states, metrics | found

        aims = {name: new[name] for name in params["targets"]}
        new["targets"] = optax.incremental_update(aims, params["targets"], cfg.tau)
        if priced:
            metrics["train/cost_estimate"] = episode_cost(next_c.mean(0), cfg, env)
        return Trainable(new, new_states), metrics

    return Learner(init=init, act=act, step=step)


def make(env: Env, axis_name: str | None = None, treatment: Treatment = no_treatment) -> Algorithm:
    """`axis_name` splits nothing here: there are no environments."""
    return offline(env, learner(env, treatment), treatment)


# OmniSafe @15603dd, configs/offline: BCQ.yaml, BCQLag.yaml
OMNISAFE: dict[str, Any] = bc.OMNISAFE | {"vae_hidden": (256, 256, 256)}
LAG: dict[str, Any] = {"lam_init": 1.0, "dual_starts": 150_000}
# for a problem of two levers
LEVER: dict[str, Any] = {
    "hidden": (64,), "vae_hidden": (64,), "discount": 0.9, "tau": 0.02, "perturbation": 0.1,
    "latent_clip": 3.0, "kl_weight": 0.05,
}  # fmt: skip

ROWS = {
    "bcq": Row(
        BCQConfig,
        make,
        "Q-learning among actions like those of a data set, no constraint",
        {"omnisafe": OMNISAFE},
        omnisafe="BCQ",
        holds="nothing",
        lever=LEVER,
    ),
    "bcq_lag": Row(
        BCQLagConfig,
        partial(make, treatment=lagrangian),
        "BCQ with an adaptive price on cost",
        {"omnisafe": OMNISAFE | LAG},
        omnisafe="BCQLag",
        lever=LEVER | {"cost_discount": 0.9, "dual_lr": 3e-3, "candidates": 30, "act_candidates": 30},
    ),
}

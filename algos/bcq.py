"""Batch-constrained Q-learning, and with a multiplier on cost."""

from functools import partial
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp

from jaxsafe.algos import bc
from jaxsafe.config import Amount, Share, config
from jaxsafe.learn.acting import Learned
from jaxsafe.learn.constraints import each
from jaxsafe.learn.conventions import Convention
from jaxsafe.learn.critics import (
    Values,
    critic_loss,
    critics_among,
    init_all_critics,
    targets_of,
    while_it_lasts,
    with_reduced_cost,
)
from jaxsafe.learn.learner import GradientStep, Learner
from jaxsafe.learn.offline import (
    OfflineCostConfig,
    OfflineTargetConfig,
    constrained,
    decaying_adam,
    episode_cost,
    offline,
)
from jaxsafe.learn.replay import Transitions
from jaxsafe.learn.row import Row
from jaxsafe.learn.steps import Trainable, descend_each, follow, skipping_adam
from jaxsafe.learn.treatments import Treatment, lagrangian, no_treatment
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
        J_c = (1 - cost_discount) T E[(1 - terminated) Q'_c(s', a'_i*)],   T the steps of an episode

    Acts with the a_i that earns most at the price, out of as many as the target has: out of more it
    would find cheaper ones, and J_c would not be its cost. J_c is of drawn z_i, so `eval/cost_sampled`
    is what to compare it with. Values go on after the time limit, so J_c is the undiscounted cost of an
    episode at the rate that Q_c says. The rest is as in BCQ.

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


class Candidates(NamedTuple):
    """Several actions for each observation: obs [..., count, O] and action [..., count, A]."""

    obs: jax.Array
    action: jax.Array


def soft(q: jax.Array, cfg: Any) -> jax.Array:
    """S, of the values of two critics."""
    return cfg.caution * q.min(0) + (1 - cfg.caution) * q.max(0)


def learner(env: Env, treatment: Treatment = no_treatment) -> Learner:
    names = treatment.constrained_costs
    size = env.action_size

    def init(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> Trainable:
        vae_key, actor_key, critic_key = jax.random.split(key, 3)
        trained = {
            "actor": coarse_mlp(cfg, size).init(actor_key, jnp.zeros(obs_size + action_size)),
            **init_all_critics(critic_key, (obs_size, action_size), 2, treatment, cfg),
        }
        params = trained | {"vae": init_vae(vae_key, obs_size, action_size, cfg)}
        opt_state = {name: skipping_adam(cfg.lr, cfg).init(x) for name, x in params.items()}
        return Trainable(params | {"targets": trained}, opt_state)

    def xi(actor: PyTree, obs: jax.Array, action: jax.Array, cfg: Any) -> jax.Array:
        """`action` [..., A] with its perturbation."""
        out: Any = coarse_mlp(cfg, size).apply(actor, jnp.concatenate([obs, action], -1))
        return jnp.clip(action + cfg.perturbation * jnp.tanh(out), -1.0, 1.0)

    def likely(vae: PyTree, obs: jax.Array, key: jax.Array, cfg: Any) -> jax.Array:
        """An action like those of the data for each of `obs` [..., O]."""
        return decode(vae, obs, draw_latent(key, (*obs.shape[:-1], 2 * size), cfg), cfg)

    def candidates(params: PyTree, obs: jax.Array, key: jax.Array, count: int, cfg: Any) -> Candidates:
        """`count` of them, by the networks `vae` and `actor` among `params`."""
        obs = jnp.broadcast_to(obs[..., None, :], (*obs.shape[:-1], count, obs.shape[-1]))
        return Candidates(obs, xi(params["actor"], obs, likely(params["vae"], obs, key, cfg), cfg))

    def act(learned: Learned, obs: jax.Array, key: jax.Array | None) -> jax.Array:
        params, cfg = learned.params, learned.config
        key = jax.random.key(0) if key is None else key  # the same latents at every step
        choice = candidates(params, obs, key, cfg.act_candidates, cfg)
        q_r, q_c = with_reduced_cost(params, *choice, names(cfg), cfg)
        best = jnp.argmax(treatment.advantage(learned.dual, q_r[0], q_c), -1)
        return jnp.take_along_axis(choice.action, best[..., None, None], -2)[..., 0, :]

    def next_values(
        params: PyTree, batch: Transitions, dual: PyTree, key: jax.Array, cfg: Any
    ) -> tuple[Values, jax.Array]:
        """S' and Q'_c as the targets take them, and Q'_c of the chosen action."""
        targets = params["targets"]
        choice = candidates(targets | {"vae": params["vae"]}, batch.next_obs, key, cfg.candidates, cfg)
        q_r, q_c = with_reduced_cost(targets, *choice, names(cfg), cfg)
        s = soft(q_r, cfg)  # [B, candidates]
        best = jnp.argmax(treatment.advantage(dual, s, q_c), -1)[:, None]

        def chosen(x: jax.Array) -> jax.Array:
            return jnp.take_along_axis(x, best, 1)[:, 0]

        next_c = each(chosen, names(cfg))(q_c)
        if treatment is not no_treatment and cfg.cost_target == "max":
            return Values(s.max(1), q_c.max(1)), next_c
        return Values(chosen(s), next_c), next_c

    def step(
        nets: Trainable, batch: Transitions, at: GradientStep, cfg: Any, axis_name: str | None
    ) -> tuple[Trainable, Metrics]:
        vae_key, next_key, key = jax.random.split(at.key, 3)
        policy_adam = decaying_adam(cfg.lr, at, cfg)

        # autoencoder
        def imitation(net: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            return bc.vae_loss(net["vae"], batch, vae_key, cfg)

        nets, metrics = descend_each(imitation, nets, {"vae": policy_adam})

        # critics
        after, next_c = next_values(nets.params, batch, at.dual, next_key, cfg)
        y = targets_of(batch, constrained(batch, names(cfg)), after, names(cfg), cfg)

        def errors(critics: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            return critic_loss(critics, batch, y, names(cfg), cfg)

        adams = dict.fromkeys(critics_among(nets.params), decaying_adam(cfg.critic_lr, at, cfg))
        nets, found = descend_each(errors, nets, adams)
        metrics |= found

        # perturbation
        params, unperturbed = nets.params, likely(nets.params["vae"], batch.obs, key, cfg)

        def loss(net: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            action = xi(net["actor"], batch.obs, unperturbed, cfg)
            q_r, q_c = with_reduced_cost(params, batch.obs, action, names(cfg), cfg)
            gain = treatment.advantage(at.dual, q_r[0], q_c).mean()
            return -gain, {"train/actor_loss": -gain}

        nets, found = descend_each(loss, nets, {"actor": policy_adam})
        metrics |= found
        if treatment is not no_treatment:
            paid = batch.mean(while_it_lasts(batch, next_c))
            metrics["train/cost_estimate"] = episode_cost(paid, cfg, env)
        return follow(nets, cfg.tau), metrics

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

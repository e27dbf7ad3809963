"""Critic-regularised regression, and with a multiplier on cost."""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp

from jaxsafe.algos import bc
from jaxsafe.config import Amount, Bounds, Cap, Real, config
from jaxsafe.learn.acting import Learned
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
from jaxsafe.learn.treatments import Treatment, lagrangian, no_treatment, price_of
from jaxsafe.nn.bounded import bounded_action, bounded_policy, init_bounded
from jaxsafe.nn.gaussian import log_prob
from jaxsafe.types import Algorithm, Env, Metrics, PyTree


@config
class CRRConfig(OfflineTargetConfig):
    """CRR: critic-regularised regression, which imitates actions by how much better they are.

        A(s, a) = min_j Q_j(s, a) - mean_i min_j Q_j(s, a_i),   a_i ~ pi(s)
        maximise_pi  E[min(exp(A(s, a) / temperature), weight_max) log pi(a | s)]
        y = r + discount (1 - terminated) clip(min_j Q'_j(s', a'), low, high),   a' ~ pi'(s')
        minimise_Q   E[sum_j (Q_j(s, a) - y)^2]
        Q' <- Q' + tau (Q - Q'),   pi' <- pi' + tau (pi - pi')

    j = 1, 2. The policy is a Gaussian about a mean in (-1, 1); its samples are clipped to [-1, 1].
    low = min(0, r_min) / (1 - discount) and high = max(0, r_max) / (1 - discount), of the least and the
    largest reward of the data. Without these bounds values run away where the policy draws actions that
    the data lack.

    Source: Wang et al. (2020), "Critic Regularized Regression", arXiv:2006.15134, algorithm 1 with the
    weights exp and the advantage's mean.
    Differs from it: the critics are twins instead of one that is distributional, whose values have
    bounds of their own, and the policy is one Gaussian instead of several, as in OmniSafe. The targets
    follow at each step.
    """

    # A by which the weight grows e-fold, in units of the return, as in the paper.
    temperature: Annotated[float, Bounds(1e-6, 1e6)] = 1.0
    weight_max: Cap = 20.0  # The largest weight, as in the paper. OmniSafe has none.
    actions: Amount = 4  # Actions of the policy over which the mean is taken, as in the paper.
    # The log standard deviation of actions at first, as in OmniSafe.
    init_log_std: Real = 0.0


@config
class CCRRConfig(OfflineCostConfig, CRRConfig):
    """C-CRR: constrained CRR, whose weights pay for cost at an adaptive price.

        A(s, a) = A_r(s, a) - lam A_c(s, a),   A_r as A in CRR,   A_c = Q_c(s, a) - mean_i Q_c(s, a_i)
        y_c = c + cost_discount (1 - terminated) Q'_c(s', a'),    a' as in CRR
        minimise_Q    E[sum_j (Q_cj(s, a) - y_c)^2], and the loss of Q as in CRR
        minimise_lam  -lam (J_c - cost_limit),  lam >= 0,  by Adam, after each gradient step
        J_c = (1 - cost_discount) T E[(1 - terminated) Q'_c(s', a')],   T the steps of an episode

    The rest is as in CRR. Q'_c is clipped likewise in y_c and in J_c, by the costs of the data. Values
    go on after the time limit, so J_c is the undiscounted cost of an episode at the rate that Q_c says.

    Source: CRR of Wang et al. (2020), arXiv:2006.15134, with the multiplier of OmniSafe's CCRR.
    Differs from OmniSafe: there values have no bounds, the critic of reward also learns the costs, and
    the critic of cost learns nothing. Its published numbers depend on that (`compat=omnisafe`). With
    `cost_critic=idle` Q_c stays what it is at first. A second step moves Q towards y_c:

        y_c = c + discount (1 - terminated) min_j Q'_j(s', a')
        A_c = Q_c(s, a) - V(s),   V(s) = mean_i min_j Q_j(s, a_i)
        J_c = (1 - cost_discount) T E[V(s)]
    """

    CONVENTIONS: ClassVar = (
        Convention(
            {"cost_critic": "idle"},
            "in C-CRR the critic of reward learns the costs, too, and the critic of cost nothing",
            "each critic learns its own",
        ),
    )

    # What the critic of cost learns. own: the costs. idle: nothing, as in OmniSafe.
    cost_critic: Literal["own", "idle"] = "own"


def learner(env: Env, treatment: Treatment = no_treatment) -> Learner:
    names = treatment.constrained_costs

    def init(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> Trainable:
        actor_key, critic_key = jax.random.split(key)
        params = {
            "actor": init_bounded(actor_key, obs_size, action_size, cfg),
            **init_all_critics(critic_key, (obs_size, action_size), 2, treatment, cfg),
        }
        opt_state = {name: skipping_adam(cfg.lr, cfg).init(x) for name, x in params.items()}
        return Trainable(params | {"targets": params}, opt_state)

    def act(learned: Learned, obs: jax.Array, key: jax.Array | None) -> jax.Array:
        return bounded_action(bounded_policy(learned.params["actor"], obs, learned.config), key)

    def next_values(targets: PyTree, batch: Transitions, key: jax.Array, cfg: Any) -> Values:
        """Q'(s', a') and Q'_c(s', a')."""
        action = bounded_action(bounded_policy(targets["actor"], batch.next_obs, cfg), key)
        return lowest(targets, batch.next_obs, action, cfg)

    def lowest(params: PyTree, obs: jax.Array, action: jax.Array, cfg: Any) -> Values:
        """The lowest Q_r, and Q_c."""
        q_r, q_c = with_reduced_cost(params, obs, action, names(cfg), cfg)
        return Values(q_r.min(0), q_c)

    def advantages(
        params: PyTree, batch: Transitions, key: jax.Array, cfg: Any
    ) -> tuple[Values, Values]:
        """By how much the data's actions are better than the policy's, A_r and A_c; and what the
        policy's are worth."""
        dist = bounded_policy(params["actor"], batch.obs, cfg)
        keys = jax.random.split(key, cfg.actions)
        drawn = jax.vmap(lambda key: bounded_action(dist, key))(keys)  # [actions, B, A]

        def of_actions(action: jax.Array) -> Values:
            return lowest(params, batch.obs, action, cfg)

        here = of_actions(batch.action)
        there = jax.tree.map(lambda x: x.mean(0), jax.vmap(of_actions)(drawn))
        if idle(cfg):  # Q_r in place of each Q_c
            there = there._replace(cost=jnp.broadcast_to(there.reward, here.cost.T.shape).T)
        return jax.tree.map(jnp.subtract, here, there), there

    def step(
        nets: Trainable, batch: Transitions, at: GradientStep, cfg: Any, axis_name: str | None
    ) -> tuple[Trainable, Metrics]:
        next_key, key = jax.random.split(at.key)

        # critics
        after = next_values(nets.params["targets"], batch, next_key, cfg)
        if at.ranges and not idle(cfg):  # OmniSafe's have no bounds
            after = Values(*(jnp.clip(x, *ends) for x, ends in zip(after, at.ranges, strict=True)))
        charged = constrained(batch, names(cfg))
        y = targets_of(batch, charged, after, names(cfg), cfg)
        adam = decaying_adam(cfg.critic_lr, at, cfg)

        def toward(y: Values) -> Callable[[dict[str, PyTree]], tuple[jax.Array, Metrics]]:
            return lambda critics: critic_loss(critics, batch, y, names(cfg), cfg)

        if idle(cfg):
            paid = charged.sum(-1) if names(cfg) else charged
            later = cfg.discount * while_it_lasts(batch, after.reward)
            nets, metrics = descend_each(toward(y), nets, {"critic_r": adam})
            nets, of_cost = descend_each(
                toward(y._replace(reward=paid + later)), nets, {"critic_r": adam}
            )
            metrics["train/critic_loss_c"] = of_cost["train/critic_loss"]
        else:
            nets, metrics = descend_each(
                toward(y), nets, dict.fromkeys(critics_among(nets.params), adam)
            )

        # policy
        better, drawn = advantages(nets.params, batch, key, cfg)
        better = treatment.advantage(at.dual, *better)
        weight = jnp.minimum(jnp.exp(better / cfg.temperature), cfg.weight_max)

        def loss(net: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            log_pi = log_prob(bounded_policy(net["actor"], batch.obs, cfg), batch.action)
            loss = -(weight * log_pi).mean()
            return loss, {"train/actor_loss": loss, "train/weight": weight.mean()}

        nets, found = descend_each(loss, nets, {"actor": decaying_adam(cfg.lr, at, cfg)})
        metrics |= found
        if treatment is not no_treatment:
            cost = drawn.cost if idle(cfg) else while_it_lasts(batch, after.cost)
            metrics["train/cost_estimate"] = episode_cost(batch.mean(cost), cfg, env)
        return follow(nets, cfg.tau), metrics

    return Learner(init=init, act=act, step=step)


def idle(cfg: Any) -> bool:
    """Whether the critic of cost learns nothing; CRR has none."""
    return getattr(cfg, "cost_critic", "own") == "idle"


def minus_price(dual: Any, adv_r: jax.Array, adv_c: jax.Array) -> jax.Array:
    """A = A_r - sum_i lam_i A_ci: the temperature sets the scale of A, so that nothing divides it."""
    return adv_r - price_of(adv_c, dual)


unscaled = lagrangian._replace(advantage=minus_price)


def make(env: Env, axis_name: str | None = None, treatment: Treatment = no_treatment) -> Algorithm:
    """`axis_name` splits nothing here: there are no environments."""
    return offline(env, learner(env, treatment), treatment)


# OmniSafe @15603dd, configs/offline: CRR.yaml, CCRR.yaml
OMNISAFE: dict[str, Any] = bc.OMNISAFE | {"actions": 10, "weight_max": float("inf")}
# for a problem of two levers
LEVER: dict[str, Any] = {"hidden": (64,), "discount": 0.9, "tau": 0.02, "temperature": 0.05}

ROWS = {
    "crr": Row(
        CRRConfig,
        make,
        "regression on the better actions of a data set, no constraint",
        {"omnisafe": OMNISAFE},
        omnisafe="CRR",
        holds="nothing",
        lever=LEVER,
    ),
    "ccrr": Row(
        CCRRConfig,
        partial(make, treatment=unscaled),
        "CRR with an adaptive price on cost",
        {"omnisafe": OMNISAFE | {"lam_init": 1.0, "dual_starts": 150_000}},
        omnisafe="CCRR",
        lever=LEVER | {"cost_discount": 0.9, "dual_lr": 5e-4, "temperature": 0.1},
    ),
}

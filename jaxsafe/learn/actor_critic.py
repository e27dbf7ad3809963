"""Gradient steps of an actor and its critics on transitions from a replay.

    y_r = r + discount^n (1 - terminated) (min_i Q'_i(s', a') + bonus'),    a' the method's next action
    y_c = c + cost_discount^n (1 - terminated) reduce_j Q'_cj(s', a')
    minimise_Q   E[sum_i (Q_i(s, a) - y_r)^2 + sum_j (Q_cj(s, a) - y_c)^2]
    maximise_pi  E[(Q_r / unit - lam Q_c) / (1 + lam)],   Q_r = pick_i Q_i(s, a) + bonus,
                                                          Q_c = reduce_j Q_cj(s, a),   a from pi(s)
    Q' <- Q' + tau (Q - Q')

The methods differ in a', in what is picked and in the bonus, which is an entropy or 0: see `Actor`. How
Q_r and Q_c are mixed is the treatment's: (Q_r / unit - lam Q_c) / (1 + lam) is a Lagrangian's. The unit
is the standard deviation of Q_r over the batch, or 1: see `price_unit`. A limit is on the undiscounted
cost of an episode; Q_c, which is discounted, only gives the direction.
"""

from collections.abc import Callable
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxsafe.config import Iterations, Rate, Weight, config
from jaxsafe.learn.batch import pmean, select
from jaxsafe.learn.constraints import Names, each, metrics_by_constraint, signal
from jaxsafe.learn.conventions import Convention
from jaxsafe.learn.learner import GradientStep, Learner
from jaxsafe.learn.normalise import CLIP, MIN_STD
from jaxsafe.learn.off_policy import OffPolicyConfig, PriceClockConfig
from jaxsafe.learn.replay import Transitions
from jaxsafe.learn.sequences import averaged, no_moments, standard
from jaxsafe.learn.steps import Trainable, adam
from jaxsafe.learn.treatments import LagrangianConfig, PIDConfig, Treatment, no_treatment
from jaxsafe.nn.critics import init_critics, q_values
from jaxsafe.types import Env, Metrics, PyTree


@config
class ActorCriticConfig(OffPolicyConfig):
    """What the actor-critic methods share."""

    # Gradient steps of the critics for each one of the policy and the targets.
    policy_delay: Iterations = 1


@config
class CostCriticConfig(PriceClockConfig):
    """For the methods whose actor weighs reward against cost."""

    CONVENTIONS: ClassVar = (
        Convention({"cost_reduce": "one"}, "there is one critic of cost", "there are two"),
        Convention(
            {"price_unit": "reward"},
            "a price of 1 weighs one unit of cost as one of reward",
            "it weighs one unit of cost as a standard deviation of Q_r",
        ),
        Convention(
            {"cost_action": "mean"},
            "targets of cost take the policy's mean action, without noise",
            "targets of cost take the same next action as those of reward",
        ),
        Convention(
            {"cost_centre": True},
            "`cost_normalize` takes the mean from costs, so that a step without cost pays",
            "`cost_normalize` only scales costs",
        ),
    )

    # How the values of two cost critics become one. max is cautious: its estimates are too high. With
    # mean the policy finds actions whose cost is estimated too low, below 0 even, and on point_goal1 it
    # then stops learning. one: a single critic, as in OmniSafe.
    cost_reduce: Literal["mean", "max", "one"] = "max"
    # What a price of 1 on one unit of cost weighs as much as. deviation: the standard deviation of Q_r
    # over the batch, so that one step of the price suits rewards of any size. reward: one unit of
    # reward, as in OmniSafe.
    price_unit: Literal["deviation", "reward"] = "deviation"
    # The next action in the targets of cost. next: that of reward's. mean: the policy's mean action, as
    # in OmniSafe.
    cost_action: Literal["next", "mean"] = "next"
    # Whether the critics see costs in standard deviations of those replayed so far. OmniSafe's do on
    # velocity tasks.
    cost_normalize: bool = False
    # Whether `cost_normalize` also takes the mean from costs. OmniSafe's does.
    cost_centre: bool = False


@config
class MultiplierConfig(LagrangianConfig, CostCriticConfig):
    """For `lagrangian`."""

    # Adam's step of the price, whatever the size of the violation. A policy answers a price only after
    # some hundred thousand steps: on point_goal1 a step of 0.03 ends in policies that stand still.
    dual_lr: Rate = 0.01


@config
class ControllerConfig(PIDConfig, CostCriticConfig):
    """For `pid`."""

    pid_kp: Weight = 0.004  # Price for each unit of the smoothed violation.
    # Price that each unit of violation adds a move. 25 units add as much as the multiplier's step.
    pid_ki: Weight = 4e-4
    pid_kd: Weight = 0.004  # Price for each unit that the smoothed cost rose.


class Proposal(NamedTuple):
    """Actions [B, A] of the policy that is trained; bonus [B], what Q_r earns besides; extra [B], a
    loss of the method's own that is added; metrics, [B] each."""

    action: jax.Array
    bonus: jax.Array
    extra: jax.Array
    metrics: dict[str, jax.Array]


class Actor(NamedTuple):
    """What one method adds to another's actor and critics.

    Its parameters are a dict, `{'actor': ..., ...}`: all that the loss of the policy trains.

    critics: the number of reward critics. Targets take the smallest of their values.
    followed: names of its parameters that have targets, beside the critics.
    init(key, obs_size, action_size, cfg) -> parameters.
    optimisers(cfg, share) -> an optimiser for each of their names; share [] of the learning rates.
    act(parameters, obs [..., O], key, cfg) -> action [..., A], the mean one where key is None.
    next_action(parameters, targets, obs [B, O], key, cfg) -> a' [B, A] and bonus' [B].
    propose(parameters, obs [B, O], key, cfg) -> Proposal.
    pick(q [critics, B]) -> [B], what the policy climbs.
    explore: see `Learner`.
    """

    critics: int
    followed: tuple[str, ...]
    init: Callable[[jax.Array, int, int, Any], dict[str, PyTree]]
    optimisers: Callable[[Any, jax.Array | float], dict[str, optax.GradientTransformation]]
    act: Callable[[dict[str, PyTree], jax.Array, jax.Array | None, Any], jax.Array]
    next_action: Callable[..., tuple[jax.Array, jax.Array]]
    propose: Callable[[dict[str, PyTree], jax.Array, jax.Array, Any], Proposal]
    pick: Callable[[jax.Array], jax.Array]
    explore: Callable[[PyTree, jax.Array, jax.Array, Any], jax.Array] | None = None


def actor_critic(env: Env, actor: Actor, treatment: Treatment) -> Learner:
    """The learner that `actor` makes. Without a treatment there are no critics of cost."""
    constrained = treatment is not no_treatment

    names = treatment.constrained_costs

    def init(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> Trainable:
        actor_key, critic_key = jax.random.split(key)
        own = actor.init(actor_key, obs_size, action_size, cfg)
        critics = {"critic_r": init_critics(critic_key, obs_size, action_size, actor.critics, cfg)}
        if constrained:
            critics["critic_c"] = init_cost_critics(
                jax.random.fold_in(critic_key, 1), obs_size, action_size, names(cfg), cfg
            )
        optimisers = actor.optimisers(cfg, 1.0) | dict.fromkeys(critics, adam(cfg.critic_lr, cfg))
        trained = own | critics
        opt_state: dict[str, Any] = {
            name: optimisers[name].init(params) for name, params in trained.items()
        }
        if constrained and cfg.cost_normalize:
            opt_state["cost_scale"] = no_moments(max(len(names(cfg)), 1))
        targets = critics | {name: own[name] for name in actor.followed}
        return Trainable(trained | {"targets": targets}, opt_state)

    def step(
        nets: Trainable, batch: Transitions, at: GradientStep, cfg: Any, axis_name: str | None
    ) -> tuple[Trainable, Metrics]:
        params, targets = nets.params, nets.params["targets"]
        next_key, key = jax.random.split(at.key)
        share = at.remaining if cfg.lr_decay else 1.0

        def mean(x: jax.Array) -> jax.Array:
            return (batch.weight * x).sum()  # this device's share

        # critics
        next_action, bonus = actor.next_action(params, targets, batch.next_obs, next_key, cfg)
        goes_on = ~batch.terminated
        next_q = q_values(targets["critic_r"], batch.next_obs, next_action, cfg).min(0)
        y_r = batch.reward + cfg.discount**batch.steps * jnp.where(goes_on, next_q + bonus, 0.0)
        critics = {"critic_r": params["critic_r"]}
        y_c, scale = jnp.zeros(()), ()
        if constrained:
            critics["critic_c"] = params["critic_c"]
            if cfg.cost_action == "mean":
                next_action = actor.act(params, batch.next_obs, None, cfg)
            next_c = reduced_costs(targets["critic_c"], batch.next_obs, next_action, names(cfg), cfg)
            charged = signal(env, batch, names(cfg))
            if cfg.cost_normalize:
                costs = charged.reshape(*batch.reward.shape, -1)
                scale = averaged(nets.opt_state["cost_scale"], costs, batch.weight, axis_name, memory=1)
                charged = standard(scale, costs, cfg.cost_centre, MIN_STD, CLIP).reshape(charged.shape)
            ahead = (cfg.cost_discount**batch.steps * goes_on).reshape(-1, *(1,) * (charged.ndim - 1))
            y_c = charged + ahead * next_c

        def critic_loss(critics: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            q = q_values(critics["critic_r"], batch.obs, batch.action, cfg)
            loss = mean(((q - y_r) ** 2).sum(0))
            metrics = {"train/critic_loss": loss, "train/q": mean(q.mean(0))}
            if constrained:
                q_c = cost_values(critics["critic_c"], batch.obs, batch.action, names(cfg), cfg)
                mean_c = each(mean, names(cfg))
                loss_c = mean_c(((q_c - y_c) ** 2).sum(0))
                metrics |= {"train/critic_loss_c": loss_c, "train/q_c": mean_c(q_c.mean(0))}
                loss += loss_c.sum()
            return loss, metrics

        grads, metrics = jax.grad(critic_loss, has_aux=True)(critics)

        def moved(trained: dict[str, PyTree], grads: dict[str, PyTree], optimisers: dict[str, Any]):
            """(parameters, states of the optimisers) after a step along `grads`."""
            new, states = {}, {}
            for name, gradient in pmean(grads, axis_name).items():
                change, states[name] = optimisers[name].update(gradient, nets.opt_state[name])
                new[name] = optax.apply_updates(trained[name], change)
            return new, states

        adam_c = adam(cfg.critic_lr * share, cfg)
        critics, critic_states = moved(critics, grads, dict.fromkeys(critics, adam_c))

        def unit(worth: jax.Array) -> jax.Array:
            """What a price of 1 on one unit of cost is worth, float []."""
            if cfg.price_unit == "reward":
                return jnp.ones(())
            centre = pmean(mean(worth), axis_name)
            variance = pmean(mean((worth - centre) ** 2), axis_name)
            return jax.lax.stop_gradient(jnp.sqrt(variance + 1e-12))

        # policy
        def policy_loss(own: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            proposal = actor.propose(own, batch.obs, key, cfg)
            q_r = actor.pick(q_values(critics["critic_r"], batch.obs, proposal.action, cfg))
            worth = q_r + proposal.bonus
            if constrained:
                q_c = reduced_costs(critics["critic_c"], batch.obs, proposal.action, names(cfg), cfg)
                worth = treatment.advantage(at.dual, worth / unit(worth), q_c)
            loss = -mean(worth)
            metrics = {"train/actor_loss": loss, **jax.tree.map(mean, proposal.metrics)}
            return loss + mean(proposal.extra), metrics

        own = {name: params[name] for name in actor.optimisers(cfg, share)}
        grads, policy_metrics = jax.grad(policy_loss, has_aux=True)(own)
        new, states = moved(own, grads, actor.optimisers(cfg, share))

        # targets follow, where the policy moves
        aims = critics | {name: new[name] for name in actor.followed}
        followed = optax.incremental_update(aims, targets, cfg.tau)
        old_states = {name: nets.opt_state[name] for name in own}
        due = (at.number + 1) % cfg.policy_delay == 0
        new, states = select(
            due,
            (new | {"targets": followed}, states),
            (own | {"targets": targets}, old_states),
        )
        metrics = pmean(metrics | policy_metrics, axis_name)
        metrics = metrics_by_constraint(metrics, names(cfg))
        scales = {"cost_scale": scale} if constrained and cfg.cost_normalize else {}
        return Trainable(new | critics, states | critic_states | scales), metrics

    return Learner(init=init, act=actor.act, step=step, explore=actor.explore)


# ---- critics of cost ---------------------------------------------------------------------------


def init_cost_critics(
    key: jax.Array, obs_size: int, action_size: int, names: Names, cfg: Any
) -> PyTree:
    """Stacked, leaves [J, ...]; of several constraints [K, J, ...]."""
    count = 1 if cfg.cost_reduce == "one" else 2

    def of_one(key: jax.Array) -> PyTree:
        return init_critics(key, obs_size, action_size, count, cfg)

    return jax.vmap(of_one)(jax.random.split(key, len(names))) if names else of_one(key)


def cost_values(
    critics: PyTree, obs: jax.Array, action: jax.Array, names: Names, cfg: Any
) -> jax.Array:
    """Q_c of each critic, float [J, B]; of several constraints [J, B, K]."""

    def of_one(critics: PyTree) -> jax.Array:
        return q_values(critics, obs, action, cfg)

    return jax.vmap(of_one, out_axes=-1)(critics) if names else of_one(critics)


def reduced_costs(
    critics: PyTree, obs: jax.Array, action: jax.Array, names: Names, cfg: Any
) -> jax.Array:
    """Q_c, float [B] or [B, K]."""
    q_c = cost_values(critics, obs, action, names, cfg)
    return q_c.max(0) if cfg.cost_reduce == "max" else q_c.mean(0)

"""Gradient steps of an actor and its critics on transitions from a replay.

    y_r = r + discount^n (1 - terminated) (min_i Q'_i(s', a') + bonus'),    a' the method's next action
    y_c = c + cost_discount^n (1 - terminated) reduce_j Q'_cj(s', a')
    minimise_Q   E[sum_i (Q_i(s, a) - y_r)^2 + sum_j (Q_cj(s, a) - y_c)^2]
    maximise_pi  E[(Q_r / unit - lam Q_c) / (1 + lam)],   Q_r = pick_i Q_i(s, a) + bonus,
                                                          Q_c = reduce_j Q_cj(s, a),   a from pi(s)
    Q' <- Q' + tau (Q - Q')

With `encoder=cnn` s is what a network makes of the picture. The critics' loss trains it, and the
policy's does not.

The methods differ in a', in what is picked and in the bonus, which is an entropy or 0: see `Actor`. How
Q_r and Q_c are mixed is the treatment's: (Q_r / unit - lam Q_c) / (1 + lam) is a Lagrangian's. The unit
is the standard deviation of Q_r over the batch, or 1: see `price_unit`. Where the method weighs cost, a
reduced Q_c or Q'_c below 0 counts as 0, unless `cost_floor` is off. A limit is on the undiscounted cost
of an episode; Q_c, which is discounted, only gives the direction.
"""

from collections.abc import Callable
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxsafe.config import Amount, Iterations, Rate, Share, Weight, config
from jaxsafe.learn.acting import Learned
from jaxsafe.learn.batch import pmean
from jaxsafe.learn.bill import PriceClockConfig
from jaxsafe.learn.constraints import metrics_by_constraint, signal
from jaxsafe.learn.conventions import Convention
from jaxsafe.learn.critics import (
    Values,
    critic_loss,
    critics_among,
    init_all_critics,
    targets_of,
    with_reduced_cost,
)
from jaxsafe.learn.learner import GradientStep, Learner
from jaxsafe.learn.normalise import CLIP, MIN_STD, averaged, no_moments, standard
from jaxsafe.learn.observations import EncoderConfig, features, init_features
from jaxsafe.learn.off_policy import OffPolicyConfig
from jaxsafe.learn.replay import Transitions
from jaxsafe.learn.steps import Trainable, adam, descend_each, follow
from jaxsafe.learn.treatments import DampedConfig, PIDConfig, Treatment, no_treatment
from jaxsafe.types import Env, Metrics, PyTree


@config
class ActorCriticConfig(EncoderConfig, OffPolicyConfig):
    """What the actor-critic methods share.

    The learning rates and `tau` are for batches of 4,096. Against OmniSafe's batches of 256 the rates
    grow less than the batch, and the targets follow faster.
    """

    # Environments side by side, of all devices together. OmniSafe has 1.
    num_envs: Amount = 2048
    lr: Rate = 6e-4  # The policy's learning rate, by Adam. OmniSafe has 3e-4.
    critic_lr: Rate = 6e-4  # The critics' learning rate, by Adam. OmniSafe has 3e-4.
    # The share of the critics that their targets take on at each step. OmniSafe has 0.005.
    tau: Share = 0.04
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
        Convention(
            {"cost_floor": False},
            "values of cost may be below 0",
            "they count as 0 there",
        ),
    )

    # How the values of two cost critics become one. max is cautious: it takes estimates that are too
    # high. one: a single critic, as in OmniSafe.
    cost_reduce: Literal["mean", "max", "one"] = "mean"
    # Whether a Q_c below 0 counts as 0, because no cost is negative. Without it the policy finds
    # actions whose cost is estimated far too low. Costs that `cost_centre` centres have values below 0:
    # switch it off for them.
    cost_floor: bool = True
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
class MultiplierConfig(DampedConfig, CostCriticConfig):
    """For `damped_lagrangian`."""

    CONVENTIONS: ClassVar = (
        Convention(
            {"dual_damping": 0.0, "dual_eps": 1e-8},
            "the price is the multiplier, which moves by about `dual_lr` at any violation",
            "the price also follows the violation at once, and a small one moves the multiplier little",
        ),
    )

    # Adam's step of the multiplier where the violation is far above `dual_eps`. A policy answers a
    # price only after some hundred thousand steps.
    dual_lr: Rate = 0.01


@config
class ControllerConfig(PIDConfig, CostCriticConfig):
    """For `pid`."""

    # Price for each unit of the smoothed violation: 30 units raise it by 0.3 deviations of Q_r at once.
    pid_kp: Weight = 0.01
    # Price that each unit of violation adds at each move. It takes 50 moves to add as much as `pid_kp`.
    # So the proportional part comes first, and damps the sum.
    pid_ki: Weight = 2e-4
    pid_kd: Weight = 0.004  # Price for each unit that the smoothed cost rose.
    # Share of the past in the smoothed violation. With 0.95 a price reacts 20 moves late.
    pid_smoothing: Share = 0.8


class Proposal(NamedTuple):
    """What the policy that is trained would do.

    action: float [B, A]. bonus: float [B], what is added to Q_r, such as an entropy. extra: float [B],
    a further loss of the method, such as that of a temperature. metrics: float [B] each.
    """

    action: jax.Array
    bonus: jax.Array
    extra: jax.Array
    metrics: dict[str, jax.Array]


class Actor(NamedTuple):
    """What a method adds to the gradient step that all of them share.

    Its parameters are a dict, `{'actor': ..., ...}`: all that the loss of the policy trains.

    critics: the number of reward critics. Targets take the smallest of their values.
    followed: names of its parameters that have targets, beside the critics.
    init(key, obs_size, action_size, cfg) -> parameters.
    optimisers(cfg, share) -> an optimiser for each of their names; share [] of the learning rates.
    act(parameters, obs [..., O], key, cfg) -> action [..., A], the mean one where key is None.
    next_action(parameters, targets, obs [B, O], key, cfg) -> a' [B, A] and bonus' [B].
    propose(parameters, obs [B, O], key, cfg) -> Proposal.
    pick(q [critics, B]) -> [B], what the policy climbs.
    explore(parameters, obs [N, O], key, cfg, remaining): see `Learner`.
    """

    critics: int
    followed: tuple[str, ...]
    init: Callable[[jax.Array, int, int, Any], dict[str, PyTree]]
    optimisers: Callable[[Any, jax.Array | float], dict[str, optax.GradientTransformation]]
    act: Callable[[dict[str, PyTree], jax.Array, jax.Array | None, Any], jax.Array]
    next_action: Callable[
        [dict[str, PyTree], dict[str, PyTree], jax.Array, jax.Array, Any], tuple[jax.Array, jax.Array]
    ]
    propose: Callable[[dict[str, PyTree], jax.Array, jax.Array, Any], Proposal]
    pick: Callable[[jax.Array], jax.Array]
    explore: Callable[[PyTree, jax.Array, jax.Array, Any, jax.Array], jax.Array] | None = None


def actor_critic(env: Env, actor: Actor, treatment: Treatment) -> Learner:
    """The learner that `actor` makes. Without a treatment there are no critics of cost."""
    names = treatment.constrained_costs

    def init(key: jax.Array, obs_size: int, action_size: int, cfg: Any) -> Trainable:
        actor_key, critic_key = jax.random.split(key)
        encoder, seen = init_features(jax.random.fold_in(key, 1), env, obs_size, cfg)
        parts = actor.init(actor_key, seen, action_size, cfg)
        sizes = seen, action_size
        critics = init_all_critics(critic_key, sizes, actor.critics, treatment, cfg)
        valued = critics | encoder  # what the critics' loss trains
        optimisers = actor.optimisers(cfg, 1.0) | dict.fromkeys(valued, adam(cfg.critic_lr, cfg))
        trained = parts | valued
        opt_state = {name: optimisers[name].init(params) for name, params in trained.items()}
        if treatment is not no_treatment and cfg.cost_normalize:
            opt_state["cost_scale"] = no_moments(max(len(names(cfg)), 1))
        targets = critics | {name: parts[name] for name in actor.followed}
        return Trainable(trained | {"targets": targets}, opt_state)

    def step(
        nets: Trainable, batch: Transitions, at: GradientStep, cfg: Any, axis_name: str | None
    ) -> tuple[Trainable, Metrics]:
        critic_key, policy_key = jax.random.split(at.key)
        share = at.remaining if cfg.lr_decay else 1.0
        charged, nets = charged_in(nets, batch, cfg, axis_name)
        y = targets_at(nets.params, batch, charged, critic_key, cfg)
        encoder = ["encoder"] if "encoder" in nets.params else []
        adams = dict.fromkeys([*critics_among(nets.params), *encoder], adam(cfg.critic_lr * share, cfg))

        def errors(valued: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            seen = batch._replace(obs=features(valued, batch.obs))
            return critic_loss(valued, seen, y, names(cfg), cfg)

        nets, metrics = descend_each(errors, nets, adams, axis_name)

        def improve(nets: Trainable) -> tuple[Trainable, Metrics]:
            """The policy climbs what the new critics say, and the targets follow."""
            loss = policy_loss(nets.params, batch, at._replace(key=policy_key), cfg, axis_name)
            nets, metrics = descend_each(loss, nets, actor.optimisers(cfg, share), axis_name)
            return follow(nets, cfg.tau), metrics

        nets, found = at_every(cfg.policy_delay, at.number, improve, nets)
        return nets, metrics_by_constraint(metrics | found, names(cfg))

    def charged_in(
        nets: Trainable, batch: Transitions, cfg: Any, axis_name: str | None
    ) -> tuple[jax.Array, Trainable]:
        """What is held under the limit, as the critics see it, and `nets` with its scale."""
        charged = signal(env, batch, names(cfg))
        if "cost_scale" not in nets.opt_state:
            return charged, nets
        costs = charged.reshape(*batch.reward.shape, -1)
        past = nets.opt_state["cost_scale"]
        scale = averaged(past, costs, batch.weight, axis_name, memory=1)
        charged = standard(scale, costs, cfg.cost_centre, MIN_STD, CLIP).reshape(charged.shape)
        return charged, nets._replace(opt_state=nets.opt_state | {"cost_scale": scale})

    def targets_at(
        params: dict[str, PyTree], batch: Transitions, charged: jax.Array, key: jax.Array, cfg: Any
    ) -> Values:
        """What the critics aim at: y_r and y_c."""
        targets, obs = params["targets"], features(params, batch.next_obs)
        action, bonus = actor.next_action(params, targets, obs, key, cfg)
        q_r, q_c = judged(targets, obs, action, cfg)
        if treatment is not no_treatment and cfg.cost_action == "mean":  # all critics once more
            q_c = judged(targets, obs, actor.act(params, obs, None, cfg), cfg).cost
        return targets_of(batch, charged, Values(q_r.min(0) + bonus, q_c), names(cfg), cfg)

    def judged(params: PyTree, obs: jax.Array, action: jax.Array, cfg: Any) -> Values:
        """Each Q_r, float [critics, B], and Q_c with the floor of `cost_floor`, [B] or [B, K]."""
        q_r, q_c = with_reduced_cost(params, obs, action, names(cfg), cfg)
        has_floor = treatment is not no_treatment and cfg.cost_floor
        return Values(q_r, jnp.maximum(q_c, 0.0) if has_floor else q_c)

    def policy_loss(
        params: dict[str, PyTree],
        batch: Transitions,
        at: GradientStep,
        cfg: Any,
        axis_name: str | None,
    ) -> Callable[[dict[str, PyTree]], tuple[jax.Array, Metrics]]:
        """The loss of the actor's parameters, with the critics among `params`."""
        obs = features(params, batch.obs)

        def loss(parts: dict[str, PyTree]) -> tuple[jax.Array, Metrics]:
            proposal = actor.propose(parts, obs, at.key, cfg)
            q_r, q_c = judged(params, obs, proposal.action, cfg)
            worth = actor.pick(q_r) + proposal.bonus
            if treatment is not no_treatment:
                unit = price_unit(batch, worth, cfg, axis_name)
                worth = treatment.advantage(at.dual, worth / unit, q_c)
            climbed = batch.mean(worth)
            metrics = {"train/actor_loss": -climbed, **jax.tree.map(batch.mean, proposal.metrics)}
            return batch.mean(proposal.extra) - climbed, metrics

        return loss

    def acting(by: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
        def act(learned: Learned, obs: PyTree, key: jax.Array | None, *more: jax.Array) -> jax.Array:
            return by(learned.params, features(learned.params, obs), key, learned.config, *more)

        return act

    explore = None if actor.explore is None else acting(actor.explore)
    return Learner(init=init, act=acting(actor.act), step=step, explore=explore)


def price_unit(batch: Transitions, worth: jax.Array, cfg: Any, axis_name: str | None) -> jax.Array:
    """What a price of 1 on one unit of cost weighs as much as, float []; `worth` [B] is Q_r."""
    if cfg.price_unit == "reward":
        return jnp.ones(())
    centre = pmean(batch.mean(worth), axis_name)
    variance = pmean(batch.mean((worth - centre) ** 2), axis_name)
    return jax.lax.stop_gradient(jnp.sqrt(variance + 1e-12))


def at_every(
    period: int,
    number: jax.Array,
    step: Callable[[Trainable], tuple[Trainable, Metrics]],
    nets: Trainable,
) -> tuple[Trainable, Metrics]:
    """`step(nets)` at every `period`-th gradient step. At the others `nets` stays, and metrics are NaN.

    `number` is a function of the loop's clock and has no member axis. So the branch that is not taken
    costs nothing, under `vmap` over members too.
    """
    if period == 1:
        return step(nets)
    like = jax.eval_shape(step, nets)[1]
    nothing = jax.tree.map(lambda x: jnp.full(x.shape, jnp.nan, x.dtype), like)
    return jax.lax.cond((number + 1) % period == 0, step, lambda nets: (nets, nothing), nets)

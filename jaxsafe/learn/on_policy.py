"""The on-policy loop: rollout, estimates, treatment, step, as one pure update.

`jit(update)` compiles an iteration, `vmap(update, in_axes=(0, None))` runs seeds or floats of the
config side by side, and `shard_map(update)` with `axis_name` set splits environments over devices. Each
device then holds `cfg.num_envs` of its own and the same parameters. It gets the same key, which is
folded with the device's index where devices must differ.
"""

import dataclasses
import math
import operator
from collections.abc import Callable
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from jaxsafe.config import (
    Amount,
    Bounds,
    ConfigError,
    EndOfDecay,
    Iterations,
    Norm,
    Rate,
    Share,
    Units,
    Weight,
    check_values,
    config,
)
from jaxsafe.learn.acting import Acted, Learned, first_carries, learned_of, reset_carry
from jaxsafe.learn.augment import Augmentation, no_augmentation
from jaxsafe.learn.batch import all_finite, batch_mean, device_key, psum, select
from jaxsafe.learn.constraints import (
    Names,
    check_cost_names,
    each,
    limit,
    metrics_by_constraint,
    signal,
    total_cost_alone,
)
from jaxsafe.learn.conventions import Convention
from jaxsafe.learn.estimates import (
    Batch,
    Experience,
    Signals,
    estimate_batch,
    init_signal_normaliser,
    scaled,
    weights,
)
from jaxsafe.learn.gaussian_policy import decide, gaussian_policy, init_nets
from jaxsafe.learn.metrics import step_metrics
from jaxsafe.learn.normalise import init_normaliser, merge
from jaxsafe.learn.observations import EncoderConfig, blank, check_observation, vector_of
from jaxsafe.learn.returns import (
    Estimator,
    LostTime,
    Window,
    empty_window,
    episode_cost,
    expected_length,
    no_lost_time,
)
from jaxsafe.learn.rollout import RolloutState, Trajectory, check_steps, collect, init_rollout
from jaxsafe.learn.steps import Context, Pair, PolicyStep, Trainable, critic_passes, fit_critic
from jaxsafe.learn.surrogates import Surrogate, with_entropy
from jaxsafe.learn.treatments import Treatment
from jaxsafe.nn.gaussian import entropy, log_prob, sample
from jaxsafe.nn.networks import action_dist, stack, stack_critics
from jaxsafe.types import Algorithm, Clocks, Env, Metrics, PyTree, Shared, State


@config
class OnPolicyConfig(EncoderConfig):
    """What the on-policy algorithms share."""

    POLICY_STEPS: ClassVar = 1  # steps of the policy in an iteration
    # The tasks whose default is a preset (docs/results/velocity)
    SUITS: ClassVar = {"frequent": ("walker2d_velocity", "swimmer_velocity", "humanoid_velocity")}

    CONVENTIONS: ClassVar = (
        Convention(
            {"cost_window": 5},
            "J_c is the mean cost of the last 100 episodes, those of 5 iterations (of the last 50 in "
            "release 0.5.0 and in the published figures)",
            "J_c is the mean cost of the last iteration",
        ),
        Convention(
            {"reward_centre": True, "cost_centre": True},
            "`reward_normalize` and `cost_normalize` take the mean from rewards and costs, so that to "
            "fail early may pay",
            "`reward_normalize` and `cost_normalize` only scale",
        ),
    )

    # Environments side by side, of all devices together. With `horizon` a batch has 20,480 steps, near
    # OmniSafe's 20,000.
    num_envs: Amount = 512
    # Steps of each environment in an iteration. Shorter ones learn less from a step.
    horizon: Amount = 40
    stagger: bool = True  # Whether the first episodes start at different ages, so that ends spread out.
    # The iteration at which whatever decays reaches 0. inf: the last one of `total_steps`.
    total_iterations: EndOfDecay = float("inf")
    hidden: tuple[Units, ...] = (64, 64)  # Units of the hidden layers of each network, as in OmniSafe.
    # separate: a network each for policy and critics, as in OmniSafe. shared: one network for all.
    # gru: one network for all, with a memory.
    trunk: Literal["separate", "shared", "gru"] = "separate"
    # Weight of each critic's squared error in the loss of a shared trunk, as in Stable-Baselines3.
    # Separate networks do not use it.
    value_coef: Weight = 0.5
    activation: Literal["tanh", "relu"] = "tanh"  # Of the hidden layers, as in OmniSafe.
    # How weights are drawn. torch is PyTorch's default (Kaiming, uniform), which OmniSafe has.
    init: Literal["orthogonal", "torch"] = "orthogonal"
    # Log of the actions' standard deviation at the start, as in safety-starter-agents.
    init_log_std: Annotated[float, Bounds(-20, 10)] = -0.5
    # free: the standard deviation is a parameter, as in OmniSafe. state: the network computes it.
    std: Literal["free", "state"] = "free"
    # Floor of the actions' standard deviation, to which what is learned is added. It must be less than
    # exp(init_log_std), where the deviation starts. 0 is no floor, as in OmniSafe.
    min_std: Annotated[float, Bounds(0, 10)] = 0.0
    # Whether observations are scaled by their running mean and variance, as in OmniSafe.
    obs_normalize: bool = True
    # Whether the learner sees rewards divided by the root of their running mean square, and at most 5
    # of it.
    reward_normalize: bool = False
    # Whether the learner sees costs scaled likewise. Limits and metrics keep the costs as they are.
    cost_normalize: bool = False
    # Whether `reward_normalize` also takes the mean from rewards, as OmniSafe's does. That changes what
    # is best where episodes can fail: one that fails no longer loses the rewards of the rest.
    reward_centre: bool = False
    # Whether `cost_normalize` also takes the mean from costs. OmniSafe's does.
    cost_centre: bool = False
    # Weight of the policy's entropy, which is added to what the policy maximises.
    entropy_coef: Weight = 0.0
    entropy_decay: bool = False  # Whether entropy_coef falls on a line to 0 at `total_iterations`.
    estimator: Estimator = "gae"  # Of advantages and of the critics' targets, as in OmniSafe.
    # Discount of rewards, as in OmniSafe. It only affects the critic and the advantages.
    discount: Share = 0.99
    gae_lambda: Share = 0.95  # Decay of the reward advantages (lambda of GAE), as in OmniSafe.
    # Discount of costs. It only affects the critic and the advantages: the limit is on undiscounted
    # cost. OmniSafe names this setting and uses `discount` instead.
    cost_discount: Share = 0.99
    cost_gae_lambda: Share = 0.95  # Decay of the cost advantages, as in OmniSafe.
    # Cost that an episode may have, undiscounted, as in OmniSafe. Unconstrained algorithms only draw
    # it in plots.
    cost_limit: Weight = 25.0
    # J_c is the mean cost over this many iterations. OmniSafe has the last 100 episodes, which are 5
    # of its iterations.
    cost_window: Iterations = 1
    minibatches: Amount = 8  # Parts that a batch is split into for each pass, of policy and critics.
    # Adam's step of the critics, as in safety-starter-agents. A shared trunk does not use it.
    critic_lr: Rate = 1e-3
    # Passes of each critic over a batch. With 8 minibatches they are the 80 steps of
    # safety-starter-agents. A shared trunk does not use it.
    critic_epochs: Iterations = 10
    # Weight of the sum of squared parameters in a critic's loss, as in OmniSafe. A shared trunk does
    # not use it.
    critic_norm_coef: Weight = 1e-3
    max_grad_norm: Norm = 40.0  # Longer gradients of a network are cut to this norm, as in OmniSafe.


# The settings that all on-policy algorithms of OmniSafe share (@15603dd, configs/on-policy) and that
# differ from the defaults above. OmniSafe's 20 episodes run one after the other, these side by side.
OMNISAFE: dict[str, Any] = {
    "num_envs": 20,
    "horizon": 1000,
    "stagger": False,
    "init": "torch",
    "init_log_std": 0.0,
}
# For Walker2d and Swimmer (docs/results/velocity_settings): a batch of the same size from rollouts
# four times as long, and four times as many gradient steps; of the critics eight times as many.
FREQUENT: dict[str, Any] = {"num_envs": 128, "horizon": 160, "minibatches": 32, "critic_epochs": 20}

# For Swimmer, where a price that comes late holds TRPO-Lagrangian on a plateau (the same page)
EARLY_PRICE: dict[str, dict[str, Any]] = {"early_price": FREQUENT | {"lam_init": 1.0}}
# OmniSafe's settings with rollouts side by side, for Hopper and Humanoid (the same page)
PARALLEL: dict[str, Any] = {"num_envs": 160, "horizon": 125}


def presets(omnisafe: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The presets of an on-policy algorithm whose published settings are `omnisafe`."""
    return {"omnisafe": omnisafe, "frequent": FREQUENT, "parallel": omnisafe | PARALLEL}


@flax.struct.dataclass
class TrainState:
    """All that an update needs besides `Shared`. Environment steps: iteration * num_envs * horizon.

    config: the algorithm's, with its floats as arrays; `num_envs` is this device's share.
    params: {'actor', 'critic_r', 'critic_c'}; of several constraints critic_c is stacked, [K, ...].
        With one network for all {'actor'}, see nn.networks.
    opt_state: {'actor': the step's, 'critics': Adam's for all critics, stacked, or ()}.
    dual: the treatment's state.
    normaliser: Normaliser, or () without `obs_normalize`.
    signal_normaliser: Normaliser of [reward, costs ...], or () without `reward_normalize` and
        `cost_normalize`.
    rollout: this device's environments.
    lost_time: LostTime, from which the mean length of an episode follows.
    past_costs: Window of J_c of the last `cost_window` iterations, [W] or [W, K].
    """

    config: Any
    params: dict[str, PyTree]
    opt_state: dict[str, PyTree]
    dual: PyTree
    normaliser: PyTree
    signal_normaliser: PyTree
    rollout: RolloutState
    lost_time: LostTime
    past_costs: Window
    key: jax.Array


class Improved(NamedTuple):
    """What an iteration makes of the policy: its networks, their optimiser, the dual, and metrics."""

    actor: PyTree
    opt_state: PyTree
    dual: PyTree
    metrics: Metrics


class Method(NamedTuple):
    """What a method adds to the loop.

    check(cfg) raises ConfigError for settings that it cannot serve.
    init_step(actor, cfg) -> the optimiser's state of the policy.
    init_dual(cfg) -> dual, what is remembered of the constraint.
    improve(ts, batch, context) -> Improved.
    constrained_costs(cfg) -> names of the costs that have a limit each; () for `cost` alone.
    augmentation: what the learner sees and is paid beside the task.
    """

    check: Callable[[Any], None]
    init_step: Callable[[PyTree, Any], PyTree]
    init_dual: Callable[[Any], PyTree]
    improve: Callable[["TrainState", "Batch", Context], Improved]
    constrained_costs: Callable[[Any], Names] = total_cost_alone
    augmentation: Augmentation = no_augmentation


def on_policy(
    env: Env,
    treatment: Treatment,
    surrogate: Surrogate,
    step: PolicyStep,
    axis_name: str | None = None,
    augmentation: Augmentation = no_augmentation,
) -> Algorithm:
    """Algorithms with one objective: the surrogate of the advantage that the treatment mixes."""

    def improve(ts: TrainState, batch: Batch, context: Context) -> Improved:
        cfg = context.cfg
        dual = treatment.update(ts.dual, context.episode_cost, cfg, context.iteration)

        def objective(actor: PyTree, batch: Batch) -> tuple[jax.Array, Metrics]:
            advantage = treatment.advantage(dual, batch.adv_r, batch.adv_c)
            earned = with_entropy(surrogate, context.iteration)
            return earned(action_dist(actor, batch.obs, cfg), batch, advantage, cfg)

        actor, opt_state, metrics = step.update(
            ts.params["actor"], ts.opt_state["actor"], objective, batch, context
        )
        return Improved(actor, opt_state, dual, metrics | treatment.metrics(dual))

    costs = treatment.constrained_costs
    method = Method(step.check, step.init, treatment.init, improve, costs, augmentation)
    return on_policy_loop(env, method, axis_name)


def on_policy_pair(
    env: Env,
    surrogate: Surrogate,
    step: PolicyStep,
    axis_name: str | None = None,
    surrogate_c: Surrogate | None = None,
    constrained_costs: Callable[[Any], Names] = total_cost_alone,
) -> Algorithm:
    """Algorithms whose step weighs reward against cost itself.

    It takes a `Pair` of objectives: `surrogate` of the reward's advantage, and `surrogate_c` (or the
    same) of the cost's. The cost's is in cost per step, float [], or [K] for K constrained costs.
    """

    def improve(ts: TrainState, batch: Batch, context: Context) -> Improved:
        cfg = context.cfg

        def objective_r(actor: PyTree, batch: Batch) -> tuple[jax.Array, Metrics]:
            earned = with_entropy(surrogate, context.iteration)
            return earned(action_dist(actor, batch.obs, cfg), batch, batch.adv_r, cfg)

        def objective_c(actor: PyTree, batch: Batch) -> tuple[jax.Array, Metrics]:
            dist = action_dist(actor, batch.obs, cfg)

            def of_one(adv_c: jax.Array) -> tuple[jax.Array, Metrics]:
                return (surrogate_c or surrogate)(dist, batch, adv_c, cfg)

            return each(of_one, constrained_costs(cfg))(batch.adv_c)

        objectives = Pair(objective_r, objective_c)
        actor, opt_state, metrics = step.update(
            ts.params["actor"], ts.opt_state["actor"], objectives, batch, context
        )
        return Improved(actor, opt_state, (), metrics)

    def check(cfg: Any) -> None:
        step.check(cfg)
        if cfg.cost_normalize:
            raise ConfigError(
                "cost_normalize=True: expected False for an algorithm that adds what it estimates of "
                "the cost to the violation, which is in units of cost"
            )

    method = Method(check, step.init, lambda cfg: (), improve, constrained_costs)
    return on_policy_loop(env, method, axis_name)


def on_policy_loop(env: Env, method: Method, axis_name: str | None) -> Algorithm:
    """The algorithm that `method` makes of the loop."""
    constrained_costs, augmentation = method.constrained_costs, method.augmentation

    def init(key: jax.Array, cfg: Any, shared: Shared) -> TrainState:
        check_sizes(cfg)
        method.check(cfg)
        cfg = jax.tree.map(jnp.float32, cfg)
        params_key, rollout_key, key = jax.random.split(key, 3)
        dual = method.init_dual(cfg)
        wrapped = augmentation.wrap(env, cfg, dual)
        names = constrained_costs(cfg)
        check_cost_names("cost_limits", names, env)
        rollout = init_rollout(wrapped, device_key(rollout_key, axis_name), cfg.num_envs, cfg.stagger)
        obs = jax.tree.map(operator.itemgetter(0), rollout.state.obs)
        check_observation(obs, cfg)
        nets = init_nets(params_key, blank(obs), wrapped.action_size, names, cfg)
        normaliser = init_normaliser(env.obs_size) if cfg.obs_normalize else ()
        learned = Learned(cfg, nets.params, dual, normaliser)
        carry = first_carries(gaussian_policy, learned, cfg.num_envs)
        return TrainState(
            config=cfg,
            params=nets.params,
            opt_state={
                "actor": method.init_step(nets.params["actor"], cfg),
                "critics": nets.opt_state,
            },
            dual=dual,
            normaliser=normaliser,
            signal_normaliser=init_signal_normaliser(cfg, len(names) or 1),
            rollout=dataclasses.replace(rollout, carry=carry),
            lost_time=no_lost_time(),
            past_costs=empty_window(cfg.cost_window, jnp.shape(limit(cfg, names))),
            key=key,
        )

    def task(learned: Learned | TrainState) -> Env:
        return augmentation.wrap(env, learned.config, learned.dual)

    def play(ts: TrainState, key: jax.Array) -> tuple[RolloutState, Trajectory]:
        """A rollout of the policy, in the task as the augmentation makes it."""
        learned = learned_of(ts)

        def act(carry: PyTree, state: State, first: jax.Array, key: jax.Array) -> Acted:
            carry = reset_carry(gaussian_policy, learned, carry, first)
            dist, carry = decide(learned, carry, state.obs)
            action = sample(dist, key)
            return action, carry, {"log_prob": log_prob(dist, action)}

        pool = augmentation.renew(ts.rollout.pool, ts.config, ts.dual)
        return collect(
            task(learned),
            act,
            dataclasses.replace(ts.rollout, pool=pool),
            device_key(key, axis_name),
            ts.config.horizon,
            lambda episode: augmentation.stop(episode, ts.config),
        )

    def update(ts: TrainState, shared: Shared) -> tuple[TrainState, Metrics]:
        cfg, names = ts.config, constrained_costs(ts.config)
        key, rollout_key, step_key, critic_key = jax.random.split(ts.key, 4)
        rollout, traj = play(ts, rollout_key)
        weight = weights(traj.bad, axis_name).max()  # of a good step; bad ones earn and cost 0 here
        charged = signal(env, traj, names)
        reward = jnp.where(traj.bad.any, 0.0, augmentation.reward(traj, cfg))
        raw = Signals(reward, charged, ts.signal_normaliser)
        signals = scaled(raw, cfg, axis_name, weight)
        augmented = dataclasses.replace(traj, next_obs=augmentation.last_obs(traj, cfg))
        seen = Experience(augmented, signals, ts.rollout.carry)
        batch, explained = estimate_batch(learned_of(ts), seen, names, axis_name)
        taken = traj.terminated.size
        length, lost_time = expected_length(ts.lost_time, env.episode_length, traj, taken, axis_name)
        cost = episode_cost(ts.past_costs, charged, weight, length, axis_name)

        violation = cost.recent - limit(cfg, names)
        context = Context(shared.iteration, cfg, step_key, axis_name, cost.recent, violation, length)
        improved = method.improve(ts, batch, context)
        fitted = FittedCritics({}, (), 0, {})
        if cfg.trunk == "separate":
            passes = critic_passes(improved.metrics, cfg)
            fitted = fit_critics(ts, batch, passes, critic_key, axis_name)
        raw_obs = vector_of(traj.obs)[..., : env.obs_size]
        normaliser = merge(ts.normaliser, raw_obs, axis_name) if cfg.obs_normalize else ()
        after = TrainState(
            config=cfg,
            params={"actor": improved.actor, **fitted.params},
            opt_state={"actor": improved.opt_state, "critics": fitted.opt_state},
            dual=improved.dual,
            normaliser=normaliser,
            signal_normaliser=signals.normaliser,
            rollout=rollout,
            lost_time=lost_time,
            past_costs=cost.past,
            key=key,
        )
        computed = (batch, normaliser, signals.normaliser, cost.of_iteration)
        after, finite = guarded(ts, after, computed, axis_name)

        def rate(x: jax.Array) -> jax.Array:
            return batch_mean(x, axis_name) * weight

        metrics = metrics_by_constraint(improved.metrics | fitted.metrics | explained, names)
        metrics["train/nonfinite"] += fitted.skipped + ~finite
        metrics |= {f"train/cost_estimate_{name}": cost.of_iteration[k] for k, name in enumerate(names)}
        metrics |= step_metrics(env, traj, rate, length, axis_name)
        dist = action_dist(improved.actor, batch.obs, cfg)
        metrics["train/entropy"] = batch_mean(entropy(dist), axis_name)
        metrics["train/std"] = batch_mean(jnp.exp(dist.log_std).mean(-1), axis_name)
        return after, jax.tree.map(jnp.float32, metrics)

    def clocks(cfg: Any) -> Clocks:
        """Gradient steps are those that teach values: of critics, or of the trunk they share."""
        check_sizes(cfg)
        method.check(cfg)
        passes = cfg.critic_epochs if cfg.trunk == "separate" else cfg.epochs * cfg.POLICY_STEPS
        return Clocks(cfg.num_envs * cfg.horizon, passes * cfg.minibatches)

    return Algorithm(init, update, gaussian_policy, learned_of, task, clocks)


def guarded(
    before: TrainState, after: TrainState, computed: PyTree, axis_name: str | None
) -> tuple[TrainState, jax.Array]:
    """`after`, with the statistics and the dual of `before` unless all of `computed` is finite on every
    device; and whether it is, bool []. Parameters are guarded step by step, where they are moved."""
    finite = psum(~all_finite(computed), axis_name) == 0
    names = ("dual", "normaliser", "signal_normaliser", "lost_time", "past_costs")
    kept = {name: select(finite, getattr(after, name), getattr(before, name)) for name in names}
    return dataclasses.replace(after, **kept), finite


class FittedCritics(NamedTuple):
    """params: {'critic_r', 'critic_c'}, or {} where they share the policy's trunk.
    skipped: int32 [], steps whose gradient was not finite.
    """

    params: dict[str, PyTree]
    opt_state: PyTree
    skipped: jax.Array | int
    metrics: Metrics


def fit_critics(
    ts: TrainState, batch: Batch, passes: jax.Array | int, key: jax.Array, axis_name: str | None
) -> FittedCritics:
    """All critics fitted to their targets at once."""

    def fit(critic: Trainable, target: jax.Array) -> tuple[Trainable, jax.Array, jax.Array]:
        return fit_critic(critic, (batch.obs, target), passes, key, ts.config, axis_name)

    critics = Trainable(stack_critics(ts.params), ts.opt_state["critics"])
    critics, errors, skipped = jax.vmap(fit)(critics, stack(batch.ret_r, batch.ret_c.T))
    params = {
        "critic_r": jax.tree.map(operator.itemgetter(0), critics.params),
        "critic_c": jax.tree.map(
            lambda x, c: x[1:].reshape(c.shape), critics.params, ts.params["critic_c"]
        ),
    }
    metrics = {
        "train/value_loss_r": errors[0],
        "train/value_loss_c": errors[1:].reshape(batch.ret_c.shape[1:]),
    }
    return FittedCritics(params, critics.opt_state, skipped.sum(), metrics)


def check_sizes(cfg: Any) -> None:
    """Refuse sizes out of their bounds, and those that do not fit each other."""
    check_values(cfg)
    check_steps(cfg.num_envs, cfg.horizon)
    check_floor(cfg.min_std, cfg.init_log_std)
    if cfg.trunk == "gru" and cfg.encoder == "cnn":
        raise ConfigError("trunk=gru: expected separate or shared with encoder=cnn")
    # a network with a memory learns from whole sequences, one of each environment
    rows = "num_envs" if cfg.trunk == "gru" else "num_envs * horizon"
    size = cfg.num_envs * (1 if cfg.trunk == "gru" else cfg.horizon)
    if size % cfg.minibatches:
        near = ((cfg.minibatches - i, cfg.minibatches + i) for i in range(1, cfg.minibatches))
        divisor = next(m for pair in near for m in pair if size % m == 0)
        raise ConfigError(
            f"minibatches={cfg.minibatches}: expected a divisor of {rows} = {size}; "
            f"the nearest is {divisor}"
        )


def check_floor(min_std: Any, init_log_std: Any) -> None:
    """Refuse a floor of the standard deviation that is not below where the deviation starts.

    JAX's traced values are not checked.
    """
    known = isinstance(min_std, float | int) and isinstance(init_log_std, float | int)
    if known and min_std >= (start := math.exp(init_log_std)):
        raise ConfigError(
            f"min_std={min_std:g}: expected less than {start:.3g}, the standard deviation at the "
            "start, exp(init_log_std)"
        )

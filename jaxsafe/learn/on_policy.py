"""The on-policy loop: rollout, estimates, treatment, step, as one pure update.

`jit(update)` compiles an iteration, `vmap(update, in_axes=(0, None))` runs seeds or floats of the
config side by side, and `shard_map(update)` with `axis_name` set splits environments over devices. Each
device then holds `cfg.num_envs` of its own and the same parameters. It gets the same key, which is
folded with the device's index where devices must differ.
"""

import dataclasses
import operator
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, Literal

import flax.struct
import jax
import jax.numpy as jnp

from jaxsafe.config import ConfigError, config
from jaxsafe.learn.acting import Learned, begun_anew, learned_of
from jaxsafe.learn.augment import Augmentation, nothing
from jaxsafe.learn.batch import (
    all_finite,
    batch_mean,
    centre,
    device_key,
    psum,
    select,
    standardise,
)
from jaxsafe.learn.constraints import Names, check_names, each, limit, signal, spread, unnamed
from jaxsafe.learn.conventions import Convention
from jaxsafe.learn.metrics import episode_metrics, explained_variance
from jaxsafe.learn.normalise import init_normaliser, merge, normalise
from jaxsafe.learn.returns import Estimator, Window, advantages, empty_window, mean_length, window_mean
from jaxsafe.learn.rollout import RolloutState, Trajectory, collect, init_rollout
from jaxsafe.learn.steps import Context, Pair, Step, adam, fit_critic, stops_critics
from jaxsafe.learn.surrogates import Surrogate, with_entropy
from jaxsafe.learn.treatments import Treatment
from jaxsafe.nn.gaussian import Gaussian, entropy, log_prob, sample
from jaxsafe.nn.networks import (
    init_params,
    init_recurrent,
    policy,
    read,
    remember,
    share_trunk,
    stack,
    stack_critics,
)
from jaxsafe.types import Algorithm, Clocks, Env, Metrics, Policy, PyTree, Shared


@config
class OnPolicyConfig:
    """What the on-policy algorithms share."""

    CONVENTIONS: ClassVar = (
        Convention(
            {"cost_window": 5},
            "J_c is the mean of the last 100 episodes, those of 5 iterations (of 50 in release 0.5.0 "
            "and in the published figures)",
            "of the last iteration",
        ),
    )

    # Environments side by side, of all devices together. With `horizon` a batch has 20,480 steps, near
    # OmniSafe's 20,000.
    num_envs: int = 512
    # Steps of each environment in an iteration. Shorter ones learn less from a step.
    horizon: int = 40
    stagger: bool = True  # Whether the first episodes start at different ages, so that ends spread out.
    # The iteration at which whatever decays reaches 0. inf: the last one of `total_steps`.
    total_iterations: float = float("inf")
    hidden: tuple[int, ...] = (64, 64)  # Units of the hidden layers of each network, as in OmniSafe.
    # separate: a network each for policy and critics, as in OmniSafe. shared: one network for all.
    # gru: one network for all, with a memory.
    trunk: Literal["separate", "shared", "gru"] = "separate"
    # Weight of each critic's squared error in the loss of a shared trunk, as in Stable-Baselines3.
    # Separate networks do not use it.
    value_coef: float = 0.5
    activation: Literal["tanh", "relu"] = "tanh"  # Of the hidden layers, as in OmniSafe.
    # How weights are drawn. torch is PyTorch's default (Kaiming, uniform), which OmniSafe has.
    init: Literal["orthogonal", "torch"] = "orthogonal"
    # Log of the actions' standard deviation at the start, as in safety-starter-agents.
    init_log_std: float = -0.5
    # free: the standard deviation is a parameter, as in OmniSafe. state: the network computes it.
    std: Literal["free", "state"] = "free"
    # Whether observations are scaled by their running mean and variance, as in OmniSafe.
    obs_normalize: bool = True
    # Whether the learner sees rewards scaled by their running mean and variance.
    reward_normalize: bool = False
    # The same for costs. Limits and metrics keep the costs as they are.
    cost_normalize: bool = False
    # Weight of the policy's entropy, which is added to what the policy maximises.
    entropy_coef: float = 0.0
    entropy_decay: bool = False  # Whether entropy_coef falls on a line to 0 at `total_iterations`.
    estimator: Estimator = "gae"  # Of advantages and of the critics' targets, as in OmniSafe.
    # Discount of rewards, as in OmniSafe. It only affects the critic and the advantages.
    discount: float = 0.99
    gae_lambda: float = 0.95  # Decay of the reward advantages (lambda of GAE), as in OmniSafe.
    # Discount of costs. It only affects the critic and the advantages: the limit is on undiscounted
    # cost. OmniSafe names this setting and uses `discount` instead.
    cost_discount: float = 0.99
    cost_gae_lambda: float = 0.95  # Decay of the cost advantages, as in OmniSafe.
    # Cost that an episode may have, undiscounted, as in OmniSafe. Unconstrained algorithms only draw
    # it in plots.
    cost_limit: float = 25.0
    # J_c is the mean cost over this many iterations. OmniSafe has the last 100 episodes, which are 5
    # of its iterations.
    cost_window: int = 1
    minibatches: int = 8  # Parts that a batch is split into for each pass, of policy and critics.
    # Adam's step of the critics, as in safety-starter-agents. A shared trunk does not use it.
    critic_lr: float = 1e-3
    # Passes of each critic over a batch. With 8 minibatches they are the 80 steps of
    # safety-starter-agents. A shared trunk does not use it.
    critic_epochs: int = 10
    # Weight of the sum of squared parameters in a critic's loss, as in OmniSafe. A shared trunk does
    # not use it.
    critic_norm_coef: float = 1e-3
    max_grad_norm: float = 40.0  # Longer gradients of a network are cut to this norm, as in OmniSafe.


# The settings that all on-policy algorithms of OmniSafe share (@15603dd, configs/on-policy) and that
# differ from the defaults above. OmniSafe's 20 episodes run one after the other, these side by side.
OMNISAFE: dict[str, Any] = {
    "num_envs": 20,
    "horizon": 1000,
    "stagger": False,
    "init": "torch",
    "init_log_std": 0.0,
}


@flax.struct.dataclass
class TrainState:
    """All that an update needs besides `Shared`. Environment steps: iteration * num_envs * horizon.

    config: the algorithm's, with its floats as arrays.
    params: {'actor', 'critic_r', 'critic_c'}; of several constraints critic_c is stacked, [K, ...].
        With one network for all {'actor'}, see nn.networks.
    opt_state: {'actor': the step's own, 'critics': Adam's for all critics, stacked, or ()}.
    dual: the treatment's state.
    normaliser: Normaliser, or () without `obs_normalize`.
    signals: Normaliser of [reward, costs ...], or () without `reward_normalize` and `cost_normalize`.
    rollout: this device's environments.
    episode_length: float [], running mean length of an episode, in steps.
    past_costs: J_c of the last `cost_window` iterations, float [W] or [W, K].
    """

    config: Any
    params: dict[str, PyTree]
    opt_state: dict[str, PyTree]
    dual: PyTree
    normaliser: PyTree
    signals: PyTree
    rollout: RolloutState
    episode_length: jax.Array
    past_costs: Window
    key: jax.Array


@flax.struct.dataclass
class Batch:
    """B = T * N transitions, as the policy sees them: observations are normalised. With a memory N
    sequences of T, and [N, T] stands for [B].

    obs [B, O], or `Sequences`; action [B, A]; log_prob [B] and old (Gaussian [B, A]) of the policy
    that acted; adv_r standardised, adv_c only centred, in cost units or, with `cost_normalize`, in
    standard deviations of a step's; ret_r, ret_c: the critics' targets [B]. Of several constraints
    adv_c and ret_c are [B, K].
    """

    obs: jax.Array
    action: jax.Array
    log_prob: jax.Array
    old: Gaussian
    adv_r: jax.Array
    adv_c: jax.Array
    ret_r: jax.Array
    ret_c: jax.Array


def on_policy(
    env: Env,
    treatment: Treatment,
    surrogate: Surrogate,
    step: Step,
    axis_name: str | None = None,
    augmentation: Augmentation = nothing,
) -> Algorithm:
    """Algorithms with one objective: the surrogate of the advantage that the treatment mixes."""

    def improve(ts: TrainState, batch: Batch, context: Context):
        cfg = context.cfg
        dual = treatment.update(ts.dual, context.cost, cfg)

        def objective(actor: PyTree, batch: Batch) -> tuple[jax.Array, Metrics]:
            advantage = treatment.advantage(dual, batch.adv_r, batch.adv_c)
            earned = with_entropy(surrogate, context.iteration)
            return earned(policy(actor, batch.obs, cfg), batch, advantage, cfg)

        actor, opt_state, metrics = step.update(
            ts.params["actor"], ts.opt_state["actor"], objective, batch, context
        )
        return actor, opt_state, dual, metrics | treatment.metrics(dual)

    return loop(env, step.init, treatment.init, improve, axis_name, augmentation, treatment.named)


def on_policy_pair(
    env: Env,
    surrogate: Surrogate,
    step: Step,
    axis_name: str | None = None,
    surrogate_c: Surrogate | None = None,
    named: Callable[[Any], Names] = unnamed,
) -> Algorithm:
    """Algorithms whose step weighs reward against cost itself, so that it takes a `Pair` of objectives:
    `surrogate` of the reward's advantage, and `surrogate_c` (or the same) of the cost's.

    The cost's objective is in cost per step, the unit of `context.excess / context.length`. For K costs
    `named(cfg)` it is [K].
    """

    def improve(ts: TrainState, batch: Batch, context: Context):
        cfg = context.cfg

        def objective_r(actor: PyTree, batch: Batch) -> tuple[jax.Array, Metrics]:
            earned = with_entropy(surrogate, context.iteration)
            return earned(policy(actor, batch.obs, cfg), batch, batch.adv_r, cfg)

        def objective_c(actor: PyTree, batch: Batch) -> tuple[jax.Array, Metrics]:
            dist = policy(actor, batch.obs, cfg)

            def of_one(adv_c: jax.Array) -> tuple[jax.Array, Metrics]:
                return (surrogate_c or surrogate)(dist, batch, adv_c, cfg)

            return each(of_one, named(cfg))(batch.adv_c)

        actor, opt_state, metrics = step.update(
            ts.params["actor"],
            ts.opt_state["actor"],
            Pair(objective_r, objective_c),
            batch,
            context,
        )
        return actor, opt_state, (), metrics

    def init_dual(cfg: Any) -> tuple[()]:
        if cfg.cost_normalize:
            raise ConfigError(
                "cost_normalize=True: expected False for an algorithm that adds what it estimates of "
                "the cost to the violation, which is in units of cost"
            )
        return ()

    return loop(env, step.init, init_dual, improve, axis_name, named=named)


def loop(
    env: Env,
    init_step: Callable[[PyTree, Any], PyTree],
    init_dual: Callable[[Any], PyTree],
    improve: Callable[..., tuple[PyTree, PyTree, PyTree, Metrics]],
    axis_name: str | None,
    augmentation: Augmentation = nothing,
    named: Callable[[Any], Names] = unnamed,
) -> Algorithm:
    """The loop around `improve(ts, batch, context)` -> (actor, opt_state, dual, metrics)."""

    def init(key: jax.Array, cfg: Any, shared: Shared) -> TrainState:
        check(cfg)
        cfg = jax.tree.map(jnp.float32, cfg)
        params_key, rollout_key, key = jax.random.split(key, 3)
        dual = init_dual(cfg)
        wrapped = augmentation.wrap(env, cfg, dual)
        sizes = wrapped.obs_size, wrapped.action_size
        params = init_params(params_key, *sizes, cfg)
        if names := named(cfg):
            check_names(names, env)
            keys = jax.random.split(params_key, len(names))
            critics = jax.vmap(lambda key: init_params(key, *sizes, cfg)["critic_c"])(keys)
            params |= {"critic_c": critics}
        opt_critics = jax.vmap(adam(cfg.critic_lr, cfg).init)(stack_critics(params))
        if cfg.trunk == "shared":
            params, opt_critics = share_trunk(params, cfg), ()
        if cfg.trunk == "gru":
            critics = 1 + (len(names) or 1)
            params, opt_critics = init_recurrent(params_key, *sizes, critics, cfg), ()
        rollout = init_rollout(wrapped, device_key(rollout_key, axis_name), cfg.num_envs, cfg.stagger)
        carry = jnp.zeros((cfg.num_envs, cfg.hidden[-1])) if cfg.trunk == "gru" else ()
        return TrainState(
            config=cfg,
            params=params,
            opt_state={"actor": init_step(params["actor"], cfg), "critics": opt_critics},
            dual=dual,
            normaliser=init_normaliser(env.obs_size) if cfg.obs_normalize else (),
            signals=init_signals(cfg, len(named(cfg)) or 1),
            rollout=dataclasses.replace(rollout, carry=carry),
            episode_length=jnp.float32(env.episode_length),
            past_costs=empty_window(cfg.cost_window, jnp.shape(limit(cfg, named(cfg)))),
            key=key,
        )

    def task(learned: Learned | TrainState) -> Env:
        return augmentation.wrap(env, learned.config, learned.dual)

    def update(ts: TrainState, shared: Shared) -> tuple[TrainState, Metrics]:
        cfg = ts.config
        key, rollout_key, step_key, critic_key = jax.random.split(ts.key, 4)

        acting = learned_of(ts)

        def behave(
            carry: PyTree, obs: jax.Array, first: jax.Array, key: jax.Array
        ) -> tuple[jax.Array, jax.Array, PyTree]:
            carry = begun_anew(remembering, acting, carry, first)
            dist, carry = decide(acting, carry, obs)
            action = sample(dist, key)
            return action, log_prob(dist, action), carry

        pool = augmentation.renew(ts.rollout.pool, cfg, ts.dual)
        rollout, traj = collect(
            task(ts),
            behave,
            dataclasses.replace(ts.rollout, pool=pool),
            device_key(rollout_key, axis_name),
            cfg.horizon,
            lambda episode: augmentation.stop(episode, cfg),
        )
        names = named(cfg)
        charged = signal(env, traj, names)
        reward, cost, signals = scaled_signals(ts, augmentation.reward(traj, cfg), charged, axis_name)
        last_obs = augmentation.last_obs(traj, cfg)
        carry = ts.rollout.carry
        batch, explained = estimate(ts, traj, carry, last_obs, reward, cost, names, axis_name)
        length = mean_length(ts.episode_length, traj.ended, traj.length, axis_name)
        cost_rate = batch_mean(traj.cost, axis_name)
        episode_cost = batch_mean(charged, axis_name, (0, 1)) * length
        recent, past_costs = window_mean(ts.past_costs, episode_cost)

        excess = recent - limit(cfg, names)
        context = Context(shared.iteration, cfg, step_key, axis_name, recent, excess, length)
        actor, opt_actor, dual, metrics = improve(ts, batch, context)
        critics, opt_critics, skipped = {}, (), 0
        if cfg.trunk == "separate":
            passes = metrics["train/passes"] if stops_critics(cfg) else cfg.critic_epochs
            critics, opt_critics, skipped, fitted = fit_critics(
                ts, batch, passes, critic_key, axis_name
            )
            metrics |= fitted
        seen = traj.obs[..., : env.obs_size]
        normaliser = merge(ts.normaliser, seen, axis_name) if cfg.obs_normalize else ()
        # parameters are guarded step by step; what is not a step of a gradient is guarded here
        finite = psum(~all_finite((batch, normaliser, signals)), axis_name) == 0
        dual, normaliser, signals, length, past_costs = select(
            finite,
            (dual, normaliser, signals, length, past_costs),
            (ts.dual, ts.normaliser, ts.signals, ts.episode_length, ts.past_costs),
        )
        # J_c of each named cost; of the cost itself it is among the next
        metrics |= explained | ({"train/cost_estimate": episode_cost} if names else {})
        metrics = spread(metrics, names) | episode_metrics(env, traj, axis_name)
        metrics |= {
            "train/cost_rate": cost_rate,  # per environment step
            "train/cost_estimate": cost_rate * length,  # J_c of this iteration
            "train/return_estimate": batch_mean(traj.reward, axis_name) * length,  # likewise
            "train/entropy": batch_mean(entropy(policy(actor, batch.obs, cfg)), axis_name),
            "train/nonfinite": metrics["train/nonfinite"] + skipped + ~finite,
        }
        ts = dataclasses.replace(
            ts,
            params={"actor": actor, **critics},
            opt_state={"actor": opt_actor, "critics": opt_critics},
            dual=dual,
            normaliser=normaliser,
            signals=signals,
            rollout=rollout,
            episode_length=length,
            past_costs=past_costs,
            key=key,
        )
        return ts, jax.tree.map(jnp.float32, metrics)

    def act(
        learned: Learned, carry: PyTree, obs: jax.Array, key: jax.Array | None
    ) -> tuple[jax.Array, PyTree, dict[str, Any]]:
        dist, carry = decide(learned, carry, obs)
        return (dist.mean if key is None else sample(dist, key)), carry, {}

    remembering = Policy(init=nothing_yet, act=act)
    return Algorithm(init, update, remembering, learned_of, task, clocks)


def decide(learned: Learned, carry: PyTree, obs: jax.Array) -> tuple[Gaussian, PyTree]:
    """The action distribution for `obs` [..., O] as the environment gives it, and the next carry."""
    actor, cfg = learned.params["actor"], learned.config
    if cfg.trunk == "gru":
        carry, dist, _ = remember(actor, carry, see(learned, obs), cfg)
        return dist, carry
    return policy(actor, see(learned, obs), cfg), carry


def nothing_yet(learned: Learned) -> PyTree:
    """The carry at the start of an episode."""
    return jnp.zeros(learned.config.hidden[-1]) if learned.config.trunk == "gru" else ()


def clocks(cfg: Any) -> Clocks:
    check(cfg)
    return Clocks(cfg.num_envs * cfg.horizon, cfg.critic_epochs * cfg.minibatches)


def fit_critics(
    ts: TrainState, batch: Batch, passes: jax.Array | int, key: jax.Array, axis_name: str | None
) -> tuple[dict[str, PyTree], PyTree, jax.Array, Metrics]:
    """All critics fitted to their targets at once: {'critic_r', 'critic_c'}, opt_state, the number of
    steps skipped, and metrics."""
    fit = partial(fit_critic, obs=batch.obs, passes=passes, key=key, cfg=ts.config, axis_name=axis_name)
    critics, opt_state, errors, skipped = jax.vmap(lambda c, o, y: fit(c, o, target=y))(
        stack_critics(ts.params), ts.opt_state["critics"], stack(batch.ret_r, batch.ret_c.T)
    )
    params = {
        "critic_r": jax.tree.map(operator.itemgetter(0), critics),
        "critic_c": jax.tree.map(lambda x, c: x[1:].reshape(c.shape), critics, ts.params["critic_c"]),
    }
    metrics = {
        "train/value_loss_r": errors[0],
        "train/value_loss_c": errors[1:].reshape(batch.ret_c.shape[1:]),
    }
    return params, opt_state, skipped.sum(), metrics


def see(ts: TrainState | Learned, obs: jax.Array) -> jax.Array:
    """`obs` [..., O] as the networks see it: what an augmentation appended is left as it is."""
    if not ts.config.obs_normalize:
        return obs
    size = ts.normaliser.mean.shape[-1]
    return jnp.concatenate([normalise(ts.normaliser, obs[..., :size]), obs[..., size:]], -1)


def init_signals(cfg: Any, costs: int) -> PyTree:
    return init_normaliser(1 + costs) if cfg.reward_normalize or cfg.cost_normalize else ()


def scaled_signals(
    ts: TrainState, reward: jax.Array, cost: jax.Array, axis_name: str | None
) -> tuple[jax.Array, jax.Array, PyTree]:
    """Reward [T, N] and cost, [T, N] or [T, N, K], as the learner sees them, and `ts.signals` with
    them added.

    Unlike observations, on which the policy has acted already, a batch is normalised by statistics
    that include it, as in OmniSafe, so that the critics' first targets have the scale of all others.
    """
    cfg = ts.config
    if not (cfg.reward_normalize or cfg.cost_normalize):
        return reward, cost, ()
    all_of_them = jnp.concatenate([reward[..., None], cost.reshape(*reward.shape, -1)], -1)
    signals = merge(ts.signals, all_of_them, axis_name)
    scaled = normalise(signals, all_of_them)
    return (
        scaled[..., 0] if cfg.reward_normalize else reward,
        scaled[..., 1:].reshape(cost.shape) if cfg.cost_normalize else cost,
        signals,
    )


def check(cfg: Any) -> None:
    """Refuse sizes that do not fit each other."""
    for name in ("num_envs", "horizon", "minibatches", "cost_window"):
        if getattr(cfg, name) < 1:
            raise ConfigError(f"{name}={getattr(cfg, name)}: expected at least 1")
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


def estimate(
    ts: TrainState,
    traj: Trajectory,
    carry: PyTree,
    next_obs: jax.Array,
    reward: jax.Array,
    cost: jax.Array,
    names: Names,
    axis_name: str | None,
) -> tuple[Batch, Metrics]:
    """Advantages and targets of `reward` [T, N] and of `cost` [T, N] or, for several `names`,
    [T, N, K], under the parameters that acted.

    Args:
        carry: what the policy remembered before the rollout.
        next_obs: float [T, N, O], whose value each step leads to.
    """
    cfg = ts.config
    obs, next_obs = see(ts, traj.obs), see(ts, next_obs)
    seen, old, v, next_v = read(ts.params, obs, next_obs, traj.first, carry, cfg)
    ratio = jnp.exp(log_prob(old, traj.action) - traj.log_prob)  # 1: the policy is still the same
    v_c, next_v_c = (x[..., 1:].reshape(cost.shape) for x in (v, next_v))

    def both(v: jax.Array, next_v: jax.Array, signal: jax.Array, discount: Any, decay: Any):
        ends = traj.terminated, traj.done
        adv, error = advantages(
            cfg.estimator, signal, v, next_v, *ends, ratio, discount=discount, decay=decay
        )
        return adv, error, error + v

    adv_r, error_r, ret_r = both(v[..., 0], next_v[..., 0], reward, cfg.discount, cfg.gae_lambda)
    of_cost = jax.vmap(both, (-1, -1, -1, None, None), -1) if names else both
    adv_c, error_c, ret_c = of_cost(v_c, next_v_c, cost, cfg.cost_discount, cfg.cost_gae_lambda)
    # rows of a minibatch: single steps or, with a memory, whole sequences of an environment
    rows = sequences if cfg.trunk == "gru" else steps
    batch = Batch(
        obs=seen if cfg.trunk == "gru" else steps(seen),
        action=rows(traj.action),
        log_prob=rows(traj.log_prob),
        old=jax.tree.map(rows, old),
        adv_r=rows(standardise(adv_r, axis_name)),
        adv_c=rows(each(lambda x: centre(x, axis_name), names)(adv_c)),
        ret_r=rows(ret_r),
        ret_c=rows(ret_c),
    )
    metrics = {
        "train/explained_variance_r": explained_variance(error_r, ret_r, axis_name),
        "train/explained_variance_c": each(
            lambda error, target: explained_variance(error, target, axis_name), names
        )(error_c, ret_c),
    }
    return batch, metrics


def steps(x: jax.Array) -> jax.Array:
    """[T * N, ...] of [T, N, ...]."""
    return x.reshape(-1, *x.shape[2:])


def sequences(x: jax.Array) -> jax.Array:
    """[N, T, ...] of [T, N, ...]."""
    return jnp.swapaxes(x, 0, 1)

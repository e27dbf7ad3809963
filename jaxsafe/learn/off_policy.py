"""The off-policy loop: rollout, replay, gradient steps, as one pure update.

An update is an iteration of `jaxsafe.learn.timetable`. It goes in rounds, and each round gathers rows
and then learns from the replay. After the rounds a method may refit a model, and the price on cost
moves if it is due: see `jaxsafe.learn.bill`.

What a method adds to this is a `Learner`, and a `Treatment` of the constraint.

`jit(update)` compiles an iteration. `vmap(update, in_axes=(0, None))` runs seeds or floats of the
config side by side. `shard_map(update)` with `axis_name` set splits environments, replay and batch over
devices. Each device then holds `cfg.num_envs` environments of its own, and the same parameters.
"""

import dataclasses
import math
from typing import Any, Literal, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from jaxsafe.config import Norm, Rate, Share, Units, config
from jaxsafe.learn.acting import Acted, ActInAll, Learned, Player, first_carries, learned_of
from jaxsafe.learn.batch import all_finite, device_key, masked_mean, psum, select
from jaxsafe.learn.bill import charge, empty_bill, settle
from jaxsafe.learn.constraints import Names, check_cost_names, metrics_by_constraint, signal
from jaxsafe.learn.learner import GradientStep, Learner, policy_by
from jaxsafe.learn.metrics import step_metrics
from jaxsafe.learn.next_step_rollout import Stepping, StepRecord, collect_records, started
from jaxsafe.learn.normalise import init_normaliser, merge, network_inputs
from jaxsafe.learn.observations import check_observation, vector_of
from jaxsafe.learn.replay import Record, Source, empty_ring, write
from jaxsafe.learn.returns import LostTime, expected_length, no_lost_time
from jaxsafe.learn.rollout import init_rollout
from jaxsafe.learn.steps import Trainable, remaining
from jaxsafe.learn.timetable import Round, RoundConfig, timetable_of
from jaxsafe.learn.treatments import Treatment, no_treatment
from jaxsafe.types import Algorithm, Clocks, Env, Metrics, PyTree, Shared, State


@config
class OffPolicyConfig(RoundConfig):
    """What the off-policy algorithms share."""

    # Units of the hidden layers of each network, as in OmniSafe.
    hidden: tuple[Units, ...] = (256, 256)
    activation: Literal["relu", "tanh"] = "relu"  # Of the hidden layers, as in OmniSafe.
    # The first weights. torch: uniform as in PyTorch, OmniSafe's choice. orthogonal: with gains.
    init: Literal["torch", "orthogonal"] = "torch"
    # What hidden layers are computed in. On a GPU bfloat16, which has 8 bits, is faster for large
    # batches. On a CPU float32 is.
    hidden_dtype: Literal["float32", "bfloat16"] = "float32"
    # Whether the critics normalise their layers, which steadies large batches. OmniSafe does not.
    layer_norm: bool = True
    # Whether observations are normalised by a running mean and variance. OmniSafe does not.
    obs_normalize: bool = True
    # The share of the critics that their targets take on at each step. OmniSafe has 0.005.
    tau: Share = 0.01
    lr: Rate = 3e-4  # The policy's learning rate, by Adam, as in OmniSafe.
    critic_lr: Rate = 3e-4  # The critics' learning rate, by Adam, as in OmniSafe.
    # Whether both learning rates fall linearly to 0 at `total_iterations`. OmniSafe keeps them.
    lr_decay: bool = False
    max_grad_norm: Norm = 40.0  # The largest norm of each network's gradient, as in OmniSafe.


@flax.struct.dataclass
class TrainState:
    """All that an update needs besides `Shared`.

    config: the algorithm's, with its floats as arrays; `num_envs` is this device's share.
    params, opt_state: the learner's.
    dual: the treatment's state, () without one.
    bill: Bill, or () without a treatment.
    normaliser: Normaliser, or () without `obs_normalize`.
    stepping: this device's environments.
    replay: their ring, [N, R, ...].
    lost_time: LostTime, from which the mean length of an episode follows.
    """

    config: Any
    params: dict[str, PyTree]
    opt_state: dict[str, PyTree]
    dual: PyTree
    bill: PyTree
    normaliser: PyTree
    stepping: Stepping
    replay: Record
    lost_time: LostTime
    key: jax.Array

    @property
    def nets(self) -> Trainable:
        return Trainable(self.params, self.opt_state)

    def with_nets(self, nets: Trainable) -> "TrainState":
        return dataclasses.replace(self, params=nets.params, opt_state=nets.opt_state)


class RoundReport(NamedTuple):
    """What a round came to.

    steps: StepRecord [rows, N].
    skipped: bool [], whether the normaliser left out its observations because they are not finite.
    learned: bool [], whether gradient steps were taken.
    metrics: of these, [gradient_steps] each.
    """

    steps: StepRecord
    skipped: jax.Array
    learned: jax.Array
    metrics: Metrics


def off_policy(
    env: Env,
    learner: Learner,
    treatment: Treatment = no_treatment,
    axis_name: str | None = None,
) -> Algorithm:
    """The algorithm that `learner` makes of the loop, with a price on cost that `treatment` moves."""
    policy = policy_by(learner)
    priced = treatment is not no_treatment

    def init(key: jax.Array, cfg: Any, shared: Shared) -> TrainState:
        rows = timetable_of(cfg, axis_name).ring
        names = treatment.constrained_costs(cfg)
        check_cost_names("cost_limits", names, env)
        cfg = jax.tree.map(jnp.float32, cfg)
        params_key, stepping_key, key = jax.random.split(key, 3)
        rollout = init_rollout(env, device_key(stepping_key, axis_name), cfg.num_envs, cfg.stagger)
        check_observation(rollout.state.obs, cfg)
        nets = learner.init(params_key, env.obs_size, env.action_size, cfg)
        dual = treatment.init(cfg)
        normaliser = init_normaliser(env.obs_size) if normalises(cfg) else ()
        learned = Learned(cfg, nets.params, dual, normaliser)
        carry = first_carries(policy, learned, cfg.num_envs)
        stepping = started(dataclasses.replace(rollout, carry=carry))
        actions = jnp.zeros((cfg.num_envs, env.action_size))
        return TrainState(
            config=cfg,
            params=nets.params,
            opt_state=nets.opt_state,
            dual=dual,
            bill=empty_bill(cfg, names) if priced else (),
            normaliser=normaliser,
            stepping=stepping,
            replay=empty_ring(learner.record(cfg)(stepping, actions), rows),
            lost_time=no_lost_time(),
            key=key,
        )

    def update(ts: TrainState, shared: Shared) -> tuple[TrainState, Metrics]:
        table = timetable_of(ts.config, axis_name)
        key, rounds_key = jax.random.split(ts.key)

        def one_round(ts: TrainState, x: tuple[jax.Array, jax.Array]) -> tuple[TrainState, RoundReport]:
            number, key = x
            gather_key, learn_key = jax.random.split(key)
            at = table.at(number, shared)
            # a model is fitted after the rounds; until it first is, there is nothing to act by
            random = (at if learner.refit is None else table.at(0, shared)).warming_up
            ts, steps, skipped = gather(ts, at, random, gather_key)
            ts, metrics = learn(ts, at, learn_key)
            return ts, RoundReport(steps, skipped, at.ready, metrics)

        keys = jax.random.split(rounds_key, table.rounds)
        ts, rounds = jax.lax.scan(one_round, ts, (jnp.arange(table.rounds), keys))
        ts, refitted = refit(ts, shared, jax.random.fold_in(rounds_key, table.rounds))
        # an environment without costs has leaves of size 0, whose first axis cannot be -1
        steps = jax.tree.map(lambda x: x.reshape(math.prod(x.shape[:2]), *x.shape[2:]), rounds.steps)
        length, lost_time = expected_length(
            ts.lost_time, env.episode_length, steps, steps.real.sum(), axis_name
        )
        ts, paid = pay(ts, steps, length, shared)
        names = treatment.constrained_costs(ts.config)
        counted = learner.counted(env, steps, ts.config)
        metrics = united(
            means_of_gradient_steps(rounds.metrics, rounds.learned),
            {"train/nonfinite": rounds.skipped.sum()},
            paid,
            metrics_of_steps(env, steps, length, names, axis_name),
            {f"train/{k}": psum((x & steps.real).sum(), axis_name) for k, x in counted.items()},
            refitted,
        )
        return dataclasses.replace(ts, lost_time=lost_time, key=key), metrics

    def gather(
        ts: TrainState, at: Round, random: jax.Array, key: jax.Array
    ) -> tuple[TrainState, StepRecord, jax.Array]:
        """The rows of a round, and whether the normaliser had to skip them."""
        learned = learned_of(ts)
        random &= learner.random_start(learned)
        explore = exploring(learned, remaining(at.iteration, ts.config))
        act = at_random_while(random, explore, (ts.config.num_envs, env.action_size))
        keys = jax.random.split(device_key(key, axis_name), timetable_of(ts.config, axis_name).rows)
        describe = learner.record(ts.config)
        stepping, (rows, steps) = collect_records(env, act, ts.stepping, keys, describe)
        normaliser, skipped = ts.normaliser, jnp.bool_(False)
        if normalises(ts.config):
            merged = merge(normaliser, vector_of(rows.obs), axis_name)
            finite = all_finite(merged)
            normaliser, skipped = select(finite, merged, normaliser), ~finite
        replay = write(ts.replay, rows, at.before)
        ts = dataclasses.replace(ts, stepping=stepping, replay=replay, normaliser=normaliser)
        return ts, steps, skipped

    def exploring(learned: Learned, share: jax.Array) -> ActInAll:
        """How training acts while a `share` of it is left."""
        if learner.policy is not None:
            return Player(learner.policy, learned, env).act_in_all

        def act(carry: PyTree, state: State, first: jax.Array, key: jax.Array) -> Acted:
            obs = network_inputs(learned.normaliser, state.obs)
            if learner.explore is None:
                return learner.act(learned, obs, key), carry, {}
            return learner.explore(learned, obs, key, share), carry, {}

        return act

    def learn(ts: TrainState, at: Round, key: jax.Array) -> tuple[TrainState, Metrics]:
        """The gradient steps of a round if it is ready, each on a batch of its own.

        If they lead to anything that is not finite, none of them takes effect. On a GPU many small
        kernels take much of a gradient step's time. So what all steps need is done once: batches are
        drawn before the first step, and the outcome is checked after the last.
        """
        cfg, table = ts.config, timetable_of(ts.config, axis_name)
        if not table.gradient_steps:
            return ts, {}
        share = remaining(at.iteration, cfg)
        source = Source(ts.replay, at.after, ts.normaliser, table.batch, cfg.n_step)

        def keys_of(key: jax.Array) -> jax.Array:
            return jax.random.split(device_key(key, axis_name))

        def batch_of(key: jax.Array) -> tuple[PyTree, jax.Array]:
            return learner.replayed(key, source, cfg, axis_name)

        def step(nets: Trainable, x: tuple[jax.Array, jax.Array, PyTree]) -> tuple[Trainable, Metrics]:
            number, key, batch = x
            when = GradientStep(number, share, key, ts.dual)
            nets, metrics = learner.step(nets, batch, when, cfg, axis_name)
            return nets, jax.tree.map(jnp.float32, metrics)

        def steps(nets: Trainable) -> tuple[Trainable, Metrics]:
            keys = jax.vmap(keys_of)(jax.random.split(key, table.gradient_steps))
            batches, dropped = jax.vmap(batch_of)(keys[:, 0])
            numbers = at.first_step + jnp.arange(table.gradient_steps)
            new, metrics = jax.lax.scan(step, nets, (numbers, keys[:, 1], batches))
            # targets are finite where what they follow is
            followed = {name: x for name, x in new.params.items() if name != "targets"}
            finite = psum(~all_finite((followed, new.opt_state)), axis_name) == 0
            lost = {"train/nonfinite": jnp.float32(dropped + ~finite)}
            return select(finite, new, nets), metrics | lost

        like = jax.eval_shape(steps, ts.nets)[1]
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
        nets, metrics = jax.lax.cond(at.ready, steps, lambda nets: (nets, nothing), ts.nets)
        return ts.with_nets(nets), metrics

    def refit(ts: TrainState, shared: Shared, key: jax.Array) -> tuple[TrainState, Metrics]:
        """What the learner does after the rounds of an iteration."""
        if learner.refit is None:
            return ts, {}
        nets, metrics = learner.refit(ts.nets, ts.replay, shared, key, ts.config, axis_name)
        return ts.with_nets(nets), metrics

    def pay(
        ts: TrainState, steps: StepRecord, length: jax.Array, shared: Shared
    ) -> tuple[TrainState, Metrics]:
        """The steps of an iteration are put on the bill, and the price moves if it is due."""
        if not priced:
            return ts, {}
        cfg, names = ts.config, treatment.constrained_costs(ts.config)
        bill = charge(ts.bill, signal(env, steps, names), steps.real, axis_name)
        dual, bill, failed = settle(treatment, ts.dual, bill, length, cfg, shared.iteration)
        metrics = metrics_by_constraint(treatment.metrics(dual), names)
        return dataclasses.replace(ts, dual=dual, bill=bill), metrics | {"train/nonfinite": failed}

    def clocks(cfg: Any) -> Clocks:
        table = timetable_of(cfg, None)
        return Clocks(cfg.num_envs * cfg.horizon, table.rounds * table.gradient_steps)

    return Algorithm(init, update, policy, learned_of, lambda learned: env, clocks)


def normalises(cfg: Any) -> bool:
    """Whether the loop keeps a normaliser of observations."""
    return isinstance(cfg, OffPolicyConfig) and cfg.obs_normalize


def at_random_while(random: jax.Array, act: ActInAll, shape: tuple[int, int]) -> ActInAll:
    """`act`; while `random` [] holds, actions of this shape, [N, A], drawn uniformly from [-1, 1].

    What `act` reports beside its actions is 0 then.
    """

    def either(carry: PyTree, state: State, first: jax.Array, key: jax.Array) -> Acted:
        act_key, random_key = jax.random.split(key)

        def chosen(carry: PyTree) -> Acted:
            return act(carry, state, first, act_key)

        def at_random(carry: PyTree) -> Acted:
            action = jax.random.uniform(random_key, shape, minval=-1.0, maxval=1.0)
            silent = {k: jnp.zeros(x.shape) for k, x in jax.eval_shape(chosen, carry)[2].items()}
            return action, carry, silent

        return jax.lax.cond(random, at_random, chosen, carry)

    return either


# ---- metrics -----------------------------------------------------------------------------------


def united(*parts: Metrics) -> Metrics:
    """All metrics, in float32. `train/nonfinite` is the sum of what the parts have under that name."""
    lost = sum(part.get("train/nonfinite", 0) for part in parts)
    metrics = {name: x for part in parts for name, x in part.items()} | {"train/nonfinite": lost}
    return jax.tree.map(jnp.float32, metrics)


def means_of_gradient_steps(metrics: Metrics, learned: jax.Array) -> Metrics:
    """Means over the steps [rounds, steps] of the rounds that `learned`, NaN where there are none.

    A metric that a step does not have is NaN there. `train/nonfinite` is a sum, not a mean.
    """

    def mean(x: jax.Array) -> jax.Array:
        return masked_mean(x, learned[:, None] & ~jnp.isnan(x), None)

    if not metrics:
        return {}
    return jax.tree.map(mean, metrics) | {"train/nonfinite": metrics["train/nonfinite"].sum()}


def metrics_of_steps(
    env: Env, steps: StepRecord, length: jax.Array, names: Names, axis_name: str | None
) -> Metrics:
    """What real steps earned and cost. `length` is of an episode, in steps."""

    def rate(x: jax.Array) -> jax.Array:
        return masked_mean(x, steps.real, axis_name)

    charged = signal(env, steps, names)
    return {
        **step_metrics(env, steps, rate, length, axis_name),
        **{f"train/cost_estimate_{n}": rate(charged[..., k]) * length for k, n in enumerate(names)},
        **{f"train/{name}": rate(x) for name, x in steps.said.items()},
    }

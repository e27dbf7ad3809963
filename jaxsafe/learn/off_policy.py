"""The off-policy loop: rollout, replay, gradient steps, as one pure update.

An update is `horizon` steps of every environment. They go in rounds. A round is `learn_every` steps,
whose rows are written into the replay, and then the gradient steps that `replay_ratio` asks for. After
the rounds a method may refit a model, and the price on cost moves if it is due.

What a method adds to this is a `Learner`, and a `Treatment` of the constraint, whose price moves on a
clock of environment steps: see `jaxsafe.learn.bill`.

`jit(update)` compiles an iteration. `vmap(update, in_axes=(0, None))` runs seeds or floats of the
config side by side. `shard_map(update)` with `axis_name` set splits environments, replay and batch over
devices. Each device then holds `cfg.num_envs` environments of its own, and the same parameters.
"""

import dataclasses
import math
from collections.abc import Iterable
from typing import Annotated, Any, Literal, NamedTuple

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
from jaxsafe.learn.acting import Learned, Player, learned_of, reset_carry
from jaxsafe.learn.batch import all_finite, device_count, device_key, masked_mean, psum, select
from jaxsafe.learn.bill import charge, empty_bill, settle
from jaxsafe.learn.constraints import Names, check_cost_names, metrics_by_constraint, signal
from jaxsafe.learn.learner import GradientStep, Learner, policy_by
from jaxsafe.learn.metrics import step_metrics
from jaxsafe.learn.next_step_rollout import Stepping, StepRecord, collect_records, started
from jaxsafe.learn.normalise import init_normaliser, merge, network_inputs
from jaxsafe.learn.observations import check_observation, vector_of
from jaxsafe.learn.replay import (
    Record,
    Source,
    Span,
    Transitions,
    draw,
    empty_ring,
    held,
    ring_rows,
    transitions,
    usable,
    write,
)
from jaxsafe.learn.returns import LostTime, expected_length, no_lost_time
from jaxsafe.learn.rollout import check_steps, init_rollout
from jaxsafe.learn.steps import Trainable, remaining
from jaxsafe.learn.treatments import Treatment, no_treatment
from jaxsafe.types import Algorithm, Clocks, Count, Env, Metrics, PyTree, Shared, State


@config
class ReplayConfig:
    """What all algorithms with a replay share."""

    # Environments side by side, of all devices together. OmniSafe has 1.
    num_envs: Amount = 1024
    horizon: Amount = 16  # Steps of each environment in an update.
    stagger: bool = True  # Whether the first episodes start at different ages, so that ends spread out.
    # The iteration at which whatever decays reaches 0. inf: the last one of `total_steps`.
    total_iterations: EndOfDecay = float("inf")
    # Transitions kept, rounded to whole updates. As in OmniSafe.
    replay_size: Annotated[int, Bounds(1, 2**31 - 1)] = 1_000_000
    # Environment steps with random actions and without learning, as in OmniSafe.
    learning_starts: Annotated[int, Bounds(0, 2**31 - 1)] = 10_000
    discount: Share = 0.99  # The discount of rewards, as in OmniSafe.
    cost_discount: Share = 0.99  # The discount of costs, as in OmniSafe.
    # The undiscounted cost that an episode may have. Unconstrained algorithms only draw it in plots.
    cost_limit: Weight = 25.0


@config
class RoundConfig(ReplayConfig):
    """What algorithms share that take gradient steps on rows of a replay."""

    # Steps of each environment between two rounds of gradient steps.
    learn_every: Amount = 1
    replay_ratio: Amount = 16  # Transitions replayed for each environment step. OmniSafe has 256.
    # Transitions of a gradient step, of all devices together. OmniSafe has 256.
    batch_size: Amount = 1024
    n_step: Iterations = 1  # Rewards summed before the critics' value. OmniSafe has 1.


@config
class OffPolicyConfig(RoundConfig):
    """What the off-policy algorithms share."""

    # Units of the hidden layers of each network, as in OmniSafe.
    hidden: tuple[Units, ...] = (256, 256)
    activation: Literal["relu", "tanh"] = "relu"  # Of the hidden layers, as in OmniSafe.
    # The first weights. torch: uniform as in PyTorch, OmniSafe's choice. orthogonal: with gains.
    init: Literal["torch", "orthogonal"] = "torch"
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
    replay: their ring, [R, N, ...].
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


class RoundCarry(NamedTuple):
    """What passes from one round to the next."""

    nets: Trainable
    normaliser: PyTree
    stepping: Stepping
    replay: Record


class RoundClock(NamedTuple):
    """Where a round stands in the run. All but `remaining` is the same for all members.

    before, after: Span, what the ring holds before and after the rows of the round are written.
    warming_up: bool [], whether actions are random.
    ready: bool [], whether there is enough in the ring to learn from.
    gradient_steps: int32 [], those of the run that were due before this round.
    remaining: float [], the share of training that is left.
    """

    before: Span
    after: Span
    warming_up: jax.Array
    ready: jax.Array
    gradient_steps: jax.Array
    remaining: jax.Array


class RoundReport(NamedTuple):
    """What a round came to.

    steps: StepRecord [learn_every, N].
    metrics: of its gradient steps, [updates] each.
    ready: see `RoundClock`.
    skipped: bool [], whether the normaliser left out its observations because they are not finite.
    """

    steps: StepRecord
    metrics: Metrics
    ready: jax.Array
    skipped: jax.Array


class Priced(NamedTuple):
    """The price on cost after an update.

    dual: the treatment's state. bill: Bill since the price last moved. failed: bool [], whether a move
    was left out because the new price is not finite.
    """

    dual: PyTree
    bill: PyTree
    metrics: Metrics
    failed: jax.Array


def off_policy(
    env: Env,
    learner: Learner,
    treatment: Treatment = no_treatment,
    axis_name: str | None = None,
) -> Algorithm:
    """The algorithm that `learner` makes of the loop, with a price on cost that `treatment` moves."""
    policy = policy_by(learner)
    explore = learner.explore or learner.act
    replayed = learner.replayed or drawn_transitions
    priced = treatment is not no_treatment

    def init(key: jax.Array, cfg: Any, shared: Shared) -> TrainState:
        sizes = sizes_of(cfg, axis_name)
        names = treatment.constrained_costs(cfg)
        check_cost_names(names, env)
        cfg = jax.tree.map(jnp.float32, cfg)
        params_key, stepping_key, key = jax.random.split(key, 3)
        rollout = init_rollout(env, device_key(stepping_key, axis_name), cfg.num_envs, cfg.stagger)
        check_observation(rollout.state.obs, cfg)
        nets = learner.init(params_key, env.obs_size, env.action_size, cfg)
        dual = treatment.init(cfg)
        normaliser = init_normaliser(env.obs_size) if sizes.normalises else ()
        carry = policy.init(Learned(cfg, nets.params, dual, normaliser))
        every = jax.tree.map(lambda x: jnp.broadcast_to(x, (cfg.num_envs, *x.shape)), carry)
        stepping = started(dataclasses.replace(rollout, carry=every))
        actions = jnp.zeros((cfg.num_envs, env.action_size))
        return TrainState(
            config=cfg,
            params=nets.params,
            opt_state=nets.opt_state,
            dual=dual,
            bill=empty_bill(cfg, names) if priced else (),
            normaliser=normaliser,
            stepping=stepping,
            replay=empty_ring(learner.record(cfg)(stepping, actions), sizes.rows),
            lost_time=no_lost_time(),
            key=key,
        )

    def update(ts: TrainState, shared: Shared) -> tuple[TrainState, Metrics]:
        sizes = sizes_of(ts.config, axis_name)
        key, rounds_key = jax.random.split(ts.key)

        def one_round(
            now: RoundCarry, x: tuple[jax.Array, jax.Array]
        ) -> tuple[RoundCarry, RoundReport]:
            number, key = x
            gather_key, learn_key = jax.random.split(key)
            at = round_clock(number, shared, sizes, ts.config, learner.refit is not None)
            now, steps, skipped = gather(ts, now, at, gather_key)

            def learn(nets: Trainable) -> tuple[Trainable, Metrics]:
                return gradient_steps(ts, now._replace(nets=nets), at, learn_key)

            like = jax.eval_shape(learn, now.nets)[1]
            nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
            nets, metrics = jax.lax.cond(at.ready, learn, lambda nets: (nets, nothing), now.nets)
            return now._replace(nets=nets), RoundReport(steps, metrics, at.ready, skipped)

        now = RoundCarry(Trainable(ts.params, ts.opt_state), ts.normaliser, ts.stepping, ts.replay)
        numbers, keys = jnp.arange(sizes.rounds), jax.random.split(rounds_key, sizes.rounds)
        now, rounds = jax.lax.scan(one_round, now, (numbers, keys))

        refit_key = jax.random.fold_in(rounds_key, sizes.rounds)
        nets, refitted = refit(ts, now, shared, refit_key)

        steps = jax.tree.map(lambda x: x.reshape(ts.config.horizon, *x.shape[2:]), rounds.steps)
        taken = steps.real.sum()
        length, lost_time = expected_length(ts.lost_time, env.episode_length, steps, taken, axis_name)
        after = pay(ts, steps, length, shared.iteration)
        metrics = means_of_gradient_steps(rounds.metrics, rounds.ready) | after.metrics
        names = treatment.constrained_costs(ts.config)
        metrics |= metrics_of_steps(env, steps, length, names, axis_name)
        lost = rounds.metrics["train/nonfinite"].sum() + rounds.skipped.sum() + after.failed
        lost += refitted.pop("train/nonfinite", 0)
        metrics |= refitted | {"train/nonfinite": lost}
        ts = dataclasses.replace(
            ts,
            params=nets.params,
            opt_state=nets.opt_state,
            dual=after.dual,
            bill=after.bill,
            normaliser=now.normaliser,
            stepping=now.stepping,
            replay=now.replay,
            lost_time=lost_time,
            key=key,
        )
        return ts, jax.tree.map(jnp.float32, metrics)

    def gather(
        ts: TrainState, now: RoundCarry, at: RoundClock, key: jax.Array
    ) -> tuple[RoundCarry, StepRecord, jax.Array]:
        """The environment steps of a round, and whether the normaliser had to skip them."""
        cfg, sizes = ts.config, sizes_of(ts.config, axis_name)
        learned = Learned(cfg, now.nets.params, ts.dual, now.normaliser)
        random = at.warming_up
        if learner.random_start is not None:
            random &= learner.random_start(learned)

        def behave(
            carry: PyTree, state: State, first: jax.Array, key: jax.Array
        ) -> tuple[jax.Array, PyTree, dict[str, jax.Array]]:
            explore_key, random_key = jax.random.split(key)

            def chosen(carry: PyTree) -> tuple[jax.Array, PyTree, dict[str, jax.Array]]:
                if learner.policy is not None:
                    player = Player(policy, learned, env)
                    return act_in_all(player, carry, state, first, explore_key)
                obs = network_inputs(now.normaliser, state.obs)
                return explore(learned, obs, explore_key), carry, {}

            def at_random(carry: PyTree) -> tuple[jax.Array, PyTree, dict[str, jax.Array]]:
                shape = (cfg.num_envs, env.action_size)
                action = jax.random.uniform(random_key, shape, minval=-1.0, maxval=1.0)
                silent = {k: jnp.zeros(x.shape) for k, x in jax.eval_shape(chosen, carry)[2].items()}
                return action, carry, silent

            return jax.lax.cond(random, at_random, chosen, carry)

        keys = jax.random.split(device_key(key, axis_name), sizes.every)
        stepping, (rows, steps) = collect_records(env, behave, now.stepping, keys, learner.record(cfg))
        normaliser, skipped = now.normaliser, jnp.bool_(False)
        if sizes.normalises:
            merged = merge(normaliser, vector_of(rows.obs), axis_name)
            finite = all_finite(merged)
            normaliser, skipped = select(finite, merged, normaliser), ~finite
        replay = write(now.replay, rows, at.before)
        return RoundCarry(now.nets, normaliser, stepping, replay), steps, skipped

    def gradient_steps(
        ts: TrainState, now: RoundCarry, at: RoundClock, key: jax.Array
    ) -> tuple[Trainable, Metrics]:
        """The gradient steps of a round, each on a batch of its own. Metrics are [updates].

        If they lead to anything that is not finite, none of them takes effect. A GPU spends as long on
        launching a gradient step as on computing it, so what all of them need is done once: all batches
        are drawn before the first, and the outcome is checked after the last.
        """
        cfg, sizes = ts.config, sizes_of(ts.config, axis_name)
        source = Source(now.replay, at.after, now.normaliser, sizes.batch, sizes.n_step)

        def keys_of(key: jax.Array) -> jax.Array:
            return jax.random.split(device_key(key, axis_name))

        def batch_of(key: jax.Array) -> tuple[PyTree, jax.Array]:
            return replayed(key, source, cfg, axis_name)

        def step(nets: Trainable, x: tuple[jax.Array, jax.Array, PyTree]) -> tuple[Trainable, Metrics]:
            number, key, batch = x
            when = GradientStep(number, at.remaining, key, ts.dual)
            new, metrics = learner.step(nets, batch, when, cfg, axis_name)
            return new, jax.tree.map(jnp.float32, metrics)

        keys = jax.vmap(keys_of)(jax.random.split(key, sizes.updates))
        batches, dropped = jax.vmap(batch_of)(keys[:, 0])
        numbers = at.gradient_steps + jnp.arange(sizes.updates)
        nets, metrics = jax.lax.scan(step, now.nets, (numbers, keys[:, 1], batches))
        finite = psum(~all_finite(nets), axis_name) == 0
        lost = {"train/nonfinite": jnp.float32(dropped + ~finite)}
        return select(finite, nets, now.nets), metrics | lost

    def refit(
        ts: TrainState, now: RoundCarry, shared: Shared, key: jax.Array
    ) -> tuple[Trainable, Metrics]:
        """What the learner does after the rounds of an update."""
        if learner.refit is None:
            return now.nets, {}
        return learner.refit(now.nets, now.replay, shared, key, ts.config, axis_name)

    def pay(ts: TrainState, steps: StepRecord, length: jax.Array, iteration: Count) -> Priced:
        """The steps of an update are put on the bill, and the price moves if it is due."""
        if not priced:
            return Priced((), (), {}, jnp.bool_(False))
        cfg, names = ts.config, treatment.constrained_costs(ts.config)
        bill = charge(ts.bill, signal(env, steps, names), steps.real, axis_name)
        dual, bill, failed = settle(treatment, ts.dual, bill, length, cfg, iteration)
        return Priced(dual, bill, metrics_by_constraint(treatment.metrics(dual), names), failed)

    def clocks(cfg: Any) -> Clocks:
        sizes = sizes_of(cfg, None)
        return Clocks(cfg.num_envs * cfg.horizon, sizes.rounds * sizes.updates)

    return Algorithm(init, update, policy, learned_of, lambda learned: env, clocks)


def act_in_all(
    player: Player, carry: PyTree, state: State, first: jax.Array, key: jax.Array
) -> tuple[jax.Array, PyTree, dict[str, jax.Array]]:
    """The actions [N, A] of a policy in N environments, its carries, begun anew at `first` [N], and
    what it says beside the actions, float [N] by name."""
    carry = reset_carry(player.policy, player.learned, carry, first)
    action, carry, said = jax.vmap(player.decide)(carry, state, jax.random.split(key, len(first)))
    return action, carry, jax.tree.map(jnp.float32, said)


def drawn_transitions(
    key: jax.Array, source: Source, cfg: Any, axis_name: str | None
) -> tuple[Transitions, jax.Array]:
    """A batch of transitions with normalised observations, and how many of them are not finite."""
    index = draw(key, source.ring, source.span, source.rows)
    discounts = {"discount": cfg.discount, "cost_discount": cfg.cost_discount}
    found = transitions(source.ring, source.span, index, n_step=source.n_step, **discounts)
    batch, dropped = usable(found, axis_name)
    obs, next_obs = (network_inputs(source.normaliser, x) for x in (batch.obs, batch.next_obs))
    return batch._replace(obs=obs, next_obs=next_obs), dropped


def means_of_gradient_steps(metrics: Metrics, ready: jax.Array) -> Metrics:
    """Means over the steps [rounds, updates] of the rounds that were `ready`, NaN where there are none.

    A metric that a step does not have is NaN there.
    """

    def mean(x: jax.Array) -> jax.Array:
        return masked_mean(x, ready[:, None] & ~jnp.isnan(x), None)

    return jax.tree.map(mean, metrics)


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


# ---- sizes and clocks -------------------------------------------------------------------------


class Sizes(NamedTuple):
    """What follows from the config.

    rounds: of an update.
    every, updates: steps of each environment, and gradient steps, in a round.
    batch: rows of a device's share of a batch.
    n_step: steps of a transition, at most.
    rows: of the replay.
    warm_up: rows, of each environment, that are taken with random actions.
    normalises: whether observations are normalised.
    """

    rounds: int
    every: int
    updates: int
    batch: int
    n_step: int
    rows: int
    warm_up: int
    normalises: bool


def sizes_of(cfg: Any, axis_name: str | None) -> Sizes:
    """Sizes, for `cfg.num_envs` environments on each device.

    Raises:
        ConfigError: sizes out of their bounds, or that do not fit each other.
    """
    check_values(cfg)
    check_steps(cfg.num_envs, cfg.horizon)
    devices = device_count(axis_name)
    num_envs = cfg.num_envs * devices
    rows = ring_rows(cfg.replay_size, num_envs, cfg.horizon)
    warm_up = -(-cfg.learning_starts // num_envs)
    if not isinstance(cfg, RoundConfig):  # no gradient steps on rows of the replay
        return Sizes(1, cfg.horizon, 0, 0, 1, rows, warm_up, False)
    if cfg.horizon % cfg.learn_every:
        choices = [n for n in range(1, cfg.horizon + 1) if cfg.horizon % n == 0]
        nearest = min(choices, key=lambda n: abs(n - cfg.learn_every))
        raise ConfigError(
            f"learn_every={cfg.learn_every}: expected a divisor of horizon={cfg.horizon}; "
            f"the nearest is {nearest}"
        )
    if cfg.batch_size % devices:
        raise ConfigError(f"batch_size={cfg.batch_size} does not split over {devices} devices")
    steps = num_envs * cfg.learn_every  # environment steps of a round
    replayed = cfg.replay_ratio * steps
    updates = round(replayed / cfg.batch_size)
    if not math.isclose(updates * cfg.batch_size, replayed):
        raise ConfigError(
            f"replay_ratio={cfg.replay_ratio}: {cfg.replay_ratio} x num_envs={num_envs} x "
            f"learn_every={cfg.learn_every} transitions are no whole number of batches of "
            f"{cfg.batch_size}; {fitting(cfg, steps)}"
        )
    if cfg.batch_size > rows * num_envs or rows <= cfg.n_step:
        raise ConfigError(
            f"replay_size={cfg.replay_size} holds {rows} steps of {num_envs} environments: expected "
            f"at least batch_size={cfg.batch_size} transitions and more than n_step={cfg.n_step} steps"
        )
    return Sizes(
        rounds=cfg.horizon // cfg.learn_every,
        every=cfg.learn_every,
        updates=updates,
        batch=cfg.batch_size // devices,
        n_step=cfg.n_step,
        rows=rows,
        warm_up=warm_up,
        normalises=isinstance(cfg, OffPolicyConfig) and cfg.obs_normalize,
    )


def round_clock(number: jax.Array, shared: Shared, sizes: Sizes, cfg: Any, refits: bool) -> RoundClock:
    """The clock at round `number` of an iteration. A learner that refits something does so at the end
    of an iteration, so its warm-up lasts until then."""
    iteration, since = jnp.asarray(shared.iteration), shared.since
    written = number * sizes.every  # rows of this iteration, before the round
    filled = (iteration - since) * cfg.horizon + written + sizes.every
    acted = iteration * cfg.horizon + (0 if refits else written)  # rows of the whole run
    return RoundClock(
        before=held(sizes.rows, cfg.horizon, written, iteration, since),
        after=held(sizes.rows, cfg.horizon, written + sizes.every, iteration, since),
        warming_up=acted < sizes.warm_up,
        ready=filled >= jnp.maximum(sizes.warm_up, 2),
        gradient_steps=(iteration * sizes.rounds + number) * sizes.updates,
        remaining=remaining(iteration, cfg),
    )


def fitting(cfg: Any, steps: int) -> str:
    """The nearest settings that make whole gradient steps of a round of `steps` environment steps."""

    def nearest(name: str, choices: Iterable[int]) -> list[str]:
        found = sorted(choices, key=lambda n: abs(n - getattr(cfg, name)))[:1]
        return [f"{name}={n}" for n in found]

    replayed, batch = round(cfg.replay_ratio * steps), cfg.batch_size
    unit = batch // math.gcd(batch, steps)
    small = [n for n in range(1, math.isqrt(replayed) + 1) if replayed % n == 0]
    rounds = [n for n in range(1, cfg.horizon + 1) if cfg.horizon % n == 0]
    fits = [n for n in rounds if replayed // cfg.learn_every * n % batch == 0]
    options = [
        *nearest("replay_ratio", [unit * max(1, round(cfg.replay_ratio / unit))]),
        *nearest("batch_size", [*small, *(replayed // n for n in small)]),
        *nearest("learn_every", fits),
    ]
    return f"the nearest that fit are {' or '.join(options)}"

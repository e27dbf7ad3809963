"""The off-policy loop: rollout, replay, gradient steps, as one pure update.

An update is `horizon` steps of every environment. They go in rounds: `learn_every` steps, whose rows
are written into the replay, and then the gradient steps that `replay_ratio` asks for. What a method
adds to this is a `Learner`, and a `Treatment` of the constraint. The treatment's price moves on a clock
of environment steps: however many environments, rounds and gradient steps there are, it moves as often.

`jit(update)` compiles an iteration, `vmap(update, in_axes=(0, None))` runs seeds or floats of the
config side by side, and `shard_map(update)` with `axis_name` set splits environments, replay and batch
over devices: each device then holds `cfg.num_envs` of its own, and the same parameters.
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
from jaxsafe.learn.acting import learned_of
from jaxsafe.learn.batch import all_finite, device_key, masked_mean, psum, select
from jaxsafe.learn.constraints import (
    Names,
    check_cost_names,
    limit,
    metrics_by_constraint,
    signal,
)
from jaxsafe.learn.learner import GradientStep, Learner, policy_by
from jaxsafe.learn.metrics import episode_metrics, world_metrics
from jaxsafe.learn.next_step_rollout import Stepping, arrival_record, collect_records, started
from jaxsafe.learn.normalise import init_normaliser, merge, network_inputs
from jaxsafe.learn.replay import (
    Record,
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
from jaxsafe.types import Algorithm, Clocks, Env, Metrics, PyTree, Shared


@config
class OffPolicyConfig:
    """What the off-policy algorithms share."""

    # Environments side by side, of all devices together. OmniSafe has 1.
    num_envs: Amount = 1024
    horizon: Amount = 16  # Steps of each environment in an update.
    # Steps of each environment between two rounds of gradient steps.
    learn_every: Amount = 1
    stagger: bool = True  # Whether the first episodes start at different ages, so that ends spread out.
    # The iteration at which whatever decays reaches 0. inf: the last one of `total_steps`.
    total_iterations: EndOfDecay = float("inf")
    # Transitions kept, rounded to whole updates. As in OmniSafe.
    replay_size: Annotated[int, Bounds(1, 2**31 - 1)] = 1_000_000
    replay_ratio: Amount = 16  # Transitions replayed for each environment step. OmniSafe has 256.
    # Transitions of a gradient step, of all devices together. OmniSafe has 256.
    batch_size: Amount = 1024
    # Environment steps with random actions and without learning, as in OmniSafe.
    learning_starts: Annotated[int, Bounds(0, 2**31 - 1)] = 10_000
    n_step: Iterations = 1  # Rewards summed before the critics' value. OmniSafe has 1.
    # Units of the hidden layers of each network, as in OmniSafe.
    hidden: tuple[Units, ...] = (256, 256)
    activation: Literal["relu", "tanh"] = "relu"  # Of the hidden layers, as in OmniSafe.
    # The first weights. torch: uniform as in PyTorch, OmniSafe's choice. orthogonal: with gains.
    init: Literal["torch", "orthogonal"] = "torch"
    # Whether the critics normalise their layers, which steadies large batches. OmniSafe does not.
    layer_norm: bool = True
    # Whether observations are normalised by a running mean and variance. OmniSafe does not.
    obs_normalize: bool = True
    discount: Share = 0.99  # The discount of rewards, as in OmniSafe.
    cost_discount: Share = 0.99  # The discount of costs, as in OmniSafe.
    # The undiscounted cost that an episode may have. Unconstrained algorithms only draw it in plots.
    cost_limit: Weight = 25.0
    # The share of the critics that their targets take on at each step. OmniSafe has 0.005.
    tau: Share = 0.01
    lr: Rate = 3e-4  # The policy's learning rate, by Adam, as in OmniSafe.
    critic_lr: Rate = 3e-4  # The critics' learning rate, by Adam, as in OmniSafe.
    # Whether both learning rates fall linearly to 0 at `total_iterations`. OmniSafe keeps them.
    lr_decay: bool = False
    max_grad_norm: Norm = 40.0  # The largest norm of each network's gradient, as in OmniSafe.


@config
class PriceClockConfig:
    """For algorithms with a treatment: when its price on cost moves."""

    # Environment steps between two moves of the price. OmniSafe moves it at every gradient step.
    dual_every: Annotated[int, Bounds(1, 2**30)] = 20_000
    # Environment steps before its first move. OmniSafe's 100 epochs are 200,000.
    dual_starts: Annotated[int, Bounds(0, 2**31 - 1)] = 0


class Bill(NamedTuple):
    """What the environments of all devices were charged since the price last moved.

    cost: float [], or [K] of several constraints, summed over `steps`, float []. age: int32 [],
    environment steps of the run since then, resets included; below 0 before `dual_starts`.
    """

    cost: jax.Array
    steps: jax.Array
    age: jax.Array


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


def off_policy(
    env: Env,
    learner: Learner,
    treatment: Treatment = no_treatment,
    axis_name: str | None = None,
) -> Algorithm:
    """The algorithm that `learner` makes of the loop, with a price on cost that `treatment` moves."""
    explore = learner.explore or learner.act
    replayed = learner.replayed or drawn_transitions
    priced = treatment is not no_treatment

    def init(key: jax.Array, cfg: Any, shared: Shared) -> TrainState:
        sizes = sizes_of(cfg, axis_name)
        names = treatment.constrained_costs(cfg)
        check_cost_names(names, env)
        cfg = jax.tree.map(jnp.float32, cfg)
        params_key, stepping_key, key = jax.random.split(key, 3)
        nets = learner.init(params_key, env.obs_size, env.action_size, cfg)
        rollout = init_rollout(env, device_key(stepping_key, axis_name), cfg.num_envs, cfg.stagger)
        stepping = started(rollout)
        actions = jnp.zeros((cfg.num_envs, env.action_size))
        return TrainState(
            config=cfg,
            params=nets.params,
            opt_state=nets.opt_state,
            dual=treatment.init(cfg),
            bill=empty_bill(cfg, names) if priced else (),
            normaliser=init_normaliser(env.obs_size) if cfg.obs_normalize else (),
            stepping=stepping,
            replay=empty_ring(arrival_record(stepping, actions), sizes.rows),
            lost_time=no_lost_time(),
            key=key,
        )

    def update(ts: TrainState, shared: Shared) -> tuple[TrainState, Metrics]:
        cfg, iteration = ts.config, jnp.asarray(shared.iteration)
        names = treatment.constrained_costs(cfg)
        sizes = sizes_of(cfg, axis_name)

        def learn(
            nets: Trainable, normaliser: PyTree, replay: Record, number: jax.Array, key: jax.Array
        ):
            """The gradient steps of round `number`."""
            rows_written = (number + 1) * cfg.learn_every
            span = held(sizes.rows, cfg.horizon, rows_written, iteration, shared.since)
            before = (iteration * sizes.rounds + number) * sizes.updates

            def step(nets: Trainable, x: tuple[jax.Array, jax.Array]) -> tuple[Trainable, Metrics]:
                count, key = x
                draw_key, step_key = jax.random.split(device_key(key, axis_name))
                source = replay, span, normaliser, sizes.batch
                batch, dropped = replayed(draw_key, *source, cfg, axis_name)
                at = GradientStep(count, remaining(iteration, cfg), step_key, ts.dual)
                new, metrics = learner.step(nets, batch, at, cfg, axis_name)
                finite = psum(~all_finite(new), axis_name) == 0
                lost = {"train/nonfinite": dropped + ~finite}
                return select(finite, new, nets), jax.tree.map(jnp.float32, metrics | lost)

            turns = before + jnp.arange(sizes.updates), jax.random.split(key, sizes.updates)
            return jax.lax.scan(step, nets, turns)

        def one_round(now: RoundCarry, x: tuple[jax.Array, jax.Array]):
            number, key = x
            stepping_key, learn_key = jax.random.split(key)
            rows_written = number * cfg.learn_every
            warming_up = iteration * cfg.horizon + rows_written < sizes.warm_up  # in rows of this run

            def act(obs: jax.Array, key: jax.Array) -> jax.Array:
                explore_key, random_key = jax.random.split(key)
                inputs = network_inputs(now.normaliser, obs)
                chosen = explore(now.nets.params, inputs, explore_key, cfg)
                uniform = jax.random.uniform(random_key, chosen.shape, minval=-1.0, maxval=1.0)
                return jnp.where(warming_up, uniform, chosen)

            keys = jax.random.split(device_key(stepping_key, axis_name), cfg.learn_every)
            stepping, (rows, steps) = collect_records(env, act, now.stepping, keys)
            span = held(sizes.rows, cfg.horizon, rows_written, iteration, shared.since)
            replay = write(now.replay, rows, span)
            normaliser, skipped = now.normaliser, jnp.bool_(False)
            if cfg.obs_normalize:
                merged = merge(normaliser, rows.obs, axis_name)
                finite = all_finite(merged)
                normaliser, skipped = select(finite, merged, normaliser), ~finite

            filled = (iteration - shared.since) * cfg.horizon + rows_written + cfg.learn_every
            ready = filled >= jnp.maximum(sizes.warm_up, 2)
            given = now.nets, normaliser, replay, number, learn_key
            like = jax.eval_shape(learn, *given)[1]
            zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
            nets, metrics = jax.lax.cond(ready, learn, lambda nets, *_: (nets, zeros), *given)
            return RoundCarry(nets, normaliser, stepping, replay), (steps, metrics, ready, skipped)

        key, rounds_key = jax.random.split(ts.key)
        now = RoundCarry(Trainable(ts.params, ts.opt_state), ts.normaliser, ts.stepping, ts.replay)
        rounds = jnp.arange(sizes.rounds), jax.random.split(rounds_key, sizes.rounds)
        now, (steps, metrics, ready, skipped) = jax.lax.scan(one_round, now, rounds)

        steps = jax.tree.map(lambda x: x.reshape(cfg.horizon, *x.shape[2:]), steps)
        length, lost_time = expected_length(
            ts.lost_time,
            env.episode_length,
            steps.terminated,
            steps.length,
            steps.real.sum(),
            axis_name,
        )
        nonfinite = metrics.pop("train/nonfinite").sum() + skipped.sum()
        metrics = {k: masked_mean(x.mean(1), ready, None) for k, x in metrics.items()}
        metrics |= episode_metrics(env, steps, axis_name) | world_metrics(steps.bad, axis_name)
        rate_r, rate_c = (masked_mean(x, steps.real, axis_name) for x in (steps.reward, steps.cost))
        dual, bill = ts.dual, ts.bill
        if priced:
            bill = charge(ts.bill, signal(env, steps, names), steps.real, axis_name)
            dual, bill, stuck = settle(treatment, ts.dual, bill, length, cfg, iteration)
            metrics |= metrics_by_constraint(treatment.metrics(dual), names)
            nonfinite += stuck
        for k, name in enumerate(names):  # J_c of each; the total's is below
            rate = masked_mean(signal(env, steps, names)[..., k], steps.real, axis_name)
            metrics[f"train/cost_estimate_{name}"] = rate * length
        metrics |= {
            "train/cost_rate": rate_c,  # per environment step
            "train/cost_estimate": rate_c * length,  # of an episode
            "train/return_estimate": rate_r * length,  # likewise
            "train/nonfinite": nonfinite,
        }
        ts = dataclasses.replace(
            ts,
            params=now.nets.params,
            opt_state=now.nets.opt_state,
            dual=dual,
            bill=bill,
            normaliser=now.normaliser,
            stepping=now.stepping,
            replay=now.replay,
            lost_time=lost_time,
            key=key,
        )
        return ts, jax.tree.map(jnp.float32, metrics)

    def clocks(cfg: Any) -> Clocks:
        sizes = sizes_of(cfg, None)
        return Clocks(cfg.num_envs * cfg.horizon, sizes.rounds * sizes.updates)

    return Algorithm(init, update, policy_by(learner), learned_of, lambda learned: env, clocks)


def drawn_transitions(
    key: jax.Array,
    ring: Record,
    span: Span,
    normaliser: PyTree,
    count: int,
    cfg: Any,
    axis_name: str | None,
) -> tuple[Transitions, jax.Array]:
    """`count` transitions with normalised observations, and how many of them are not finite."""
    index = draw(key, ring, span, count)
    discounts = {"discount": cfg.discount, "cost_discount": cfg.cost_discount}
    found = transitions(ring, span, index, n_step=cfg.n_step, **discounts)
    batch, dropped = usable(found, axis_name)
    obs, next_obs = (network_inputs(normaliser, x) for x in (batch.obs, batch.next_obs))
    return batch._replace(obs=obs, next_obs=next_obs), dropped


# ---- the price on cost -------------------------------------------------------------------------


def empty_bill(cfg: Any, names: Names) -> Bill:
    return Bill(jnp.zeros(jnp.shape(limit(cfg, names))), jnp.float32(0), jnp.int32(-cfg.dual_starts))


def charge(bill: Bill, cost: jax.Array, real: jax.Array, axis_name: str | None) -> Bill:
    """`bill` with `cost`, float [T, N] or [T, N, K], of the steps that are `real`, bool [T, N]."""
    mask = real.reshape(*real.shape, *(1,) * (cost.ndim - 2))
    more, steps, age = psum(
        (jnp.where(mask, cost, 0.0).sum((0, 1)), real.sum(), jnp.int32(real.size)), axis_name
    )
    return Bill(bill.cost + more, bill.steps + steps, bill.age + age)


def settle(
    treatment: Treatment, dual: PyTree, bill: Bill, length: jax.Array, cfg: Any, iteration: jax.Array
) -> tuple[PyTree, Bill, jax.Array]:
    """The price after the moves that are due, what remains of the bill, and whether a move failed.

    J_c is what a step has cost since the last move, times the mean `length` of an episode. After an
    iteration of more than `dual_every` steps several moves may be due; they see the same J_c.
    """
    episode_cost = bill.cost / jnp.maximum(bill.steps, 1) * length
    due = jnp.maximum(bill.age, 0) // cfg.dual_every

    def move(_: jax.Array, dual: PyTree) -> PyTree:
        return treatment.update(dual, episode_cost, cfg, iteration)

    moved = jax.lax.fori_loop(0, due, move, dual)
    finite = all_finite(moved)
    paid = Bill(jnp.zeros_like(bill.cost), jnp.float32(0), bill.age - due * cfg.dual_every)
    bill = select((due > 0) | (bill.age < 0), paid, bill)
    return select(finite, moved, dual), bill, ~finite


# ---- sizes -------------------------------------------------------------------------------------


class Sizes(NamedTuple):
    """What follows from the config: rounds of an update; gradient steps of a round; transitions of a
    device's share of a batch; rows of the replay; rows of warm-up."""

    rounds: int
    updates: int
    batch: int
    rows: int
    warm_up: int


def sizes_of(cfg: Any, axis_name: str | None) -> Sizes:
    """Sizes, for `cfg.num_envs` environments on each device.

    Raises:
        ConfigError: sizes out of their bounds, or that do not fit each other.
    """
    check_values(cfg)
    check_steps(cfg.num_envs, cfg.horizon)
    devices = 1 if axis_name is None else jax.lax.axis_size(axis_name)
    num_envs = cfg.num_envs * devices
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
    rows = ring_rows(cfg.replay_size, num_envs, cfg.horizon)
    if cfg.batch_size > rows * num_envs or rows <= cfg.n_step:
        raise ConfigError(
            f"replay_size={cfg.replay_size} holds {rows} steps of {num_envs} environments: expected "
            f"at least batch_size={cfg.batch_size} transitions and more than n_step={cfg.n_step} steps"
        )
    return Sizes(
        rounds=cfg.horizon // cfg.learn_every,
        updates=updates,
        batch=cfg.batch_size // devices,
        rows=rows,
        warm_up=-(-cfg.learning_starts // num_envs),
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

"""The off-policy loop: rollout, replay, gradient steps, as one pure update.

An update is `horizon` steps of every environment. They go in rounds: `learn_every` steps, whose rows
are written into the replay, and then the gradient steps that `replay_ratio` asks for. What a method
adds to this is a `Learner`.

`jit(update)` compiles an iteration, `vmap(update, in_axes=(0, None))` runs seeds or floats of the
config side by side, and `shard_map(update)` with `axis_name` set splits environments, replay and batch
over devices: each device then holds `cfg.num_envs` of its own, and the same parameters.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable
from typing import Any, Literal, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import optax

from jaxsafe.config import ConfigError, config
from jaxsafe.learn.acting import learned_of
from jaxsafe.learn.batch import all_finite, device_key, masked_mean, pmean, psum, select
from jaxsafe.learn.learner import Fit, Learner, Turn, policy_by, seen
from jaxsafe.learn.metrics import episode_metrics
from jaxsafe.learn.normalise import init_normaliser, merge
from jaxsafe.learn.replay import Row, Transitions, draw, empty_ring, held, ring_rows, transitions, write
from jaxsafe.learn.returns import mean_length
from jaxsafe.learn.rollout import Episode, RolloutState, init_rollout, restart, sums
from jaxsafe.learn.steps import remaining
from jaxsafe.types import Algorithm, Clocks, Env, Metrics, PyTree, Shared


@config
class OffPolicyConfig:
    """What the off-policy algorithms share."""

    # Environments side by side, of all devices together. OmniSafe has 1.
    num_envs: int = 1024
    horizon: int = 16  # Steps of each environment in an update.
    # Steps of each environment between two rounds of gradient steps.
    learn_every: int = 1
    stagger: bool = True  # Whether the first episodes start at different ages, so that ends spread out.
    # The iteration at which whatever decays reaches 0. inf: the last one of `total_steps`.
    total_iterations: float = float("inf")
    # Transitions kept, rounded to whole updates. As in OmniSafe.
    replay_size: int = 1_000_000
    replay_ratio: int = 16  # Transitions replayed for each environment step. OmniSafe has 256.
    batch_size: int = 4096  # Transitions of a gradient step, of all devices together. OmniSafe has 256.
    # Environment steps with random actions and without learning, as in OmniSafe.
    learning_starts: int = 10_000
    n_step: int = 1  # Rewards summed before the critics' value. OmniSafe has 1.
    hidden: tuple[int, ...] = (256, 256)  # Units of the hidden layers of each network, as in OmniSafe.
    activation: Literal["relu", "tanh"] = "relu"  # Of the hidden layers, as in OmniSafe.
    # The first weights. torch: uniform as in PyTorch, OmniSafe's choice. orthogonal: with gains.
    init: Literal["torch", "orthogonal"] = "torch"
    # Whether the critics normalise their layers, which steadies large batches. OmniSafe does not.
    layer_norm: bool = True
    # Whether observations are normalised by a running mean and variance. OmniSafe does not.
    obs_normalize: bool = True
    discount: float = 0.99  # The discount of rewards, as in OmniSafe.
    cost_discount: float = 0.99  # The discount of costs, as in OmniSafe.
    # The undiscounted cost that an episode may have. Unconstrained algorithms only draw it in plots.
    cost_limit: float = 25.0
    # The share of the critics that their targets take on at each step. OmniSafe has 0.005.
    tau: float = 0.05
    lr: float = 3e-4  # The policy's learning rate, by Adam, as in OmniSafe.
    critic_lr: float = 3e-4  # The critics' learning rate, by Adam, as in OmniSafe.
    # Whether both learning rates fall linearly to 0 at `total_iterations`. OmniSafe keeps them.
    lr_decay: bool = False
    max_grad_norm: float = 40.0  # The largest norm of each network's gradient, as in OmniSafe.


@flax.struct.dataclass
class Walk:
    """N environments that reset on the next step: where they arrived, and how; bool [N]."""

    rollout: RolloutState
    first: jax.Array
    terminated: jax.Array
    truncated: jax.Array


class Steps(NamedTuple):
    """What T steps of N environments came to, [T, N]. A reset is no step: `real` is false.

    ended marks complete episodes that end with the step; episode and length are their sums.
    """

    real: jax.Array
    reward: jax.Array
    cost: jax.Array
    ended: jax.Array
    episode: Episode
    length: jax.Array


@flax.struct.dataclass
class TrainState:
    """All that an update needs besides `Shared`.

    config: the algorithm's, with its floats as arrays.
    params, opt_state: the learner's.
    dual: (), the state of a treatment of the constraint.
    normaliser: Normaliser, or () without `obs_normalize`.
    walk: this device's environments. replay: their ring, [R, N, ...].
    episode_length: float [], running mean length of an episode, in steps.
    """

    config: Any
    params: dict[str, PyTree]
    opt_state: dict[str, PyTree]
    dual: PyTree
    normaliser: PyTree
    walk: Walk
    replay: Row
    episode_length: jax.Array
    key: jax.Array


class Cycle(NamedTuple):
    """What passes from one round to the next."""

    fit: Fit
    normaliser: PyTree
    walk: Walk
    replay: Row


def off_policy(env: Env, learner: Learner, axis_name: str | None = None) -> Algorithm:
    """The algorithm that `learner` makes of the loop."""

    def init(key: jax.Array, cfg: Any, shared: Shared) -> TrainState:
        sizes = sizes_of(cfg, axis_name)
        cfg = jax.tree.map(jnp.float32, cfg)
        params_key, walk_key, key = jax.random.split(key, 3)
        fit = learner.init(params_key, env.obs_size, env.action_size, cfg)
        rollout = init_rollout(env, device_key(walk_key, axis_name), cfg.num_envs, cfg.stagger)
        no = jnp.zeros(cfg.num_envs, bool)
        walk = Walk(rollout, first=~no, terminated=no, truncated=no)
        actions = jnp.zeros((cfg.num_envs, env.action_size))
        return TrainState(
            config=cfg,
            params=fit.params,
            opt_state=fit.opt_state,
            dual=(),
            normaliser=init_normaliser(env.obs_size) if cfg.obs_normalize else (),
            walk=walk,
            replay=empty_ring(arrival(walk, actions), sizes.rows),
            episode_length=jnp.float32(env.episode_length),
            key=key,
        )

    def update(ts: TrainState, shared: Shared) -> tuple[TrainState, Metrics]:
        cfg, iteration = ts.config, jnp.asarray(shared.iteration)
        sizes = sizes_of(cfg, axis_name)

        def learn(fit: Fit, normaliser: PyTree, replay: Row, number: jax.Array, key: jax.Array):
            """The gradient steps of round `number`."""
            written = (number + 1) * cfg.learn_every
            span = held(sizes.rows, cfg.horizon, written, iteration, shared.since)
            before = (iteration * sizes.rounds + number) * sizes.updates

            def step(fit: Fit, x: tuple[jax.Array, jax.Array]) -> tuple[Fit, Metrics]:
                count, key = x
                draw_key, step_key = jax.random.split(device_key(key, axis_name))
                index = draw(draw_key, replay, span, sizes.batch)
                discounts = {"discount": cfg.discount, "cost_discount": cfg.cost_discount}
                found = transitions(replay, span, index, n_step=cfg.n_step, **discounts)
                batch, dropped = usable(found, axis_name)
                obs, next_obs = (seen(normaliser, x, cfg) for x in (batch.obs, batch.next_obs))
                batch = batch._replace(obs=obs, next_obs=next_obs)
                turn = Turn(count, remaining(iteration, cfg), step_key)
                new, metrics = learner.step(fit, batch, turn, cfg, axis_name)
                finite = psum(~jnp.isfinite(optax.tree.norm(new)), axis_name) == 0
                lost = {"train/nonfinite": dropped + ~finite}
                return select(finite, new, fit), jax.tree.map(jnp.float32, metrics | lost)

            turns = before + jnp.arange(sizes.updates), jax.random.split(key, sizes.updates)
            return jax.lax.scan(step, fit, turns)

        def one_round(cycle: Cycle, x: tuple[jax.Array, jax.Array]):
            number, key = x
            walk_key, learn_key = jax.random.split(key)
            written = number * cfg.learn_every
            begun = iteration * cfg.horizon + written < sizes.warm_up  # in rows of this run

            def act(obs: jax.Array, key: jax.Array) -> jax.Array:
                explore_key, random_key = jax.random.split(key)
                now = seen(cycle.normaliser, obs, cfg)
                chosen = learner.explore(cycle.fit.params, now, explore_key, cfg)
                uniform = jax.random.uniform(random_key, chosen.shape, minval=-1.0, maxval=1.0)
                return jnp.where(begun, uniform, chosen)

            keys = jax.random.split(device_key(walk_key, axis_name), cfg.learn_every)
            walk, (rows, steps) = walked(env, act, cycle.walk, keys)
            span = held(sizes.rows, cfg.horizon, written, iteration, shared.since)
            replay = write(cycle.replay, rows, span)
            normaliser, skipped = cycle.normaliser, jnp.bool_(False)
            if cfg.obs_normalize:
                merged = merge(normaliser, rows.obs, axis_name)
                finite = all_finite(merged)
                normaliser, skipped = select(finite, merged, normaliser), ~finite

            filled = (iteration - shared.since) * cfg.horizon + written + cfg.learn_every
            ready = filled >= jnp.maximum(sizes.warm_up, 2)
            given = cycle.fit, normaliser, replay, number, learn_key
            like = jax.eval_shape(learn, *given)[1]
            nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
            fit, metrics = jax.lax.cond(ready, learn, lambda fit, *_: (fit, nothing), *given)
            return Cycle(fit, normaliser, walk, replay), (steps, metrics, ready, skipped)

        key, rounds_key = jax.random.split(ts.key)
        cycle = Cycle(Fit(ts.params, ts.opt_state), ts.normaliser, ts.walk, ts.replay)
        rounds = jnp.arange(sizes.rounds), jax.random.split(rounds_key, sizes.rounds)
        cycle, (steps, metrics, ready, skipped) = jax.lax.scan(one_round, cycle, rounds)

        steps = jax.tree.map(lambda x: x.reshape(cfg.horizon, *x.shape[2:]), steps)
        length = mean_length(ts.episode_length, steps.ended, steps.length, axis_name)
        length = jnp.where(jnp.isfinite(length), length, ts.episode_length)
        nonfinite = metrics.pop("train/nonfinite").sum() + skipped.sum()
        metrics = {k: masked_mean(x.mean(1), ready, None) for k, x in metrics.items()}
        metrics |= episode_metrics(env, steps, axis_name)
        rate_r, rate_c = (masked_mean(x, steps.real, axis_name) for x in (steps.reward, steps.cost))
        metrics |= {
            "train/cost_rate": rate_c,  # per environment step
            "train/cost_estimate": rate_c * length,  # of an episode
            "train/return_estimate": rate_r * length,  # likewise
            "train/nonfinite": nonfinite,
        }
        ts = dataclasses.replace(
            ts,
            params=cycle.fit.params,
            opt_state=cycle.fit.opt_state,
            normaliser=cycle.normaliser,
            walk=cycle.walk,
            replay=cycle.replay,
            episode_length=length,
            key=key,
        )
        return ts, jax.tree.map(jnp.float32, metrics)

    def clocks(cfg: Any) -> Clocks:
        sizes = sizes_of(cfg, None)
        return Clocks(cfg.num_envs * cfg.horizon, sizes.rounds * sizes.updates)

    return Algorithm(init, update, policy_by(learner), learned_of, lambda learned: env, clocks)


# ---- environments that reset on the next step --------------------------------------------------


def arrival(walk: Walk, action: jax.Array) -> Row:
    """The rows [N, ...] of where the environments are, with the actions that they take there."""
    state = walk.rollout.state
    return Row(
        obs=state.obs,
        action=action,
        reward=state.reward,
        cost=state.cost,
        costs=state.costs,
        first=walk.first,
        terminated=walk.terminated,
        truncated=walk.truncated,
    )


def walked(
    env: Env, act: Callable[[jax.Array, jax.Array], jax.Array], walk: Walk, keys: jax.Array
) -> tuple[Walk, tuple[Row, Steps]]:
    """One step of every environment for each of `keys` [T], or a reset where its episode has ended.

    Args:
        act: (obs [N, O], key) -> action [N, A].
    Returns:
        The walk, and the rows and steps, [T, N, ...].
    """

    def step(walk: Walk, key: jax.Array) -> tuple[Walk, tuple[Row, Steps]]:
        act_key, reset_key = jax.random.split(key)
        row = arrival(walk, act(walk.rollout.state.obs, act_key))
        state = jax.vmap(env.step)(walk.rollout.state, row.action)
        rollout = dataclasses.replace(
            walk.rollout,
            state=state,
            steps=walk.rollout.steps + 1,
            episode=jax.tree.map(jnp.add, walk.rollout.episode, sums(state)),
        )
        rollout = restart(env, rollout, row.last, reset_key)
        terminated = rollout.state.terminated
        truncated = (rollout.steps >= env.episode_length) & ~terminated
        steps = Steps(
            real=~row.last,
            reward=rollout.state.reward,
            cost=rollout.state.cost,
            ended=(terminated | truncated) & rollout.complete,
            episode=rollout.episode,
            length=rollout.steps,
        )
        return Walk(rollout, row.last, terminated, truncated), (row, steps)

    return jax.lax.scan(step, walk, keys)


def usable(found: Transitions, axis_name: str | None) -> tuple[Transitions, jax.Array]:
    """`found` with weights whose sum is 1, and 0 for transitions that are not finite, which are
    replaced by zeros; and how many of those there are, over all devices."""
    floats = [x for x in jax.tree.leaves(found) if jnp.issubdtype(x.dtype, jnp.floating)]
    finite = jnp.isfinite(sum(x.sum(tuple(range(1, x.ndim))) for x in floats))

    def keep(x: jax.Array) -> jax.Array:
        return jnp.where(finite.reshape(-1, *(1,) * (x.ndim - 1)), x, jnp.zeros_like(x))

    kept = jax.tree.map(keep, found)
    total = pmean(kept.weight.sum(), axis_name)
    dropped = psum((~finite & (found.weight > 0)).sum(), axis_name)
    return kept._replace(weight=kept.weight / jnp.maximum(total, 1e-6)), dropped


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
        ConfigError: sizes that do not fit each other.
    """
    at_least_1 = ("num_envs", "horizon", "learn_every", "replay_size", "replay_ratio", "batch_size")
    for name in (*at_least_1, "n_step"):
        if getattr(cfg, name) < 1:
            raise ConfigError(f"{name}={getattr(cfg, name)}: expected at least 1")
    if cfg.learning_starts < 0:
        raise ConfigError(f"learning_starts={cfg.learning_starts}: expected at least 0")
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
    if cfg.replay_ratio * steps % cfg.batch_size:
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
        updates=cfg.replay_ratio * steps // cfg.batch_size,
        batch=cfg.batch_size // devices,
        rows=rows,
        warm_up=-(-cfg.learning_starts // num_envs),
    )


def fitting(cfg: Any, steps: int) -> str:
    """The nearest settings that make whole gradient steps of a round of `steps` environment steps."""

    def nearest(name: str, choices: Iterable[int]) -> list[str]:
        found = sorted(choices, key=lambda n: abs(n - getattr(cfg, name)))[:1]
        return [f"{name}={n}" for n in found]

    replayed, batch = cfg.replay_ratio * steps, cfg.batch_size
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

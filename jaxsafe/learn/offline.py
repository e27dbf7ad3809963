"""The offline loop: gradient steps on a data set, without an environment step.

`jit(update)` compiles an iteration of `updates` gradient steps. All members share the data set:
`vmap(update, in_axes=(0, None))` keeps one copy of it. What a method adds to this is a `Learner` and,
if it has a constraint, a `Treatment`.

There are no environment steps here, so the clock of a treatment's price is the gradient steps: the
price moves once after each of them, from step `dual_starts` on. It moves on J_c, the cost of an
episode in the learner's own estimate, which the learner reports as `train/cost_estimate`.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxsafe.config import (
    Amount,
    Bounds,
    ConfigError,
    EndOfDecay,
    Norm,
    Rate,
    Share,
    Units,
    Weight,
    check_values,
    config,
    nearest,
)
from jaxsafe.learn.acting import learned_of
from jaxsafe.learn.batch import all_finite, select
from jaxsafe.learn.constraints import Names, metrics_by_constraint
from jaxsafe.learn.conventions import Convention
from jaxsafe.learn.learner import GradientStep, Learner, policy_by
from jaxsafe.learn.normalise import init_normaliser, merge, network_inputs
from jaxsafe.learn.observations import (
    check_observation,
    observation_like,
    vector_of,
    with_vector,
)
from jaxsafe.learn.replay import Transitions
from jaxsafe.learn.steps import Trainable, remaining, skipped_steps, skipping_adam
from jaxsafe.learn.treatments import LagrangianConfig, Treatment, no_treatment
from jaxsafe.types import Algorithm, Clocks, Env, Metrics, PyTree, Shared

Array = jax.Array | np.ndarray
# (data, cfg) -> what draws a gradient step's rows: key -> int32 [B]
Draw = Callable[["DataSet", Any], Callable[[jax.Array], jax.Array]]


class Episodes(NamedTuple):
    """The m episodes of a data set.

    number: int32 [n], which of them each transition belongs to. first_obs: [m, ...], where they begin.
    ret, cost: float [m], undiscounted sums. whole: bool [m], False for an episode that is cut off: it
    neither terminates nor runs out of time.
    """

    number: Array
    first_obs: PyTree
    ret: Array
    cost: Array
    whole: Array


class DataSet(NamedTuple):
    """n transitions, in any order.

    obs, next_obs: float [n, O], or dicts of that, 'vector', and 'vision', uint8 [n, H, W, C].
    action: float [n, A]. reward, cost: float [n]. terminated: bool [n], True where next_obs has no
    value. truncated: bool [n], True where the episode runs out of time, which is not termination.
    costs: float [n] each, by name, of the costs that have names.
    episodes: Episodes, or () where it is not known which transitions make one.
    """

    obs: PyTree
    action: Array
    reward: Array
    cost: Array
    next_obs: PyTree
    terminated: Array
    truncated: Array
    costs: Mapping[str, Array]
    episodes: PyTree


def data_set(
    obs: Any,
    action: np.ndarray,
    reward: np.ndarray,
    cost: np.ndarray,
    next_obs: Any,
    terminated: np.ndarray,
    truncated: np.ndarray | None = None,
    costs: dict[str, np.ndarray] | None = None,
    cut: np.ndarray | None = None,
) -> DataSet:
    """A data set of whole arrays, whose transitions are in the order of their episodes.

    Args:
        truncated: None if it is not known. The episodes are then not known either.
        cut: bool [n], where an episode stops without an end, besides the last transition.
    """
    action, reward, cost = (np.asarray(x, np.float32) for x in (action, reward, cost))
    obs, next_obs = (
        with_vector(jax.tree.map(np.asarray, x), np.asarray(vector_of(x), np.float32))
        for x in (obs, next_obs)
    )
    terminated, episodes = np.asarray(terminated, bool), ()
    if truncated is not None:
        truncated = np.asarray(truncated, bool) & ~terminated
        ends = terminated | truncated
        last = ends if cut is None else ends | np.asarray(cut, bool)
        episodes = episodes_of(obs, reward, cost, ends, last)
    else:
        truncated = np.zeros_like(terminated)
    costs = {name: np.asarray(x, np.float32) for name, x in (costs or {}).items()}
    return DataSet(obs, action, reward, cost, next_obs, terminated, truncated, costs, episodes)


def episodes_of(
    obs: Any, reward: np.ndarray, cost: np.ndarray, ends: np.ndarray, last: np.ndarray
) -> Episodes:
    """The episodes of transitions in order. `last` marks the last transition of each, `ends` those that
    are whole; the very last one is the last of an episode anyway."""
    first = np.concatenate([[True], last[:-1]])
    number = np.cumsum(first, dtype=np.int32) - 1
    count = int(number[-1]) + 1
    ret, paid = (np.bincount(number, x, count).astype(np.float32) for x in (reward, cost))
    first_obs = jax.tree.map(lambda x: x[first], obs)
    return Episodes(number, first_obs, ret, paid, np.bincount(number, ends, count) > 0)


def data_set_like(env: Env) -> DataSet:
    """A data set of one transition, all zeros: its shapes are those of data of `env`."""
    like = observation_like(env)
    obs = jax.tree.map(lambda x: np.zeros((1, *x.shape), x.dtype), like)
    number = np.zeros(1, np.float32)
    action, yes = np.zeros((1, env.action_size), np.float32), np.ones(1, bool)
    return data_set(obs, action, number, number, obs, yes, ~yes, dict.fromkeys(env.cost_names, number))


@config
class OfflineConfig:
    """What the offline algorithms share."""

    updates: Amount = 1000  # Gradient steps of an iteration, which is a row of the metrics.
    # Transitions of a gradient step, drawn with replacement. As in OmniSafe's VAE-BC.
    batch_size: Amount = 256
    # The iteration at which whatever decays reaches 0. inf: the last one of `total_updates`.
    total_iterations: EndOfDecay = float("inf")
    hidden: tuple[Units, ...] = (256, 256)  # Units of the hidden layers of each network.
    activation: Literal["relu", "tanh"] = "relu"  # Of the hidden layers, as in OmniSafe.
    # The first weights. torch: uniform as in PyTorch, OmniSafe's choice. orthogonal: with gains.
    init: Literal["torch", "orthogonal"] = "torch"
    # What hidden layers are computed in. On a GPU bfloat16, which has 8 bits, is faster for large
    # batches. On a CPU float32 is.
    hidden_dtype: Literal["float32", "bfloat16"] = "float32"
    # Whether observations are normalised by the mean and variance of the data. OmniSafe does not.
    obs_normalize: bool = True
    # The discount of rewards. Imitation only uses it for evaluation's discounted return.
    discount: Share = 0.99
    # The discount of costs. Without a critic of cost it is only for evaluation's discounted cost.
    cost_discount: Share = 0.99
    # The undiscounted cost that an episode may have. Unconstrained algorithms only draw it in plots.
    cost_limit: Weight = 25.0
    lr: Rate = 1e-3  # The policy's learning rate, by Adam, as in OmniSafe's VAE-BC.
    lr_decay: bool = False  # Whether learning rates fall linearly to 0 at `total_iterations`.
    max_grad_norm: Norm = 40.0  # The largest norm of each network's gradient.


@config
class OfflineValueConfig(OfflineConfig):
    """For methods that learn values of reward and of cost."""

    CONVENTIONS: ClassVar = (
        Convention(
            {"time_limit_ends": True},
            "offline, the value after an episode runs out of time is 0",
            "running out of time is not an end: values go on with the next observation",
        ),
    )

    critic_lr: Rate = 1e-3  # The learning rate of values, by Adam, as in OmniSafe.
    layer_norm: bool = False  # Whether the critics' hidden layers are normalised. OmniSafe's are not.
    # Whether the value after the end of an episode's time is 0. OmniSafe's is.
    time_limit_ends: bool = False


@config
class OfflineTargetConfig(OfflineValueConfig):
    """For methods whose values aim at those of slower copies of the networks."""

    # The share of each network that its copy takes on at each step, as in OmniSafe.
    tau: Share = 0.005


@config
class OfflinePriceConfig(LagrangianConfig):
    """For methods with a price on cost, which moves with the gradient steps."""

    # Adam's step of the price after each gradient step, as in OmniSafe.
    dual_lr: Rate = 1e-3
    # Gradient steps before the price first moves. OmniSafe has 150,000 of a million.
    dual_starts: Annotated[int, Bounds(0, 2**31 - 1)] = 0


@config
class OfflineCostConfig(OfflinePriceConfig):
    """For methods that learn values of cost, and pay for them at a price."""

    CONVENTIONS: ClassVar = (
        Convention(
            {"limit_on": "value"},
            "offline, the limit is on the mean discounted value of cost, Q_c",
            "the limit is on the undiscounted cost of an episode, (1 - cost_discount) T Q_c",
        ),
    )

    # The discount of costs. J_c = (1 - cost_discount) T Q_c needs one below 1.
    cost_discount: Annotated[float, Bounds(0, 0.9999)] = 0.99
    # How the values of two cost critics become one. max is cautious: it takes estimates that are too
    # high. one: a single critic.
    cost_reduce: Literal["mean", "max", "one"] = "mean"
    # What the limit is on: the cost of an episode, or Q_c as OmniSafe has it. A Q_c of 25 is a cost of
    # 125 in an episode of 500 steps.
    limit_on: Literal["episode", "value"] = "episode"


@flax.struct.dataclass
class TrainState:
    """All that an update needs besides `Shared`, whose `data` is the data set.

    config: the algorithm's, with its floats as arrays.
    params, opt_state: the learner's.
    dual: the state of the treatment of the constraint, () without one.
    normaliser: Normaliser of the data's observations, or () without `obs_normalize`.
    """

    config: Any
    params: dict[str, PyTree]
    opt_state: dict[str, PyTree]
    dual: PyTree
    normaliser: PyTree
    key: jax.Array


def anywhere(data: DataSet, cfg: Any) -> Callable[[jax.Array], jax.Array]:
    """Draws rows of the whole data set, uniformly and with replacement."""
    return lambda key: jax.random.randint(key, (cfg.batch_size,), 0, len(data.reward))


def offline(
    env: Env, learner: Learner, treatment: Treatment = no_treatment, draw: Draw = anywhere
) -> Algorithm:
    """The algorithm that `learner` makes of the loop, with a price on cost that `treatment` moves.

    A learner with a treatment is told the price as `at.dual`, and as `learned.dual` where it acts. It
    reports J_c as `train/cost_estimate`, float [] or [K].

    A network whose gradient is not finite sits a step out, and the others move. `train/nonfinite`
    counts the steps in which one does. An iteration of such steps alone has no effect.
    """
    priced = treatment is not no_treatment
    names = treatment.constrained_costs

    def init(key: jax.Array, cfg: Any, shared: Shared) -> TrainState:
        check_values(cfg)
        data, like = data_of(shared, env), observation_like(env)
        check_observation(like, cfg)
        check_pictures(data, like)
        check_costs(names(cfg), data)
        draw(data, cfg)  # refuses data that it cannot serve
        cfg = jax.tree.map(jnp.float32, cfg)
        params_key, key = jax.random.split(key)
        nets = learner.init(params_key, env.obs_size, env.action_size, cfg)
        normaliser: PyTree = ()
        if cfg.obs_normalize:
            normaliser = merge(init_normaliser(env.obs_size), jnp.asarray(vector_of(data.obs)))
        return TrainState(cfg, nets.params, nets.opt_state, treatment.init(cfg), normaliser, key)

    def update(ts: TrainState, shared: Shared) -> tuple[TrainState, Metrics]:
        cfg, data = ts.config, data_of(shared, env)
        iteration = jnp.asarray(shared.iteration)
        key, steps_key = jax.random.split(ts.key)
        rows_by, ranges = draw(data, cfg), value_ranges(data, names(cfg), cfg)

        def step(now: Carry, x: tuple[jax.Array, jax.Array]) -> tuple[Carry, Metrics]:
            count, key = x
            draw_key, first_key, step_key = jax.random.split(key, 3)
            batch = batch_at(data, rows_by(draw_key), cfg, ts.normaliser, names(cfg))
            first_obs = first_obs_at(data, first_key, cfg, ts.normaliser)
            share = remaining(iteration, cfg)
            at = GradientStep(count, share, step_key, now.dual, first_obs, ranges)
            nets, metrics = learner.step(now.nets, batch, at, cfg, None)
            lost, dual = skipped_steps(nets.opt_state) > skipped_steps(now.nets.opt_state), now.dual
            if priced:
                moved = treatment.update(dual, metrics["train/cost_estimate"], cfg, iteration)
                finite = all_finite(moved)
                lost |= ~finite
                dual = select(finite & (count >= cfg.dual_starts), moved, dual)
                metrics |= treatment.metrics(dual)
            metrics = metrics_by_constraint(metrics | {"train/nonfinite": lost}, names(cfg))
            return Carry(nets, dual), jax.tree.map(jnp.float32, metrics)

        counts = iteration * cfg.updates + jnp.arange(cfg.updates)
        keys = jax.random.split(steps_key, cfg.updates)
        start = Carry(Trainable(ts.params, ts.opt_state), ts.dual)
        end, metrics = jax.lax.scan(step, start, (counts, keys))
        lost = metrics.pop("train/nonfinite").sum()
        end = select(lost < cfg.updates, end, start)  # without a whole step nothing is learned
        metrics = jax.tree.map(jnp.mean, metrics) | {"train/nonfinite": lost}
        nets = end.nets
        ts = dataclasses.replace(
            ts, params=nets.params, opt_state=nets.opt_state, dual=end.dual, key=key
        )
        return ts, metrics

    def clocks(cfg: Any) -> Clocks:
        check_values(cfg)
        return Clocks(0, cfg.updates)

    return Algorithm(init, update, policy_by(learner), learned_of, lambda learned: env, clocks)


class Carry(NamedTuple):
    """What passes from one gradient step to the next."""

    nets: Trainable
    dual: PyTree


def batch_at(
    data: DataSet, rows: jax.Array, cfg: Any, normaliser: PyTree, names: Names = ()
) -> Transitions:
    """The transitions of some rows [B], as the networks see them: observations normalised, actions
    clipped to [-1, 1], as the environments clip them. `costs` are those of `names`, [B, K]."""

    def at(x: Array) -> jax.Array:
        return jnp.asarray(x)[rows]

    cost, terminated = at(data.cost), at(data.terminated)
    if isinstance(cfg, OfflineValueConfig) and cfg.time_limit_ends:
        terminated |= at(data.truncated)
    return Transitions(
        obs=network_inputs(normaliser, jax.tree.map(at, data.obs)),
        action=jnp.clip(at(data.action), -1.0, 1.0),
        reward=at(data.reward),
        cost=cost,
        costs=jnp.stack([at(data.costs[name]) for name in names], -1)
        if names
        else jnp.zeros((len(rows), 0)),
        next_obs=network_inputs(normaliser, jax.tree.map(at, data.next_obs)),
        steps=jnp.ones(len(rows), jnp.int32),
        terminated=terminated,
        weight=jnp.full(len(rows), 1 / len(rows)),
    )


def first_obs_at(data: DataSet, key: jax.Array, cfg: Any, normaliser: PyTree) -> PyTree:
    """Observations [B, O] at which episodes begin, drawn with replacement; () where none is known."""
    if not data.episodes:
        return ()
    first_obs = data.episodes.first_obs
    rows = jax.random.randint(key, (cfg.batch_size,), 0, len(vector_of(first_obs)))
    return network_inputs(normaliser, jax.tree.map(lambda x: jnp.asarray(x)[rows], first_obs))


def value_ranges(data: DataSet, names: Names, cfg: Any) -> tuple[Any, Any]:
    """The bounds of values of reward and of cost, (low, high) each: float [] or, of several
    constraints, [K]. Where no reward is above r_max, no sum of discounted rewards is above
    max(0, r_max) / (1 - discount)."""

    def of(x: Array, discount: jax.Array) -> tuple[jax.Array, jax.Array]:
        steps = 1 / jnp.maximum(1 - discount, 1e-6)
        low, high = jnp.nanmin(jnp.asarray(x), 0), jnp.nanmax(jnp.asarray(x), 0)
        return steps * jnp.minimum(low, 0.0), steps * jnp.maximum(high, 0.0)

    costs = jnp.stack([jnp.asarray(data.costs[name]) for name in names], -1) if names else data.cost
    return of(data.reward, cfg.discount), of(costs, cfg.cost_discount)


def constrained(batch: Transitions, names: Names) -> jax.Array:
    """What is held under the limit: float [B] or, of several constraints, [B, K]."""
    return batch.costs if names else batch.cost


def episode_cost(q_c: jax.Array, cfg: Any, env: Env) -> jax.Array:
    """J_c = (1 - cost_discount) T Q_c, the undiscounted cost of an episode of T steps.

    Q_c is a discounted sum without end, as values go on after the time limit: of a cost p at each step
    it is p / (1 - cost_discount), and J_c is p T. With `limit_on` value it is Q_c itself.
    """
    if cfg.limit_on == "value":
        return q_c
    return (1 - cfg.cost_discount) * env.episode_length * q_c


def decaying_adam(lr: jax.Array, at: GradientStep, cfg: Any) -> optax.GradientTransformation:
    """`skipping_adam` at this moment, whose step has decayed if `cfg.lr_decay`."""
    return skipping_adam(lr * at.remaining if cfg.lr_decay else lr, cfg)


def check_costs(names: Names, data: DataSet) -> None:
    """Raise ConfigError if a constraint is on a cost that the data set lacks."""
    for name in names:
        if name not in data.costs:
            hint = nearest(name, data.costs) if data.costs else "; it has no costs with names"
            raise ConfigError(f"cost_limits: the data set has no cost {name!r}{hint}")


def given(data: Any) -> DataSet:
    """`data`, which must be a data set.

    Raises:
        ConfigError: there is none.
    """
    if not isinstance(data, DataSet):
        raise ConfigError("an offline algorithm learns from a data set: give dataset=PATH")
    return data


def need_episodes(data: Any, why: str) -> Episodes:
    """The episodes of the data set.

    Raises:
        ConfigError: they are not known, or there is no data set. `why` says what they are needed for.
    """
    if not (episodes := given(data).episodes):
        raise ConfigError(f"{why}: the data set has no timeouts, which say where episodes end")
    return episodes


def data_of(shared: Shared, env: Env) -> DataSet:
    """The data set, which must be one of this environment.

    Raises:
        ConfigError: there is none, or its arrays have other sizes.
    """
    data = given(shared.data)
    for name, x, size in (
        ("observations", vector_of(data.obs), env.obs_size),
        ("next_observations", vector_of(data.next_obs), env.obs_size),
        ("actions", data.action, env.action_size),
    ):
        if x.shape[1] != size:
            raise ConfigError(
                f"dataset: {name} have {x.shape[1]} numbers, those of the environment {size}"
            )
    return data


def check_pictures(data: DataSet, like: PyTree) -> None:
    """Raise ConfigError unless the pictures of a data set are those of an environment that observes
    what `like` has the shapes of."""

    def size(obs: PyTree, skip: int) -> str:
        if not isinstance(obs, dict):
            return "no pictures"
        height, width, channels = obs["vision"].shape[skip:]
        return f"pictures of {width} x {height} x {channels}"

    shown = size(like, 0)
    for obs in (data.obs, data.next_obs):
        if (found := size(obs, 1)) != shown:
            raise ConfigError(f"dataset: it has {found}, the environment {shown}")

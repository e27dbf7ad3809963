"""The offline loop: gradient steps on a data set, without an environment step.

`jit(update)` compiles an iteration of `updates` gradient steps. All members share the data set:
`vmap(update, in_axes=(0, None))` keeps one copy of it. What a method adds to this is a `Learner`.
"""

import dataclasses
from typing import Any, Literal, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxsafe.config import (
    Amount,
    ConfigError,
    EndOfDecay,
    Norm,
    Rate,
    Share,
    Units,
    Weight,
    check_values,
    config,
)
from jaxsafe.learn.acting import learned_of
from jaxsafe.learn.batch import select
from jaxsafe.learn.learner import GradientStep, Learner, policy_by
from jaxsafe.learn.normalise import init_normaliser, merge, network_inputs
from jaxsafe.learn.replay import Transitions
from jaxsafe.learn.steps import Trainable, remaining
from jaxsafe.types import Algorithm, Clocks, Env, Metrics, PyTree, Shared


class DataSet(NamedTuple):
    """n transitions, in any order.

    obs, next_obs: float [n, O]. action: float [n, A]. reward, cost: float [n]. terminated: bool [n],
    True where next_obs has no value; running out of time is not termination.
    """

    obs: jax.Array | np.ndarray
    action: jax.Array | np.ndarray
    reward: jax.Array | np.ndarray
    cost: jax.Array | np.ndarray
    next_obs: jax.Array | np.ndarray
    terminated: jax.Array | np.ndarray


def data_set_like(env: Env) -> DataSet:
    """A data set of one transition, all zeros: its shapes are those of data of `env`."""
    obs, number = np.zeros((1, env.obs_size), np.float32), np.zeros(1, np.float32)
    action = np.zeros((1, env.action_size), np.float32)
    return DataSet(obs, action, number, number, obs, np.zeros(1, bool))


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
    # Whether observations are normalised by the mean and variance of the data. OmniSafe does not.
    obs_normalize: bool = True
    # The discount of rewards. Imitation only uses it for evaluation's discounted return.
    discount: Share = 0.99
    cost_discount: Share = 0.99  # The discount of costs, likewise.
    # The undiscounted cost that an episode may have. Imitation only draws it in plots.
    cost_limit: Weight = 25.0
    lr: Rate = 1e-3  # The policy's learning rate, by Adam, as in OmniSafe's VAE-BC.
    lr_decay: bool = False  # Whether it falls linearly to 0 at `total_iterations`.
    max_grad_norm: Norm = 40.0  # The largest norm of each network's gradient.


@flax.struct.dataclass
class TrainState:
    """All that an update needs besides `Shared`, whose `data` is the data set.

    config: the algorithm's, with its floats as arrays.
    params, opt_state: the learner's.
    dual: (), the state of a treatment of the constraint.
    normaliser: Normaliser of the data's observations, or () without `obs_normalize`.
    """

    config: Any
    params: dict[str, PyTree]
    opt_state: dict[str, PyTree]
    dual: PyTree
    normaliser: PyTree
    key: jax.Array


def offline(env: Env, learner: Learner) -> Algorithm:
    """The algorithm that `learner` makes of the loop."""

    def init(key: jax.Array, cfg: Any, shared: Shared) -> TrainState:
        check_values(cfg)
        data = data_of(shared, env)
        cfg = jax.tree.map(jnp.float32, cfg)
        params_key, key = jax.random.split(key)
        nets = learner.init(params_key, env.obs_size, env.action_size, cfg)
        normaliser: PyTree = ()
        if cfg.obs_normalize:
            normaliser = merge(init_normaliser(env.obs_size), jnp.asarray(data.obs))
        return TrainState(cfg, nets.params, nets.opt_state, (), normaliser, key)

    def update(ts: TrainState, shared: Shared) -> tuple[TrainState, Metrics]:
        cfg, data = ts.config, data_of(shared, env)
        iteration = jnp.asarray(shared.iteration)
        key, steps_key = jax.random.split(ts.key)

        def step(nets: Trainable, x: tuple[jax.Array, jax.Array]) -> tuple[Trainable, Metrics]:
            count, key = x
            draw_key, step_key = jax.random.split(key)
            rows = jax.random.randint(draw_key, (cfg.batch_size,), 0, len(data.obs))
            at = GradientStep(count, remaining(iteration, cfg), step_key)
            new, metrics = learner.step(nets, batch_at(data, rows, cfg, ts.normaliser), at, cfg, None)
            finite = jnp.isfinite(optax.tree.norm(new))
            metrics |= {"train/nonfinite": ~finite}
            return select(finite, new, nets), jax.tree.map(jnp.float32, metrics)

        counts = iteration * cfg.updates + jnp.arange(cfg.updates)
        keys = jax.random.split(steps_key, cfg.updates)
        nets, metrics = jax.lax.scan(step, Trainable(ts.params, ts.opt_state), (counts, keys))
        lost = metrics.pop("train/nonfinite").sum()
        metrics = jax.tree.map(jnp.mean, metrics) | {"train/nonfinite": lost}
        ts = dataclasses.replace(ts, params=nets.params, opt_state=nets.opt_state, key=key)
        return ts, metrics

    def clocks(cfg: Any) -> Clocks:
        check_values(cfg)
        return Clocks(0, cfg.updates)

    return Algorithm(init, update, policy_by(learner), learned_of, lambda learned: env, clocks)


def batch_at(data: DataSet, rows: jax.Array, cfg: Any, normaliser: PyTree) -> Transitions:
    """The transitions of some rows [B], with observations as the networks see them.

    A data set knows one cost alone, so `costs` has no entries: it is [B, 0].
    """
    obs, action, reward, cost, next_obs, terminated = (jnp.asarray(x)[rows] for x in data)
    return Transitions(
        obs=network_inputs(normaliser, obs),
        action=action,
        reward=reward,
        cost=cost,
        costs=jnp.zeros((len(rows), 0)),
        next_obs=network_inputs(normaliser, next_obs),
        steps=jnp.ones(len(rows), jnp.int32),
        terminated=terminated,
        weight=jnp.full(len(rows), 1 / len(rows)),
    )


def data_of(shared: Shared, env: Env) -> DataSet:
    """The data set, which must be one of this environment.

    Raises:
        ConfigError: there is none, or its arrays have other sizes.
    """
    data = shared.data
    if not isinstance(data, DataSet):
        raise ConfigError("an offline algorithm learns from a data set: give dataset=PATH")
    for name, x, size in (
        ("observations", data.obs, env.obs_size),
        ("next_observations", data.next_obs, env.obs_size),
        ("actions", data.action, env.action_size),
    ):
        if x.shape[1] != size:
            raise ConfigError(
                f"dataset: {name} have {x.shape[1]} numbers, those of the environment {size}"
            )
    return data

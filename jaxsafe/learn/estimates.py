"""From a rollout to a batch: what the learner is paid, advantages, and the critics' targets."""

from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from jaxsafe.learn.acting import Learned
from jaxsafe.learn.batch import centre, psum, standardise
from jaxsafe.learn.constraints import Names, each
from jaxsafe.learn.metrics import explained_variance
from jaxsafe.learn.normalise import Normaliser, init_normaliser, merge, network_inputs, normalise
from jaxsafe.learn.returns import ValuedSteps, advantages
from jaxsafe.learn.rollout import Bad, Trajectory
from jaxsafe.nn.gaussian import Gaussian, log_prob
from jaxsafe.nn.networks import apply_to_rollout
from jaxsafe.types import Metrics, PyTree


@flax.struct.dataclass
class Batch:
    """B = T * N transitions, as the policy sees them: observations are normalised. With a memory N
    sequences of T, and [N, T] stands for [B].

    obs: float [B, O], a dict of that and pictures, or `Sequences`.
    action: float [B, A].
    log_prob: float [B], of the policy that acted.
    old: Gaussian [B, A], of the policy that acted.
    adv_r: float [B], standardised.
    adv_c: float [B], only centred: in cost units or, with `cost_normalize`, in standard deviations of a
        step's cost. Of several constraints [B, K].
    ret_r, ret_c: float [B], the critics' targets. Of several constraints ret_c is [B, K].
    """

    obs: PyTree
    action: jax.Array
    log_prob: jax.Array
    old: Gaussian
    adv_r: jax.Array
    adv_c: jax.Array
    ret_r: jax.Array
    ret_c: jax.Array


# ---- what the learner is paid -------------------------------------------------------------------


class Signals(NamedTuple):
    """Reward [T, N] and cost, [T, N] or [T, N, K], and the statistics by which they are scaled.

    normaliser: Normaliser of [reward, costs ...], or () where neither is scaled.
    """

    reward: jax.Array
    cost: jax.Array
    normaliser: PyTree


def init_signal_normaliser(cfg: Any, costs: int) -> PyTree:
    return init_normaliser(1 + costs) if cfg.reward_normalize or cfg.cost_normalize else ()


def scaled(raw: Signals, cfg: Any, axis_name: str | None, weight: jax.Array | float = 1.0) -> Signals:
    """Reward and cost as the config asks the learner to see them, and the statistics with this batch.

    Observations are normalised by what was known when the policy acted on them. Rewards and costs are
    scaled with their own batch, as in OmniSafe, so that the critics' first targets have the scale of
    all others. What is not centred is divided by the root of its mean square.

    Args:
        raw: reward and cost in their own units, and the statistics before this batch.
        weight: float [], of a good step; see `weights`. Bad steps are 0 in `raw`.
    """
    if not (cfg.reward_normalize or cfg.cost_normalize):
        return Signals(raw.reward, raw.cost, ())
    side_by_side = [raw.reward[..., None], raw.cost.reshape(*raw.reward.shape, -1)]
    together = jnp.concatenate(side_by_side, -1)
    normaliser = merge(raw.normaliser, together, axis_name, weight)
    centred = jnp.array([cfg.reward_centre, *(together.shape[-1] - 1) * [cfg.cost_centre]])
    mean = jnp.where(centred, normaliser.mean, 0.0)
    var = jnp.where(centred, normaliser.var, normaliser.var + normaliser.mean**2)
    found = normalise(Normaliser(normaliser.count, mean, var), together)
    return Signals(
        found[..., 0] if cfg.reward_normalize else raw.reward,
        found[..., 1:].reshape(raw.cost.shape) if cfg.cost_normalize else raw.cost,
        normaliser,
    )


def weights(bad: Bad, axis_name: str | None) -> jax.Array:
    """What a step counts, [T, N]: 0 where it is bad, and 1 on average. NaN where all are bad."""
    good, size = psum(((~bad.any).sum(), jnp.float32(bad.obs.size)), axis_name)
    return jnp.where(good > 0, jnp.where(bad.any, 0.0, size / jnp.maximum(good, 1)), jnp.nan)


# ---- advantages and targets ---------------------------------------------------------------------


class Experience(NamedTuple):
    """A rollout as the learner sees it.

    traj: the rollout; `next_obs` is what each step's value bootstraps from.
    signals: what the learner is paid and charged in it.
    carry: what the policy remembered before it, [N, H], or () without a memory.
    """

    traj: Trajectory
    signals: Signals
    carry: PyTree


class SignalEstimate(NamedTuple):
    """Of reward or of one cost, float [T, N]: advantages, the critic's targets, and their errors."""

    advantage: jax.Array
    target: jax.Array
    error: jax.Array


def estimate_batch(
    learned: Learned, seen: Experience, names: Names, axis_name: str | None
) -> tuple[Batch, Metrics]:
    """The batch: advantages and targets of reward and cost, under the parameters that acted.

    A bad step says nothing: its advantages are 0, and its targets are what the critics say already.

    Args:
        learned: what acted.
        seen: the rollout.
        names: the costs that have a limit each, on the last axis of `seen.signals.cost`.
    """
    cfg, traj, signals = learned.config, seen.traj, seen.signals
    bad, weight = traj.bad.any, weights(traj.bad, axis_name)
    obs, next_obs = (network_inputs(learned.normaliser, x) for x in (traj.obs, traj.next_obs))
    found = apply_to_rollout(learned.params, obs, next_obs, traj.first, seen.carry, cfg)
    ratio = jnp.exp(log_prob(found.dist, traj.action) - traj.log_prob)  # 1: the policy has not moved
    shape = signals.cost.shape
    v_c, next_v_c = (x[..., 1:].reshape(shape) for x in (found.value, found.next_value))

    def of_signal(
        x: jax.Array, v: jax.Array, next_v: jax.Array, discount: Any, decay: Any
    ) -> SignalEstimate:
        x = jnp.where(bad, v, x)  # a bad step is terminated, so its error is x - v = 0
        steps = ValuedSteps(x, v, next_v, traj.terminated | bad, traj.done)
        advantage, error = advantages(cfg.estimator, steps, ratio, discount, decay)
        return SignalEstimate(advantage, error + v, error)

    v_r, next_v_r = found.value[..., 0], found.next_value[..., 0]
    of_reward = of_signal(signals.reward, v_r, next_v_r, cfg.discount, cfg.gae_lambda)
    of_costs = jax.vmap(of_signal, (-1, -1, -1, None, None), -1) if names else of_signal
    of_cost = of_costs(signals.cost, v_c, next_v_c, cfg.cost_discount, cfg.cost_gae_lambda)
    # a minibatch has single steps or, for a policy with a memory, whole sequences of an environment
    lay_out = by_env if cfg.trunk == "gru" else by_step
    batch = Batch(
        obs=found.inputs if cfg.trunk == "gru" else jax.tree.map(by_step, found.inputs),
        action=lay_out(traj.action),
        log_prob=lay_out(traj.log_prob),
        old=jax.tree.map(lay_out, found.dist),
        adv_r=lay_out(standardise(of_reward.advantage, axis_name, weight) * weight),
        adv_c=lay_out(each(lambda x: centre(x, axis_name, weight) * weight, names)(of_cost.advantage)),
        ret_r=lay_out(of_reward.target),
        ret_c=lay_out(of_cost.target),
    )

    def explained(error: jax.Array, target: jax.Array) -> jax.Array:
        return explained_variance(error, target, axis_name)

    metrics = {
        "train/explained_variance_r": explained(of_reward.error, of_reward.target),
        "train/explained_variance_c": each(explained, names)(of_cost.error, of_cost.target),
    }
    return batch, metrics


def by_step(x: jax.Array) -> jax.Array:
    """[T * N, ...] of [T, N, ...]."""
    steps, envs, *rest = x.shape  # a vector beside a picture may be empty, so that -1 would not tell
    return x.reshape(steps * envs, *rest)


def by_env(x: jax.Array) -> jax.Array:
    """[N, T, ...] of [T, N, ...]."""
    return jnp.swapaxes(x, 0, 1)

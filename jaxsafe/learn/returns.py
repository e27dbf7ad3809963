"""Advantages, and what an episode costs."""

from typing import Literal, NamedTuple, Protocol

import chex
import jax
import jax.numpy as jnp

from jaxsafe.learn.batch import batch_mean, psum

Estimator = Literal["gae", "gae_rtg", "plain", "vtrace"]


class ValuedSteps(NamedTuple):
    """T steps of N environments with what a critic says of them, [T, N] each; of rewards or of costs.

    reward: float. value, next_value: float, V(s_t) and V(s_{t+1}), the latter before any reset.
    terminated: bool, the next state is worth 0. done: bool, terminated or out of time.
    """

    reward: jax.Array
    value: jax.Array
    next_value: jax.Array
    terminated: jax.Array
    done: jax.Array


def gae(steps: ValuedSteps, discount: jax.Array | float, decay: jax.Array | float) -> jax.Array:
    """Generalised advantage estimates, for rewards or for costs.

        delta_t = r_t + discount (0 if terminated_t else V(s_{t+1})) - V(s_t)
        A_t     = delta_t + discount decay (0 if done_t else A_{t+1})

    `terminated` cuts the bootstrap and `done` cuts the sum, so a time limit still bootstraps. Nothing
    is multiplied by zero: a value that is not finite stays behind the cut.

    Args:
        discount, decay: scalars in [0, 1]; gamma and lambda in the paper.
    Returns:
        Advantages, float [T, N], in the units of the reward. With `value` added they are the
        TD(lambda) returns.
    Raises:
        AssertionError: while tracing, if the arrays differ in shape.
    Source: Schulman et al. (2016), "High-Dimensional Continuous Control Using
        Generalized Advantage Estimation", section 3.
    """
    chex.assert_equal_shape(steps)
    delta = td_error(steps, discount)
    return backward_sums(delta, steps.done, discount * decay, jnp.ones_like(delta))


def td_error(steps: ValuedSteps, discount: jax.Array | float) -> jax.Array:
    next_value = jnp.where(steps.terminated, 0.0, steps.next_value)
    return steps.reward + discount * next_value - steps.value


def backward_sums(
    delta: jax.Array, done: jax.Array, factor: jax.Array | float, rho: jax.Array
) -> jax.Array:
    """A_t = rho_t (delta_t + factor (1 - done_t) A_{t+1}), float [T, N]."""

    def backward(later: jax.Array, x: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        delta, done, rho = x
        now = rho * (delta + factor * jnp.where(done, 0.0, later))
        return now, now

    return jax.lax.scan(backward, jnp.zeros_like(delta[0]), (delta, done, rho), reverse=True)[1]


def vtrace(steps: ValuedSteps, ratio: jax.Array, discount: jax.Array | float) -> jax.Array:
    """V-trace: advantages for a policy pi from the data of another, mu.

        A_t = rho_t (r_t + discount v_{t+1} - V(s_t)),   v_t = V(s_t) + A_t,   rho_t = min(1, pi / mu)

    where v_{t+1} is 0 if terminated_t, else V(s_{t+1}) if done_t. Both of the paper's clips, rho and
    c, are at 1, which makes one recursion of its two: v_t - V(s_t) is A_t. With pi = mu it is
    `gae` with a decay of 1.

    Args:
        ratio: float [T, N], pi(a_t | s_t) / mu(a_t | s_t).
    Returns:
        Advantages, float [T, N]. With `value` added they are the targets v.
    Source: Espeholt et al. (2018), "IMPALA: Scalable Distributed Deep-RL with Importance Weighted
        Actor-Learner Architectures", arXiv:1802.01561, equation 1 and section 4.2.
    """
    chex.assert_equal_shape([*steps, ratio])
    delta = td_error(steps, discount)
    return backward_sums(delta, steps.done, discount, jnp.minimum(1.0, ratio))


def advantages(
    estimator: Estimator,
    steps: ValuedSteps,
    ratio: jax.Array,
    discount: jax.Array | float,
    decay: jax.Array | float,
) -> tuple[jax.Array, jax.Array]:
    """Advantages, and the errors of the critic: its targets less its values. OmniSafe's four:

        gae:      generalised advantages; their own TD(lambda) returns as targets
        gae_rtg:  generalised advantages; discounted rewards to go as targets
        plain:    temporal differences of one step; rewards to go as targets
        vtrace:   V-trace, for both

    Rewards to go run to the end of the episode or of the batch and add the value there, unless it
    terminated: V(s) plus `gae` with a decay of 1.

    Args: as for `vtrace` and `gae`; only those two names with gae in them read `decay`.
    """
    match estimator:
        case "gae":
            advantage = error = gae(steps, discount, decay)
        case "gae_rtg":
            advantage, error = gae(steps, discount, decay), gae(steps, discount, decay=1.0)
        case "plain":
            advantage, error = td_error(steps, discount), gae(steps, discount, decay=1.0)
        case "vtrace":
            advantage = error = vtrace(steps, ratio, discount)
    return advantage, error


class Window(NamedTuple):
    """The last W of some values, float [W, ...], the newest last, and how many there are, int32 []."""

    values: jax.Array
    count: jax.Array


def empty_window(size: int, shape: tuple[int, ...]) -> Window:
    return Window(jnp.zeros((size, *shape)), jnp.int32(0))


def window_mean(window: Window, value: jax.Array) -> tuple[jax.Array, Window]:
    """The mean of the last W values, of which `value` is one, and the window with it."""
    values = jnp.concatenate([window.values[1:], value[None]])
    count = jnp.minimum(window.count + 1, len(values))
    return values.sum(0) / count, Window(values, count)


class EpisodeCost(NamedTuple):
    """J_c, the undiscounted cost of an episode: [] or, of several constraints, [K].

    of_iteration: this iteration's estimate, the mean cost of a step times the mean length.
    recent: the mean of the estimates in `past`, which is what the method gets.
    past: Window of the last `cost_window` estimates, this one included.
    """

    of_iteration: jax.Array
    recent: jax.Array
    past: Window


def episode_cost(
    past: Window, charged: jax.Array, weight: jax.Array, length: jax.Array, axis_name: str | None
) -> EpisodeCost:
    """J_c after a rollout.

    Args:
        past: of the iterations before it.
        charged: float [T, N] or [T, N, K], what is held under the limit, 0 in bad steps.
        weight: float [], of a good step.
        length: float [], mean length of an episode, in steps.
    """
    of_iteration = batch_mean(charged, axis_name, (0, 1)) * weight * length
    recent, past = window_mean(past, of_iteration)
    return EpisodeCost(of_iteration, recent, past)


class LostTime(NamedTuple):
    """Sums over the recent past, float [] each: steps that failures took from their episodes, which
    would have lasted to the time limit, and steps taken."""

    lost: jax.Array
    taken: jax.Array


def no_lost_time() -> LostTime:
    return LostTime(jnp.zeros(()), jnp.zeros(()))


class Failures(Protocol):
    """Where episodes failed, bool [T, N], and the steps of the episodes so far, int [T, N]."""

    @property
    def terminated(self) -> jax.Array: ...

    @property
    def length(self) -> jax.Array: ...


def expected_length(
    past: LostTime,
    limit: int,
    steps: Failures,
    taken: jax.Array | int,
    axis_name: str | None = None,
) -> tuple[jax.Array, LostTime]:
    """The mean length L of an episode in steps, float [], by which a cost per step is multiplied.

    By the renewal-reward theorem the mean cost of an episode is the mean cost per step times L. The
    batch gives the first factor without lag, whether or not an episode ended in it. The same theorem
    gives L: an episode that fails at step n loses T - n of the time limit T, so the time lost per step
    is x = (T - L) / L, and

        L = T / (1 + x),   x = lost / taken, over about the last N complete episodes.

    - L is exactly T while nothing fails. Over synchronous whole episodes J_c is then their plain mean
      cost, Safety Gym's. Over parts of staggered episodes it is unbiased once all environments have
      taken T steps. Until then late parts of episodes are missing.
    - Only `terminated` shortens L. Where the environment itself cuts episodes (`State.truncated`), J_c
      is the cost of T steps, as if they had gone on.
    - The first batch counts in full. If failures are equally likely at every step, the first L is
      within a quarter of the true one, or up to half above it where `stagger` pretends to ages. A mean
      over the episodes that have ended would start with short ones alone.
    - Until the first episodes are T steps old, L is too low where only young episodes fail, and too
      high where only old ones do.

    Args:
        past: what the last call returned, at first `no_lost_time()`.
        limit: T, `env.episode_length`.
        steps: this batch's.
        taken: how many of its T N entries are steps; resets are none.
    """
    lost = jnp.where(steps.terminated, limit - steps.length, 0).sum(dtype=jnp.float32)
    lost, taken, num_envs = psum((lost, jnp.float32(taken), steps.terminated.shape[1]), axis_name)
    lost, taken = past.lost + lost, past.taken + taken
    least = jnp.maximum(taken, 1)  # without a step, as where all were bad, there is no loss either
    length = limit / (1 + lost / least)
    keep = jnp.minimum(1.0, num_envs * length / least)
    return length, LostTime(keep * lost, keep * taken)

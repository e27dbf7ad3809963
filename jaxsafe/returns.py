"""Advantages, and what an episode costs."""

import chex
import jax
import jax.numpy as jnp

from jaxsafe.batch import psum


def gae(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    done: jax.Array,
    *,
    discount: jax.Array | float,
    decay: jax.Array | float,
) -> jax.Array:
    """Generalised advantage estimates, for rewards or for costs.

        delta_t = r_t + discount (0 if terminated_t else V(s_{t+1})) - V(s_t)
        A_t     = delta_t + discount decay (0 if done_t else A_{t+1})

    `terminated` cuts the bootstrap, `done` (terminated or out of time) cuts the sum, so a
    time limit still bootstraps from `next_value`, the value of the state before the reset.
    Nothing is multiplied by zero: a value that is not finite stays behind the cut.

    Args:
        reward, value, next_value: float [T, N], over steps and environments.
        terminated, done: bool [T, N].
        discount, decay: scalars in [0, 1]; gamma and lambda in the paper.
    Returns:
        Advantages, float [T, N], in the units of `reward`. With `value` added they are the
        TD(lambda) returns.
    Raises:
        AssertionError: while tracing, if the five arrays differ in shape.
    Source: Schulman et al. (2016), "High-Dimensional Continuous Control Using
        Generalized Advantage Estimation", section 3.
    """
    chex.assert_equal_shape([reward, value, next_value, terminated, done])
    delta = reward + discount * jnp.where(terminated, 0.0, next_value) - value

    def backward(advantage: jax.Array, x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        delta, done = x
        advantage = delta + discount * decay * jnp.where(done, 0.0, advantage)
        return advantage, advantage

    return jax.lax.scan(backward, jnp.zeros_like(value[0]), (delta, done), reverse=True)[1]


def mean_length(
    length: jax.Array, ended: jax.Array, lengths: jax.Array, axis_name: str | None = None
) -> jax.Array:
    """A running mean of episode lengths, in steps: what a cost per step is multiplied by.

    By the renewal-reward theorem an episode's mean cost is the mean cost per step times the mean
    length of an episode. The batch gives the first factor without lag, whether or not an episode
    ended in it. This is the second: it starts at the time limit, where it stays, exactly, while
    nothing terminates early; else it is a mean over about the last N complete episodes. So

    - over synchronous whole episodes the product is their plain mean cost, Safety Gym's J_c;
    - over parts of staggered episodes that only time ends, it is unbiased: rate times limit;
    - early terminations reach the length with a lag of an episode, since one that is shortened is
      known at once and one that is not only when it ends. The cost rate never lags.

    Args:
        length: float [], the mean so far, at first `env.episode_length`.
        ended: bool [T, N], complete episodes that ended.
        lengths: int [T, N], their lengths there.
    """
    excess, count, memory = psum(
        (jnp.where(ended, lengths - length, 0.0).sum(), ended.sum(), ended.shape[1]), axis_name
    )
    return length + excess / (count + memory)

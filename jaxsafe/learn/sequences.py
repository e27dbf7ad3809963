"""Gradient steps on sequences from a replay: what is drawn, and its TD(lambda) returns."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxsafe.config import ConfigError
from jaxsafe.learn.batch import device_count, pmean, psum
from jaxsafe.learn.normalise import network_inputs
from jaxsafe.learn.replay import Record, Source, draw, sequences
from jaxsafe.learn.returns import ValuedSteps, gae


class SequenceBatch(NamedTuple):
    """B sequences of T rows from a replay, leaves [T, B, ...].

    weight: float [B], 0 for what must not count. Weights sum to 1 over a device's share, on average
        over devices.
    """

    rows: Record
    weight: jax.Array

    @property
    def follows(self) -> jax.Array:
        """Whether row t + 1 is what came of row t, bool [T - 1, B]. It is not at the end of an episode,
        and where a sequence goes on with the oldest row of the replay after the newest."""
        return ~(self.rows.last[:-1] | self.rows.first[1:])

    def mean(self, x: jax.Array) -> jax.Array:
        """The mean of `x` [T, B] over the rows: this device's share of it."""
        return (self.weight * x.mean(0)).sum()


def check_sequences(cfg: Any, axis_name: str | None) -> None:
    """Refuse batches that are no whole number of sequences on each device."""
    length, devices = cfg.n_step + 1, device_count(axis_name)
    if cfg.batch_size % (length * devices):
        on_each = f", on each of {devices} devices" if devices > 1 else ""
        raise ConfigError(
            f"batch_size={cfg.batch_size}: expected a multiple of n_step + 1 = {length}, "
            f"the rows of a sequence{on_each}"
        )


def drawn_sequences(
    key: jax.Array, source: Source, cfg: Any, axis_name: str | None
) -> tuple[SequenceBatch, jax.Array]:
    """Sequences of `n_step` + 1 rows, `rows` in all, with normalised observations.

    Returns:
        The sequences, and how many weigh nothing, over all devices, for a number that is not finite.
    """
    length = source.n_step + 1
    index = draw(key, source.ring, source.span, source.rows // length, ahead=0)
    found = sequences(source.ring, source.span, index, length)
    floats = [x for x in jax.tree.leaves(found) if jnp.issubdtype(x.dtype, jnp.floating)]
    finite = jnp.isfinite(sum(x.sum((0, *range(2, x.ndim))) for x in floats))  # [B]

    def kept(x: jax.Array) -> jax.Array:
        return jnp.where(finite.reshape(1, -1, *(1,) * (x.ndim - 2)), x, jnp.zeros_like(x))

    found = jax.tree.map(kept, found)
    weight = finite / jnp.maximum(pmean(finite.sum(dtype=jnp.float32), axis_name), 1.0)
    found = found.replace(obs=network_inputs(source.normaliser, found.obs))
    return SequenceBatch(found, weight), psum((~finite).sum(), axis_name)


def lambda_returns(
    batch: SequenceBatch,
    reward: jax.Array,
    value: jax.Array,
    ended: jax.Array,
    *,
    discount: jax.Array | float,
    decay: jax.Array | float,
) -> jax.Array:
    """TD(lambda) returns of all rows but the last, float [T - 1, B].

        G_t = r_{t+1} + discount ((1 - decay) V_{t+1} + decay G_{t+1})

    where G_{t+1} is V_{t+1} if row t + 1 is the last of its episode or of the sequence, and both are 0
    if it ended for good. What stands where `follows` does not hold means nothing.

    Args:
        reward, value: float [T, B], of each row; `value` is that of its observation.
        ended: bool [T, B], whether nothing is to come after a row.
    """
    ends = jnp.concatenate([~batch.follows[1:], jnp.ones_like(batch.follows[:1])])
    steps = ValuedSteps(reward[1:], value[:-1], value[1:], ended[1:], ends)
    return value[:-1] + gae(steps, discount, decay)

"""A replay: the latest rows of every environment, in a ring on the device.

A row describes the arrival at an observation, and then the action that was taken from it:

    row t:  first_t  obs_t  reward_t  cost_t  terminated_t  truncated_t  |  action_t

Environments reset on the next step. The last observation of an episode has a row of its own, whose
action is ignored, and the row after it is the first of the next episode. So row t + 1 is always what
follows row t, one observation a row is enough, and each episode takes one row more than it has steps.

The ring has R rows of N environments, leaves [N, R, ...]. Which rows are written next and which ones
the ring holds are functions of the loop's clock. They are the same for all members of a `vmap`, so
that writing is one `dynamic_update_slice` into a donated ring and never a scatter. The environments
come first because on a CPU XLA copies an array [R, 1, ...] on its way into a loop and out of it.

Positions count from the oldest row that the ring holds: 0 is the oldest, `count - 1` the newest.
"""

from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from jaxsafe.learn.batch import aligned, pmean, psum, select_rows
from jaxsafe.types import Count, PyTree


@flax.struct.dataclass
class Record:
    """The arrival at `obs` and the action taken from it; every field is [..., N, ...].

    obs: pytree, in its own dtypes. action: float [..., A], ignored where the episode has ended.
    reward, cost: float [...], costs: float [..., K], all of the step that led to `obs`; 0 where
    `first`. first: bool [...], a reset led to `obs`. terminated, truncated: bool [...].
    """

    obs: PyTree
    action: jax.Array
    reward: jax.Array
    cost: jax.Array
    costs: jax.Array
    first: jax.Array
    terminated: jax.Array
    truncated: jax.Array

    @property
    def last(self) -> jax.Array:
        return self.terminated | self.truncated


class Span(NamedTuple):
    """The rows that a ring holds: `count` of them, int32 [], from row `oldest`, int32 []."""

    oldest: jax.Array
    count: jax.Array


class Index(NamedTuple):
    """Rows of a ring, by their positions and environments: int32 of one shape."""

    position: jax.Array
    env: jax.Array


class Source(NamedTuple):
    """What a gradient step draws from: a ring, what it holds, and the normaliser of observations.

    rows: of the ring, as many as make a batch on this device. n_step: the most steps of a transition.
    """

    ring: Record
    span: Span
    normaliser: PyTree
    rows: int
    n_step: int


class Transitions(NamedTuple):
    """B transitions of up to n steps.

    obs: pytree [B, ...]. action: float [B, A]. next_obs: pytree [B, ...], the observation after
    `steps` steps, int [B]. reward, cost: float [B], costs: float [B, K], discounted sums over those
    steps; K are the environment's costs, or those under a limit in a batch of a data set. terminated:
    bool [B], next_obs has no value. weight: float [B], 0 for what must not count, else 1; a learner
    gets weights whose sum is 1, for `mean`.
    """

    obs: PyTree
    action: jax.Array
    reward: jax.Array
    cost: jax.Array
    costs: jax.Array
    next_obs: PyTree
    steps: jax.Array
    terminated: jax.Array
    weight: jax.Array

    def mean(self, x: jax.Array) -> jax.Array:
        """The mean of `x` [B, ...] over the transitions: this device's share of it."""
        return (aligned(self.weight, x) * x).sum(0)


def ring_rows(transitions: int, num_envs: int, block: int) -> int:
    """R, rows for about so many transitions of all environments: whole blocks, the nearest number."""
    return max(1, round(transitions / (num_envs * block))) * block


def empty_ring(row: Record, rows: int) -> Record:
    """A ring for rows like `row` [N, ...], arrays or their shapes."""
    return jax.tree.map(lambda x: jnp.zeros((x.shape[0], rows, *x.shape[1:]), x.dtype), row)


def held(rows: int, block: int, written: Count, iteration: Count, since: Count) -> Span:
    """What a ring of `rows` rows holds in the course of an iteration.

    Args:
        rows: R, a multiple of `block`.
        block: rows that an iteration writes.
        written: how many of them it has written by now.
        iteration, since: int32 [], the loop's clock, and the iteration that wrote the oldest rows.
    """
    blocks = rows // block
    end = (iteration % blocks) * block + written
    count = jnp.minimum(jnp.minimum(iteration - since, blocks) * block + written, rows)
    return Span((end - count) % rows, count)


def write(ring: Record, new: Record, span: Span) -> Record:
    """`ring` with the rows `new` [T, N, ...] after those of `span`; T divides the rows of the ring."""
    end = (span.oldest + span.count) % ring.reward.shape[1]

    def put(ring: jax.Array, new: jax.Array) -> jax.Array:
        return jax.lax.dynamic_update_slice_in_dim(ring, jnp.swapaxes(new, 0, 1), end, axis=1)

    return jax.tree.map(put, ring, new)


def take(leaves: PyTree, span: Span, index: Index) -> PyTree:
    """The entries of `leaves` [N, R, ...] at `index`, a pytree of [B, ...]."""

    def entries(x: jax.Array) -> jax.Array:
        rows = jax.lax.rem(span.oldest + index.position, jnp.int32(x.shape[1]))
        return x.at[index.env, rows].get(mode="promise_in_bounds")

    return jax.tree.map(entries, leaves)


def draw(key: jax.Array, ring: Record, span: Span, batch: int, ahead: int = 1) -> Index:
    """`batch` rows, uniformly and with replacement, of those with `ahead` rows after them."""
    position_key, env_key = jax.random.split(key)
    choices = jnp.maximum(span.count - ahead, 1)
    return Index(
        jax.random.randint(position_key, (batch,), 0, choices),
        jax.random.randint(env_key, (batch,), 0, ring.reward.shape[0]),
    )


def transitions(
    ring: Record,
    span: Span,
    index: Index,
    *,
    discount: jax.Array | float,
    cost_discount: jax.Array | float,
    n_step: int = 1,
) -> Transitions:
    """The transitions that begin at `index`, which has a row after it.

        reward = sum_{j<k} discount^j r_{t+1+j},   next_obs = obs_{t+k},   k <= n_step

    k is smaller than n_step where the episode ends sooner, or where the ring holds fewer rows. An
    episode's last row begins nothing: its weight is 0.

    Args:
        discount, cost_discount: scalars, of rewards and of costs within the n steps.
    """
    ahead = index.position + jnp.arange(n_step + 1)[:, None]  # [n + 1, B]
    inside = ahead[1:] < span.count
    window = Index(jnp.minimum(ahead, span.count - 1), jnp.broadcast_to(index.env, ahead.shape))
    kept = (ring.reward, ring.cost, ring.costs, ring.terminated, ring.last)
    reward, cost, costs, terminated, last = take(kept, span, window)
    happened = jnp.cumprod(~last[:-1] & inside, axis=0).astype(bool)  # [n, B]
    steps = happened.sum(0)
    end = Index(index.position + steps, index.env)

    def total(x: jax.Array, discount: jax.Array | float) -> jax.Array:
        """Over the steps that happened, of x [n + 1, B, ...]."""
        factors = aligned(jnp.asarray(discount) ** jnp.arange(n_step), x)
        return jnp.where(aligned(happened, x), factors * x[1:], 0).sum(0)

    return Transitions(
        obs=take(ring.obs, span, index),
        action=take(ring.action, span, index),
        reward=total(reward, discount),
        cost=total(cost, cost_discount),
        costs=total(costs, cost_discount),
        next_obs=take(ring.obs, span, end),
        steps=steps,
        terminated=jnp.take_along_axis(terminated, steps[None], axis=0)[0],
        weight=(steps > 0).astype(jnp.float32),
    )


def sequences(ring: Record, span: Span, index: Index, length: int) -> Record:
    """Rows [length, B, ...] from `index` on, for models with a memory.

    A sequence may contain ends: it goes on with the next episode, whose row is `first`. A sequence that
    passes the newest row goes on with the oldest, which is marked `first` too. So every row may begin
    one, and is in as many sequences as any other. A memory that begins anew at `first` never sees two
    episodes.
    """
    position = (index.position + jnp.arange(length)[:, None]) % span.count
    rows = take(ring, span, Index(position, jnp.broadcast_to(index.env, position.shape)))
    return rows.replace(first=rows.first | (position == 0))


def usable(found: Transitions, axis_name: str | None) -> tuple[Transitions, jax.Array]:
    """`found` without transitions that are not finite, and how many were dropped, over all devices.

    Those are replaced by zeros and weigh 0; the weights of the others sum to 1.
    """
    floats = [x for x in jax.tree.leaves(found) if jnp.issubdtype(x.dtype, jnp.floating)]
    finite = jnp.isfinite(sum(x.sum(tuple(range(1, x.ndim))) for x in floats))
    kept = select_rows(finite, found, jax.tree.map(jnp.zeros_like, found))
    total = pmean(kept.weight.sum(), axis_name)
    dropped = psum((~finite & (found.weight > 0)).sum(), axis_name)
    return kept._replace(weight=kept.weight / jnp.maximum(total, 1e-6)), dropped

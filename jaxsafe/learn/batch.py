"""Means over a batch that may be spread over devices. `axis_name` None means one device."""

import jax
import jax.numpy as jnp

from jaxsafe.types import PyTree


def pmean(tree: PyTree, axis_name: str | None) -> PyTree:
    """The mean over devices of every leaf.

    Do not differentiate through it: under `shard_map(check_vma=False)` its derivative is not that of a
    mean over devices. Take it of the gradients of each device's share.
    """
    return tree if axis_name is None else jax.lax.pmean(tree, axis_name)


def device_count(axis_name: str | None) -> int:
    """How many devices share the batch."""
    return 1 if axis_name is None else jax.lax.axis_size(axis_name)


def psum(tree: PyTree, axis_name: str | None) -> PyTree:
    return tree if axis_name is None else jax.lax.psum(tree, axis_name)


def batch_mean(
    x: jax.Array, axis_name: str | None, axis: int | tuple[int, ...] | None = None
) -> jax.Array:
    """The mean of `x` over `axis` (default: all of them) and over devices, which hold equal shares."""
    return pmean(jnp.mean(x, axis), axis_name)


def masked_mean(x: jax.Array, mask: jax.Array, axis_name: str | None) -> jax.Array:
    """The mean of `x` where `mask` holds, over all devices; NaN where it holds nowhere."""
    total, count = psum((jnp.where(mask, x, 0.0).sum(), mask.sum()), axis_name)
    return jnp.where(count > 0, total / jnp.maximum(count, 1), jnp.nan)


def centre(x: jax.Array, axis_name: str | None, weight: jax.Array | float = 1.0) -> jax.Array:
    """`x` less its mean over all devices, in which an entry counts `weight`, 1 on average."""
    return x - batch_mean(x * weight, axis_name)


def standardise(x: jax.Array, axis_name: str | None, weight: jax.Array | float = 1.0) -> jax.Array:
    """Zero mean and unit population variance over the batch of all devices; `weight` as in `centre`."""
    x = centre(x, axis_name, weight)
    return x / (jnp.sqrt(batch_mean(x**2 * weight, axis_name)) + 1e-8)


def select(condition: jax.Array, new: PyTree, old: PyTree) -> PyTree:
    """`new` where the scalar `condition` holds, else `old`, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def aligned(x: jax.Array, like: jax.Array) -> jax.Array:
    """`x` with axes of 1 at its end, as many as `like` has more: entry i of `x` goes with row i."""
    return x.reshape(*x.shape, *(1,) * (like.ndim - x.ndim))


def select_rows(mask: jax.Array, new: PyTree, old: PyTree) -> PyTree:
    """`new` where `mask` [N] holds, else `old` [N, ...]; leaves of `new` may broadcast."""
    return jax.tree.map(lambda a, b: jnp.where(aligned(mask, b), a, b), new, old)


def all_finite(tree: PyTree) -> jax.Array:
    """Whether all numbers of `tree` are, bool []."""
    # Small leaves as one array: of hundreds, XLA makes a program that grows with their square. Large
    # ones alone: to join them is a copy on a CPU. x * 0 is 0, or NaN where x is not finite.
    floats = [x.ravel() for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
    small = jnp.concatenate([jnp.zeros(1), *(x for x in floats if x.size < 2**14)])
    large = [x for x in floats if x.size >= 2**14]
    return jnp.isfinite(jnp.stack([(x * 0).sum() for x in (small, *large)])).all()


def device_key(key: jax.Array, axis_name: str | None) -> jax.Array:
    """A key of this device's own."""
    return key if axis_name is None else jax.random.fold_in(key, jax.lax.axis_index(axis_name))

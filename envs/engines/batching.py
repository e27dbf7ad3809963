"""Functions of a whole batch as functions of one world, which `vmap` makes a batch again."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def batched(run_batch: Callable) -> Callable:
    """A function of one world from one of a batch: every `vmap` adds to the batch."""

    @jax.custom_batching.custom_vmap
    def flat(*args: Any) -> Any:
        return run_batch(*args)

    @flat.def_vmap
    def _(axis_size: int, in_batched: Any, *args: Any) -> Any:
        args = broadcast_unbatched(axis_size, in_batched, args)
        each = jax.tree.leaves(args)[0].shape[1]
        out = flat(*jax.tree.map(lambda x: x.reshape(axis_size * each, *x.shape[2:]), args))
        out = jax.tree.map(lambda x: x.reshape(axis_size, each, *x.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    @jax.custom_batching.custom_vmap
    def run(*args: Any) -> Any:
        return jax.tree.map(lambda x: x[0], flat(*jax.tree.map(lambda x: x[None], args)))

    @run.def_vmap
    def _(axis_size: int, in_batched: Any, *args: Any) -> Any:
        out = flat(*broadcast_unbatched(axis_size, in_batched, args))
        return out, jax.tree.map(lambda _: True, out)

    return run


def broadcast_unbatched(axis_size: int, in_batched: Any, args: Any) -> Any:
    """Give every argument the batch axis."""
    return jax.tree.map(
        lambda x, batched: x if batched else jnp.broadcast_to(x, (axis_size, *x.shape)),
        args,
        tuple(in_batched),
    )

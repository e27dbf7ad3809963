"""A draw from an ensemble in one kernel of a Hopper GPU (H100, H200), hidden layers in bfloat16.

    sigma^2 = e^low + 1 / (e^-high + e^-v),   out = mu + sigma n,   n ~ N(0, 1),   spread = |sigma|

where mu and v are a network's outputs. This is the sigma of ensemble.py without its logarithms.

Thousands of plans make layers of hundreds of megabytes. Here all that lies between `x` and `out` stays
in registers, and the weights pass through the chip's own memory. The random numbers are Philox's of
seven rounds, one stream for each key.

A column of inputs is always 1, and so is a unit of each hidden layer, since swish(1.278) = 1. Their
weights are the biases. Columns beyond are 0, up to what the tensor cores take at a time.

Source: NVIDIA, Parallel Thread Execution ISA, "Asynchronous warpgroup level matrix instructions";
    Salmon et al. (2011), "Parallel Random Numbers: As Easy as 1, 2, 3".
"""
# Kernels are Warp's language in Python's syntax, which no type checker of Python knows:
# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportInvalidTypeForm=false
# pyright: reportAssignmentType=false

import contextlib
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxsafe.nvidia import warp_problem

THREADS = 512  # of a block of the kernel: three groups of 128 compute, one fetches weights
SHARED_MEMORY = 200 * 1024  # bytes of a block for weights, of the 227 KiB that there are
LARGEST = 13  # of inputs, width and outputs below: a few registers of a thread are spilled then
FOR_HOPPER = {"cuda_arch_suffix": "a", "cuda_output": "cubin"}  # as warp.config calls it
ONE = 1.2784645  # swish of it is 1
BODY = Path(__file__).with_suffix(".cu").read_text()
Drawn = tuple[jax.Array, jax.Array]


class Sizes(NamedTuple):
    """What the kernel is compiled for."""

    inputs: int  # tiles of 16 columns, the one that is 1 included
    width: int  # likewise of the widest hidden layer
    outputs: int  # tiles of 8 columns of the means, and as many of the variances
    inner: int  # layers that lead from hidden to hidden


def sizes_of(inputs: int, hidden: Sequence[int], outputs: int) -> Sizes:
    """Of networks with so many inputs, units in each hidden layer, and means."""
    return Sizes(inputs // 16 + 1, max(hidden) // 16 + 1, -(-outputs // 8), len(hidden) - 1)


def serves(inputs: int, hidden: Sequence[int], outputs: int) -> bool:
    """Whether the kernel runs here, and is for such networks: at most 207 inputs, 207 units in a layer
    and 104 means."""
    if jax.default_backend() != "gpu" or not hidden:
        return False
    hopper = all(getattr(x, "compute_capability", "") == "9.0" for x in jax.local_devices())
    fits = max(sizes_of(inputs, hidden, outputs)[:3]) <= LARGEST
    return hopper and fits and not warp_problem()


def widths(weights: Sequence[jax.Array]) -> tuple[int, tuple[int, ...], int]:
    """Inputs, units of the hidden layers, and means, of layers [M, I, O]."""
    hidden = tuple(w.shape[2] for w in weights[:-1])
    return weights[0].shape[1], hidden, weights[-1].shape[2] // 2


# ---- what the kernel reads -----------------------------------------------------------------------


def with_biases(weights: Sequence[jax.Array], biases: Sequence[jax.Array]) -> list[jax.Array]:
    """Layers as matrices [M, I', O'] of whole tiles, in which a column that is 1 carries the biases."""
    sizes, padded = sizes_of(*widths(weights)), []
    for index, (w, b) in enumerate(zip(weights, biases, strict=True)):
        models, deep, wide = w.shape
        last = index == len(weights) - 1
        rows = 16 * (sizes.width if index else sizes.inputs)
        columns = 16 * (sizes.outputs if last else sizes.width)
        w = jnp.concatenate([w, b[:, None]], 1)
        if last:  # means in one half, variances in the other
            w = jnp.pad(
                w.reshape(models, deep + 1, 2, -1),
                ((0, 0), (0, 0), (0, 0), (0, columns // 2 - wide // 2)),
            )
            w = w.reshape(models, deep + 1, columns)
        else:
            w = jnp.pad(w, ((0, 0), (0, 0), (0, columns - wide))).at[:, deep, wide].set(ONE)
        padded.append(jnp.pad(w, ((0, 0), (0, rows - deep - 1), (0, 0))))
    return padded


def tiles(padded: Sequence[jax.Array]) -> jax.Array:
    """Layers of whole tiles, in the order in which the kernel reads them: bfloat16 [M, T].

    First one half of a layer's outputs, then the other; in each, sixteen inputs at a time; of these,
    blocks of 8 outputs and 8 inputs, those of the same outputs side by side.
    """

    def ordered(w: jax.Array) -> jax.Array:
        models, rows, columns = w.shape
        w = w.reshape(models, rows // 16, 2, 8, 2, columns // 16, 8)  # m k pair i side n o
        return w.transpose(0, 4, 1, 5, 2, 6, 3).reshape(models, -1)  # m side k n pair o i

    return jnp.concatenate([ordered(w) for w in padded], 1).astype(jnp.bfloat16)


def with_one(x: jax.Array) -> jax.Array:
    """`x` [.., I], a column that is 1, and zeros up to a sixteen: bfloat16."""
    inputs = x.shape[-1]
    after = jnp.zeros(16 - inputs % 16).at[0].set(1.0)
    after = jnp.broadcast_to(after, (*x.shape[:-1], len(after)))
    return jnp.concatenate([x, after], -1).astype(jnp.bfloat16)


# ---- the kernel ----------------------------------------------------------------------------------


def product(name: str, columns: int) -> str:
    """C++ of a function that adds to `sum` 64 rows of 16 inputs times `columns` outputs."""
    count = columns // 2
    sums = ", ".join(f"%{i}" for i in range(count))
    inputs = ", ".join(f"%{count + i}" for i in range(4))
    operands = ", ".join(f'"+f"(sum[{i}])' for i in range(count))
    multiply = f"wgmma.mma_async.sync.aligned.m64n{columns}k16.f32.bf16.bf16"
    return f"""
auto {name} = [](float* sum, unsigned a, unsigned b, unsigned c, unsigned d, size_t where, int more) {{
    asm volatile("{{\\n.reg .pred more;\\nsetp.ne.b32 more, %{count + 5}, 0;\\n"
        "{multiply} {{{sums}}}, {{{inputs}}}, %{count + 4}, more, 1, 1, 0;\\n}}"
        : {operands} : "r"(a), "r"(b), "r"(c), "r"(d), "l"(where), "r"(more));
}};
"""


@functools.cache
def kernel_of(sizes: Sizes) -> Any:
    import warp as wp

    constants = ", ".join(f"{name.upper()} = {size}" for name, size in sizes._asdict().items())
    slot = 256 * max(sizes.width, sizes.outputs)  # bytes of 16 inputs of half a layer
    slots = SHARED_MEMORY // slot
    words = wp.constant(slots * slot // 4)
    constants += f", SLOT = {slot}, SLOTS = {slots}"
    products = product("hidden_product", 8 * sizes.width) + product("output_product", 8 * sizes.outputs)

    @wp.func_native(f"constexpr int {constants};\n#if defined(__CUDA_ARCH__)\n{products}#endif\n{BODY}")
    def draw(
        seed: wp.array2d[wp.uint32],
        bounds: wp.array4d[float],
        weights: wp.array3d[wp.bfloat16],
        x: wp.array4d[wp.bfloat16],
        out: wp.array4d[float],
        spread: wp.array3d[float],
        room: wp.tile[wp.uint32, words],
        block: int,
        thread: int,
    ): ...

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=(THREADS, 1))
    def kernel(
        seed: wp.array2d[wp.uint32],
        bounds: wp.array4d[float],
        weights: wp.array3d[wp.bfloat16],
        x: wp.array4d[wp.bfloat16],
        out: wp.array4d[float],
        spread: wp.array3d[float],
    ):
        block, thread = wp.tid()
        room = wp.tile_empty(shape=words, dtype=wp.uint32, storage="shared")
        draw(seed, bounds, weights, x, out, spread, room, block, thread)

    return kernel


@contextlib.contextmanager
def changed(place: Any, values: Mapping[str, Any]) -> Iterator[None]:
    """Attributes of `place` with these values, within a `with`."""
    before = {name: getattr(place, name) for name in values}
    try:
        for name, value in values.items():
            setattr(place, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(place, name, value)


@functools.cache
def launcher(sizes: Sizes) -> Callable[..., Sequence[jax.Array]]:
    import warp as wp

    def launch(
        seed: wp.array2d[wp.uint32],
        bounds: wp.array4d[float],
        weights: wp.array3d[wp.bfloat16],
        x: wp.array4d[wp.bfloat16],
        out: wp.array4d[float],
        spread: wp.array3d[float],
    ):
        kernel, device = kernel_of(sizes), wp.get_device()
        if not device.is_cuda:
            raise RuntimeError("the kernel that draws from models runs on a GPU alone")
        with changed(wp.config, FOR_HOPPER):
            wp.load_module(kernel.module, device, block_dim=THREADS)
        wp.launch(
            kernel,
            dim=(device.sm_count, THREADS),
            inputs=[seed, bounds, weights, x],
            outputs=[out, spread],
            block_dim=THREADS,
        )

    return wp.jax_callable(launch, num_outputs=2, graph_mode=wp.JaxCallableGraphMode.NONE)


def batched(run: Callable[..., Drawn]) -> Callable[..., Drawn]:
    """`run` with a rule for `vmap`, which makes more copies of the inputs, and more groups of networks
    where those differ.

    Args:
        run: (seed uint32 [C, 2], bounds [G, M, 2, K], weights [G, M, T], x [C, M, B, I]) -> out
            [C, M, B, K] and spread [C, M, B]. The first C / G copies are those of the first group.
    """

    @jax.custom_batching.custom_vmap
    def draw(seed: jax.Array, bounds: jax.Array, weights: jax.Array, x: jax.Array) -> Drawn:
        return run(seed, bounds, weights, x)

    @draw.def_vmap
    def _(size: int, in_batched: Any, *args: jax.Array) -> tuple[Drawn, tuple[bool, bool]]:
        differ = in_batched[1] or in_batched[2]  # the networks
        groups = 1 if differ else len(args[2])

        def merged(x: jax.Array) -> jax.Array:  # [size, groups, copies] -> [groups, size, copies]
            x = x.reshape(size, groups, -1, *x.shape[2:]).swapaxes(0, 1)
            return x.reshape(-1, *x.shape[3:])

        def apart(x: jax.Array) -> jax.Array:
            x = x.reshape(groups, size, -1, *x.shape[1:]).swapaxes(0, 1)
            return x.reshape(size, -1, *x.shape[3:])

        seed, bounds, weights, x = (
            x if batched else jnp.broadcast_to(x, (size, *x.shape)) if differ or i in (0, 3) else x
            for i, (x, batched) in enumerate(zip(args, in_batched, strict=True))
        )
        if differ:
            bounds, weights = merged(bounds), merged(weights)
        out, spread = draw(merged(seed), bounds, weights, merged(x))
        return (apart(out), apart(spread)), (True, True)

    return draw


@functools.cache
def on_gpu(sizes: Sizes) -> Callable[..., Drawn]:
    def run(seed: jax.Array, bounds: jax.Array, weights: jax.Array, x: jax.Array) -> Drawn:
        shape = x.shape[:3]
        shapes = {"out": (*shape, bounds.shape[-1]), "spread": shape}
        out, spread = launcher(sizes)(seed, bounds, weights, x, output_dims=shapes)
        return out, spread

    return batched(run)


def draw(
    weights: Sequence[jax.Array],
    biases: Sequence[jax.Array],
    low: jax.Array,
    high: jax.Array,
    x: jax.Array,
    key: jax.Array,
) -> Drawn:
    """One draw from each network at each of its own inputs: out [M, ..., K] and spread [M, ...].

    Args:
        weights, biases: of each layer, float [M, I, O] and [M, O].
        low, high: bounds of the log variances, float [M, K].
        x: inputs, standardised, float [M, ..., I].
    """
    sizes, outputs = sizes_of(*widths(weights)), low.shape[1]
    entries = with_one(x).reshape(1, len(x), -1, 16 * sizes.inputs)
    networks = tiles(with_biases(weights, biases))
    seed = jax.random.bits(key, (1, 2), jnp.uint32)
    even = ((0, 0), (0, outputs % 2))  # the column that makes it even has no variance
    ends = (jnp.pad(jnp.exp(low), even), jnp.pad(jnp.exp(-high), even, constant_values=jnp.inf))
    out, spread = on_gpu(sizes)(seed, jnp.stack(ends, 1)[None], networks[None], entries)
    return out.reshape(*x.shape[:-1], -1)[..., :outputs], spread.reshape(x.shape[:-1])

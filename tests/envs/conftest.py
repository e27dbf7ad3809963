"""Warp, too, compiles little optimised, where it compiles for the CPU."""

import contextlib

import jax

with contextlib.suppress(ImportError):
    import warp as wp

    if jax.default_backend() == "cpu":
        wp.config.optimization_level = 0

"""How the tests compile: little optimised, because a program runs a few times at most."""

import os
from typing import Any

import jax

from jaxsafe.run.devices import use_compilation_cache

FAST = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
EXACT = FAST.copy()  # as users' programs add up
if jax.__version_info__ < (0, 11):
    # The emitters of fusions take more time than all else at this level. With XLA's older ones two ways
    # to the implicit gradients of Beta draws differ: a test of these has EXACT.
    FAST["xla_cpu_use_fusion_emitters"] = False
    EXACT["xla_cpu_use_fusion_emitters"] = True
# For what runs longer than it compiles. Compiling takes a third longer, and running a quarter as long.
BUSY = FAST | {"xla_backend_optimization_level": 1}


def compile_quickly() -> None:
    """As with `FAST`, what has no options of its own, and what the processes compile that tests start.

    XLA reads its flags once, before it first compiles. JAX's cache has another program for other flags,
    so a worker of pytest-xdist has the same as a lone process.
    """
    flags, given = as_flags(FAST), os.environ.get("XLA_FLAGS", "")
    if not given.startswith(flags):
        os.environ["XLA_FLAGS"] = " ".join([flags, given])


def as_flags(options: dict[str, Any]) -> str:
    """The options as flags for XLA, of which the last of a name counts."""
    return " ".join(f"--{name}={str(value).lower()}" for name, value in options.items())


def keep_programs() -> None:
    """What a first run of the tests compiles, the next one reads, and so do the processes that tests
    start: small programs, too. There are thousands."""
    use_compilation_cache()
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def forget_lines() -> None:
    """Programs are lowered without the lines of code that made them, which no test reads: here, and in
    the processes that tests start."""
    os.environ["JAX_TRACEBACK_IN_LOCATIONS_LIMIT"] = "0"
    jax.config.update("jax_traceback_in_locations_limit", 0)

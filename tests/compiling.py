"""How the tests compile: little optimised, because a program runs a few times at most."""

import jax

from jaxsafe.run.devices import use_compilation_cache

FAST = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


def keep_programs() -> None:
    """What a first run of the tests compiles, the next one reads: small programs, too. There are
    thousands."""
    use_compilation_cache()
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)

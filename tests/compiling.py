"""How the tests compile: little optimised, because a program runs a few times at most."""

FAST = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}

"""Safe reinforcement learning in which environments and learners compile into one JAX program."""

import importlib
import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxsafe.api import Run, SweepResult, collect, evaluate, make, render, sweep, train
    from jaxsafe.config import ConfigError

__version__ = "0.1.0"

# A host callback (the CPU engine is one) holds a thread of XLA's pool while it waits for its input,
# which another thread of that pool brings. With two cores the pool has two threads, and two
# callbacks at once wait for ever. JAX reads this when it first uses the CPU.
os.environ.setdefault("PJRT_NPROC", str(max(8, os.cpu_count() or 1)))

__all__ = [
    "ConfigError",
    "Run",
    "SweepResult",
    "collect",
    "evaluate",
    "make",
    "render",
    "sweep",
    "train",
]


def __getattr__(name: str) -> Any:
    """The public names, imported when they are first used."""
    if name not in __all__:
        raise AttributeError(f"module 'jaxsafe' has no attribute {name!r}")
    return getattr(importlib.import_module("jaxsafe.api"), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]

"""Safe reinforcement learning in which environments and learners compile into one JAX program."""

import importlib
import os
import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxsafe.api import Run, SweepResult, collect, evaluate, make, render, sweep, train
    from jaxsafe.config import ConfigError

__version__ = "0.1.0"


def _threads() -> int:
    """How many threads XLA's pool needs on the CPU.

    A host callback (the CPU engine is one) holds a thread while it waits for its input, which another
    thread of the pool brings. With two threads, two callbacks at once wait for ever. So there are two
    for each device that the CPU is split into, as two programs may run on it, and one that brings
    their inputs. More than that only costs time: with eight on two cores, products of matrices are a
    quarter slower.
    """
    flag = re.search(r"host_platform_device_count=(\d+)", os.environ.get("XLA_FLAGS", ""))
    devices = flag[1] if flag else os.environ.get("JAX_NUM_CPU_DEVICES", "")
    return max(1 + 2 * (int(devices) if devices.isdigit() else 1), os.cpu_count() or 1)


os.environ.setdefault("PJRT_NPROC", str(_threads()))  # read when JAX first uses the CPU

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

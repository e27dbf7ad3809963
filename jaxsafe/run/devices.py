"""The devices of this machine, what they are called, and the cache of programs compiled for them."""

import contextlib
import os
from collections.abc import Callable
from pathlib import Path

import jax

from jaxsafe.config import ConfigError
from jaxsafe.types import PyTree


def use_compilation_cache() -> None:
    """Keep XLA's programs in the user's cache folder, unless the user has chosen one."""
    if jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        with contextlib.suppress(OSError, RuntimeError):  # no home, or a read-only one, costs only time
            home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
            folder = Path(home) / "jaxsafe" / "xla"
            folder.mkdir(parents=True, exist_ok=True)
            jax.config.update("jax_compilation_cache_dir", str(folder))


def check_devices(devices: int) -> None:
    if jax.process_count() > 1 and devices != jax.device_count():
        raise ConfigError(
            f"devices={devices}: expected {jax.device_count()}, which the "
            f"{jax.process_count()} processes have together ({jax.default_backend()})"
        )
    if devices > jax.device_count():
        raise ConfigError(
            f"devices={devices}: JAX sees {jax.device_count()} ({jax.default_backend()})"
            + ("; set JAX_NUM_CPU_DEVICES to split the CPU" if jax.default_backend() == "cpu" else "")
        )


def device_name() -> str:
    device = jax.local_devices()[0]
    return f"cpu ({os.cpu_count()} cores)" if device.platform == "cpu" else str(device.device_kind)


def jit_once(fn: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """`jax.jit` of what runs only a few times. On a CPU it is less optimised, which saves seconds."""
    on_cpu = {"xla_backend_optimization_level": 1, "xla_llvm_disable_expensive_passes": True}
    return jax.jit(fn, compiler_options=on_cpu if jax.default_backend() == "cpu" else None)

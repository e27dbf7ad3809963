"""An engine by its name, or by the device."""

import importlib.util

import jax

from jaxsafe.config import ConfigError, nearest
from jaxsafe.envs.engines import c
from jaxsafe.envs.engines.simulation import Engine, Simulation

ENGINES = ("c", "warp", "jax")


def default_engine() -> str:
    """The engine of JAX's default device."""
    platform = jax.default_backend()
    if platform == "cpu":
        return "c"
    return "warp" if platform in ("gpu", "cuda") and warp_available() else "jax"


def warp_available() -> bool:
    return importlib.util.find_spec("warp") is not None


def make_engine(name: str, simulation: Simulation) -> Engine:
    """The engine `name` ('c', 'warp', 'jax' or 'auto') for a simulation.

    Raises:
        ConfigError: an unknown engine, or a model that this one cannot run.
    """
    name = default_engine() if name == "auto" else name
    if name == "c":
        return c.make(simulation)
    if name == "warp":
        if not warp_available():
            raise ConfigError(
                "env.engine='warp': warp-lang is not installed; pip install 'jaxsafe[gpu]'"
            )
        from jaxsafe.envs.engines.warp import engine  # late: it needs Warp

        return engine.make(simulation)
    if name == "jax":
        from jaxsafe.envs.engines.jax import engine  # late: MJX is slow to import

        return engine.make(simulation)
    raise ConfigError(f"env.engine={name!r}{nearest(name, ('auto', *ENGINES))}")

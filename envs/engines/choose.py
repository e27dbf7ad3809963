"""An engine by its name, or by the device."""

import jax

from jaxsafe.config import ConfigError, nearest
from jaxsafe.envs.engines import c
from jaxsafe.envs.engines.simulation import Engine, Simulation
from jaxsafe.nvidia import warp_problem

ENGINES = ("c", "warp", "jax")


def default_engine() -> str:
    """The engine of JAX's default device."""
    platform = jax.default_backend()
    if platform == "cpu":
        return "c"
    return "warp" if platform in ("gpu", "cuda") and not warp_problem() else "jax"


def make_engine(name: str, simulation: Simulation) -> Engine:
    """The engine `name` ('c', 'warp', 'jax' or 'auto') for a simulation.

    Raises:
        ConfigError: an unknown engine, or a model that this one cannot run.
    """
    name = default_engine() if name == "auto" else name
    if name == "c":
        return c.make(simulation)
    if name == "warp":
        if problem := warp_problem():
            raise ConfigError(f"env.engine='warp': {problem}")
        from jaxsafe.envs.engines.warp import engine  # late: it needs Warp

        return engine.make(simulation)
    if name == "jax":
        from jaxsafe.envs.engines.jax import engine  # late: MJX is slow to import

        return engine.make(simulation)
    raise ConfigError(f"env.engine={name!r}{nearest(name, ('auto', *ENGINES))}")

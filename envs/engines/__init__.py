"""Physics engines: a MuJoCo model in, batched physics steps out.

    engine = make_engine("auto", Simulation(mujoco.MjSpec.from_string(xml), substeps=4))
    physics, readings = engine.run(engine.start(), ctrl)

Engine `c` is MuJoCo itself, a thread pool behind a callback: it is exact, and the default on a CPU.
Engine `warp` is MuJoCo Warp with kernels of our own, the default on an NVIDIA GPU. Engine `jax` is MJX
in plain JAX, for every other device. The state between two calls is small; each engine keeps or builds
its own working data.
"""

from jaxsafe.envs.engines.choose import ENGINES, default_engine, make_engine
from jaxsafe.envs.engines.simulation import (
    FIELDS,
    Engine,
    Physics,
    PhysicsCall,
    Readings,
    Room,
    Simulation,
    is_bad,
    mocap_at,
)

__all__ = [
    "ENGINES",
    "FIELDS",
    "Engine",
    "Physics",
    "PhysicsCall",
    "Readings",
    "Room",
    "Simulation",
    "default_engine",
    "is_bad",
    "make_engine",
    "mocap_at",
]

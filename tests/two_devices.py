"""Claims about two devices, in a process that has two.

def claim(*names):
    ...
    print(name, "ok")

assert on_two_devices(claim, "ambs") == ["ambs ok"]
"""

import inspect
import os
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from compiling import FAST, keep_programs
from jax.sharding import AxisType, PartitionSpec
from learners import at
from toys import START, Corridor

from jaxsafe.algos import ALGOS

HERE = Path(__file__).parent


def on_two_devices(claim: Callable[..., None], *names: str) -> list[str]:
    """Run `claim(*names)`, a function at the top of a test module, in a process with two devices.

    Returns the lines that it prints.
    """
    file = Path(inspect.getfile(claim))
    path = os.pathsep.join([str(HERE), str(HERE.parent), os.environ.get("PYTHONPATH", "")])
    env = os.environ | {"JAX_NUM_CPU_DEVICES": "2", "JAX_PLATFORMS": "cpu", "PYTHONPATH": path}
    env.pop("PJRT_NPROC", None)  # of this process, which has one device
    command = [sys.executable, __file__, str(file.parent), file.stem, claim.__name__, *names]
    out = subprocess.run(command, env=env, capture_output=True, text=True)
    assert out.returncode == 0, out.stderr[-3000:]
    return out.stdout.splitlines()


def split(fn: Callable, devices: int = 2, options: dict[str, Any] = FAST) -> Callable:
    """`fn`, each device with its own entry [devices, ...] of every array; also of what it returns."""

    def one(*args: Any) -> Any:
        return jax.tree.map(lambda y: y[None], fn(*jax.tree.map(lambda y: y[0], args)))

    parts: dict[str, Any] = {"devices": jax.devices()[:devices], "axis_types": (AxisType.Auto,)}
    mesh = jax.make_mesh((devices,), ("devices",), **parts)
    spec = PartitionSpec("devices")
    sharded = jax.shard_map(one, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    return jax.jit(sharded, compiler_options=options)


def agree(tree: Any) -> None:
    """Assert that both devices have the same arrays."""
    for x in jax.tree.leaves(tree):
        np.testing.assert_array_equal(x[0], x[1])


def same_parameters_own_replays(name: str, cfg: Any) -> None:
    """Assert that two devices keep the same parameters, and each a replay of its own."""
    algo = ALGOS[name].make(Corridor(), "devices")
    ts = split(lambda key: algo.init(key, cfg, START))(jnp.stack([jax.random.key(0)] * 2))
    update = split(algo.update)
    for i in range(4):
        ts, metrics = update(ts, jax.tree.map(lambda x: jnp.stack([x, x]), at(i)))
        agree((ts.params, ts.opt_state, ts.dual, ts.lost_time, metrics))
    rings = np.asarray(ts.replay.obs)
    assert rings.shape[1] == cfg.num_envs and (rings[0] != rings[1]).any()
    print(name, "ok")


if __name__ == "__main__":
    folder, module, function, *words = sys.argv[1:]
    sys.path.append(folder)
    keep_programs()
    getattr(import_module(module), function)(*words)

"""Claims about two devices, in a process that has two.

def claim(*names): ...

assert on_two_devices(claim, "ambs") == ["ambs ok"]  # what it prints
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
from toys import START, Corridor

from jaxsafe.algos import ALGOS

HERE = Path(__file__).parent


def on_two_devices(claim: Callable[..., None], *names: str) -> list[str]:
    """The lines that `claim(*names)` prints, a function of a module of tests."""
    file = Path(inspect.getfile(claim))
    command = [sys.executable, __file__, str(file.parent), file.stem, claim.__name__, *names]
    env = os.environ | {"JAX_NUM_CPU_DEVICES": "2", "JAX_PLATFORMS": "cpu"}
    out = subprocess.run(command, env=env, capture_output=True, text=True)
    assert out.returncode == 0, out.stderr[-3000:]
    return out.stdout.splitlines()


def split(fn: Callable, devices: int = 2) -> Callable:
    """`fn`, each device with its own entry [devices, ...] of every array; also of what it returns."""

    def one(*args: Any) -> Any:
        return jax.tree.map(lambda y: y[None], fn(*jax.tree.map(lambda y: y[0], args)))

    parts: dict[str, Any] = {"devices": jax.devices()[:devices], "axis_types": (AxisType.Auto,)}
    mesh = jax.make_mesh((devices,), ("devices",), **parts)
    spec = PartitionSpec("devices")
    sharded = jax.shard_map(one, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    return jax.jit(sharded, compiler_options=FAST)


def agree(tree: Any) -> None:
    """Hold that both devices have the same."""
    for x in jax.tree.leaves(tree):
        np.testing.assert_array_equal(x[0], x[1])


def replays_apart(name: str, cfg: Any, at: Callable[[int], Any]) -> None:
    """Hold of an algorithm with a replay that devices keep the same parameters, each with a ring of its
    own. `at` gives what an update is told of its iteration."""
    algo = ALGOS[name].make(Corridor(), "devices")
    ts = split(lambda key: algo.init(key, cfg, START))(jnp.stack([jax.random.key(0)] * 2))
    update = split(algo.update)
    for i in range(4):
        now = jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * 2), at(i))
        ts, metrics = update(ts, now)
        agree((ts.params, ts.opt_state, ts.dual, ts.lost_time, metrics))
    rings = np.asarray(ts.replay.obs)
    assert rings.shape[1] == cfg.num_envs and (rings[0] != rings[1]).any()
    print(name, "ok")


if __name__ == "__main__":
    folder, module, name, *words = sys.argv[1:]
    sys.path += [str(HERE), folder]
    keep_programs()
    getattr(import_module(module), name)(*words)

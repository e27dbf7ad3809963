"""Time every kernel of engine `warp`: python scripts/profile_warp.py point_goal2 --num-envs 16384

Needs an NVIDIA GPU. The worlds are those of 60 steps of random actions. Prints the constraint rows and
solver iterations, the slowest kernels of a physics step, launched one by one, and the speed of all
substeps and a forward pass in one CUDA graph, as it is and with less work or less room.
"""
# MuJoCo's bindings come without types:
# pyright: reportAttributeAccessIssue=false

import argparse
import collections
import dataclasses
import statistics
import sys
import time
from typing import Any

from jaxsafe.commands.jaxsafe import leaving_at_ctrl_c

with leaving_at_ctrl_c():
    import jax
    import mujoco
    import numpy as np

    from jaxsafe import envs
    from jaxsafe.commands.guard import guarded
    from jaxsafe.config import ConfigError
    from jaxsafe.envs.engines import Simulation
    from jaxsafe.envs.safety_gym import scene as scenes
    from jaxsafe.envs.safety_gym import sleeping
    from jaxsafe.envs.velocity.task import Velocity
    from jaxsafe.run.flags import Parser

VARIANTS = {  # name -> options of the model, factors on the room for contacts and for rows
    "as it is": ({}, 1.0, 1.0),
    "10 iterations": ({"iterations": 10}, 1.0, 1.0),
    "5 iterations": ({"iterations": 5}, 1.0, 1.0),
    "3 iterations": ({"iterations": 3}, 1.0, 1.0),
    "10 line searches": ({"ls_iterations": 10}, 1.0, 1.0),
    "room for rows x 0.6": ({}, 1.0, 0.6),
    "room for contacts x 0.6": ({}, 0.6, 1.0),
}
NAMES = ("qpos", "qvel", "qacc_warmstart", "mocap_pos", "mocap_quat")  # of MuJoCo's data


def stepped(env: envs.SafetyGym | Velocity, worlds: int):
    """The states of `worlds` after 60 random steps."""

    def step(state, key):
        action = jax.random.uniform(key, (worlds, env.action_size), minval=-1)
        return jax.vmap(env.step)(state, action), None

    begin = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), worlds))
    keys = jax.random.split(jax.random.key(1), 60)
    return jax.jit(lambda state: jax.lax.scan(step, state, keys)[0])(begin)


def simulated(env: envs.SafetyGym | Velocity, state) -> tuple[Simulation, dict[str, np.ndarray]]:
    """What engine warp simulates of `env`, and the worlds of `state` in it, by `NAMES`."""
    if isinstance(env, Velocity):
        physics = state.physics.physics
        fields = physics.qpos, physics.qvel, physics.warmstart, physics.mocap_pos, physics.mocap_quat
        return env.simulation, dict(zip(NAMES, jax.device_get(fields), strict=True))
    small = scenes.build(sleeping.small_config(env.config, sleeping.awake(env.config, "warp")))

    def awake(p):
        chosen = {k: sleeping.awake_objects(p, env.scene, small, k) for k in sleeping.SLEEPERS}
        at = sleeping.places(env.scene, chosen)
        velocity, warmstart = p.qvel[at.qvel], p.warmstart[at.qvel]
        return p.qpos[at.qpos], velocity, warmstart, p.mocap_pos[at.mocap], p.mocap_quat[at.mocap]

    fields = jax.device_get(jax.jit(jax.vmap(awake))(state.physics.bodies))
    return small.simulation(env.config), dict(zip(NAMES, fields, strict=True))


def command() -> int:
    parser = Parser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("env", metavar="ENV")
    parser.add_argument("--num-envs", type=int, default=16384)
    parser.add_argument("--top", type=int, default=22, help="kernels to list")
    args = parser.parse_args()
    env = envs.make(args.env, engine="warp")
    if jax.default_backend() == "cpu":
        raise ConfigError("profile_warp needs an NVIDIA GPU")
    import warp as wp
    from mujoco.mjx.third_party import mujoco_warp

    from jaxsafe.envs.engines.warp import dynamics

    worlds, substeps = args.num_envs, env.substeps
    simulation, start = simulated(env, stepped(env, worlds))
    start = {name: x for name, x in start.items() if x.size}
    assert simulation.room is not None
    contacts, rows = simulation.room
    model = simulation.compile(count=True)
    sensors_off = mujoco.mjtDisableBit.mjDSBL_SENSOR.value

    def build(options: dict, less_contacts: float, less_rows: float):
        m = mujoco_warp.put_model(model)
        m.opt.warn_overflow = 0
        for name, value in options.items():
            setattr(m.opt, name, value)
        flags = m.opt.disableflags | sensors_off
        blind = dataclasses.replace(m, opt=dataclasses.replace(m.opt, disableflags=flags))
        room = {
            "naconmax": int(contacts * less_contacts) * worlds + 128,
            "njmax": int(rows * less_rows),
        }
        data = mujoco_warp.make_data(model, nworld=worlds, **room)
        dynamics.adopt(model, m, data, simulation.pillars, simulation.fields)
        return m, blind, data

    def load(data) -> None:
        for name, x in start.items():
            wp.copy(getattr(data, name), wp.array(x, dtype=getattr(data, name).dtype))

    def go(m, blind, data) -> None:
        at_once = dynamics.at_once(data)
        for _ in range(0 if at_once else substeps):
            dynamics.step(blind, data)
        dynamics.forward(m, data, substeps if at_once else 0)

    with wp.ScopedDevice("cuda:0"):
        for name, variant in VARIANTS.items():
            m, blind, data = build(*variant)
            load(data)
            go(m, blind, data)  # compiles
            with wp.ScopedCapture() as capture:
                go(m, blind, data)
            graph: Any = capture.graph
            seconds = []
            for _ in range(7):
                load(data)
                wp.synchronize()
                begin = time.perf_counter()
                wp.capture_launch(graph)
                wp.synchronize()
                seconds.append(time.perf_counter() - begin)
            median = statistics.median(seconds[2:])
            print(f"{name:26}{1e3 * median:8.2f} ms {worlds / median:14,.0f} steps/s", flush=True)

        _, blind, data = build({}, 1.0, 1.0)
        load(data)
        for _ in range(3):
            dynamics.step(blind, data)
        for name, x in (("rows", data.nefc), ("solver iterations", data.solver_niter)):
            x = x.numpy()
            print(f"{name}: mean {x.mean():.1f}, 99.9% {np.quantile(x, 0.999):.0f}, most {x.max()}")
        steps, spent = 3, collections.defaultdict(list)
        wp.timing_begin(cuda_filter=wp.TIMING_ALL)
        for _ in range(steps):
            dynamics.step(blind, data)
        for kernel in wp.timing_end():
            spent[kernel.name].append(kernel.elapsed)
        total = sum(map(sum, spent.values())) / steps
        print(f"{sum(map(len, spent.values())) / steps:.0f} kernels a physics step, {total:.2f} ms")
        for name, times in sorted(spent.items(), key=lambda item: -sum(item[1]))[: args.top]:
            print(f"  {sum(times) / steps:8.3f} ms {len(times) / steps:6.1f}  {name[:80]}")
    return 0


def main() -> int:
    return guarded(command)


if __name__ == "__main__":
    sys.exit(main())

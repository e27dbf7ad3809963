"""Measure environments and fused training: jaxsafe benchmark point_goal1 --num-envs 1024

Each row is one program. Compiling is timed apart. The rate is the median of --repeats runs, after
--warmup steps of each environment: fresh layouts, where nothing touches yet, are faster. With --algo a
run is an update of the algorithm, else steps with random actions, resets included. An algorithm with a
replay is measured once it learns. Settings are options of train, those of the tasks and, with --algo,
its own, as in `env.wrap.action_repeat=2 --algo sac_lag preset=parallel algo.hidden_dtype=bfloat16`. A
physics step is one substep. The forward pass at the end of a step is not counted. A task of your own is
'module:name', as in train. Only Safety Gym's and the velocity tasks tell their physics steps. A --peer
has the sizes of --num-envs and --algo.
"""

import argparse
import dataclasses
import itertools
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe import algos
from jaxsafe.commands.guard import guarded
from jaxsafe.commands.peers import PEERS
from jaxsafe.config import Amount, ConfigError, Devices, Iterations, Period, nearest
from jaxsafe.envs import SafetyGym, Velocity
from jaxsafe.envs.wrap import innermost, raw_steps
from jaxsafe.learn.observations import EncoderConfig
from jaxsafe.learn.offline import OfflineConfig
from jaxsafe.learn.rollout import collect, init_rollout, memoryless
from jaxsafe.learn.timetable import ReplayConfig, RoundConfig, timetable_of
from jaxsafe.run import files, run_folder
from jaxsafe.run.arguments import compose
from jaxsafe.run.devices import check_devices, device_name, use_compilation_cache
from jaxsafe.run.flags import Parser, number
from jaxsafe.run.programs import build
from jaxsafe.run.session import engine_of
from jaxsafe.run.settings import Settings, TrainConfig, find_algo, make_env
from jaxsafe.types import Shared


class Timing(NamedTuple):
    """What `timed` measured, in seconds, and how to go on: `program(state, i)`."""

    compile_s: float
    runs: list[float]
    program: Any  # jax.stages.Compiled
    state: Any
    i: np.int32


def timed(fn, state, before: int, repeats: int) -> Timing:
    """Compile `state = fn(state, i)` and run it, `before` times unmeasured and then `repeats` times."""
    start = time.perf_counter()
    compiled = jax.jit(fn, donate_argnums=0).lower(state, np.int32(0)).compile()
    compile_time, runs = time.perf_counter() - start, []
    for i in range(before + repeats):
        start = time.perf_counter()
        state = jax.block_until_ready(compiled(state, np.int32(i)))
        runs.append(time.perf_counter() - start)
    return Timing(compile_time, runs[before:], compiled, state, np.int32(before + repeats))


def stepping(env, num_envs: int, seeds: int, horizon: int):
    """(state, fn): `horizon` steps of random actions, with resets."""

    def policy(obs, key):
        action = jax.random.uniform(key, (num_envs, env.action_size), minval=-1.0, maxval=1.0)
        return action, jnp.zeros(num_envs)

    def run(state):
        rollout, key = state
        key, next_key = jax.random.split(key)
        rollout, trajectory = collect(env, memoryless(policy), rollout, key, horizon)
        seen = sum(x.sum(dtype=jnp.float32) for x in jax.tree.leaves(trajectory.obs))
        return (rollout, next_key), trajectory.reward.sum() + seen

    def init(key):
        reset_key, key = jax.random.split(key)
        return init_rollout(env, reset_key, num_envs, stagger=True), key

    return per_seed(init, seeds), lambda state, i: jax.vmap(run)(state)[0]


def training(env, algo: str, cfg, seeds: int, devices: int, data=()):
    """(state, fn): one update of `algo`, with `data` for one that learns offline."""
    length = {"total_updates": cfg.updates} if data else {}
    settings = TrainConfig(num_seeds=seeds, devices=devices, **length)
    check_devices(settings.devices)
    program = build(env, algos.ALGOS[algo].make, [cfg], settings, data)
    shared = program.shared()
    state = jax.jit(program.init)(jax.device_put(program.start, program.sharding), shared)

    def update(now, i):
        ts, data = now
        return program.update(ts, Shared(i, data=data))[0], data

    return (state, shared.data), update


def per_seed(init, seeds: int):
    return jax.jit(jax.vmap(init))(jax.random.split(jax.random.key(0), seeds))


def memory() -> int:
    """Most bytes in use so far: on the device, Warp's included, or of this process on a CPU."""
    stats = jax.local_devices()[0].memory_stats()
    if stats and "peak_bytes_in_use" in stats:
        warp = sys.modules.get("warp")  # imported by its engine
        apart = warp.get_mempool_used_mem_high("cuda:0") if warp else 0
        return stats["peak_bytes_in_use"] + apart
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def task_settings(name: str, args: argparse.Namespace) -> Settings:
    """The settings of a task, as `make_env` takes them.

    Raises:
        ConfigError: no such task, or an option that it does not have.
    """
    awake = [] if args.awake is None else [f"env.awake={args.awake}"]
    size = "[{},{}]".format(*args.vision) if args.vision else ""
    vision = ["env.observe_vision=true", f"env.vision_size={size}"] if size else []
    engine = [] if args.engine == "auto" else [f"env.engine={args.engine}"]  # others have none
    return compose([f"env={name}", *engine, *awake, *vision, *args.env_options])


def config_of(algo: str, options: list[str], **sizes: Any) -> Any:
    """The config of an algorithm.

    Args:
        options: those of train, as 'preset=parallel' and 'algo.lr=1e-3'.
        sizes: fields of the config; those that are None are left as they are.
    Raises:
        ConfigError: an option that is neither of these, or a wrong value.
    """
    for option in options:
        if not option.startswith(("preset=", "compat=", "algo.")):
            raise ConfigError(f"{option}: expected preset=, compat= or algo.OPTION=")
    given = {name: size for name, size in sizes.items() if size is not None}
    return dataclasses.replace(compose([f"algo={algo}", *options]).algo, **given)


def measure(name: str, wanted: int | None, args: argparse.Namespace) -> dict:
    """A row, of so many environments as are `wanted`, or as the algorithm has, or 256."""
    env, warmup = make_env(task_settings(name, args)), args.warmup
    if args.algo:
        if issubclass(algos.ALGOS[args.algo].config, OfflineConfig):
            raise ConfigError(
                f"--algo {args.algo} takes no environment steps; scripts/profile_learner.py measures it"
            )
        sees = args.vision and issubclass(algos.ALGOS[args.algo].config, EncoderConfig)
        encoder = {"encoder": "cnn"} if sees else {}
        cfg = config_of(args.algo, args.options, num_envs=wanted, horizon=args.horizon, **encoder)
        num_envs, horizon = cfg.num_envs, cfg.horizon
        if isinstance(cfg, ReplayConfig):  # until then it only fills its replay
            warmup = max(warmup, -(-cfg.learning_starts // num_envs) + horizon)
        state, fn = training(env, args.algo, cfg, args.seeds, args.devices)
    else:
        num_envs, horizon = wanted or 256, args.horizon or 100
        state, fn = stepping(env, num_envs, args.seeds, horizon)
    inner: Any = innermost(env)
    before = max(1, -(-warmup // horizon))
    timing = timed(fn, state, before=before, repeats=args.repeats)
    runs = timing.runs
    seconds = statistics.median(runs)
    rate = num_envs * horizon * args.seeds / seconds
    raw = rate * raw_steps(env)
    physics = isinstance(inner, SafetyGym | Velocity)  # others do not tell it
    return {
        "env": name,
        "engine": engine_of(env),
        "awake": args.awake,
        "vision": args.vision,
        "algo": args.algo,
        "options": " ".join([*args.env_options, *args.options]),
        "num_envs": num_envs,
        "num_seeds": args.seeds,
        "devices": args.devices if args.algo else 1,
        "horizon": horizon,
        "warmup": before * horizon,
        "env_steps_per_s": rate,
        "physics_steps_per_s": raw * inner.substeps if physics else None,
        "simulated_s_per_s": raw * inner.step_seconds if physics else None,
        "fastest": num_envs * horizon * args.seeds / min(runs),
        "slowest": num_envs * horizon * args.seeds / max(runs),
        "compile_s": timing.compile_s,
        "memory_bytes": memory(),
    }


def peer_sizes(wanted: int | None, args: argparse.Namespace) -> dict[str, int]:
    """The options of peers.py with which a peer has our environments, batches and gradient steps.

    Raises:
        ConfigError: peers cannot learn as --algo does.
    """
    sizes = {"num_envs": wanted, "horizon": args.horizon}
    cfg = config_of(args.algo, args.options, **sizes) if args.algo else None
    if not isinstance(cfg, RoundConfig):
        return {} if wanted is None else {"num-envs": wanted}
    timetable = timetable_of(cfg, None)
    if timetable.gradient_steps % timetable.rows:
        raise ConfigError(
            f"algo.learn_every={cfg.learn_every}: expected whole gradient steps for each step of all "
            f"environments, as peers take them; here {timetable.gradient_steps} follow {timetable.rows}"
        )
    return {
        "num-envs": cfg.num_envs,
        "batch-size": timetable.batch,
        "gradient-steps": timetable.gradient_steps // timetable.rows,
    }


def measure_peer(spec: str, sizes: dict[str, int]) -> list[dict]:
    """The rows of peers.py, by the Python that has the peer installed."""
    name, _, python = spec.partition("=")
    options = [f"--{option}={size}" for option, size in sizes.items()]
    command = [python or sys.executable, Path(__file__).with_name("peers.py"), name, *options]
    beside = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}  # this process has most of the GPU's memory
    try:
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, env=os.environ | beside)
    except OSError as error:
        raise ConfigError(f"--peer {spec}: {error.strerror}: {python}") from None
    if done.returncode:
        raise ConfigError(f"--peer {spec}: it ended with status {done.returncode}; see above")
    return [json.loads(line) for line in done.stdout.splitlines()]


def versions() -> dict[str, str]:
    packages = ("jax", "mujoco", "mujoco-mjx", "warp-lang", "jaxsafe")
    found = {"python": platform.python_version(), "device": device_name(), "cores": str(os.cpu_count())}
    return found | {name: x for name in packages if (x := run_folder.installed(name))}


def show(row: dict) -> str:
    what = row["algo"] or "steps"
    what += " {}x{}".format(*row["vision"]) if row["vision"] else ""
    physics, simulated = (
        "" if row[rate] is None else f"{row[rate]:,.0f}"
        for rate in ("physics_steps_per_s", "simulated_s_per_s")
    )
    return (
        f"{row['env']:<16} {row['engine'] or '':<5} {what:<13} {row['num_seeds']:>3} x "
        f"{row['num_envs']:<6} {row['env_steps_per_s']:>11,.0f} {physics:>12} {simulated:>10} "
        f"{row['compile_s']:>8.1f} {row['memory_bytes'] / 2**30:>7.2f}"
    )


def show_peer(row: dict) -> str:
    what = f"{row['peer']}: {row['algo'] or 'steps'}"
    return f"{row['env']:<22} {what:<14} {row['num_envs']:>6} {row['env_steps_per_s']:>11,.0f}"


def main() -> int:
    """Exit status: 2 for bad input, 1 where the memory is too small."""
    return guarded(command)


def new_parser() -> argparse.ArgumentParser:
    parser = Parser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "envs",
        nargs="*",
        metavar="ENV|key=value",
        help="tasks to measure; settings of them or of --algo",
    )
    parser.add_argument(
        "--num-envs",
        type=number(Amount),
        nargs="+",
        default=[None],
        help="environments of each seed (default 256, or with --algo those of the algorithm)",
    )
    parser.add_argument(
        "--seeds", type=number(Devices), default=1, help="seeds side by side (default 1)"
    )
    parser.add_argument(
        "--devices", type=number(Devices), default=1, help="devices over which --algo splits its seeds"
    )
    parser.add_argument("--engine", default="auto", help="auto (default), c, warp or jax")
    parser.add_argument(
        "--awake",
        type=number(Iterations),
        metavar="K",
        help="how many vases and gremlins are simulated at once",
    )
    parser.add_argument(
        "--vision",
        type=number(Iterations),
        nargs=2,
        metavar=("WIDTH", "HEIGHT"),
        help="steps with a picture of this size each, and --algo with its encoder for them",
    )
    parser.add_argument("--algo", help="measure updates of this algorithm instead of random actions")
    parser.add_argument("--horizon", type=number(Amount), help="steps of each environment in a run")
    parser.add_argument(
        "--warmup",
        type=number(Period),
        default=200,
        help="steps of each environment before the measurement (default 200)",
    )
    parser.add_argument("--repeats", type=number(Iterations), default=5, help="runs (default 5)")
    parser.add_argument(
        "--peer",
        nargs="*",
        default=[],
        metavar="NAME=PYTHON",
        help="also measure another library, as crax=PYTHON (see peers.py)",
    )
    parser.add_argument("--json", type=Path, help="append the rows to this file, a line each")
    return parser


def arguments() -> argparse.Namespace:
    """What was typed, checked before anything is compiled, with the settings among `envs` apart: those
    of the tasks in `env_options`, those of --algo in `options`."""
    args = new_parser().parse_args()
    args.env_options = [text for text in args.envs if text.startswith("env.") and "=" in text]
    args.options = [text for text in args.envs if "=" in text and text not in args.env_options]
    args.envs = [text for text in args.envs if "=" not in text]
    if args.algo:
        find_algo(args.algo)
        config_of(args.algo, args.options)
    elif args.options:
        raise ConfigError(f"{args.options[0]}: expected env.OPTION=; other settings need --algo")
    if not args.envs and not args.peer:
        raise ConfigError("nothing to measure: name a task, as in `benchmark point_goal1`, or a --peer")
    for spec in args.peer:
        if (peer := spec.partition("=")[0]) not in PEERS:
            raise ConfigError(f"--peer {spec}: unknown peer{nearest(peer, PEERS)}")
    for num_envs in args.num_envs if args.peer else ():
        peer_sizes(num_envs, args)
    for name in args.envs:
        task_settings(name, args)
    try:
        if args.json:
            args.json.open("a").close()
    except OSError as error:
        raise ConfigError(f"--json {args.json}: {error.strerror}") from error
    return args


def command() -> int:
    args = arguments()
    use_compilation_cache()
    about = versions()
    print(f"{' '.join(f'{k} {v}' for k, v in about.items())}")
    print(
        f"{'env':<16} {'engine':<5} {'what':<13} {'seeds x envs':<12} {'env steps/s':>11} "
        f"{'physics/s':>12} {'sim s/s':>10} {'compile':>8} {'GiB':>7}"
    )

    def keep(row: dict) -> None:
        if args.json:
            with files.naming(args.json), args.json.open("a") as file:
                command = " ".join(sys.argv)
                row = {"command": command, "commit": run_folder.commit(), **about} | row
                file.write(json.dumps(row) + "\n")

    for name in args.envs:
        for num_envs in args.num_envs:
            row = measure(name, num_envs, args)
            print(show(row), flush=True)
            keep(row)
    for spec, num_envs in itertools.product(args.peer, args.num_envs):
        for row in measure_peer(spec, peer_sizes(num_envs, args)):
            print(show_peer(row), flush=True)
            keep(row)
    return 0

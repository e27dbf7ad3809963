"""Time updates without physics: python scripts/profile_learner.py ppo_lag [key=value ...] --seeds 5
python scripts/profile_learner.py dreamer_lag preset=pixels --vision 64 64

The environment has the sizes of point_goal1 and costs nothing to step, so that what is left of an
update is the learner: acting, estimates, the policy's step and the critics'. With --vision it shows
noise beside its numbers. An offline algorithm has 100,000 transitions of random numbers. Options are
preset=, compat= and algo.OPTION= of train. Prints the median, the floating-point operations of matrix
products, and with --kernels what an update consists of. On a GPU that is compiled without CUDA graphs,
which hide what their kernels come from.
"""

import argparse
import collections
import math
import os
import re
import statistics
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from jaxsafe.commands.jaxsafe import leaving_at_ctrl_c

with leaving_at_ctrl_c():
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jaxsafe import algos
    from jaxsafe.commands.benchmark import Timing, config_of, timed, training
    from jaxsafe.commands.guard import guarded
    from jaxsafe.config import ConfigError, nearest
    from jaxsafe.learn.offline import DataSet, OfflineConfig, data_set
    from jaxsafe.run.flags import Parser
    from jaxsafe.types import State


@dataclass(frozen=True)
class Weightless:
    """60 numbers that rotate; observation, reward and cost are read off them.

    vision: width and height of a picture, if one is observed, too.
    """

    vision: tuple[int, int] | None = None
    obs_size: int = 60
    action_size: int = 2
    episode_length: int = 1000
    cost_names: tuple[str, ...] = ("first",)

    def reset(self, key: jax.Array) -> State:
        return self._state(jax.random.normal(key, (self.obs_size,)))

    def step(self, state: State, action: jax.Array) -> State:
        return self._state(0.99 * jnp.roll(state.physics, 1) + 0.01 * action.sum())

    def _state(self, x: jax.Array) -> State:
        return State(x, self._observed(x), x[0], jnp.abs(x[1]), jnp.abs(x[1:2]), jnp.bool_(False), {})

    def _observed(self, x: jax.Array) -> Any:
        if self.vision is None:
            return x
        width, height = self.vision
        noise = jnp.resize(100 * x, (height, width, 3)).astype(jnp.uint8)
        return {"vector": x, "vision": noise}


def transitions(env: Weightless, count: int = 100_000) -> DataSet:
    """Transitions of random numbers, in episodes of the environment's length."""
    draw = np.random.default_rng(0).standard_normal
    time_up = np.arange(1, count + 1) % env.episode_length == 0
    costs = {name: np.abs(draw(count)) for name in env.cost_names}
    obs, next_obs = (draw((count, env.obs_size)) for _ in range(2))
    action, reward, cost = draw((count, env.action_size)), draw(count), np.abs(draw(count))
    return data_set(obs, action, reward, cost, next_obs, np.zeros(count), time_up, costs)


def products_of(jaxpr: Any) -> int:
    """The floating-point operations of a program's matrix products, two for each multiplication.

    Of the branches of a `cond` the dearest counts. The body of a `while` counts once.
    """
    total = 0
    for step in jaxpr.eqns:
        if step.primitive.name == "dot_general":
            (summed, _), _ = step.params["dimension_numbers"]
            terms = math.prod(step.invars[0].aval.shape[i] for i in summed)
            total += 2 * terms * math.prod(step.outvars[0].aval.shape)
            continue
        inside = [
            products_of(getattr(x, "jaxpr", x))
            for x in jax.tree.leaves(list(step.params.values()), is_leaf=is_program)
            if is_program(x)
        ]
        if inside:
            dearest = max(inside) if step.primitive.name == "cond" else sum(inside)
            total += step.params.get("length", 1) * dearest
    return total


def is_program(x: Any) -> bool:
    return hasattr(getattr(x, "jaxpr", x), "eqns")


class Kernel(NamedTuple):
    """What XLA runs, all its runs in an update together."""

    ms: float
    count: int
    name: str  # of the kernel
    source: str  # the line of JAX that it comes from, such as jit(update)/while/body/dot_general


HOLDERS = re.compile("while|call|cond|tuple|async")  # operations that consist of others


def kernels_of(timing: Timing) -> list[Kernel]:
    """The kernels of one more update, the slowest first. On a CPU they are XLA's operations."""
    sources = dict(re.findall(r'%?([\w.-]+) = [^\n]*op_name="([^"]+)"', timing.program.as_text()))
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(timing.program(timing.state, timing.i))
        [path] = Path(folder).rglob("*.xplane.pb")
        profile = jax.profiler.ProfileData.from_file(str(path))
    durations: dict[tuple[str, str], list[float]] = collections.defaultdict(list)
    for plane in profile.planes:
        for line in plane.lines:
            on_gpu = plane.name.startswith("/device:GPU") and line.name.startswith("Stream")
            for event in line.events:
                operation = str(dict(event.stats).get("hlo_op", event.name if on_gpu else ""))
                if operation and not HOLDERS.match(operation):
                    durations[event.name, operation].append(event.duration_ns)
    found = [
        Kernel(sum(ns) / 1e6, len(ns), name, sources.get(operation, operation))
        for (name, operation), ns in durations.items()
    ]
    return sorted(found, reverse=True)


def show(kernels: list[Kernel], most: int) -> None:
    total, count = sum(k.ms for k in kernels), sum(k.count for k in kernels)
    print(f"{total:.1f} ms in {count:,} kernels; the slowest:")
    for k in kernels[:most]:
        each = 1e3 * k.ms / k.count
        print(f"{k.ms:9.2f} ms {k.count:7,} x {each:8.1f} us  {k.name[:40]:40}  {k.source}")


def command() -> int:
    parser = Parser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("algo", metavar="ALGO")
    parser.add_argument("options", nargs="*", metavar="key=value")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--num-envs", type=int, help="of each seed")
    parser.add_argument("--horizon", type=int)
    parser.add_argument("--vision", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--kernels", type=int, default=0, help="list so many of the slowest kernels")
    args = parser.parse_args()
    if args.kernels:  # read when JAX first looks for a device
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_gpu_enable_command_buffer="
    if args.algo not in algos.ALGOS:
        raise ConfigError(f"unknown algo {args.algo!r}{nearest(args.algo, algos.ALGOS)}")
    offline = issubclass(algos.ALGOS[args.algo].config, OfflineConfig)
    if offline and (args.num_envs or args.horizon):
        raise ConfigError(f"{args.algo} has no environments: leave out --num-envs and --horizon")
    cfg = config_of(args.algo, args.options, num_envs=args.num_envs, horizon=args.horizon)
    data = transitions(Weightless()) if offline else ()
    env = Weightless(vision=tuple(args.vision) if args.vision else None)
    state, update = training(env, args.algo, cfg, args.seeds, devices=1, data=data)
    size = f"{cfg.updates} gradient steps" if offline else f"{cfg.num_envs} x {cfg.horizon}"
    warm_up = 0 if offline else -(-getattr(cfg, "learning_starts", 0) // (cfg.num_envs * cfg.horizon))
    products = products_of(jax.make_jaxpr(update)(state, np.int32(0)).jaxpr) / 1e12
    timing = timed(update, state, before=2 + warm_up, repeats=args.repeats)
    seconds = statistics.median(timing.runs)
    print(
        f"{' '.join([args.algo, *args.options])}, {args.seeds} x {size}: "
        f"{1e3 * seconds:.1f} ms an update, compiled in {timing.compile_s:.1f} s\n"
        f"{products:.3g} TFLOP of products an update, {products / seconds:.3g} TFLOP/s"
    )
    if args.kernels:
        show(kernels_of(timing), args.kernels)
    return 0


def main() -> int:
    return guarded(command)


if __name__ == "__main__":
    sys.exit(main())

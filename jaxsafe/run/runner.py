"""The training loop: compile once, call `update`, log, checkpoint, stop when asked.

Every array of the train state carries a leading axis here: over members (each setting of the
algorithm's floats with each seed), or over the devices that share the environments of a lone one.
The loop stays one update ahead of what is logged, in a thread, so the device does not wait for files.
"""

import contextlib
import dataclasses
import math
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from jaxsafe.config import ConfigError, flat
from jaxsafe.learn.constraints import own_limits
from jaxsafe.run import checkpoint, distributed, run_folder
from jaxsafe.run.interrupts import Interrupts
from jaxsafe.run.progress import Report
from jaxsafe.types import Algorithm, Clocks, Env, PyTree, Shared

AXIS = "devices"
OVERFLOW = "train/overflow"  # steps of an episode in which engine warp ran out of room
ROOM = 0.8  # of the memory that a program may take by `capacity`
POLICY = ("params", "normaliser")  # the parts of what acts that another run can start from


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """The settings beside `env` and `algo`."""

    total_steps: int = 10_000_000  # environment steps of one seed, rounded up to whole updates
    num_envs: int | None = None  # of one seed; null: algo.num_envs
    num_seeds: int = 1  # trained at once: seed, seed + 1, ...
    seed: int = 0
    devices: int = 1  # the seeds are split over them or, for a lone one, its environments
    coordinator: str | None = None  # host:port of process 0 where several train one run together
    num_processes: int | None = None  # of them; under SLURM all three are known
    process_index: int | None = None  # 0 .. num_processes - 1
    preset: str = "fast"  # the algorithm's defaults: fast, published, or one of its published settings
    compat: str = "none"  # whose departures from the papers to follow: none, or omnisafe
    run_dir: str | None = None  # null: runs/<env>-<algo>/<time>-seed<seed>
    resume: bool | str = False  # true: run_dir, or the newest unfinished run like this one; or a folder
    init_from: str | None = None  # a run folder whose policy to start from
    checkpoint_every: float = 60.0  # s between checkpoints
    checkpoint_iterations: int = 0  # also after this many iterations; 0: by time alone
    eval_episodes: int = 20  # at the end, for each seed; 0: none
    video: bool = True  # of the first seed's policy, at the end

    def __post_init__(self) -> None:
        for name in ("total_steps", "num_envs", "num_seeds", "devices"):
            if (value := getattr(self, name)) is not None and value < 1:
                raise ConfigError(f"{name}={value}: expected at least 1")
        for name in ("seed", "checkpoint_every", "checkpoint_iterations", "eval_episodes"):
            if not (value := getattr(self, name)) >= 0:
                raise ConfigError(f"{name}={value}: expected at least 0")
        if self.seed + self.num_seeds > 2**31:
            raise ConfigError(f"seed={self.seed}: expected less than {2**31 - self.num_seeds + 1}")


class TooLarge(ConfigError):
    """What was asked cannot fit the memory."""


class Member(NamedTuple):
    """One of the runs that train side by side: a setting of the algorithm with a seed."""

    algo: Any  # its config
    seed: int
    swept: dict[str, float]  # those of its floats in which the settings differ, as algo.<field>

    @property
    def setting(self) -> str:
        return run_folder.setting_name(self.swept)


def members(configs: Sequence[Any], settings: TrainConfig) -> list[Member]:
    """Every setting with every seed, seeds fastest."""
    plain = [flat({"algo": dataclasses.asdict(c)}) for c in configs]
    swept = [name for name, value in plain[0].items() if any(c[name] != value for c in plain)]
    return [
        Member(cfg, settings.seed + i, {name: values[name] for name in swept})
        for cfg, values in zip(configs, plain, strict=True)
        for i in range(settings.num_seeds)
    ]


class Program(NamedTuple):
    """`init(start, shared) -> ts` and `update(ts, shared) -> (ts, metrics)` over the leading axis, not
    yet compiled. `params(ts)` is what acts, on the same axis; `clocks` are those of one seed."""

    init: Callable[[PyTree, Shared], PyTree]
    update: Callable[[PyTree, Shared], tuple[PyTree, dict[str, jax.Array]]]
    params: Callable[[PyTree], PyTree]
    clocks: Clocks
    start: PyTree  # (keys, config): [M], or [devices] for one split member
    members: list[Member]
    sharding: jax.sharding.Sharding


class Outcome(NamedTuple):
    ts: PyTree
    iteration: int
    steps: int
    interrupted: bool


def use_compilation_cache() -> None:
    """Keep XLA's programs in the user's cache folder, unless the user has chosen one."""
    if jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        with contextlib.suppress(OSError, RuntimeError):  # no home, or a read-only one, costs only time
            home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
            folder = Path(home) / "jaxsafe" / "xla"
            folder.mkdir(parents=True, exist_ok=True)
            jax.config.update("jax_compilation_cache_dir", str(folder))


def build(env: Env, make: Callable, configs: Sequence[Any], settings: TrainConfig) -> Program:
    """Spread one algorithm over settings, seeds and devices.

    Args:
        env: the environment.
        make: `make(env, axis_name) -> Algorithm` of the algorithm.
        configs: its config in each setting; they differ in floats alone.
        settings: seeds and devices.
    Raises:
        ConfigError: the members, or the environments of a lone one, do not split over the devices.
    """
    devices, run = settings.devices, members(configs, settings)
    share = devices if len(run) == 1 else 1  # devices among which the environments of one are split
    if len(run) % devices and share == 1:
        raise ConfigError(
            f"{len(run)} seeds do not split over devices={devices}: "
            f"expected a multiple of {devices}, or 1"
        )
    if configs[0].num_envs % share:
        raise ConfigError(f"num_envs={configs[0].num_envs} does not split over devices={devices}")

    algo: Algorithm = make(env, AXIS if share > 1 else None)
    clocks = algo.clocks(configs[0])

    def settled(cfg: Any) -> Any:
        ends = cfg.total_iterations
        if math.isinf(ends):
            ends = float(-(-settings.total_steps // clocks.steps))
        return dataclasses.replace(cfg, num_envs=cfg.num_envs // share, total_iterations=ends)

    # A split seed has one key for all its devices: the algorithm folds the device's index in.
    keys = jax.vmap(jax.random.key)(np.array([m.seed for m in run] * share, np.uint32))
    floats = jax.tree.map(lambda *x: np.array(x, np.float32), *[settled(m.algo) for m in run * share])
    rows = max(1, len(run) // devices)  # on each device
    init = over_rows(lambda start, shared: algo.init(start[0], start[1], shared), rows)
    update = over_rows(algo.update, rows)
    if devices == 1:
        one = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
        return Program(init, update, algo.params, clocks, (keys, floats), run, one)
    mesh = jax.make_mesh(
        (devices,), (AXIS,), devices=jax.devices()[:devices], axis_types=(AxisType.Auto,)
    )
    spec = PartitionSpec(AXIS)

    def split(fn: Callable) -> Callable:
        def parted(tree: PyTree, shared: Shared) -> PyTree:
            leaves, treedef = jax.tree.flatten(tree)

            def own_part(full: list[jax.Array], shared: Shared) -> PyTree:
                given = iter(full)
                tree = treedef.unflatten([next(given) if x.size else empty(x) for x in leaves])
                return fn(tree, shared)

            # arrays without elements stay outside: jax 0.11 crashes on them as inputs
            full = [x for x in leaves if x.size]
            specs = {"in_specs": (spec, PartitionSpec()), "out_specs": spec}
            return jax.shard_map(own_part, mesh=mesh, **specs, check_vma=False)(full, shared)

        return parted

    def empty(x: jax.Array) -> jax.Array:
        return jnp.zeros((x.shape[0] // devices, *x.shape[1:]), x.dtype)

    sharding = NamedSharding(mesh, spec)
    return Program(split(init), split(update), algo.params, clocks, (keys, floats), run, sharding)


def over_rows(fn: Callable[[PyTree, Shared], PyTree], rows: int) -> Callable[[PyTree, Shared], PyTree]:
    """`fn` over a leading axis of `rows`. One row is no vmap, which would run both sides of a cond."""

    def strong(tree: PyTree) -> PyTree:  # no weak types, so that a restored state is the same program
        return jax.tree.map(lambda x: x if checkpoint.is_key(x) else jnp.asarray(x, x.dtype), tree)

    def alone(tree: PyTree, shared: Shared) -> PyTree:
        out = fn(jax.tree.map(lambda x: x[0], tree), shared)
        return strong(jax.tree.map(lambda x: x[None], out))

    def together(tree: PyTree, shared: Shared) -> PyTree:
        return strong(jax.vmap(fn, in_axes=(0, None))(tree, shared))

    return together if rows > 1 else alone


def check_devices(settings: TrainConfig) -> None:
    if jax.process_count() > 1 and settings.devices != jax.device_count():
        raise ConfigError(
            f"devices={settings.devices}: expected {jax.device_count()}, which the "
            f"{jax.process_count()} processes have together ({jax.default_backend()})"
        )
    if settings.devices > jax.device_count():
        raise ConfigError(
            f"devices={settings.devices}: JAX sees {jax.device_count()} ({jax.default_backend()})"
            + ("; set JAX_NUM_CPU_DEVICES to split the CPU" if jax.default_backend() == "cpu" else "")
        )


def check_memory(env: Env, algo_config: Any, num_members: int, devices: int) -> None:
    """Refuse, before anything compiles, a trajectory that cannot fit the device.

    A lower bound: observations before and after each step, actions and a few scalars.
    """
    limit, what = device_memory()
    step = 4 * (2 * env.obs_size + env.action_size + 8 + len(env.cost_names))  # bytes
    need = step * algo_config.num_envs * algo_config.horizon * num_members // devices
    if need > limit:
        raise TooLarge(
            f"num_envs={algo_config.num_envs} x horizon={algo_config.horizon} x "
            f"{num_members} seeds needs at least {need / 2**30:,.1f} GiB a device, "
            f"{what} has {limit / 2**30:,.1f}; use fewer num_envs"
        )


def check_state_memory(program: Program, settings: TrainConfig) -> None:
    """Like `check_memory`, for the train state itself (old and new), known once it is traced."""
    limit, what = device_memory()
    leaves = jax.tree.leaves(jax.eval_shape(program.init, program.start, Shared(np.int32(0))))
    need = (
        2
        * sum(x.size * (8 if checkpoint.is_key(x) else x.dtype.itemsize) for x in leaves)
        // settings.devices
    )
    if need > limit:
        raise TooLarge(
            f"the train state needs {need / 2**30:,.1f} GiB a device, {what} has {limit / 2**30:,.1f}; "
            "use fewer num_envs or num_seeds"
        )


def capacity(program: Program) -> int:
    """How many of its members fit the memory at once, by the compiled update's own account."""
    like = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=program.sharding),
        jax.eval_shape(program.init, program.start, Shared(np.int32(0))),
    )
    used: Any = compiled(program, like).memory_analysis()
    need = used.temp_size_in_bytes + used.argument_size_in_bytes + used.output_size_in_bytes
    share = ROOM * device_memory()[0] / (need - used.alias_size_in_bytes)  # of the members
    return max(1, int(min(1.0, share) * len(program.members)))


def compiled(program: Program, ts: PyTree) -> Any:
    """The update for a train state of these shapes; JAX remembers it."""
    return jax.jit(program.update, donate_argnums=0).lower(ts, Shared(np.int32(0))).compile()


def device_memory() -> tuple[float, str]:
    """Bytes that the first device can hold, and what to call them; infinite where unknown."""
    stats = jax.local_devices()[0].memory_stats() if jax.default_backend() != "cpu" else None
    if stats and "bytes_limit" in stats:
        return float(stats["bytes_limit"]), "the device"
    limits = [float("inf")]
    with contextlib.suppress(OSError, ValueError):
        rows = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        limits.append(float(rows["MemAvailable"].split()[0]) * 1024)
    for path in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with contextlib.suppress(OSError, ValueError):
            limits.append(float(Path(path).read_text()))
    return min(limits), "this machine"


def device_name() -> str:
    device = jax.local_devices()[0]
    return f"cpu ({os.cpu_count()} cores)" if device.platform == "cpu" else str(device.device_kind)


def train(
    program: Program,
    settings: TrainConfig,
    folder: Path,
    report: Report,
    resume_command: str,
    adapt: Callable[[PyTree], PyTree] | None = None,
) -> Outcome:
    """Train to `settings.total_steps`, from the newest checkpoint in `folder` if there is one.

    Args:
        program: from `build`.
        settings: those it was built with.
        folder: the run folder; gets metrics.csv, tensorboard/ and checkpoints/.
        report: where progress goes.
        resume_command: printed when the run is stopped early.
        adapt: changes a fresh train state (start from another policy); not used on resumption.
    Returns:
        The train state, with its leading axis, and how far it is.
    Raises:
        checkpoint.CheckpointError, OSError: the disk failed; the last good checkpoint stays.
    """
    per_update = program.clocks.steps
    iterations = -(-settings.total_steps // per_update)
    store = folder / "checkpoints"
    resuming = bool(distributed.first(np.array(bool(checkpoint.checkpoints(store)))))
    with report, Interrupts(report.line, report.hosted) as stop:
        stop.nothing_to_save = (
            f"stopped before the first update; {resume_command if resuming else 'nothing to save'}"
        )
        begun = time.perf_counter()
        iteration = 0
        if resuming:
            like = jax.eval_shape(program.init, program.start, Shared(np.int32(0)))
            ts, iteration = restored(store, like, report)
            ts = distributed.place(ts, program.sharding)
            report.line(f"resuming at {iteration * per_update:,} steps")
        else:
            start = distributed.place(program.start, program.sharding)
            ts = jax.jit(program.init)(start, Shared(np.int32(0)))
            ts = distributed.place(adapt(ts), program.sharding) if adapt else ts
        if iteration >= iterations:
            report.line("nothing left to train")
            return Outcome(ts, iteration, iteration * per_update, False)
        names = sorted(jax.eval_shape(program.update, ts, Shared(np.int32(0)))[1])
        update = compiled(program, ts)
        report.line(f"compiled in {time.perf_counter() - begun:.1f} s")
        stop.nothing_to_save = ""

        vote = distributed.Vote(program.sharding)
        with (
            Log(folder, names, program.members, iteration, per_update, report)
            if distributed.leads()
            else contextlib.nullcontext()
        ) as log:
            limits = [m.algo.cost_limit for m in program.members if not own_limits(m.algo)]
            report.start(iterations * per_update, iteration * per_update, limits)
            saved_at = time.perf_counter()
            while iteration < iterations:
                ts, metrics = update(ts, Shared(np.int32(iteration)))
                metrics, iteration = distributed.whole(metrics), iteration + 1
                if log:
                    log.append(iteration, metrics)
                by_count = (
                    settings.checkpoint_iterations and iteration % settings.checkpoint_iterations == 0
                )
                late = time.perf_counter() - saved_at >= settings.checkpoint_every
                stopping, by_time = vote(stop.requested, late)
                if stopping or by_count or by_time or iteration == iterations:
                    state = distributed.whole(ts)
                    if log:
                        log.sync()
                        checkpoint.save(store, state, iteration, iteration * per_update)
                        acting = jax.tree.map(
                            lambda x: x[: len(program.members)], program.params(state)
                        )
                        checkpoint.save(folder / "policy", acting, iteration, iteration * per_update)
                    saved_at = time.perf_counter()
                if stopping:
                    break
        report.stop()
        interrupted = iteration < iterations
        if interrupted:
            report.line(f"stopped at {iteration * per_update:,} steps; continue with: {resume_command}")
    return Outcome(ts, iteration, iteration * per_update, interrupted)


def restored(store: Path, like: PyTree, report: Report) -> tuple[PyTree, int]:
    """The train state of the newest sound checkpoint that process 0 finds, and its iteration."""
    if jax.process_count() == 1:
        ts, manifest = checkpoint.restore(store, like, report.line)
        return ts, manifest.iteration
    arrays = {name: np.zeros(x.shape, x.dtype) for name, x in checkpoint.as_data(like).items()}
    iteration = 0
    if distributed.leads():
        ts, manifest = checkpoint.restore(store, like, report.line)
        arrays, iteration = checkpoint.to_arrays(ts), manifest.iteration
    arrays, known = distributed.first((arrays, np.array(iteration)))
    return checkpoint.from_arrays(like, arrays), int(known)


class Log:
    """Metrics to metrics.csv, TensorBoard and the progress report, the files by a thread.

    What goes wrong in the thread is raised by the next call.
    """

    def __init__(
        self,
        folder: Path,
        names: list[str],
        members: list[Member],
        iteration: int,
        per_update: int,
        report: Report,
    ):
        self.seeds, self.per_update, self.warned = [m.seed for m in members], per_update, False
        self.report = report
        self.swept = {name: np.array([m.swept[name] for m in members]) for name in members[0].swept}
        self.csv = run_folder.Metrics(folder, [*self.swept, *names], iteration)
        self.begun = time.perf_counter() - self.csv.seconds
        self.boards = [
            run_folder.Board(
                folder / "tensorboard" / m.setting.replace(", ", "-") / f"seed{m.seed}",
                iteration * per_update,
            )
            for m in members
        ]
        self.thread = ThreadPoolExecutor(1)
        self.writing: Future[tuple[int, dict[str, np.ndarray]]] | None = None

    def __enter__(self) -> "Log":
        return self

    def __exit__(self, *_: object) -> None:
        self.thread.shutdown()
        self.csv.close()
        for board in self.boards:
            board.close()

    def append(self, iteration: int, metrics: dict[str, jax.Array]) -> None:
        """Begin to write the metrics of an iteration, once those of the last one are written."""
        self._finish()
        self.writing = self.thread.submit(self._write, iteration, metrics)

    def sync(self) -> None:
        """Put all that was appended on the disk."""
        self._finish()
        self.csv.sync()
        for board in self.boards:
            board.flush()

    def _write(
        self, iteration: int, metrics: dict[str, jax.Array]
    ) -> tuple[int, dict[str, np.ndarray]]:
        values = {k: np.asarray(v, np.float32) for k, v in jax.device_get(metrics).items()}
        steps, seconds = iteration * self.per_update, time.perf_counter() - self.begun
        self.csv.append(iteration, steps, self.seeds, seconds, values | self.swept)
        for s, board in enumerate(self.boards):
            board.append(steps, {name: float(value[s]) for name, value in values.items()})
        return steps, values

    def _finish(self) -> None:
        if not self.writing:
            return
        writing, self.writing = self.writing, None
        steps, values = writing.result()
        if not self.warned and (values.get(OVERFLOW, np.zeros(())) > 0).any():  # NaN: nothing ended
            self.warned = True
            self.report.line(
                f"warning: contacts found no room in some steps ({OVERFLOW} in metrics.csv); "
                "raise env.contact_room"
            )
        self.report.update(
            steps,
            len(self.seeds),
            **{
                short: mean(values[name]) if name in values else float("nan")
                for short, name in (
                    ("ret", "train/return_estimate"),
                    ("cost", "train/cost_estimate"),
                    ("lam", "train/lam"),
                )
            },
        )


def mean(values: np.ndarray) -> float:
    """Over the seeds that have a value."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else float("nan")


# ---- the policy alone: other runs start from it, evaluation needs nothing else ----------------


def policy_folder(folder: Path) -> Path:
    """Where the policies of a run lie: beside its checkpoints or, in runs before 0.2, in them."""
    alone = folder / "policy"
    return alone if checkpoint.checkpoints(alone) else folder / "checkpoints"


def read_policy(
    folder: Path,
    rows: int,
    warn: Callable[[str], None] | None = None,
) -> dict[str, np.ndarray]:
    """The newest policies of a run folder by leaf name, [rows, ...], with whatever else lies there.

    Rows beyond the run's members are the copies on the other devices of a split one.
    """
    arrays, _ = checkpoint.load(policy_folder(folder), warn)
    policy = {name: x[:rows] for name, x in arrays.items()}
    if any(len(x) != rows for x in policy.values()):
        raise ConfigError(f"{folder} holds fewer than the {rows} policies of its config.yaml")
    return policy


def check_policy(like: PyTree, policy: dict[str, np.ndarray], source: Path, why: str = "") -> None:
    """Raise ConfigError unless `policy` has the networks of `like`, whatever its rows."""

    def networks(named: dict[str, Any]) -> dict[str, Any]:
        return {k: v for k, v in named.items() if k.split(".")[0] in POLICY}

    expected = dict(zip(checkpoint.leaf_names(like), jax.tree.leaves(like), strict=True))
    expected, policy = networks(expected), networks(policy)
    for name in sorted({*expected, *policy}):
        have, want = (
            str(list(x[name].shape[1:])) if name in x else "absent" for x in (policy, expected)
        )
        if have != want:
            raise ConfigError(
                f"the policy of {source} does not fit: {name} is {have}, expected {want}{why}"
            )


def with_policy(ts: PyTree, policy: dict[str, np.ndarray], rows: Sequence[int]) -> PyTree:
    """`ts` with the networks and normaliser of `policy`: row `rows[i]` of it for member i.

    The copies of a member on several devices share its row.
    """
    leaves, treedef = jax.tree.flatten(ts)
    picks = np.resize(rows, len(leaves[0]))

    def start(name: str, x: jax.Array) -> jax.Array:
        taken = name in policy and name.split(".")[0] in POLICY
        return jnp.asarray(policy[name][picks], x.dtype) if taken else x

    named = zip(checkpoint.leaf_names(ts), leaves, strict=True)
    return treedef.unflatten([start(name, x) for name, x in named])


def acting(like: PyTree, policy: dict[str, np.ndarray], configs: PyTree, source: Path) -> PyTree:
    """What acts of each of S policies, [S, ...].

    Args:
        like: of one, without that axis.
        policy: from `read_policy`.
        configs: the algorithm's, floats [S], from config.yaml.
        source: the run folder, for messages.
    Raises:
        ConfigError: the policies are of other networks.
    """
    rows = len(jax.tree.leaves(configs)[0])
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct((rows, *x.shape), x.dtype), like)
    check_policy(like, policy, source)
    arrays = policy | checkpoint.to_arrays({"config": configs})
    for name in checkpoint.leaf_names(like):
        if name not in arrays:
            raise ConfigError(f"the policy of {source} does not fit: {name} is absent")
    return checkpoint.from_arrays(like, arrays)

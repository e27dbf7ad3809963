"""One algorithm over settings, seeds and devices.

Every array of the train state carries a leading axis here: over members (each setting of the
algorithm's floats with each seed), or over the devices that share the environments of a lone one.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from jaxsafe.config import ConfigError, flat
from jaxsafe.envs.wrap import raw_steps
from jaxsafe.learn.observations import observation_like
from jaxsafe.run import checkpoint, clock, run_folder
from jaxsafe.run.settings import TrainConfig
from jaxsafe.types import Algorithm, Clocks, Env, PyTree, Shared

AXIS = "devices"


class Member(NamedTuple):
    """One of the runs that train side by side: a setting of the algorithm with a seed."""

    config: Any  # of the algorithm
    seed: int
    swept: dict[str, float]  # those of its floats in which the settings differ, as algo.<field>

    @property
    def setting(self) -> str:
        return run_folder.setting_name(self.swept)


def members(configs: Sequence[Any], train_cfg: TrainConfig) -> list[Member]:
    """Every setting with every seed, seeds fastest."""
    plain = [flat({"algo": dataclasses.asdict(c)}) for c in configs]
    swept = [name for name, value in plain[0].items() if any(c[name] != value for c in plain)]
    return [
        Member(cfg, train_cfg.seed + i, {name: values[name] for name in swept})
        for cfg, values in zip(configs, plain, strict=True)
        for i in range(train_cfg.num_seeds)
    ]


class Program(NamedTuple):
    """An algorithm over the leading axis, not yet compiled.

    init(start, shared) -> ts.
    update(ts, shared) -> (ts, metrics).
    learned(ts) -> what the policies are made of, on the same axis.
    clocks: what one update takes of one seed.
    start: (keys, config), [M], or [devices] for one split member.
    members: on the axis, in order.
    sharding, everywhere: of the train state, and of what members share.
    data: the data set, or ().
    """

    init: Callable[[PyTree, Shared], PyTree]
    update: Callable[[PyTree, Shared], tuple[PyTree, dict[str, jax.Array]]]
    learned: Callable[[PyTree], PyTree]
    clocks: Clocks
    start: PyTree
    members: list[Member]
    sharding: jax.sharding.Sharding
    everywhere: jax.sharding.Sharding
    data: PyTree = ()

    def shared(self, iteration: int = 0, since: int = 0) -> Shared:
        return Shared(np.int32(iteration), np.int32(since), self.data)


def build(
    env: Env, make: Callable, configs: Sequence[Any], train_cfg: TrainConfig, data: PyTree = ()
) -> Program:
    """The program of one algorithm over settings, seeds and devices.

    Args:
        env: the environment.
        make: `make(env, axis_name) -> Algorithm` of the algorithm.
        configs: its config in each setting; they differ in floats alone.
        train_cfg: seeds and devices.
        data: the data set, for an algorithm that takes no environment steps.
    Raises:
        ConfigError: the members, or the environments of a lone one, do not split over the devices; a
            data set that is missing, or that the algorithm has no use for; pictures on several GPUs.
    """
    devices, run = train_cfg.devices, members(configs, train_cfg)
    split = len(run) == 1 and devices > 1  # the environments of a lone member, over the devices
    if len(run) % devices and not split:
        raise ConfigError(
            f"{len(run)} {'seeds' if len(configs) == 1 else 'members'} do not split over "
            f"devices={devices}: "
            f"expected a multiple of {devices}, or 1"
        )
    check_pictures(env, devices)
    algo: Algorithm = make(env, AXIS if split else None)
    clocks, *_ = map(algo.clocks, configs)  # which refuse settings that do not fit each other
    clocks = clocks._replace(steps=clocks.steps * raw_steps(env))
    check_data(clocks, data, train_cfg)
    if split:
        check_split(clocks, configs[0], devices)
    iterations = float(clock.iterations(train_cfg, clocks))

    def settled(cfg: Any) -> Any:
        ends = iterations if math.isinf(cfg.total_iterations) else cfg.total_iterations
        part = {"num_envs": cfg.num_envs // devices} if split else {}
        return dataclasses.replace(cfg, total_iterations=ends, **part)

    # A split seed has one key for all its devices: the algorithm folds the device's index in.
    each = run * (devices if split else 1)
    keys = jax.vmap(jax.random.key)(np.array([m.seed for m in each], np.uint32))
    floats = jax.tree.map(lambda *x: np.array(x, np.float32), *[settled(m.config) for m in each])
    rows = max(1, len(run) // devices)  # on each device
    init = over_rows(lambda start, shared: algo.init(start[0], start[1], shared), rows)
    update = over_rows(algo.update, rows)
    if devices == 1:
        one = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
        return Program(init, update, algo.learned, clocks, (keys, floats), run, one, one, data)
    mesh = jax.make_mesh(
        (devices,), (AXIS,), devices=jax.devices()[:devices], axis_types=(AxisType.Auto,)
    )
    return Program(
        init=over_devices(init, mesh),
        update=over_devices(update, mesh),
        learned=algo.learned,
        clocks=clocks,
        start=(keys, floats),
        members=run,
        sharding=NamedSharding(mesh, PartitionSpec(AXIS)),
        everywhere=NamedSharding(mesh, PartitionSpec()),
        data=data,
    )


def check_data(clocks: Clocks, data: PyTree, train_cfg: TrainConfig) -> None:
    """Raise ConfigError for a data set that is missing, or that the algorithm has no use for."""
    if data and clocks.steps:
        raise ConfigError(f"dataset={train_cfg.dataset}: this algorithm learns from no data set")
    if not data and not clocks.steps:
        raise ConfigError("an offline algorithm learns from a data set: give dataset=PATH")


def check_pictures(env: Env, devices: int) -> None:
    """Raise ConfigError for pictures on several GPUs: to compile them ends the process (jax 0.11.2)."""
    if devices > 1 and jax.default_backend() == "gpu" and isinstance(observation_like(env), dict):
        raise ConfigError(
            f"devices={devices}: jax 0.11.2 crashes as it compiles pictures for several GPUs; "
            "expected 1, on which all seeds train side by side"
        )


def check_split(clocks: Clocks, cfg: Any, devices: int) -> None:
    """Raise ConfigError where a lone member has no environments that split over the devices."""
    if not clocks.steps:
        raise ConfigError(
            f"devices={devices}: a lone seed has no environments to split over them; use num_seeds"
        )
    if cfg.num_envs % devices:
        raise ConfigError(f"num_envs={cfg.num_envs} does not split over devices={devices}")


def over_devices(
    fn: Callable[[PyTree, Shared], PyTree], mesh: Mesh
) -> Callable[[PyTree, Shared], PyTree]:
    """`fn` on each device, with its part of the leading axis."""
    spec, devices = PartitionSpec(AXIS), mesh.size

    def empty(x: jax.Array) -> jax.Array:
        return jnp.zeros((x.shape[0] // devices, *x.shape[1:]), x.dtype)

    def parted(tree: PyTree, shared: Shared) -> PyTree:
        leaves, treedef = jax.tree.flatten(tree)

        def on_part(full: list[jax.Array], shared: Shared) -> PyTree:
            given = iter(full)
            tree = treedef.unflatten([next(given) if x.size else empty(x) for x in leaves])
            return fn(tree, shared)

        # arrays without elements stay outside: jax 0.11 crashes on them as inputs
        full = [x for x in leaves if x.size]
        specs = {"in_specs": (spec, PartitionSpec()), "out_specs": spec}
        return jax.shard_map(on_part, mesh=mesh, **specs, check_vma=False)(full, shared)

    return parted


def over_rows(fn: Callable[[PyTree, Shared], PyTree], rows: int) -> Callable[[PyTree, Shared], PyTree]:
    """`fn` over a leading axis of `rows`. With one row, skip vmap: there a cond runs both branches."""

    def strong(tree: PyTree) -> PyTree:  # no weak types, so that a restored state is the same program
        return jax.tree.map(lambda x: x if checkpoint.is_key(x) else jnp.asarray(x, x.dtype), tree)

    def alone(tree: PyTree, shared: Shared) -> PyTree:
        out = fn(jax.tree.map(lambda x: x[0], tree), shared)
        return strong(jax.tree.map(lambda x: x[None], out))

    def together(tree: PyTree, shared: Shared) -> PyTree:
        return strong(jax.vmap(fn, in_axes=(0, None))(tree, shared))

    return together if rows > 1 else alone


def compiled(program: Program, ts: PyTree) -> Any:
    """The update for a train state of these shapes; JAX remembers it."""
    data = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=program.everywhere), program.data
    )
    shared = program.shared()._replace(data=data)
    return jax.jit(program.update, donate_argnums=0).lower(ts, shared).compile()

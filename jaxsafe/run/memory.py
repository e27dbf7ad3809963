"""Whether a run fits the memory: lower bounds before anything compiles, and then the program itself."""

from typing import Any

import jax

from jaxsafe.config import ConfigError
from jaxsafe.learn.model_based import ModelBasedConfig
from jaxsafe.learn.observations import observation_like
from jaxsafe.learn.planning import planning_bytes
from jaxsafe.run import checkpoint, programs
from jaxsafe.run.programs import Program
from jaxsafe.run.settings import Settings
from jaxsafe.types import Env

WORKING_SIZES = ("batch_size", "model_batch", "plans", "shield_rollouts")
PROGRAM_SHARE = 0.8  # of the memory that a program may take by `capacity`


class TooLarge(ConfigError):
    """What was asked cannot fit the memory."""


def too_large(needed: str, advice: str) -> TooLarge:
    limit, what = device_memory()
    return TooLarge(f"{needed}, {what} has {limit / 2**30:,.1f}; {advice}")


def gib(size: float) -> str:
    return f"{size / 2**30:,.1f} GiB"


def check_memory(env: Env, settings: Settings) -> None:
    """Refuse, before anything is built, a trajectory or an evaluation that cannot fit the device.

    Lower bounds. Of a trajectory: observations before and after each step, actions and a few scalars.
    """
    seen = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(observation_like(env)))
    step = 2 * seen + 4 * (env.action_size + 8 + len(env.cost_names))  # bytes
    steps = settings.row.make(env, None).clocks(settings.algo).steps
    members = len(settings.configs) * settings.train.num_seeds
    need = step * steps * members // settings.train.devices
    if need > device_memory()[0]:
        what = f"{steps:,} environment steps an update x {members} seeds"
        smaller = " or a smaller env.vision_size" * sees_pictures(env, settings)
        raise too_large(f"{what} needs at least {gib(need)} a device", f"use fewer num_envs{smaller}")
    if isinstance(settings.algo, ModelBasedConfig):
        check_plans(env, settings, members)
    check_episodes(env, settings.train.eval_episodes, members)


def sees_pictures(env: Env, settings: Settings) -> bool:
    """Whether observations have a picture whose size is an option."""
    return isinstance(observation_like(env), dict) and "vision_size" in settings.env_options


def check_plans(env: Env, settings: Settings, members: int) -> None:
    """Refuse plans that cannot fit the device, for the environments of training or, if they are more,
    for the episodes of an evaluation."""
    train = settings.train
    worlds = members * max(settings.algo.num_envs // train.devices, train.eval_episodes)
    need = worlds * planning_bytes(env, settings.algo)
    if need > device_memory()[0]:
        raise too_large(
            f"planning in {worlds:,} environments at once needs at least {gib(need)} a device",
            "use fewer num_envs, eval_episodes or algo.plans",
        )


def check_episodes(env: Env, episodes: int, policies: int) -> None:
    """Refuse an evaluation whose rewards and costs of each step cannot fit the device."""
    need = 4 * (5 + len(env.cost_names)) * env.episode_length * episodes * policies  # bytes
    if need > device_memory()[0]:
        needed = f"{episodes:,} episodes of {policies} policies need at least {gib(need)}"
        raise too_large(needed, "evaluate fewer")


def check_state_memory(program: Program, env: Env, settings: Settings) -> None:
    """Like `check_memory`, for the train state itself, known once it is traced: old and new, but a
    replay only once, as it is written in place. Every device has the whole data set."""
    devices = settings.train.devices
    like = jax.eval_shape(program.init, program.start, program.shared())
    whole = sum(x.size * x.dtype.itemsize for x in checkpoint.as_data(like).values())
    replay = checkpoint.replay_bytes(like)
    data = sum(x.nbytes for x in jax.tree.leaves(program.data))
    need = (2 * (whole - replay) + replay) / devices + data
    if need > device_memory()[0]:
        part = f" ({gib(replay / devices)} of it replay)" if replay else ""
        part += f" ({gib(data)} of it the data set)" if data else ""
        sizes = ["algo.replay_size"] + ["env.vision_size"] * sees_pictures(env, settings)
        less = f"a smaller {', '.join(sizes)}" if replay > whole / 2 else "fewer num_envs"
        needed = f"the train state needs {gib(need)} a device{part}"
        raise too_large(needed, f"use {less} or num_seeds")


def check_work_memory(update: Any, cfg: Any) -> None:
    """Refuse a compiled update whose arrays between its operations cannot fit the device. The system
    would end the process without a word. `cfg` is of an algorithm, whose sizes the refusal names."""
    need = update.memory_analysis().temp_size_in_bytes
    if need > device_memory()[0]:
        sizes = ["num_envs", "num_seeds", *(f"algo.{n}" for n in WORKING_SIZES if hasattr(cfg, n))]
        needed = f"an update works in {gib(need)} a device"
        raise too_large(needed, f"use a smaller {', '.join(sizes[:-1])} or {sizes[-1]}")


def capacity(program: Program) -> int:
    """How many of its members fit the memory at once, by the compiled update's own account."""
    like = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=program.sharding),
        jax.eval_shape(program.init, program.start, program.shared()),
    )
    used: Any = programs.compiled(program, like).memory_analysis()
    need = used.temp_size_in_bytes + used.argument_size_in_bytes + used.output_size_in_bytes
    share = PROGRAM_SHARE * device_memory()[0] / (need - used.alias_size_in_bytes)  # of the members
    return max(1, int(min(1.0, share) * len(program.members)))


def device_memory() -> tuple[float, str]:
    """Bytes that the first device can hold, and what to call them; infinite where unknown."""
    stats = jax.local_devices()[0].memory_stats() if jax.default_backend() != "cpu" else None
    if stats and "bytes_limit" in stats:
        return float(stats["bytes_limit"]), "the device"
    return checkpoint.host_memory(), "this machine"

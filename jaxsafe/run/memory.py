"""Whether a run fits the memory: lower bounds before anything compiles, and then the program itself."""

import contextlib
import gc
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax

from jaxsafe.config import ConfigError
from jaxsafe.learn.model_based import ModelBasedConfig
from jaxsafe.learn.observations import observation_like
from jaxsafe.learn.on_policy import OnPolicyConfig
from jaxsafe.learn.planning import planning_bytes
from jaxsafe.learn.world_model import WorldModelConfig
from jaxsafe.run import checkpoint, programs
from jaxsafe.run.programs import Program
from jaxsafe.run.settings import Settings
from jaxsafe.types import Env

# of an algorithm, what the arrays of its gradient steps grow with, those of acting, and its networks
LEARNING = ("batch_size", "imagine_steps", "model_batch", "size")
ACTING = ("plans", "shield_rollouts")
NETWORKS = ("size", "hidden")
PROGRAM_SHARE = 0.8  # of the memory that a program may take by `capacity`
LEAST_PART = 0.1  # of what a program takes: a smaller part is not worth a word of advice


class TooLarge(ConfigError):
    """What was asked cannot fit the memory."""


class OutOfMemory(RuntimeError):
    """The memory was too small in the middle of a run. The message is one line for the user."""


class Use(NamedTuple):
    """Bytes that a program takes of each device."""

    state: float  # the train state without its replay, which an update changes in place
    replay: float
    data: float  # the data set, of which each device has the whole
    work: float = 0.0  # arrays between operations, and what an update returns beside the state

    @property
    def kept(self) -> float:
        """What stays from one update to the next."""
        return self.state + self.replay + self.data

    @property
    def total(self) -> float:
        return self.kept + self.work

    def __str__(self) -> str:
        names = "train state", "replay", "data set", "working arrays"
        parts = [f"{name} {x / 2**30:,.1f}" for name, x in zip(names, self, strict=True) if x]
        return f"{gib(self.total)} a device ({', '.join(parts)})"


def too_large(needed: str, advice: str, held: float = 0.0) -> TooLarge:
    """`held`: bytes of what is needed that are on the device already."""
    room, what = device_memory()
    return TooLarge(f"{needed}, {what} has {gib(room + held)}; {advice}")


def fits(need: float) -> bool:
    """Whether the device can still hold `need` bytes."""
    if need > device_memory()[0]:
        gc.collect()  # arrays of an earlier run may wait for it
    return need <= device_memory()[0]


def gib(size: float) -> str:
    return f"{size / 2**30:,.1f} GiB"


def check_memory(env: Env, settings: Settings) -> None:
    """Refuse, before anything is built, a trajectory or an evaluation that cannot fit the device.

    Lower bounds. Of a trajectory: observations before and after each step, actions and a few scalars.
    """
    seen = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(observation_like(env)))
    step = 2 * seen + 4 * (env.action_size + 8 + len(env.cost_names))  # bytes
    steps = settings.row.make(env, None).clocks(settings.algo).steps
    members = settings.num_members
    need = step * steps * members // settings.train.devices
    if not fits(need):
        what = f"{steps:,} environment steps an update x {members} seeds"
        pictures = " or a smaller env.vision_size" * sees_pictures(env, settings)
        raise too_large(f"{what} needs at least {gib(need)} a device", f"use fewer num_envs{pictures}")
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
    if not fits(need):
        raise too_large(
            f"planning in {worlds:,} environments at once needs at least {gib(need)} a device",
            "use fewer num_envs, eval_episodes or algo.plans",
        )


def check_episodes(env: Env, episodes: int, policies: int) -> None:
    """Refuse an evaluation whose rewards and costs of each step cannot fit the device."""
    need = 4 * (5 + len(env.cost_names)) * env.episode_length * episodes * policies  # bytes
    if not fits(need):
        needed = f"{episodes:,} episodes of {policies} policies need at least {gib(need)}"
        raise too_large(needed, "evaluate fewer")


def check_state_memory(program: Program, env: Env, settings: Settings) -> None:
    """Like `check_memory`, for what is kept from one update to the next, known once it is traced."""
    use = kept_by(program)
    if not fits(use.total):
        raise too_large(f"a run keeps {use}", f"use {smaller(use, env, settings)}")


@contextlib.contextmanager
def watched(program: Program, env: Env, settings: Settings) -> Iterator[Callable[[Any], None]]:
    """While a program trains, a lack of memory is one line that says what to make smaller.

    Gives what checks the compiled update before it runs. It refuses one that cannot fit beside what is
    on the device by then: the train state, the data set and whatever else. On a CPU the system would
    end the process without a word.

    Raises:
        OutOfMemory: for XLA's error where the memory was too small all the same.
    """
    use = kept_by(program)

    def check(update: Any) -> None:
        nonlocal use
        use = use_of(update, program)
        if not fits(use.work):
            advice = f"use {smaller(use, env, settings)}"
            raise too_large(f"an update needs {use}", advice, held=use.kept)

    try:
        yield check
    except jax.errors.JaxRuntimeError as error:
        if not is_exhausted(error):
            raise
        less = smaller(use, env, settings, *["eval_episodes"] * bool(settings.train.eval_every))
        raise OutOfMemory(f"out of memory; use {less}; what was saved stays") from error


def is_exhausted(error: Exception) -> bool:
    """Whether the memory was too small, as XLA says it here and there: RESOURCE_EXHAUSTED; INTERNAL:
    Error dispatching computation: Out of memory; CUDA_ERROR_OUT_OF_MEMORY: out of memory."""
    return "RESOURCE_EXHAUSTED" in str(error) or "out of memory" in str(error).lower()


def smaller(use: Use, env: Env, settings: Settings, *more: str) -> str:
    """What to make smaller, as 'a smaller A, B or C': what the large parts of `use` grow with, the
    largest part first, and `more`."""
    cfg, pictures = settings.algo, ["env.vision_size"] * sees_pictures(env, settings)
    envs = ["num_envs"] * hasattr(cfg, "num_envs")
    grow_with = (
        [*envs, *named(cfg, NETWORKS)],
        ["algo.replay_size", *pictures],
        ["data set"],
        working_sizes(cfg, pictures, envs),
    )
    parts = sorted(zip(use, grow_with, strict=True), key=lambda part: -part[0])
    names = [x for size, group in parts if size >= LEAST_PART * use.total for x in group] + [*more]
    if len(settings.configs) > 1:
        names.append("max_parallel")
    elif settings.train.num_seeds > 1:
        names.append("num_seeds")
    *others, last = dict.fromkeys(names or ["num_envs"])
    return f"a smaller {', '.join(others)}{' or ' * bool(others)}{last}"


def working_sizes(cfg: Any, pictures: list[str], envs: list[str]) -> list[str]:
    """What the arrays between an update's operations grow with, what helps most first.

    Gradient steps and acting take turns, so the larger one counts. With a world model its rows tell
    which: AMBS with its authors' settings and pictures, compiled for a CPU, takes half as much with
    half the `batch_size`. It takes the same with an eighth of the `shield_rollouts`, or with half as
    many environments.
    """
    horizon = ["algo.horizon"] * isinstance(cfg, OnPolicyConfig)
    learning, acting = [*named(cfg, LEARNING), *horizon, *pictures], [*named(cfg, ACTING), *envs]
    if isinstance(cfg, WorldModelConfig):
        tried = math.prod(getattr(cfg, name, 1) for name in ACTING)
        return learning if cfg.batch_size * cfg.imagine_steps > cfg.num_envs * tried else acting
    return learning + acting


def named(cfg: Any, sizes: Sequence[str]) -> list[str]:
    """Those of `sizes` that an algorithm has, as options."""
    return [f"algo.{name}" for name in sizes if hasattr(cfg, name)]


def kept_by(program: Program) -> Use:
    """What a program keeps from one update to the next."""
    like = jax.eval_shape(program.init, program.start, program.shared())
    devices = program.sharding.num_devices
    state = sum(x.size * x.dtype.itemsize for x in checkpoint.as_data(like).values()) / devices
    replay = checkpoint.replay_bytes(like) / devices
    return Use(state - replay, replay, sum(x.nbytes for x in jax.tree.leaves(program.data)))


def use_of(update: Any, program: Program) -> Use:
    """What a program and its compiled update take. The new train state has the place of the old one,
    which is donated, as far as XLA says so."""
    used = update.memory_analysis()
    beside = used.output_size_in_bytes - used.alias_size_in_bytes
    return kept_by(program)._replace(work=used.temp_size_in_bytes + beside)


def capacity(program: Program) -> int:
    """How many of its members fit the memory at once, by the compiled update's own account."""
    like = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=program.sharding),
        jax.eval_shape(program.init, program.start, program.shared()),
    )
    use = use_of(programs.compiled(program, like), program)
    gc.collect()  # arrays of the group before may wait for it
    room = PROGRAM_SHARE * device_memory()[0] - use.data  # which they share
    share = room / (use.total - use.data)  # of the members
    return max(1, int(min(1.0, share) * len(program.members)))


def device_memory() -> tuple[float, str]:
    """Bytes that the first device can still hold, and what to call it; infinite where unknown."""
    stats = jax.local_devices()[0].memory_stats() if jax.default_backend() != "cpu" else None
    if stats and "bytes_limit" in stats:
        return float(stats["bytes_limit"] - stats["bytes_in_use"]), "the device"
    return checkpoint.host_memory(), "this machine"

"""A run from its settings to its folder: where it trains, that it fits, and the training itself."""

import contextlib
import datetime
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import jaxsafe
from jaxsafe.config import ConfigError, flat
from jaxsafe.envs.wrap import innermost
from jaxsafe.nvidia import warp_problem
from jaxsafe.run import checkpoint, clock, dataset, distributed, files, loop, memory, run_folder
from jaxsafe.run.devices import check_devices, device_name, use_compilation_cache
from jaxsafe.run.evaluate import TRAINING, keys_of_episodes, make_training_evaluation
from jaxsafe.run.interrupts import Interrupts
from jaxsafe.run.loggers import Callback, check_logger, wandb_callback
from jaxsafe.run.plain import differences
from jaxsafe.run.policies import warm_start
from jaxsafe.run.programs import Program, build
from jaxsafe.run.progress import Reporter
from jaxsafe.run.settings import (
    NOT_COMPARED,
    Settings,
    TrainConfig,
    algo_options,
    as_options,
    make_env,
    preset_for,
    settings_of_run,
    unusual_in_words,
)
from jaxsafe.types import Env


class Session(NamedTuple):
    """A run that can start."""

    settings: Settings
    folder: Path
    env: Env
    program: Program
    resume_command: str  # the command that continues it
    callbacks: tuple[Callback, ...] = ()  # called with the metrics of each iteration


Finish = Callable[[Session, Reporter, Interrupts], None]  # what follows training


def choose_folder(settings: Settings, job: int | None, say: Callable[[str], None]) -> Path:
    """The folder to train in. `job` is the number of a multirun's job.

    Raises:
        ConfigError: it holds another run, or this one and `resume` is not set, it is beyond the end
            that is asked for or it has lost its checkpoints; or `resume` and `run_dir` are two folders.
    """
    train = settings.train
    if isinstance(train.resume, str):
        folder = Path(train.resume).expanduser()
        check_same_run(settings, folder)
        saved = run_folder.read_config(folder).get("run_dir")  # another one, if the folder has moved
        given = folder if train.run_dir in (None, saved) else Path(train.run_dir).expanduser()
        if given.absolute() != folder.absolute():
            raise ConfigError(f"run_dir={given}: resume={folder} goes on in that folder; give one")
        check_goes_on(folder, train, say)
        return folder
    home = Path("runs") / settings.label
    if train.run_dir is None:
        if train.resume:
            for folder in sorted((p.parent for p in home.glob("*/config.yaml")), reverse=True):
                done = run_folder.newest_progress(folder)
                if (done is None or not clock.ended(train, done)) and is_same_run(settings, folder):
                    return folder
            say(f"no unfinished run of this command in {home}: starting one")
        name = f"{datetime.datetime.now():%Y%m%d-%H%M%S}-seed{train.seed}"
        name += "" if job is None else f"-job{job}"  # jobs may start at the same time
        taken = (home / (f"{name}-{i}" if i else name) for i in range(10**6))
        return next(path for path in taken if not path.exists())
    folder = Path(train.run_dir).expanduser()
    if job is not None:
        folder = folder / str(job)
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"run_dir={folder} is not a folder")
    if files.there(folder / "config.yaml") and train.resume:
        check_same_run(settings, folder)
        check_goes_on(folder, train, say)
    elif any(checkpoint.checkpoints(files.inside(folder, x)) for x in ("checkpoints", "policy")):
        raise ConfigError(
            f"{folder} already holds a run: continue it with resume=true, or choose another run_dir"
        )
    elif train.resume:
        say(f"nothing to resume in {folder}: starting there")
    return folder


def check_goes_on(folder: Path, train: TrainConfig, say: Callable[[str], None]) -> None:
    """Raise ConfigError if the run in `folder` is beyond the end that `train` has, or has lost its
    checkpoints. One that was killed before its first has none yet, and starts from the beginning."""
    if done := run_folder.newest_progress(folder):
        clock.check_end(train, done, folder)
    store, policies = (
        checkpoint.checkpoints(files.inside(folder, x)) for x in ("checkpoints", "policy")
    )
    if policies and not store:
        raise ConfigError(
            f"{folder} has no checkpoint to go on from, only a policy; init_from={folder} begins a new "
            "run with it"
        )
    if not store:
        say(f"no checkpoint in {folder} yet: starting from the beginning")


def agree_on_folder(settings: Settings, job: int | None, say: Callable[[str], None]) -> Path:
    """`choose_folder` of process 0, for all processes.

    Raises:
        ConfigError: as there, or this process has other settings, or another data set, than process 0.
    """
    if jax.process_count() == 1:
        return choose_folder(settings, job, say)
    mine = flat(settings.plain())
    if settings.train.dataset is not None:
        mine["the data set's SHA-256"] = dataset.sha256(settings.train.dataset)
    folder = choose_folder(settings, job, say) if distributed.leads() else ""
    folder, theirs = json.loads(distributed.text_from_process_0(json.dumps([str(folder), mine])))
    for name, (here, there) in differences(mine, theirs).items():
        raise ConfigError(f"{name}={here} in this process, {there} in process 0")
    return Path(folder)


def check_same_run(settings: Settings, folder: Path) -> None:
    """Raise ConfigError if the run in `folder` has other settings than these."""
    saved = flat(settings_of_run(run_folder.read_config(folder), settings.extras).plain())
    free = {*NOT_COMPARED, "num_envs"}  # algo.num_envs has that number, too
    if settings.num_members > 1:
        free.add("devices")  # each member is whole on one of them
    path, known = settings.train.dataset, run_folder.dataset_of(folder)
    if path is not None and known:
        if dataset.sha256(path) != known:
            raise ConfigError(f"dataset={path} is not the file that {folder} was trained with")
        free.add("dataset")  # the same file may have moved
    for name, (here, there) in differences(flat(settings.plain()), saved).items():
        if name not in free:
            raise ConfigError(
                f"{name}={here} but {folder} was trained with {there}; resume={folder} goes on with "
                f"its settings, and init_from={folder} begins a new run with its policy"
            )


def is_same_run(settings: Settings, folder: Path) -> bool:
    try:
        check_same_run(settings, folder)
    except ConfigError:
        return False
    return True


def prepare(settings: Settings) -> tuple[Env, Program]:
    """The environment and the program to train, not yet compiled.

    Raises:
        ConfigError: sizes that do not fit each other, the devices or, as memory.TooLarge, the memory.
    """
    train = settings.train
    use_compilation_cache()
    check_devices(train.devices)
    check_logger(train.logger)
    env = make_env(settings)
    with as_options(settings.row):
        memory.check_memory(env, settings)
        data: Any = ()
        if train.dataset is not None:
            data = dataset.read_dataset(train.dataset, env.episode_length)
        for cfg in settings.configs:
            settings.row.check(cfg, env, data)
        program = build(env, settings.row.make, settings.configs, train, data)
        memory.check_state_memory(program, env, settings)
    return env, program


def about_replay(program: Program, train: TrainConfig) -> str:
    """How large the replay of a seed is, and what a resumed run does without it; '' of none."""
    like = jax.eval_shape(program.init, program.start, program.shared())
    size = checkpoint.replay_bytes(like)
    if not size:
        return ""
    rows = next(x for name, x in checkpoint.as_data(like).items() if checkpoint.in_replay(name))
    each = math.prod(rows.shape[:3]) // len(program.members)  # [members or devices, N, R, ...]
    line = f"replay of {each:,} transitions a seed, {size / 1e9:.2f} GB in all"
    if checkpoint.keeps_replay(like, train.checkpoint_replay):
        return line
    return f"{line}, not kept in checkpoints: a resumed run first fills it anew with its policy"


def run(session: Session, report: Reporter, finish: Finish) -> int:
    """Train, then `finish`. Returns the exit status: 0, or 130 if the user stopped it.

    Raises:
        ConfigError: another process is training in the folder; memory.TooLarge: an update cannot fit.
        memory.OutOfMemory: the memory was too small all the same.
        divergence.Diverged: the run learns no more.
    """
    hooks = hooks_of(session, report)  # what it refuses leaves no folder
    with held(session.folder) if distributed.leads() else contextlib.nullcontext():
        return run_alone(session, report, finish, hooks)


def held(folder: Path) -> contextlib.AbstractContextManager[None]:
    """`files.held` of a run folder, which is made if it is not there.

    Raises:
        checkpoint.NotSaved: the disk failed.
        ConfigError: as there.
    """
    with checkpoint.writing_to(folder):
        folder.mkdir(parents=True, exist_ok=True)
    return files.held(folder)


def run_alone(session: Session, report: Reporter, finish: Finish, hooks: loop.Hooks) -> int:
    settings, program, train = session.settings, session.program, session.settings.train
    if distributed.leads():
        write_head(session)
        if train.logger == "wandb":
            to_wandb = wandb_callback(session.folder, settings.plain(), program.members)
            hooks = hooks._replace(callbacks=(*hooks.callbacks, to_wandb))
    report.line(greeting(session))
    for line in filter(None, (about_preset(settings), about_cpu(settings))):
        report.line(line)
    for line in dict.fromkeys(filter(None, map(settings.row.note, settings.configs))):
        report.line(line)
    if line := about_replay(program, train):
        report.line(line)
    env = settings.plain()["env"]
    if train.dataset is not None:
        odd = dataset.oddities(train.dataset, program.data)
        for line in filter(None, (dataset.other_task(train.dataset, env), *odd)):
            report.line(line)
    with memory.watched(program, session.env, settings) as check:
        stopped = loop.train(program, train, session.folder, report, hooks._replace(check=check))
    distributed.part()
    if stopped:
        return 130
    if not distributed.leads():
        return 0
    with Interrupts(report.line, report.hosted) as stop:
        if not report.hosted:
            stop.nothing_to_save = (
                f"stopped; the training is saved, and for what is left {session.resume_command}"
            )
        finish(session, report, stop)
    report.line(f"run folder: {session.folder}")
    return 0


def hooks_of(session: Session, report: Reporter) -> loop.Hooks:
    """What the session adds to the loop."""
    settings, train = session.settings, session.settings.train
    hooks = loop.Hooks(
        session.resume_command,
        about=lambda m: unusual_in_words(settings._replace(configs=(m.config,))),
        callbacks=session.callbacks,
    )
    if train.eval_every:
        algo = settings.row.make(session.env, None)
        many = len(settings.configs)
        keys = keys_of_episodes(TRAINING, train.eval_episodes, train.seeds, many)
        hooks = hooks._replace(evaluate=make_training_evaluation(algo, keys))
    begun = run_folder.newest_progress(session.folder) is not None
    if train.init_from is not None and not distributed.from_process_0(np.array(begun)):
        hooks = hooks._replace(adapt=warm_start(settings, session.program, report.line))
    return hooks


def engine_of(env: Env) -> str | None:
    """What computes the physics of an environment; None where it has no engine."""
    return getattr(innermost(env), "engine", None)


def write_head(session: Session) -> None:
    """What a run folder has before the first iteration.

    Raises:
        checkpoint.NotSaved: the disk failed.
    """
    folder, train = session.folder, session.settings.train
    with checkpoint.writing_to(folder):
        run_folder.write_config(folder, session.settings.plain())
        data = None if train.dataset is None else dataset.sha256(train.dataset)
        run_folder.append_versions(folder, device_name(), engine_of(session.env), data)


def about_preset(settings: Settings) -> str:
    """That the task has defaults of its own, if these are they; else ''."""
    preset = settings.train.preset
    if preset == "fast" or preset != preset_for(settings.env_name, settings.row):
        return ""
    return f"preset={preset}, which suits {settings.env_name}; preset=fast has the general defaults"


def about_cpu(settings: Settings) -> str:
    """On a CPU: that there are settings for it, if these are the defaults; else ''."""
    meant = settings.row.published.get("cpu")
    if jax.default_backend() != "cpu" or not meant:
        return ""
    defaults = algo_options(settings.row, preset_for(settings.env_name, settings.row))
    if any(getattr(settings.algo, name) != defaults[name] for name in meant):
        return ""
    return "the defaults are for a GPU; preset=cpu is for two cores and half an hour"


def greeting(session: Session) -> str:
    """What trains where, in one line."""
    settings, train = session.settings, session.settings.train
    several = f"{len(settings.configs)} settings x " if len(settings.configs) > 1 else ""
    seeds = f"{train.num_seeds} seed{'s' if train.num_seeds > 1 else ''}"
    seeds += f" x {settings.algo.num_envs} envs" if session.program.clocks.steps else ""
    where = device_name() + (f" x {train.devices}" if train.devices > 1 else "")
    if jax.process_count() > 1:
        where += f" in {jax.process_count()} processes"
    engine = engine_of(session.env)
    where += f", engine {engine}" if engine else ""
    kernels = {
        "warp": ", and a minute of Warp's kernels the first time",
        "c": ", 15 to 60 s at every start of engine c",
    }.get(engine or "", "")
    if engine == "jax" and "NVIDIA" in device_name() and (problem := warp_problem()):
        where += f" (warp would be faster, but {problem})"
    return (
        f"jaxsafe {jaxsafe.__version__} | {settings.env_name} | {settings.algo_name} | "
        f"{several}{seeds} | {where} | compiling rollout and update{kernels} ..."
    )

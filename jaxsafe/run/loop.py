"""The training loop: compile once, call `update`, log, checkpoint, stop when asked.

The loop stays one update ahead of what is logged, in a thread, so the device does not wait for files.
"""

import contextlib
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxsafe.learn.constraints import limits_by_name
from jaxsafe.run import checkpoint, clock, distributed, divergence, files, programs
from jaxsafe.run.divergence import Diverged
from jaxsafe.run.evaluate import COLUMNS
from jaxsafe.run.interrupts import Interrupts
from jaxsafe.run.log import Log
from jaxsafe.run.loggers import Callback
from jaxsafe.run.programs import Member, Program
from jaxsafe.run.progress import Reporter
from jaxsafe.run.settings import TrainConfig
from jaxsafe.types import PyTree


class Hooks(NamedTuple):
    """What a session adds to the loop.

    adapt(ts) -> ts changes a fresh train state, to start from another policy; not used on resumption.
    evaluate(params) -> {name: [M]} measures the policies of all members, for the columns
        `evaluate.COLUMNS`; process 0 calls it. None: they are not measured.
    about(member) says what is unusual in the settings of a member that diverged.
    callbacks(clock, metrics) are called by process 0 once the files have an iteration.
    """

    adapt: Callable[[PyTree], PyTree] = lambda ts: ts
    evaluate: Callable[[PyTree], dict[str, np.ndarray]] | None = None
    about: Callable[[Member], str] = str
    callbacks: tuple[Callback, ...] = ()


class Outcome(NamedTuple):
    ts: PyTree
    iteration: int
    interrupted: bool


def train(
    program: Program,
    train_cfg: TrainConfig,
    folder: Path,
    report: Reporter,
    resume_command: str,
    hooks: Hooks = Hooks(),  # noqa: B008
) -> Outcome:
    """Train to the end that `train_cfg` gives, from the newest checkpoint in `folder` if there is one.

    Args:
        program: from `build`.
        train_cfg: those it was built with.
        folder: the run folder; gets metrics.csv, tensorboard/ and checkpoints/.
        report: where progress goes.
        resume_command: printed when the run is stopped early.
        hooks: what is done beside.
    Returns:
        The train state, with its leading axis, and how far it is.
    Raises:
        checkpoint.CheckpointError, OSError: the disk failed; the last good checkpoint stays.
        divergence.Diverged: no member learns any more; likewise.
    """
    iterations, unit = clock.iterations(train_cfg, program.clocks), clock.unit(program.clocks)
    store, acting_store = files.inside(folder, "checkpoints"), files.inside(folder, "policy")
    resuming = bool(distributed.from_process_0(np.array(bool(checkpoint.checkpoints(store)))))
    with report, Interrupts(report.line, report.hosted) as stop:
        stop.nothing_to_save = (
            f"stopped before the first update; {resume_command if resuming else 'nothing to save'}"
        )
        begun = time.perf_counter()
        iteration = since = 0
        program = program._replace(data=distributed.place(program.data, program.everywhere))
        like = jax.eval_shape(program.init, program.start, program.shared())
        keeps_replay = checkpoint.keeps_replay(like, train_cfg.checkpoint_replay)
        if resuming:
            ts, iteration, since = restored(store, like, report)
            # the run may have a new end, from which rates that decay are counted
            ts = dataclasses.replace(ts, config=program.start[1])
            ts = distributed.place(ts, program.sharding)
            empty = ", with an empty replay" if iteration and since == iteration else ""
            report.line(f"resuming at {unit.at(iteration):,} {unit.name}{empty}")
        else:
            start = distributed.place(program.start, program.sharding)
            ts = jax.jit(program.init)(start, program.shared())
            ts = distributed.place(hooks.adapt(ts), program.sharding)
        if iteration >= iterations:
            report.line("nothing left to train")
            return Outcome(ts, iteration, False)
        names = sorted(jax.eval_shape(program.update, ts, program.shared())[1])
        names += COLUMNS if hooks.evaluate else ()
        update = programs.compiled(program, ts)
        report.line(f"compiled in {time.perf_counter() - begun:.1f} s")
        stop.nothing_to_save = ""

        vote, health = distributed.Vote(program.sharding), jax.jit(divergence.health)
        watch = divergence.Watch(program.members, hooks.about)
        with (
            Log(
                folder,
                names,
                program.members,
                iteration,
                program.clocks,
                report,
                watch,
                hooks.callbacks,
            )
            if distributed.leads()
            else contextlib.nullcontext()
        ) as log:
            limits = [m.algo.cost_limit for m in program.members if not limits_by_name(m.algo)]
            report.start(unit.at(iterations), unit.at(iteration), limits, unit.name)
            saved_at, pause, evaluated = time.perf_counter(), train_cfg.checkpoint_every, False
            while iteration < iterations:
                ts, metrics = update(ts, program.shared(iteration, since))
                found = health(program.params(ts))
                (metrics, found), iteration = distributed.whole((metrics, found)), iteration + 1
                due = unit.crosses(train_cfg.eval_every, iteration) or iteration == iterations
                if hooks.evaluate and due:
                    acting = distributed.whole(program.params(ts))
                    if log and not evaluated:
                        report.line(
                            f"compiling the evaluation of {train_cfg.eval_episodes} episodes ..."
                        )
                        evaluated = True
                    if log:
                        metrics |= hooks.evaluate(of_members(program, acting))
                if log:
                    log.append(iteration, metrics, found)
                by_count = (
                    train_cfg.checkpoint_iterations and iteration % train_cfg.checkpoint_iterations == 0
                )
                late = time.perf_counter() - saved_at >= pause
                stopping, by_time, over = vote(stop.requested, late, watch.over)
                if over:
                    break
                if stopping or by_count or by_time or iteration == iterations:
                    saving = time.perf_counter()
                    state = distributed.whole(ts)
                    at = clock.after(iteration, program.clocks)
                    if log:
                        log.sync()
                    if log and not watch.over:
                        checkpoint.save(store, state, at, since, keeps_replay)
                        acting = of_members(program, program.params(state))
                        checkpoint.save(acting_store, acting, at)
                    saved_at = time.perf_counter()
                    if keeps_replay and checkpoint.replay_bytes(like):  # at most 5% of the time
                        pause = max(train_cfg.checkpoint_every, 19 * (saved_at - saving))
                if stopping:
                    break
        report.stop()
        if lost := distributed.text_from_process_0(watch.verdict):  # which alone watches
            raise Diverged(lost)
        interrupted = iteration < iterations
        if interrupted:
            done = f"{unit.at(iteration):,} {unit.name}"
            report.line(f"stopped at {done}; continue with: {resume_command}")
    return Outcome(ts, iteration, interrupted)


def of_members(program: Program, params: PyTree) -> PyTree:
    """The policy's parameters of each member, [M, ...], on one device.

    A member that is split over devices has equal copies; the first is taken.
    """
    own = jax.tree.map(lambda x: x[: len(program.members)], params)
    return jax.device_put(own, jax.local_devices()[0])


def restored(store: Path, like: PyTree, report: Reporter) -> tuple[PyTree, int, int]:
    """The train state of the newest sound checkpoint that process 0 finds, its iteration, and the one
    from which on its replay holds everything."""
    if jax.process_count() == 1:
        ts, manifest = checkpoint.restore(store, like, report.line)
        return ts, manifest.at.iteration, manifest.since
    arrays = {name: np.zeros(x.shape, x.dtype) for name, x in checkpoint.as_data(like).items()}
    numbers = np.zeros(2, int)
    if distributed.leads():
        ts, manifest = checkpoint.restore(store, like, report.line)
        arrays = checkpoint.to_arrays(ts)
        numbers = np.array([manifest.at.iteration, manifest.since])
    arrays, (iteration, since) = distributed.from_process_0((arrays, numbers))
    return checkpoint.from_arrays(like, arrays), int(iteration), int(since)

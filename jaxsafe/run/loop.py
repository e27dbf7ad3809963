"""The training loop: compile once, call `update`, log, checkpoint, stop when asked.

The loop stays one update ahead of what is logged, in a thread, so the device does not wait for files.
"""

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxsafe.learn.constraints import own_limits
from jaxsafe.run import checkpoint, clock, distributed, spread
from jaxsafe.run.evaluate import COLUMNS
from jaxsafe.run.interrupts import Interrupts
from jaxsafe.run.log import Log
from jaxsafe.run.progress import Report
from jaxsafe.run.settings import TrainConfig
from jaxsafe.run.spread import Program
from jaxsafe.types import PyTree


class Hooks(NamedTuple):
    """What a session adds to the loop.

    adapt(ts) -> ts changes a fresh train state, to start from another policy; not used on resumption.
    evaluate(params) -> {name: [M]} measures the policies of all members, for the columns
        `evaluate.COLUMNS`; process 0 calls it. None: they are not measured.
    """

    adapt: Callable[[PyTree], PyTree] = lambda ts: ts
    evaluate: Callable[[PyTree], dict[str, np.ndarray]] | None = None


class Outcome(NamedTuple):
    ts: PyTree
    iteration: int
    interrupted: bool


def train(
    program: Program,
    settings: TrainConfig,
    folder: Path,
    report: Report,
    resume_command: str,
    hooks: Hooks = Hooks(),  # noqa: B008
) -> Outcome:
    """Train to the end that `settings` gives, from the newest checkpoint in `folder` if there is one.

    Args:
        program: from `build`.
        settings: those it was built with.
        folder: the run folder; gets metrics.csv, tensorboard/ and checkpoints/.
        report: where progress goes.
        resume_command: printed when the run is stopped early.
        hooks: what is done beside.
    Returns:
        The train state, with its leading axis, and how far it is.
    Raises:
        checkpoint.CheckpointError, OSError: the disk failed; the last good checkpoint stays.
    """
    iterations, unit = clock.iterations(settings, program.clocks), clock.unit(program.clocks)
    store = folder / "checkpoints"
    resuming = bool(distributed.first(np.array(bool(checkpoint.checkpoints(store)))))
    with report, Interrupts(report.line, report.hosted) as stop:
        stop.nothing_to_save = (
            f"stopped before the first update; {resume_command if resuming else 'nothing to save'}"
        )
        begun = time.perf_counter()
        iteration = since = 0
        program = program._replace(data=distributed.place(program.data, program.everywhere))
        like = jax.eval_shape(program.init, program.start, program.shared())
        keeps_replay = checkpoint.keeps_replay(like, settings.checkpoint_replay)
        if resuming:
            ts, iteration, since = restored(store, like, report)
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
        update = spread.compiled(program, ts)
        report.line(f"compiled in {time.perf_counter() - begun:.1f} s")
        stop.nothing_to_save = ""

        vote = distributed.Vote(program.sharding)
        with (
            Log(folder, names, program.members, iteration, program.clocks, report)
            if distributed.leads()
            else contextlib.nullcontext()
        ) as log:
            limits = [m.algo.cost_limit for m in program.members if not own_limits(m.algo)]
            report.start(unit.at(iterations), unit.at(iteration), limits, unit.name)
            saved_at, pause = time.perf_counter(), settings.checkpoint_every
            while iteration < iterations:
                ts, metrics = update(ts, program.shared(iteration, since))
                metrics, iteration = distributed.whole(metrics), iteration + 1
                due = unit.crosses(settings.eval_every, iteration) or iteration == iterations
                if hooks.evaluate and due:
                    acting = distributed.whole(program.params(ts))
                    if log:
                        metrics |= hooks.evaluate(of_members(program, acting))
                if log:
                    log.append(iteration, metrics)
                by_count = (
                    settings.checkpoint_iterations and iteration % settings.checkpoint_iterations == 0
                )
                late = time.perf_counter() - saved_at >= pause
                stopping, by_time = vote(stop.requested, late)
                if stopping or by_count or by_time or iteration == iterations:
                    saving = time.perf_counter()
                    state = distributed.whole(ts)
                    at = clock.after(iteration, program.clocks)
                    if log:
                        log.sync()
                        checkpoint.save(store, state, at, since, keeps_replay)
                        acting = of_members(program, program.params(state))
                        checkpoint.save(folder / "policy", acting, at)
                    saved_at = time.perf_counter()
                    if keeps_replay and checkpoint.replay_bytes(like):  # at most 5% of the time
                        pause = max(settings.checkpoint_every, 19 * (saved_at - saving))
                if stopping:
                    break
        report.stop()
        interrupted = iteration < iterations
        if interrupted:
            done = f"{unit.at(iteration):,} {unit.name}"
            report.line(f"stopped at {done}; continue with: {resume_command}")
    return Outcome(ts, iteration, interrupted)


def of_members(program: Program, params: PyTree) -> PyTree:
    """What acts of each member, [M, ...], on one device: a split one has a copy on each of its own."""
    own = jax.tree.map(lambda x: x[: len(program.members)], params)
    return jax.device_put(own, jax.local_devices()[0])


def restored(store: Path, like: PyTree, report: Report) -> tuple[PyTree, int, int]:
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
    arrays, (iteration, since) = distributed.first((arrays, numbers))
    return checkpoint.from_arrays(like, arrays), int(iteration), int(since)

"""The training loop: compile once, call `update`, log, checkpoint, stop when asked.

A thread logs an update while the device computes the next one, so the device does not wait for files.
"""

import contextlib
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxsafe.learn.constraints import limits_by_name
from jaxsafe.run import checkpoint, clock, distributed, divergence, files, programs, run_folder
from jaxsafe.run.devices import jit_once
from jaxsafe.run.divergence import Diverged
from jaxsafe.run.evaluate import COLUMNS
from jaxsafe.run.interrupts import Interrupts
from jaxsafe.run.log import Log, Outputs
from jaxsafe.run.loggers import Callback
from jaxsafe.run.programs import Member, Program
from jaxsafe.run.progress import Reporter
from jaxsafe.run.settings import TrainConfig
from jaxsafe.types import PyTree


class Hooks(NamedTuple):
    """What a session adds to the loop.

    resume_command: the command that continues the run, printed when it is stopped early.
    check(update) looks at the compiled update before it runs.
    adapt(ts) -> ts changes a fresh train state, to start from another policy; not used on resumption.
    evaluate(learned) -> {name: [M]} measures the policies of all members, for the columns
        `evaluate.COLUMNS`; process 0 calls it. None: they are not measured.
    about(member) says what is unusual in the settings of a member that diverged.
    callbacks(clock, metrics) are called by process 0 once the files have an iteration.
    """

    resume_command: str
    check: Callable[[Any], None] = lambda update: None
    adapt: Callable[[PyTree], PyTree] = lambda ts: ts
    evaluate: Callable[[PyTree], dict[str, np.ndarray]] | None = None
    about: Callable[[Member], str] = str
    callbacks: tuple[Callback, ...] = ()


class Start(NamedTuple):
    """Where the loop begins: a train state, its iteration, and that from which its replay is whole."""

    ts: PyTree
    iteration: int = 0
    since: int = 0


def train(
    program: Program, train_cfg: TrainConfig, folder: Path, report: Reporter, hooks: Hooks
) -> bool:
    """Train to the end that `train_cfg` gives, from the newest checkpoint in `folder` if there is one.

    Args:
        program: from `build`.
        train_cfg: those it was built with.
        folder: the run folder; gets metrics.csv, tensorboard/, checkpoints/ and policy/, and
            diverged.json if a member diverges.
        report: where progress goes.
        hooks: what the session adds.
    Returns:
        Whether the user stopped it before the end.
    Raises:
        checkpoint.NotSaved, OSError: the disk failed; the last good checkpoint stays.
        divergence.Diverged: no member learns any more; likewise.
        memory.TooLarge: by `hooks.check`, an update cannot fit the memory.
    """
    iterations, unit = clock.iterations(train_cfg, program.clocks), clock.unit(program.clocks)
    store = files.inside(folder, "checkpoints")
    resuming = bool(distributed.from_process_0(np.array(bool(checkpoint.checkpoints(store)))))
    with report, Interrupts(report.line, report.hosted) as stop:
        nothing = hooks.resume_command if resuming or train_cfg.resume else "nothing to save"
        stop.nothing_to_save = f"stopped before the first update; {nothing}"
        begun = time.perf_counter()
        program = program._replace(data=distributed.place(program.data, program.everywhere))
        start = resumed(program, store, report) if resuming else fresh(program, hooks)
        if start.iteration >= iterations:
            report.line("nothing left to train")
            Saver(folder, program, train_cfg, start).save_lost_policies(start.ts, start.iteration)
            return False
        names = sorted(jax.eval_shape(program.update, start.ts, program.shared())[1])
        names += COLUMNS if hooks.evaluate else ()
        update = programs.compiled(program, start.ts)
        jax.block_until_ready(start.ts)  # so that a check of the memory finds it there
        hooks.check(update)
        spent = time.perf_counter() - begun
        report.line(f"compiled in {spent:.1f} s; an iteration is {unit.each:,} {unit.name}")
        stop.nothing_to_save = ""

        leads = distributed.leads()
        lost = divergence.lost_by(folder, start.iteration) if leads else []
        watch = divergence.Watch(program.members, hooks.about, lost)
        outputs = Outputs(folder, report, watch, hooks.callbacks)
        with (
            Log(outputs, program, names, start.iteration) if leads else contextlib.nullcontext() as log
        ):
            limits = [m.config.cost_limit for m in program.members if not limits_by_name(m.config)]
            report.start(unit.at(iterations), unit.at(start.iteration), limits, unit.name)
            saver = Saver(folder, program, train_cfg, start)
            vote, health = distributed.Vote(program.sharding), jax.jit(divergence.health)
            (ts, iteration, since), evaluated = start, False
            del start  # the first update takes its arrays
            while iteration < iterations:
                ts, metrics = update(ts, program.shared(iteration, since))
                found = health(program.learned(ts))
                (metrics, found), iteration = distributed.whole((metrics, found)), iteration + 1
                due = unit.crosses(train_cfg.eval_every, iteration) or iteration == iterations
                if hooks.evaluate and due:
                    learned = distributed.whole(program.learned(ts))
                    if log and not evaluated:
                        episodes = train_cfg.eval_episodes
                        report.line(f"compiling the evaluation of {episodes} episodes ...")
                        evaluated = True
                    if log:
                        metrics |= hooks.evaluate(of_members(program, learned))
                if log:
                    log.append(iteration, metrics, found)
                stopping, late, over = vote(stop.requested, saver.late(), watch.over)
                if over:
                    break
                if stopping or late or saver.at_count(iteration) or iteration == iterations:
                    saver.save(ts, iteration, log)
                if stopping:
                    break
        report.stop()
        if lost := distributed.text_from_process_0(watch.verdict):  # which alone watches
            raise Diverged(lost)
        stopped = iteration < iterations
        if stopped:
            done = f"{unit.at(iteration):,} {unit.name}"
            report.line(f"stopped at {done}; continue with: {hooks.resume_command}")
    return stopped


def fresh(program: Program, hooks: Hooks) -> Start:
    """The train state before the first update."""
    given = distributed.place(program.start, program.sharding)
    ts = jit_once(program.init)(given, program.shared())
    return Start(distributed.place(hooks.adapt(ts), program.sharding))


def resumed(program: Program, store: Path, report: Reporter) -> Start:
    """The train state of the newest sound checkpoint in `store`."""
    like = jax.eval_shape(program.init, program.start, program.shared())
    ts, iteration, since = restored(store, like, report)
    # the run may have a new end, from which rates that decay are counted
    ts = dataclasses.replace(ts, config=program.start[1])
    unit = clock.unit(program.clocks)
    empty = ", with an empty replay" if iteration and since == iteration else ""
    report.line(f"resuming at {unit.at(iteration):,} {unit.name}{empty}")
    return Start(distributed.place(ts, program.sharding), iteration, since)


class Saver:
    """When the loop saves, and what.

    Args:
        folder: the run folder.
        program, train_cfg: the run's.
        start: where the loop began.
    """

    def __init__(self, folder: Path, program: Program, train_cfg: TrainConfig, start: Start):
        self.program, self.since = program, start.since
        self.store, self.policies = (files.inside(folder, name) for name in ("checkpoints", "policy"))
        self.every, self.count = train_cfg.checkpoint_every, train_cfg.checkpoint_iterations
        self.keeps_replay = checkpoint.keeps_replay(start.ts, train_cfg.checkpoint_replay)
        self.saves_replay = self.keeps_replay and checkpoint.replay_bytes(start.ts) > 0
        self.pause, self.saved_at = self.every, time.perf_counter()

    def late(self) -> bool:
        """Whether the last checkpoint is old enough for another one."""
        return time.perf_counter() - self.saved_at >= self.pause

    def at_count(self, iteration: int) -> bool:
        """Whether a checkpoint was asked for at this iteration."""
        return self.count > 0 and iteration % self.count == 0

    def save(self, ts: PyTree, iteration: int, log: Log | None) -> None:
        """Write a checkpoint and the policies, once all rows are on the disk.

        All processes call it. The one with a log writes, unless the run turns out to have diverged.
        """
        begun = time.perf_counter()
        state = distributed.whole(ts)
        at = clock.after(iteration, self.program.clocks)
        if log:
            log.sync()
        if log and not log.watch.over:
            checkpoint.save(self.store, state, at, self.since, self.keeps_replay)
            self.save_policies(state, at)
        self.saved_at = time.perf_counter()
        if self.saves_replay:
            self.pause = pause_after(self.saved_at - begun, self.every)

    def save_policies(self, state: PyTree, at: checkpoint.Progress) -> None:
        checkpoint.save(self.policies, of_members(self.program, self.program.learned(state)), at)

    def save_lost_policies(self, ts: PyTree, iteration: int) -> None:
        """The policies of the last checkpoint, if the process was killed before it wrote them."""
        state, at = distributed.whole(ts), clock.after(iteration, self.program.clocks)
        saved = run_folder.newest_progress(self.policies.parent, self.policies.name)
        if distributed.leads() and (saved is None or saved.iteration < at.iteration):
            self.save_policies(state, at)


def pause_after(took: float, every: float) -> float:
    """Seconds to the next checkpoint after one with a replay: `every` or more, so that they take at
    most 5% of the time. One that a slow disk held up puts the next off by half an hour at most."""
    return max(every, min(19 * took, 1800.0))


def of_members(program: Program, learned: PyTree) -> PyTree:
    """What the policy of each member has learned, [M, ...], on one device.

    A member that is split over devices has equal copies; the first is taken.
    """
    rows = jax.tree.map(lambda x: x[: len(program.members)], learned)
    return jax.device_put(rows, jax.local_devices()[0])


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

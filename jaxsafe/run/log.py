"""Where the metrics of training go: metrics.csv, TensorBoard and the progress report."""

import contextlib
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxsafe.learn.metrics import BAD
from jaxsafe.run import clock, files, run_folder
from jaxsafe.run.divergence import KINDS, Health, Watch, write_lost
from jaxsafe.run.loggers import Callback, WandbRun
from jaxsafe.run.programs import Member, Program
from jaxsafe.run.progress import Reporter

OVERFLOW = "train/overflow"  # steps of an episode in which engine warp ran out of room
SHOWN = {  # what the progress report shows: the first of these that is known
    "ret": ("train/return_estimate", "eval/return"),
    "cost": ("train/cost_estimate", "eval/cost"),
    "lam": ("train/nu", "train/lam"),  # of CPO nu is the price, and lam the trust region's
}
UNKNOWN = np.full(1, np.nan)


class Outputs(NamedTuple):
    """Where the metrics of an iteration go."""

    folder: Path  # the run folder, for metrics.csv and TensorBoard's files
    report: Reporter
    watch: Watch
    callbacks: Sequence[Callback] = ()


class Log:
    """Metrics to metrics.csv, TensorBoard and the progress report, the files by a thread.

    What goes wrong in the thread is raised by the next call.

    Args:
        outputs: where metrics go.
        program: whose metrics they are.
        names: of the metrics, which are columns of metrics.csv.
        iteration: how far the run is; later rows of an earlier start are dropped.
    """

    def __init__(self, outputs: Outputs, program: Program, names: list[str], iteration: int):
        self.folder, self.report, self.watch, self.callbacks = outputs
        members, self.clocks = program.members, program.clocks
        self.warned_of_bad = self.warned_of_overflow = False
        self.seeds, self.unit = [m.seed for m in members], clock.unit(program.clocks)
        self.swept = {name: np.array([m.swept[name] for m in members]) for name in members[0].swept}
        self.csv = run_folder.Metrics(self.folder, [*self.swept, *names], iteration)
        self.begun = time.perf_counter() - self.csv.seconds
        self.boards = [
            run_folder.Board(
                files.make_folder(self.folder, *board_of(m)),
                self.unit.at(iteration),
            )
            for m in members
        ]
        self.runs = contextlib.ExitStack()  # of Weights & Biases
        self.thread = ThreadPoolExecutor(1)
        self.writing: Future[tuple[clock.Progress, dict[str, np.ndarray], Health]] | None = None

    def __enter__(self) -> "Log":
        for callback in self.callbacks:
            if isinstance(callback, WandbRun):
                self.runs.enter_context(callback)
        return self

    def __exit__(self, *error: Any) -> None:
        self.thread.shutdown()
        self.csv.close()
        for board in self.boards:
            board.close()
        self.runs.__exit__(*error)

    def append(self, iteration: int, metrics: dict[str, jax.Array], health: Health) -> None:
        """Begin to write the metrics of an iteration, once those of the last one are written."""
        self._finish()
        self.writing = self.thread.submit(self._write, iteration, metrics, health)

    def sync(self) -> None:
        """Put all that was appended on the disk."""
        self._finish()
        self.csv.sync()
        for board in self.boards:
            board.flush()

    def _write(
        self, iteration: int, metrics: dict[str, jax.Array], health: Health
    ) -> tuple[clock.Progress, dict[str, np.ndarray], Health]:
        values = {k: np.asarray(v, np.float32) for k, v in jax.device_get(metrics).items()}
        shown, seconds = self.unit.at(iteration), time.perf_counter() - self.begun
        at = clock.after(iteration, self.clocks)
        self.csv.append(at, self.seeds, seconds, values | self.swept)
        self.csv.ended |= bool((values.get("train/episodes", UNKNOWN) > 0).any())
        drawn = values | ({} if self.csv.ended else estimates(values))
        for s, board in enumerate(self.boards):
            board.append(shown, {name: float(value[s]) for name, value in drawn.items()})
        return at, values, jax.device_get(health)

    def _finish(self) -> None:
        if not self.writing:
            return
        writing, self.writing = self.writing, None
        at, values, health = writing.result()
        shown = self.unit.at(at.iteration)
        lines = self.watch(at.iteration, f"{shown:,} {self.unit.name}", values, health)
        if lines:
            write_lost(self.folder, self.watch.lost.values())
        for line in lines:
            if not self.watch.over:  # else the run ends, and says it
                self.report.line(f"warning: {line}; the others go on")
        if not self.warned_of_bad and (values.get(BAD[0], np.zeros(())) > 0).any():
            self.warned_of_bad = True
            kinds = [word for k, word in KINDS.items() if (values[f"train/bad_{k}"] > 0).any()]
            self.report.line(
                f"warning: {values[BAD[0]].sum():.0f} worlds had a step that is not finite "
                f"({', '.join(kinds)}) by {shown:,} {self.unit.name}; such worlds are reset, and the "
                f"step does not count ({BAD[0]} in metrics.csv)"
            )
        overflow = values.get(OVERFLOW, np.zeros(()))  # NaN where no episode ended
        if not self.warned_of_overflow and (overflow > 0).any():
            self.warned_of_overflow = True
            self.report.line(
                f"warning: contacts found no room in some steps ({OVERFLOW} in metrics.csv); "
                "raise env.contact_room"
            )
        for callback in self.callbacks:
            callback(at, dict(values))
        self.report.update(
            shown,
            len(self.seeds),
            **{
                short: mean_of_known(next((values[name] for name in names if name in values), UNKNOWN))
                for short, names in SHOWN.items()
            },
        )


def estimates(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What stands beside the empty charts of return and cost as long as no episode has ended."""
    found = {name: values.get(run_folder.estimate_of(name)) for name in ("train/return", "train/cost")}
    return {f"{k} (estimate, no episode ended yet)": x for k, x in found.items() if x is not None}


def board_of(member: Member) -> list[str]:
    """The folders in a run folder that hold a member's file for TensorBoard."""
    setting = member.setting.replace(", ", "-")
    return ["tensorboard", *([setting] if setting else []), f"seed{member.seed}"]


def mean_of_known(values: np.ndarray) -> float:
    """Over the seeds that have a value."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else float("nan")

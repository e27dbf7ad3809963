"""Where the metrics of training go: metrics.csv, TensorBoard and the progress report."""

import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np

from jaxsafe.run import clock, run_folder
from jaxsafe.run.progress import Report
from jaxsafe.run.spread import Member
from jaxsafe.types import Clocks

OVERFLOW = "train/overflow"  # steps of an episode in which engine warp ran out of room


SHOWN = {  # what the progress report shows: the first of these that is known
    "ret": ("train/return_estimate", "eval/return"),
    "cost": ("train/cost_estimate", "eval/cost"),
    "lam": ("train/lam",),
}
UNKNOWN = np.full(1, np.nan)


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
        clocks: Clocks,
        report: Report,
    ):
        self.seeds, self.clocks, self.warned = [m.seed for m in members], clocks, False
        self.report, self.unit = report, clock.unit(clocks)
        self.swept = {name: np.array([m.swept[name] for m in members]) for name in members[0].swept}
        self.csv = run_folder.Metrics(folder, [*self.swept, *names], iteration)
        self.begun = time.perf_counter() - self.csv.seconds
        self.boards = [
            run_folder.Board(
                folder / "tensorboard" / m.setting.replace(", ", "-") / f"seed{m.seed}",
                self.unit.at(iteration),
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
        shown, seconds = self.unit.at(iteration), time.perf_counter() - self.begun
        at = clock.after(iteration, self.clocks)
        self.csv.append(at, self.seeds, seconds, values | self.swept)
        for s, board in enumerate(self.boards):
            board.append(shown, {name: float(value[s]) for name, value in values.items()})
        return shown, values

    def _finish(self) -> None:
        if not self.writing:
            return
        writing, self.writing = self.writing, None
        shown, values = writing.result()
        if not self.warned and (values.get(OVERFLOW, np.zeros(())) > 0).any():  # NaN: nothing ended
            self.warned = True
            self.report.line(
                f"warning: contacts found no room in some steps ({OVERFLOW} in metrics.csv); "
                "raise env.contact_room"
            )
        self.report.update(
            shown,
            len(self.seeds),
            **{
                short: mean(next((values[name] for name in names if name in values), UNKNOWN))
                for short, names in SHOWN.items()
            },
        )


def mean(values: np.ndarray) -> float:
    """Over the seeds that have a value."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else float("nan")

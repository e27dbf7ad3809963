"""What a training run says while it runs: a live bar on a terminal, one changing line in a notebook,
plain lines elsewhere."""

import contextlib
import math
import time
from collections.abc import Iterator, Sequence
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn
from rich.text import Text

PLAIN_EVERY = 5.0  # s between lines when stdout is no terminal
NOTEBOOK_EVERY = 0.25  # s between changes of the line
MOMENT = 1.0  # s, after which a task is worth a word


def short(value: float) -> str:
    """About four significant digits; '-' for what is not known yet."""
    if math.isnan(value):
        return "-"
    if abs(value) >= 1e4 or (value != 0 and abs(value) < 1e-3):
        return f"{value:.1e}".replace("e+0", "e").replace("e-0", "e-")
    return f"{value:.3g}" if abs(value) < 1e3 else f"{value:.0f}"


def count_text(value: float) -> str:
    for size, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= size:
            return f"{value / size:.3g}{unit}"
    return f"{value:.0f}"


def duration_text(seconds: float) -> str:
    if not math.isfinite(seconds):
        return "-"
    minutes, s = divmod(round(seconds), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours}:{m:02d}:{s:02d}" if hours else f"{m}:{s:02d}"


class Reporter:
    """Prints to stdout; `with` it, so that a live bar is taken down whatever happens.

    Args:
        console: where to, if not there.
        hosted: in a program that goes on after Ctrl-C.
    """

    def __init__(self, console: Console | None = None, hosted: bool = False):
        self.notebook = console is None and Console().is_jupyter
        # rich's own output in notebooks is a block of HTML a line, and its bar wants ipywidgets
        plain = Console(
            highlight=False,
            soft_wrap=True,
            force_jupyter=False,
            force_terminal=False if self.notebook else None,
        )
        self.console = console or plain
        self.hosted = hosted
        self.live: Progress | None = None
        self.width = 0  # of the changing line

    def __enter__(self) -> "Reporter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @contextlib.contextmanager
    def _showing(self) -> Iterator[None]:
        """Once the terminal is gone, nothing is shown any more."""
        try:
            yield
        except OSError:
            self.console, self.live = Console(quiet=True), None

    def line(self, text: str) -> None:
        with self._showing():
            self._end_changing()
            self.console.print(text, markup=False)

    def start(self, total: int, done: int, cost_limits: Sequence[float], unit: str = "steps") -> None:
        """Begin to show progress from `done` to `total`, which count in `unit`."""
        self.total, self.unit = total, unit
        self.last = {"ret": math.nan, "cost": math.nan, "lam": math.nan}  # finite values seen last
        self.guessed = ""  # what stands before a cost that the learner estimates
        self.printed = -math.inf
        ends = sorted({min(cost_limits), max(cost_limits)}) if cost_limits else []
        self.limits = "/" * bool(ends) + "-".join(map(short, ends))
        self.begun, self.begun_at = time.perf_counter(), done
        if self.console.is_terminal:
            columns: list[ProgressColumn] = [
                BarColumn(bar_width=20),
                TextColumn("{task.percentage:>3.0f}%"),
                TextColumn("{task.fields[text]}"),
            ]
            self.live = Progress(
                *columns, console=self.console, auto_refresh=True, refresh_per_second=4
            )
            self.task = self.live.add_task("", total=total, completed=done, text=Text("first update"))
            self.live.start()

    def update(self, done: int, num_members: int, ret: float, cost: float, lam: float) -> None:
        """Show the state where each member has `done` so many; NaN keeps the last value.

        Without environment steps only an evaluation knows a return. A cost that comes without a return
        is the learner's own estimate.
        """
        if self.unit == "updates" and math.isfinite(cost) and not math.isfinite(ret):
            self.guessed = "estimated "
        now = time.perf_counter()
        self.last.update(
            {k: v for k, v in (("ret", ret), ("cost", cost), ("lam", lam)) if math.isfinite(v)}
        )
        rate = (done - self.begun_at) / max(now - self.begun, 1e-9)  # of one seed
        lam = self.last["lam"]  # of algorithms that have one multiplier
        text = (
            f"{count_text(done)}/{count_text(self.total)} {self.unit}  "
            f"{count_text(rate * num_members)} {self.unit}/s  "
            f"return {short(self.last['ret'])}  "
            f"{self.guessed}cost {short(self.last['cost'])}{self.limits}  "
            f"{f'lam {short(lam)}  ' if math.isfinite(lam) else ''}"
            f"left {duration_text((self.total - done) / max(rate, 1e-9))}"
        )
        if self.live:
            with self._showing():
                self.live.update(self.task, completed=done, text=text)
        elif self.notebook:
            if now - self.printed >= NOTEBOOK_EVERY or done >= self.total:
                self.printed, text = now, f"{100 * done / self.total:3.0f}%  {text}"
                self._change(text)
        elif now - self.printed >= PLAIN_EVERY or done >= self.total:
            self.printed = now
            self.line(f"{100 * done / self.total:3.0f}%  {text}")

    def going(self, about: str, share: float) -> None:
        """Say which share of a task is done, if it takes more than a moment. 0 begins it, 1 ends it.

        On a terminal and in a notebook it is one changing line, which is gone at the end, elsewhere
        plain lines.
        """
        now = time.perf_counter()
        if share == 0:
            self.begun = self.printed = now
            self.first = None
            return
        if self.first is None:
            self.first = now, share  # until here it may have compiled
        changing = self.notebook or self.console.is_terminal
        if share == 1:
            with self._showing():
                self._change("")
        elif now - self.begun >= MOMENT and (changing or now - self.printed >= PLAIN_EVERY):
            text = f"{100 * share:3.0f}%  {about}"
            if share > self.first[1]:
                rate = (share - self.first[1]) / max(now - self.first[0], 1e-9)
                text += f"  left {duration_text((1 - share) / rate)}"
            self.printed = now
            if changing:
                with self._showing():
                    self._change(text[: self.console.width - 1])
            else:
                self.line(text)

    def _change(self, text: str) -> None:
        """Put `text` where the changing line is; '' leaves the place empty."""
        if text or self.width:
            ends = "" if text else "\r"
            print("\r" + text.ljust(self.width), end=ends, file=self.console.file, flush=True)
        self.width = len(text)

    def _end_changing(self) -> None:
        if self.width:
            print(file=self.console.file)
            self.width = 0

    def stop(self) -> None:
        with self._showing():
            self._end_changing()
            if self.live:
                self.live.stop()
                self.live = None

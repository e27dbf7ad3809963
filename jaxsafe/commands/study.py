"""Train what a study lacks: jaxsafe study NAME [--minutes 8]

docs/results/NAME/study.yaml lists the runs of a study, the most important first. This command trains
each run that is not done, in DIR/NAME/. Then it adds the run's figures and curves to the study and to
its page. A run that was stopped, by Ctrl-C or by --minutes, continues the next time. Its folder in DIR
has to be there for that. Runs that failed or diverged are kept and marked. Failed ones are tried again
at the end.

Several runs share a GPU with --at-once; start NVIDIA's multi-process service first
(docs/performance.md). Exit status: 0 if nothing is left to do, 130 if stopped, 1 if a run or the
disk failed, 2 for bad input.
"""

import argparse
import contextlib
import os
import queue
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, NamedTuple

import jaxsafe
from jaxsafe.commands.guard import DIVERGED, guarded
from jaxsafe.config import Bounds, ConfigError, Devices, nearest
from jaxsafe.report import studies, study_files
from jaxsafe.report.read import read_one
from jaxsafe.report.studies import Study
from jaxsafe.run import checkpoint, files, run_folder
from jaxsafe.run.arguments import argument
from jaxsafe.run.flags import Parser, number
from jaxsafe.run.settings import load

ROOT = Path(jaxsafe.__file__).parent.parent
Minutes = Annotated[float, Bounds(0, 1e6, inf="until all is done")]
STOPPED = (130, -signal.SIGINT)


class Place(NamedTuple):
    """Where and how long to train."""

    folder: Path  # the run folder; the log stands beside it
    gpu: str | None  # the index of the GPU, or None for JAX's choice
    late: Callable[[], bool]  # whether to stop now


def in_folder(options: list[str], folder: Path) -> list[str]:
    """The arguments of scripts/train.py that begin the run in `folder`, or continue it."""
    return [*options, argument("run_dir", folder), "resume=true"]


def train(options: list[str], place: Place) -> int:
    """Run `jaxsafe train` with its output in a log beside the run folder. Returns its exit status."""
    place.folder.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "jaxsafe", "train", *in_folder(options, place.folder)]
    visible = {} if place.gpu is None else {"CUDA_VISIBLE_DEVICES": place.gpu}
    visible |= {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}  # several share a GPU
    with files.appending(log_of(place.folder)) as log:
        process = subprocess.Popen(
            command,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=os.environ | visible,
            start_new_session=True,  # Ctrl-C is passed on once, below
        )
        while process.poll() is None:
            if place.late():
                process.send_signal(signal.SIGINT)
                return process.wait()
            time.sleep(0.1)
    return process.returncode


def log_of(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.log")


def states(study: Study) -> dict[str, str]:
    """done, diverged, failed or '' of each run: the worst of its seeds."""
    order = ("done", "diverged", "failed")
    found = dict.fromkeys(study.runs, "")
    for row in study_files.read(study.folder).rows:
        if row["run"] in found and row["state"] in order:
            found[row["run"]] = max(found[row["run"]] or "done", row["state"], key=order.index)
    return found


def left(study: Study, only: list[str], runs: Path) -> list[str]:
    """What is still to train: those begun, then by worth, and last those that failed."""
    known = states(study)
    found = [run for run in study.runs if known[run] in ("", "failed")]
    found = [run for run in found if not only or study_files.name_of(run) in only]

    def turn(run: str) -> tuple[bool, bool]:
        return known[run] == "failed", not (runs / study_files.name_of(run)).exists()

    return sorted(found, key=turn)


def listing(study: Study, runs: Path) -> str:
    lines = []
    for run, state in states(study).items():
        folder = runs / study_files.name_of(run)
        if not state and (progress := run_folder.newest_progress(folder)):
            steps, updates = progress.steps, progress.updates
            state = f"begun, at {steps:,} steps" if steps else f"begun, at {updates:,} updates"
        lines.append(f"{study_files.name_of(run)}: {state or 'to do'}")
    return "\n".join(lines)


def find_study(name: str) -> Path:
    """A folder with a study.yaml, or the name of one in docs/results. Its path ends in its name, also
    where it was given as `.`."""
    home = ROOT / "docs" / "results"
    for folder in (Path(name).expanduser(), home / name):
        if files.there(folder / "study.yaml"):
            return Path(os.path.abspath(folder))
    known = sorted(path.parent.name for path in home.glob("*/study.yaml"))
    raise ConfigError(f"no study {name}{nearest(name, known)}; a new one begins with its study.yaml")


@contextlib.contextmanager
def stopping(event: threading.Event) -> Iterator[None]:
    """Set `event` at Ctrl-C and its like, instead of raising."""
    endings = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
    before = {ending: signal.signal(ending, lambda *_: event.set()) for ending in endings}
    try:
        yield
    finally:
        for ending, handler in before.items():
            signal.signal(ending, handler)


def work(study: Study, runs: list[str], folder: Path, slots: list[str | None], end: float) -> int:
    """Train runs of a study, several at once. Returns the exit status.

    Args:
        runs: in the order in which they begin.
        folder: which holds their run folders.
        slots: the GPU of each run that is trained at once, as of `Place`.
        end: when to stop, in seconds of `time.monotonic`.
    Raises:
        checkpoint.NotSaved: nobody can write where the runs or the study are.
    """
    for place in (folder, study.folder) if runs else ():  # before hours of training
        with checkpoint.writing_to(place):
            files.try_writing(place)
    for word in " ".join([*study.options, *study.runs]).split():
        kind, _, name = word.partition("=")
        if kind in ("env", "algo"):  # the user's own are imported here, too, to read what came out
            load(kind, name)
    free: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    for gpu in slots:
        free.put(gpu)
    stop, adding = threading.Event(), threading.Lock()

    def late() -> bool:
        return stop.is_set() or time.monotonic() >= end

    def state_of(run: str) -> str:
        gpu = free.get()
        try:
            return trained(study, run, Place(folder / study_files.name_of(run), gpu, late), adding)
        except Exception as error:  # the other runs go on
            print(f"{study_files.name_of(run)}: {error!r}", flush=True)
            return "failed"
        finally:
            free.put(gpu)

    print(f"{len(runs)} of {len(study.runs)} runs to do", flush=True)
    with stopping(stop), ThreadPoolExecutor(len(slots)) as threads:
        ends = dict(zip(map(study_files.name_of, runs), threads.map(state_of, runs), strict=True))
    lasting = [name for kind in ("", "failed") for name, state in ends.items() if state == kind]
    if len(lasting) < len(runs) and study_files.holds_study(study.folder):
        studies.write_page(study)
    print(f"left to do: {', '.join(lasting) or 'nothing'}")
    return 1 if "failed" in ends.values() else 130 if lasting else 0


def trained(study: Study, run: str, place: Place, adding: threading.Lock) -> str:
    """Train a run, and add what it made to its study. Returns how it ended: done, diverged, failed, or
    '' if it did not.

    Args:
        adding: held by the run that is added.
    """
    folder, start = place.folder, time.monotonic()
    if place.late():
        return ""
    try:
        with files.held(folder) if folder.exists() else contextlib.nullcontext():
            pass
    except ConfigError as error:  # a second command on the same study
        print(f"{folder.name}: {error}", flush=True)
        return ""
    status = train(study.command(run), place)
    minutes = f"{(time.monotonic() - start) / 60:.1f} minutes"
    if status in STOPPED:
        print(f"{folder.name}: stopped, {minutes}", flush=True)
        return ""
    state = {0: "done", DIVERGED: "diverged"}.get(status, "failed")
    with adding:
        found = read_one(folder) if files.there(run_folder.metrics_file(folder)) else []
        if len(found) > 1:
            raise ConfigError(f"{run}: expected one setting a run, not {len(found)} side by side")
        for setting in found:
            failure = "" if state == "done" else state
            studies.add(study, run, setting, studies.origin_of(folder), failure)
    log = f", see {log_of(folder)}" if status else ""
    print(f"{folder.name}: {state}{log}, {minutes}", flush=True)
    return state


def main() -> int:
    """Exit status: see above."""
    return guarded(command)


def command() -> int:
    args = new_parser().parse_args()
    study = studies.read(find_study(args.study))
    names = [study_files.name_of(run) for run in study.runs]
    for name in args.only:
        if name not in names:
            raise ConfigError(f"--only {name}{nearest(name, names)}")
    folder = args.runs / study.folder.name
    if args.list:
        print(listing(study, folder))
        return 0
    if args.page:
        studies.write_page(study)
        return 0
    runs = left(study, args.only, folder)
    if args.commands:
        for run in runs:
            options = in_folder(study.command(run), folder / study_files.name_of(run))
            print(shlex.join(["python", "scripts/train.py", *options]))
        return 0
    slots = args.at_once * (args.gpus.split(",") if args.gpus else [None])
    return work(study, runs, folder, slots, time.monotonic() + 60 * args.minutes)


def new_parser() -> argparse.ArgumentParser:
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", metavar="NAME", help="a study in docs/results, or its folder")
    parser.add_argument("--list", action="store_true", help="only list which runs are done")
    parser.add_argument(
        "--commands", action="store_true", help="only print the commands that are left, for a scheduler"
    )
    parser.add_argument("--page", action="store_true", help="only draw the page")
    parser.add_argument(
        "--minutes", type=number(Minutes), default=float("inf"), help="stop after so many minutes"
    )
    parser.add_argument(
        "--only",
        nargs="+",
        default=[],
        metavar="RUN",
        help="only these runs, by the names that --list prints",
    )
    parser.add_argument("--gpus", help="which GPUs to use, as 0,1,2,3")
    parser.add_argument(
        "--at-once", type=number(Devices), default=1, help="runs at a time on each GPU (default 1)"
    )
    parser.add_argument(
        "--runs",
        type=Path,
        default=Path("runs") / "studies",
        metavar="DIR",
        help="where the run folders are (default runs/studies)",
    )
    return parser

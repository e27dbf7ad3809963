"""A run folder: what was asked, what ran, what came out. Plain JSON, YAML, CSV and Orbax.

config.yaml     every setting, resolved
versions.json   package versions, commit, device and command of each start
metrics.csv     a row for each iteration and seed, or metrics.csv.xz. A cell without a value is empty.
                With several settings: a row for each of them too, and a column for each swept float
tensorboard/    the same for TensorBoard, a folder for each seed (and setting)
checkpoints/    train states, to resume from: see jaxsafe.run.checkpoint
policy/         the policies alone: all that evaluation, films and init_from read
curves.png, video.mp4, evaluation.json   written at the end; calibration.png of a shield
diverged.json   the members that were given up, if there are any
"""

import csv
import datetime
import importlib.metadata
import io
import itertools
import json
import math
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from tensorboardX.proto import event_pb2, summary_pb2
from tensorboardX.record_writer import RecordWriter

import jaxsafe
from jaxsafe.config import ConfigError
from jaxsafe.learn.metrics import BAD
from jaxsafe.run import checkpoint, files
from jaxsafe.run.checkpoint import Progress
from jaxsafe.run.evaluate import COLUMNS

PACKAGES = (
    "jax", "jaxlib", "mujoco", "mujoco-mjx", "warp-lang", "flax", "optax", "orbax-checkpoint", "numpy",
    "brax",
)  # fmt: skip
MOST_HEADER = 64 * files.KB  # letters of a table's first line
INDEX = (*Progress._fields, "seed", "seconds")  # the first columns of metrics.csv
# options about the machine and the network, which a file never sets
COMMAND_ONLY = ("coordinator", "num_processes", "process_index", "logger")
ALL_BUT_DOCS = ("--", ":/", ":(top,exclude)docs")  # of the source tree, as git names it


def write_config(folder: Path, config: dict[str, Any]) -> None:
    files.write(folder / "config.yaml", yaml.safe_dump(config, sort_keys=False))


def read_config(folder: Path) -> dict[str, Any]:
    """The settings of a run, as plain values: nothing in the file is executed.

    Raises:
        ConfigError: no run folder, its config.yaml is not a mapping of settings, or it says something
            about the machine or the network.
    """
    path = folder / "config.yaml"
    if not files.there(path):
        inside = sorted(folder.glob("*/config.yaml"))
        hint = f"; there is {inside[0].parent}" if inside else ""
        raise ConfigError(f"{folder} is not a run folder: it has no config.yaml{hint}")
    config = files.read_yaml(path)
    groups = [config.get(g) if isinstance(config, dict) else None for g in ("env", "algo")]
    if not all(isinstance(g, dict) and isinstance(g.get("name"), str) for g in groups):
        raise ConfigError(f"{path} is not the config of a run: it names no env or no algo")
    for name in COMMAND_ONLY:
        if name in config:
            raise ConfigError(f"{path} sets {name}, which only a command may")
    return config


def append_versions(folder: Path, device: str, engine: str | None, dataset: str | None = None) -> None:
    """Add this start of the run to versions.json, with the SHA-256 of its data set."""
    now = {
        "time": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
        "command": typed_command(sys.argv),
        "commit": commit(),
        "device": device,
        "engine": engine,
        "dataset": dataset,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "jaxsafe": jaxsafe.__version__,
        **{name: installed(name) for name in PACKAGES},
    }
    files.write(folder / "versions.json", json.dumps([*starts(folder), now], indent=1))


def typed_command(argv: Sequence[str]) -> str:
    """The command as it was typed. `hydra_jobs` adds ++ to words, and `jaxsafe train` is one word."""
    words = [x.removeprefix("++") for x in argv]
    if words and words[0].startswith("jaxsafe "):
        return f"{words[0]} {shlex.join(words[1:])}"
    return shlex.join([Path(sys.executable).name, *words])


def starts(folder: Path) -> list[dict[str, Any]]:
    """What versions.json says of each start; nothing where it cannot be read."""
    try:
        found = files.read_json(folder / "versions.json")
    except ConfigError:
        return []
    return [each for each in found if isinstance(each, dict)] if isinstance(found, list) else []


def last_start(folder: Path) -> dict[str, Any]:
    return next(reversed(starts(folder)), {})


def trained_by(folder: Path) -> str:
    """The version of jaxsafe that a run was last started with, and its commit."""
    last = last_start(folder)
    return f"{last['jaxsafe']} ({last.get('commit')})" if "jaxsafe" in last else "of an unknown version"


def dataset_of(folder: Path) -> str | None:
    """The SHA-256 of the data set that a run was last started with; None where that is not known."""
    return str(last_start(folder).get("dataset") or "") or None


def installed(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def commit() -> str | None:
    """The commit of the source tree, '-dirty' if it has changes; None outside a repository.

    Changes of docs/ do not count: that is where studies put their results.
    """

    def git(*args: str) -> str:
        where = Path(jaxsafe.__file__).parent
        return subprocess.run(
            ["git", "-C", str(where), *args], check=True, capture_output=True, text=True, timeout=10
        ).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", "__init__.py")  # fails in another project's tree
        changes = git("status", "--porcelain", *ALL_BUT_DOCS)
        return git("rev-parse", "HEAD") + ("-dirty" if changes else "")
    except (OSError, subprocess.SubprocessError):
        return None


def estimate_of(name: str) -> str:
    """The column that estimates train/return, train/cost or train/cost_<name> from every step, whether
    or not an episode ended."""
    for metric in ("train/return", "train/cost"):
        if name.startswith(metric):
            return f"{metric}_estimate{name.removeprefix(metric)}"
    return name


class Metrics:
    """metrics.csv: appends rows, and on resumption drops those after the checkpoint.

    A run whose metrics.csv was packed continues with it unpacked; the packed one is no longer read.
    """

    def __init__(self, folder: Path, names: list[str], iteration: int):
        """Open for appending after `iteration`; later rows and a torn last line are dropped.

        Columns of evaluation, and those of bad worlds, may be new, or stay without new values.

        Raises:
            ConfigError: the file exists with other columns.
        """
        self.path, self.names, self.seconds = folder / "metrics.csv", list(names), 0.0
        header = [*INDEX, *self.names]
        kept = []
        before = metrics_file(folder)
        if files.there(before) and iteration:
            with files.reading(before):
                rows = csv.reader(io.StringIO(files.read_text(before), newline=""))
                found = next(rows, header)
                odd = sorted(set(found) ^ set(header))
                if not all(name in (*COLUMNS, *BAD) for name in odd):
                    raise ConfigError(f"{before} has other columns ({', '.join(odd)})")
                self.names += [name for name in found if name not in header]
                header = [*INDEX, *self.names]
                kept = [
                    [dict(zip(found, row, strict=True)).get(name, "") for name in header]
                    for row in rows
                    if len(row) == len(found) and row[0].isdigit() and int(row[0]) <= iteration
                ]
                self.seconds = float(kept[-1][INDEX.index("seconds")]) if kept else 0.0
        valued = {name for row in kept for name, cell in zip(header, row, strict=True) if cell}
        self.ended = "train/return" in valued  # whether an episode did so far
        with files.replacing(self.path) as part, part.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([header, *kept])
        self.file = files.appending(self.path)
        self.writer = csv.writer(self.file, lineterminator="\n")

    def append(self, at: Progress, seeds: list[int], seconds: float, values: Mapping) -> None:
        """Add one row a seed; `values` holds float [S] by metric name, those of evaluation if known."""
        nothing = dict.fromkeys(COLUMNS, np.full(len(seeds), np.nan))
        columns = [np.asarray((nothing | dict(values))[name], np.float32) for name in self.names]
        with files.naming(self.path):
            for s, seed in enumerate(seeds):
                cells = ("" if math.isnan(c[s]) else str(c[s]) for c in columns)
                self.writer.writerow([*at, seed, f"{seconds:.3f}", *cells])
            self.file.flush()

    def sync(self) -> None:
        """Put every row on the disk, before a checkpoint counts on them."""
        with files.naming(self.path):
            self.file.flush()
            os.fsync(self.file.fileno())

    def close(self) -> None:
        with files.naming(self.path):
            self.file.close()


class Board:
    """TensorBoard's file of one seed, written at once: no thread of its own that could fail unseen."""

    def __init__(self, folder: Path, steps: int):
        """Open for appending after `steps`; TensorBoard drops what older files have beyond."""
        host, now = platform.node(), time.time()
        self.path = folder / f"events.out.tfevents.{int(now):010d}.{host}.{os.getpid()}.{steps}"
        with files.replacing(self.path):  # a new file, whatever is there
            pass
        self.writer = RecordWriter(str(self.path))
        self._write(0, file_version="brain.Event:2")
        if steps:
            session = event_pb2.SessionLog(status=event_pb2.SessionLog.START)  # type: ignore[attr-defined]
            self._write(steps + 1, session_log=session)

    def append(self, steps: int, values: Mapping[str, float]) -> None:
        entries = [{"tag": name, "simple_value": v} for name, v in values.items() if math.isfinite(v)]
        self._write(steps, summary=summary_pb2.Summary(value=entries))  # type: ignore[attr-defined]

    def _write(self, steps: int, **what: Any) -> None:
        event = event_pb2.Event(wall_time=time.time(), step=steps, **what)  # type: ignore[attr-defined]
        with files.naming(self.path):
            self.writer.write(event.SerializeToString())

    def flush(self) -> None:
        with files.naming(self.path):
            self.writer.flush()

    def close(self) -> None:
        with files.naming(self.path):
            self.writer.close()


def metrics_file(folder: Path) -> Path:
    """metrics.csv, or metrics.csv.xz as long as there is only that."""
    path = folder / "metrics.csv"
    packed = path.with_name("metrics.csv.xz")
    return packed if files.there(packed) and not files.there(path) else path


def read_metrics(folder: Path) -> dict[str, np.ndarray]:
    """metrics.csv as float columns by name (NaN where a cell is empty); empty if there is none."""
    path = metrics_file(folder)
    return read_table(path) if files.there(path) else {}


def read_table(path: Path) -> dict[str, np.ndarray]:
    """A .csv or .csv.xz as `read_metrics` gives it. A torn line is left out.

    Raises:
        ConfigError: a cell is no number, a column that every table has is absent or has an empty cell,
            or the file cannot be read.
    """
    text = files.read_text(path)
    with files.reading(path):
        header, _, body = text.partition("\n")
        if len(header) > MOST_HEADER:
            raise ConfigError(f"{path} begins with a line of {len(header):,} letters")
        names = header.strip().split(",")
        lines = (line for line in io.StringIO(body) if line.count(",") == len(names) - 1)
        filled = (line.rstrip("\r\n").replace(",,", ",nan,").replace(",,", ",nan,") for line in lines)
        rows = (f"{line}nan" if line.endswith(",") else line for line in filled)
        first = next(rows, None)
        table = (
            np.loadtxt(itertools.chain([first], rows), delimiter=",", comments=None, ndmin=2)
            if first
            else np.empty((0, len(names)))
        )
        found = dict(zip(names, table.T, strict=True))
    for name in ("iteration", "steps", "seed"):
        if len(table) and not np.isfinite(found.get(name, np.nan)).all():
            raise ConfigError(f"{path} has no column {name}, or an empty cell in it")
    return found


def read_evaluation(folder: Path, setting: str) -> dict[str, np.ndarray]:
    """What evaluation found of each seed in a setting ('' where there is one), [S] by name.

    Empty without evaluation.json, or with one that does not hold the seeds apart.

    Raises:
        ConfigError: the file cannot be read.
    """
    path = folder / "evaluation.json"
    if not files.there(path):
        return {}
    found = files.read_json(path)
    with files.reading(path):
        found = found[setting] if setting else found
        seeds = {name: np.array(values, float) for name, values in found.get("seeds", {}).items()}
    for name, values in seeds.items():
        if values.ndim != 1:
            raise ConfigError(f"{path}: expected a list of numbers, one a seed, as {name}")
    return seeds


def by_setting(metrics: dict[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """The tables of settings trained side by side, by name; {'': metrics} if there is but one."""
    names = [name for name in metrics if name.startswith("algo.")]
    if not names:
        return {"": metrics}
    values = np.stack([metrics[name] for name in names], axis=1)
    _, first, which = np.unique(values, axis=0, return_index=True, return_inverse=True)
    return {
        setting_name(dict(zip(names, values[first[i]], strict=True))): {
            name: column[which.ravel() == i] for name, column in metrics.items()
        }
        for i in np.argsort(first)
    }


def setting_name(swept: Mapping[str, Any]) -> str:
    return ", ".join(f"{k}={v:.9g}" if isinstance(v, float) else f"{k}={v}" for k, v in swept.items())


def step_column(metrics: Mapping[str, np.ndarray]) -> str:
    """The column that says how far training is: 'steps' or, where it takes no environment steps,
    'updates'."""
    moves = "updates" not in metrics or not len(metrics["steps"]) or metrics["steps"].max() > 0
    return "steps" if moves else "updates"


def late_rows(metrics: Mapping[str, np.ndarray]) -> np.ndarray:
    """The rows of the last 10% of training so far, bool [rows]."""
    return metrics["iteration"] > 0.9 * metrics["iteration"].max()


def last_tenth(metrics: dict[str, np.ndarray], name: str) -> np.ndarray:
    """The mean of a metric over the last 10% of training so far, [S]; NaN for a seed without value."""
    late = late_rows(metrics) & np.isfinite(metrics[name])
    values = (metrics[name][late & (metrics["seed"] == s)] for s in np.unique(metrics["seed"]))
    return np.array([v.mean() if len(v) else np.nan for v in values])


def newest_progress(folder: Path, part: str = "checkpoints") -> Progress | None:
    """How far the newest checkpoint is, or with `part` "policy" the newest policy; None without one."""
    for path in checkpoint.checkpoints(files.inside(folder, part)):
        try:
            return checkpoint.read_manifest(path).at
        except ConfigError:
            continue
    return None

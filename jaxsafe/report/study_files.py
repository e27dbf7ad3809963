"""The two files of a study that hold its runs.

    final.csv    a row a run and seed: the columns of `ROW`, then figures, then those of `Origin`
    curves.npz   curves    float32 [rows, 4, 100]: return, cost, cost rate and override rate over
                           training, as means over equal stretches of it; NaN before the first episode
                           has ended, and where no shield acts. Older files lack the last one
                 run, seed text [rows], to find the curves of a row
                 settings  JSON: every setting of the runs, {common: {...}, runs: {run: {...}}}

Both are replaced whole, curves.npz first, so that a reader finds the curves of every row of final.csv
whenever the writer was stopped. Nothing in them is executed.
"""

import csv
import hashlib
import io
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsafe.run import files

ROW = ("run", "env", "algo", "settings", "seed", "state", "steps")
CURVES = ("train/return", "train/cost", "train/cost_rate", "train/overruled")  # as in metrics.csv
POINTS = 100
OLDER = 3  # curves of a file from before the override rate was kept
LONGEST = 230  # letters of a folder's name; file systems take 255 bytes


class Origin(NamedTuple):
    """What a run was made with; '' is not known."""

    commit: str = ""
    dirty: str = ""  # 'yes': the tree had changes that were in no commit; or 'no'
    device: str = ""
    engine: str = ""
    python: str = ""
    jax: str = ""
    mujoco: str = ""
    warp: str = ""
    trained: str = ""  # the day
    source: str = ""  # where every iteration is: a run folder, or COMMIT:PATH in the history


class Condensed(NamedTuple):
    """The runs of a study."""

    rows: list[dict[str, str]]
    curves: dict[tuple[str, str], np.ndarray]  # by run and seed, float32 [4, 100]
    settings: dict[str, dict[str, Any]]  # by run, as `flat` names them

    def figures(self) -> list[str]:
        """The columns that hold numbers."""
        names = dict.fromkeys(name for row in self.rows for name in row)
        return [name for name in names if name not in ROW and name not in Origin._fields]


def holds_study(folder: Path) -> bool:
    return files.there(folder / "final.csv")


def name_of(run: str) -> str:
    """What the folder of a run is called: 'point_goal1-cpo-seed_1' for 'env=point_goal1 algo=cpo
    seed=1'. As a value of `run_dir` it needs no quotes. The end of a name that is too long for a folder
    is told by a hash."""
    words = [re.sub("^(env|algo)=", "", word) for word in run.split()]
    name = re.sub(r"[^\w.+-]+", "_", "-".join(words))
    if len(name) <= LONGEST:
        return name
    return f"{name[: LONGEST - 9]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def read(folder: Path) -> Condensed:
    """The runs of a study; none where none is finished.

    Raises:
        ConfigError: the files cannot be read, or do not belong together.
    """
    if not holds_study(folder):
        return Condensed([], {}, {})
    text = files.read_text(folder / "final.csv")
    found = files.read_arrays(folder / "curves.npz")
    with files.reading(folder):
        rows = list(csv.DictReader(io.StringIO(text, newline="")))
        if not all(isinstance(x, str) for row in rows for x in (*row.keys(), *row.values())):
            raise ValueError("final.csv has rows of another length than its header")
        for name in (*ROW, "return", "cost", *Origin._fields):
            if rows and name not in rows[0]:
                raise ValueError(f"final.csv has no column {name}")
        keys = zip(found["run"].tolist(), found["seed"].tolist(), strict=True)
        kept = found["curves"]
        if kept.shape[1:] not in ((len(CURVES), POINTS), (OLDER, POINTS)) or kept.dtype.kind != "f":
            raise ValueError(f"curves.npz has curves {kept.dtype}{kept.shape}")
        lacking = ((0, 0), (0, len(CURVES) - kept.shape[1]), (0, 0))
        whole = np.pad(kept, lacking, constant_values=np.nan)
        curves = dict(zip(keys, whole, strict=True))
        saved = json.loads(str(found["settings"]))
        known = {row["run"] for row in rows}  # not one that was about to be added
        settings = {run: saved["common"] | own for run, own in saved["runs"].items() if run in known}
        if any((row["run"], row["seed"]) not in curves or row["run"] not in settings for row in rows):
            raise ValueError("curves.npz lacks rows of final.csv")
    return Condensed(rows, curves, settings)


def write(folder: Path, runs: Condensed) -> None:
    """Write both files. Curves and settings without a row are left out."""
    keys = [(row["run"], row["seed"]) for row in runs.rows]
    settings = {run: runs.settings[run] for run, _ in keys}
    packed, text = io.BytesIO(), io.StringIO()
    np.savez_compressed(
        packed,
        run=np.array([run for run, _ in keys]),
        seed=np.array([seed for _, seed in keys]),
        curves=np.stack([runs.curves[key] for key in keys]),
        settings=np.array(json.dumps(apart(settings))),
    )
    header = [*ROW, *runs.figures(), *Origin._fields]
    writer = csv.DictWriter(text, header, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(runs.rows)
    files.write(folder / "curves.npz", packed.getvalue())
    files.write(folder / "final.csv", text.getvalue())


def apart(settings: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """What all runs have in common, and what else each has."""
    first, *others = settings.values()
    common = {k: v for k, v in first.items() if all(k in s and s[k] == v for s in others)}
    rest = {run: {k: v for k, v in s.items() if k not in common} for run, s in settings.items()}
    return {"common": common, "runs": rest}


def table(
    rows: Sequence[Mapping[str, str]], curves: Sequence[np.ndarray], clock: str = "steps"
) -> dict[str, np.ndarray]:
    """The curves of one run's seeds as columns of a metrics.csv with a row a point and seed.

    `clock` is what `steps` of a row counts: 'steps' of the environment, or 'updates' where training
    takes none.
    """
    ends = [np.linspace(0, int(row["steps"]), POINTS + 1)[1:] for row in rows]
    seeds = np.repeat([float(row["seed"]) for row in rows], POINTS)
    columns = {
        "iteration": np.tile(np.arange(1.0, POINTS + 1), len(rows)),
        "steps": np.zeros(len(seeds)),
        "seed": seeds,
    }
    columns |= {clock: np.concatenate(ends)}
    found = {name: np.concatenate([c[i] for c in curves]) for i, name in enumerate(CURVES)}
    return columns | {name: x.astype(float) for name, x in found.items() if np.isfinite(x).any()}

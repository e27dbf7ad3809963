"""Data sets for offline learning, read from files. Nothing in a file is executed.

A data set is an .npz of flat arrays under the names that DSRL and D4RL use:

    observations, next_observations   float [n, O]
    actions                           float [n, A]
    rewards, costs                    float [n]
    terminals                         bool [n]; the end of an episode by its time limit is none

Other arrays in the file are left alone.

Source: Liu et al. (2023), "Datasets and Benchmarks for Offline Safe Reinforcement Learning",
    arXiv:2306.09303, for the names.
"""

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from jaxsafe.config import ConfigError, nearest, one_line
from jaxsafe.learn.offline import DataSet
from jaxsafe.run import checkpoint

# name in the file -> the field that it is, and how many axes it has
ARRAYS = {
    "observations": ("obs", 2),
    "actions": ("action", 2),
    "rewards": ("reward", 1),
    "costs": ("cost", 1),
    "next_observations": ("next_obs", 2),
    "terminals": ("terminated", 1),
}
BROKEN = (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error)  # of files that are no .npz


def read_dataset(path: str) -> DataSet:
    """The data set in an .npz file: float32 and, for `terminated`, bool.

    Raises:
        ConfigError: no such file, one that is none, or arrays that are missing, of other shapes, or not
            finite.
    """
    file = found(path)
    try:
        with np.load(file.open("rb"), allow_pickle=False) as arrays:
            if missing := [name for name in ARRAYS if name not in arrays]:
                raise ConfigError(f"dataset={path} has no {missing[0]}{nearest(missing[0], arrays)}")
            raw = {name: arrays[name] for name in ARRAYS}
    except (TypeError, *BROKEN) as error:  # TypeError: a lone array
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"dataset={path} cannot be read as .npz: {one_line(error)}") from error
    count = raw["rewards"].shape[:1]
    fields = {}
    for name, (field, axes) in ARRAYS.items():
        x = raw[name]
        shape = "[n, size]" if axes == 2 else "[n]"
        if x.dtype.kind not in "biuf" or x.ndim != axes or x.shape[:1] != count or not x.size:
            raise ConfigError(
                f"dataset={path}: {name} is {x.dtype}{list(x.shape)}, expected numbers {shape}, with "
                "the same n as rewards"
            )
        with np.errstate(over="ignore"):
            x = x.astype(np.float32)
        if not np.isfinite(x).all():
            raise ConfigError(f"dataset={path}: {name} holds numbers that are not finite")
        fields[field] = x.astype(bool) if field == "terminated" else x
    return DataSet(**fields)


def write_dataset(path: str | Path, data: DataSet) -> None:
    """Write a data set that `read_dataset` reads."""
    fields = {name: np.asarray(x) for name, x in data._asdict().items()}
    named: Any = {name: fields[field] for name, (field, _) in ARRAYS.items()}
    np.savez_compressed(path, **named)


def sha256(path: str) -> str:
    """The checksum of a data set's file.

    Raises:
        ConfigError: there is no such file.
    """
    return checkpoint.digest(found(path))


def found(path: str) -> Path:
    file = Path(path).expanduser()
    if not file.is_file():
        raise ConfigError(f"dataset={path}: there is no such file")
    return file

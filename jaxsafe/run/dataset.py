"""Data sets for offline learning: read from files, and written. Nothing in a file is executed.

What is read:

    .npz, .hdf5   flat arrays under the names of D4RL and DSRL, as below
    .npz          OmniSafe's names: obs, action, reward, cost, next_obs, done
    .hdf5         Minari's groups, one an episode, or the folder of such a data set

What is written, as .npz or .hdf5:

    observations, next_observations   float [n, O]
    actions                           float [n, A]
    rewards, costs                    float [n]
    terminals                         bool [n]; the end of an episode by its time limit is none
    timeouts                          bool [n]; that end
    cuts                              bool [n], if there are any: an episode stops there without an end
    cost_NAME                         float [n], for each cost with a name
    vision, next_vision               uint8 [n, height, width, channels], where there are pictures
    about                             what the file says of itself, as JSON; in .hdf5 its attributes

Transitions are in the order of their episodes. Without `timeouts` any order will do, and the episodes
are not known. Other arrays in a file are left alone.

Source: Liu et al. (2023), "Datasets and Benchmarks for Offline Safe Reinforcement Learning",
    arXiv:2306.09303, for the names.
"""

import contextlib
import io
import json
import math
import re
import textwrap
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from jaxsafe.config import ConfigError, flat, nearest, one_line
from jaxsafe.envs.registry import OF_ENGINE
from jaxsafe.learn.observations import vector_of
from jaxsafe.learn.offline import DataSet, data_set
from jaxsafe.run import files
from jaxsafe.run.plain import as_text

# name in the file -> the field that it is, and how many axes it has
ARRAYS = {
    "observations": ("obs", 2),
    "actions": ("action", 2),
    "rewards": ("reward", 1),
    "costs": ("cost", 1),
    "next_observations": ("next_obs", 2),
    "terminals": ("terminated", 1),
}
PICTURES = {"obs": "vision", "next_obs": "next_vision"}  # field -> name in the file
NAMED = "cost_"  # begins the names of costs that have names
ABOUT = "about"  # the text of an .npz that has what attributes say in .hdf5
OMNISAFE = {  # OmniSafe's name -> ours
    "obs": "observations",
    "action": "actions",
    "reward": "rewards",
    "cost": "costs",
    "next_obs": "next_observations",
    "done": "terminals",
}
MINARI = {  # Minari's name of what each step of an episode has -> the field
    "rewards": "reward",
    "actions": "action",
    "terminations": "terminated",
    "truncations": "truncated",
}
BROKEN = (  # of files that hold something else
    OSError, ValueError, EOFError, TypeError, LookupError, RuntimeError, MemoryError, OverflowError,
    zipfile.BadZipFile, zlib.error,
)  # fmt: skip
HDF5 = b"\x89HDF\r\n\x1a\n"  # how such files begin
PACKED = 1000  # times that unpacking may make a file larger: arrays of zeros shrink a thousandfold
FILTERS = ("gzip", "lzf", None)  # ways to pack that h5py brings itself


class Source(NamedTuple):
    """What a file holds: the names of its arrays, `read(name)`, the names of its groups, and `about()`,
    what it says of itself."""

    names: tuple[str, ...]
    read: Callable[[str], np.ndarray]
    groups: tuple[str, ...] = ()
    about: Callable[[], dict[str, Any]] = dict


def read_dataset(path: str, episode_length: int | None = None) -> DataSet:
    """The data set in a file, or in a folder of Minari's. Floats are float32.

    Args:
        episode_length: the environment's time limit in steps. OmniSafe's `done` tells no end by it from
            termination; an episode of so many steps ends by it. None: of as many as the longest has.
    Raises:
        ConfigError: no such file, one that is none, or arrays that are missing, of other shapes, or not
            finite.
    """
    file = found(path)
    with opened(path, file) as source:
        if groups := [name for name in source.groups if re.fullmatch(r"episode_\d+", name)]:
            return from_minari(path, source, groups)
        theirs, ours = (len({*names} & {*source.names}) for names in (OMNISAFE, ARRAYS))
        if theirs > ours:
            return from_omnisafe(path, source, episode_length)
        return from_flat(path, source)


def read_about(path: str) -> dict[str, Any]:
    """What a data set says of itself, text and numbers by name; empty if it says nothing.

    `jaxsafe collect` says 'recipe' and 'env', both JSON, 'actions', 'jaxsafe' and 'commit'.

    Raises:
        ConfigError: no such file, or one that is none.
    """
    with opened(path, found(path)) as source:
        said = source.about()
    return {name: x for name, x in said.items() if isinstance(x, str | int | float)}


def task_of(path: str) -> dict[str, Any]:
    """The name and the options of the environment that a data set was collected on, as text; empty if
    the file does not say them."""
    try:
        said = flat(json.loads(read_about(path)["env"]))
        named = isinstance(said["name"], str)
        return {option: as_text(value) for option, value in said.items()} if named else {}
    except (ConfigError, AttributeError, *BROKEN):  # the data may be sound all the same
        return {}


def other_task(path: str, env: dict[str, Any]) -> str:
    """A warning where the file of a data set says that it is of another environment, or of another
    option of it; else ''.

    Args:
        env: the environment's name and all its options, as `Settings.plain` has them.
    """
    theirs, ours = task_of(path), {option: as_text(value) for option, value in flat(env).items()}
    for option in ("name", *sorted(ours.keys() - {"name", *OF_ENGINE})):
        if (said := theirs.get(option, ours[option])) != ours[option]:
            said = "".join(x if x.isprintable() else "?" for x in said[:100])  # a stranger's
            is_of, here = ("", "env=") if option == "name" else (f"env.{option}=",) * 2
            return (
                f"warning: dataset={path} is of {is_of}{said}, and {here}{ours[option]}; expected "
                "data of the same task"
            )
    return ""


def oddities(path: str, data: DataSet) -> list[str]:
    """A warning of each kind of numbers that no environment gives."""
    most, least = float(abs(data.action).max()), float(data.cost.min())
    found = []
    if most > 1 + 1e-5:
        found.append(f"actions up to {most:g}, which the tasks here cut to [-1, 1]")
    if least < 0:
        found.append(f"costs down to {least:g}; expected 0 or more")
    return [f"warning: dataset={path} has {line}" for line in found]


def from_flat(path: str, source: Source) -> DataSet:
    for name in ARRAYS:
        if name not in source.names:
            raise ConfigError(f"dataset={path} has no {name}{nearest(name, source.names)}")
    raw = {name: source.read(name) for name in ARRAYS}
    axes = {name: axes for name, (_, axes) in ARRAYS.items()}
    for name in source.names:
        if name in ("timeouts", "cuts") or name.startswith(NAMED):
            raw[name], axes[name] = source.read(name), 1
    raw = {name: checked(path, name, x, axes[name], raw["rewards"]) for name, x in raw.items()}
    costs = {name.removeprefix(NAMED): x for name, x in raw.items() if name.startswith(NAMED)}
    fields: Any = {field: raw[name] for name, (field, _) in ARRAYS.items()}
    for field, name in PICTURES.items():
        if "vision" in source.names:
            picture = pictures(path, name, source, raw["rewards"])
            fields[field] = {"vector": fields[field], "vision": picture}
    return data_set(**fields, truncated=raw.get("timeouts"), costs=costs, cut=raw.get("cuts"))


def pictures(path: str, name: str, source: Source, like: np.ndarray) -> np.ndarray:
    if name not in source.names:
        raise ConfigError(f"dataset={path} has vision, and no {name}")
    x = source.read(name)
    if x.dtype != np.uint8 or x.ndim != 4 or len(x) != len(like) or not x.size:
        raise ConfigError(
            f"dataset={path}: {name} is {x.dtype}{list(x.shape)}, expected uint8 [n, height, width, "
            "channels], with the same n as rewards"
        )
    return x


def from_omnisafe(path: str, source: Source, episode_length: int | None) -> DataSet:
    """Numbers of a step are [n, 1] there. Where one policy's share stops, an episode stops without a
    mark: its last next_obs is not the obs that follows."""
    raw = {}
    for theirs, ours in OMNISAFE.items():
        if theirs not in source.names:
            raise ConfigError(f"dataset={path} has OmniSafe's names, and no {theirs}")
        x = source.read(theirs)
        raw[ours] = x[:, 0] if ARRAYS[ours][1] == 1 and x.ndim == 2 and x.shape[1] == 1 else x
    sized = {name: checked(path, name, x, ARRAYS[name][1], raw["rewards"]) for name, x in raw.items()}
    done, obs, after = (sized[k] for k in ("terminals", "observations", "next_observations"))
    if obs.shape != after.shape:
        raise ConfigError(
            f"dataset={path}: next_obs is {list(after.shape)}, expected {list(obs.shape)}, as obs is"
        )
    done = done.astype(bool)
    follows = (after[:-1] == obs[1:]).all(1)
    cut = ~np.append(follows, True) & ~done
    last = done | cut
    begin = np.flatnonzero(np.append(True, last[:-1]))
    number = np.cumsum(np.append(0, last[:-1]))
    steps = np.arange(len(done)) - begin[number] + 1
    limit = episode_length or steps.max()
    fields: Any = {field: sized[name] for name, (field, _) in ARRAYS.items() if name != "terminals"}
    late = steps >= limit
    return data_set(**fields, terminated=done & ~late, truncated=done & late, cut=cut)


def from_minari(path: str, source: Source, groups: list[str]) -> DataSet:
    """Observations are one more than the steps of an episode, and infos/cost too, or as many."""
    known = {*source.names}
    parts: dict[str, list[np.ndarray]] = {}
    for group in sorted(groups, key=lambda group: int(group.removeprefix("episode_"))):

        def read(name: str, group: str = group) -> np.ndarray:
            if f"{group}/{name}" not in known:
                costs = "; Minari has no other costs" if name == "infos/cost" else ""
                raise ConfigError(f"dataset={path} has no {group}/{name}{costs}")
            return source.read(f"{group}/{name}")

        raw = {name: read(name) for name in ("observations", "infos/cost", *MINARI)}
        rewards = checked(path, f"{group}/rewards", raw["rewards"], 1, raw["rewards"])
        if raw["infos/cost"].shape[:1] == (len(rewards) + 1,):  # that of the reset, too
            raw["infos/cost"] = raw["infos/cost"][1:]
        obs = checked(path, f"{group}/observations", raw.pop("observations"), 2, rewards, more=1)
        steps = {
            name: checked(path, f"{group}/{name}", x, 2 if name == "actions" else 1, rewards)
            for name, x in raw.items()
        }
        for name, x in {
            "obs": obs[:-1],
            "next_obs": obs[1:],
            "cost": steps["infos/cost"],
            **{field: steps[name] for name, field in MINARI.items()},
            "cut": np.arange(len(rewards)) == len(rewards) - 1,
        }.items():
            parts.setdefault(name, []).append(x)
    widths = {name: {x.shape[1:] for x in several} for name, several in parts.items()}
    if any(len(shapes) > 1 for shapes in widths.values()):
        raise ConfigError(f"dataset={path}: its episodes have arrays of different widths")
    whole: Any = {name: np.concatenate(several) for name, several in parts.items()}
    return data_set(**whole)


def checked(
    path: str, name: str, x: np.ndarray, axes: int, like: np.ndarray, more: int = 0
) -> np.ndarray:
    """`x` as float32, if it is numbers of so many axes, and as many as `like`, and `more`."""
    if x.ndim == axes and not len(x):
        raise ConfigError(f"dataset={path}: {name} is empty")
    expected = tuple(n + more for n in like.shape[:1])
    if x.dtype.kind not in "biuf" or x.ndim != axes or x.shape[:1] != expected:
        shape = f"[n{f' + {more}' * bool(more)}{', size' * (axes == 2)}]"
        raise ConfigError(
            f"dataset={path}: {name} is {x.dtype}{list(x.shape)}, expected numbers {shape}, with "
            "the same n as rewards"
        )
    with np.errstate(over="ignore"):
        x = x.astype(np.float32)
    if not np.isfinite(x).all():
        raise ConfigError(f"dataset={path}: {name} holds numbers that are not finite")
    return x


# ---- files ---------------------------------------------------------------------------------------


@contextlib.contextmanager
def opened(path: str, file: Path) -> Iterator[Source]:
    """What a file holds. Whatever is wrong with it becomes a ConfigError of one line."""
    with file.open("rb") as begin:
        hdf5 = begin.read(len(HDF5)) == HDF5
    try:
        if hdf5:
            with h5py.File(file, "r") as arrays:
                yield in_hdf5(path, arrays, file.stat().st_size)
        else:
            with zipfile.ZipFile(file) as archive:
                size = sum(x.file_size for x in archive.infolist())
            check_size(path, size, file.stat().st_size)
            with np.load(file, allow_pickle=False) as arrays:
                yield Source(tuple(arrays), arrays.__getitem__, about=lambda: in_text(arrays))
    except ConfigError:
        raise
    except BROKEN as error:
        if not hdf5 and not zipfile.is_zipfile(file):
            raise ConfigError(
                f"dataset={path} is neither .hdf5 nor .npz, by how it begins and ends"
            ) from error
        kind = ".hdf5" if hdf5 else ".npz"
        reason = textwrap.shorten(one_line(error), 200)  # it may quote what the file holds
        raise ConfigError(f"dataset={path} cannot be read as {kind}: {reason}") from error


def in_text(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """What the text of an .npz says; nothing if it is not ours."""
    text = arrays[ABOUT] if ABOUT in arrays else np.zeros(0)
    said = json.loads(str(text.item())) if text.dtype.kind == "U" and text.shape == () else {}
    return said if isinstance(said, dict) else {}


def in_attributes(file: h5py.File) -> dict[str, Any]:
    """Those that are one number, or one text of a fixed length. In a damaged file HDF5 may crash at a
    text of another length, or never end."""
    kept = {name: file.attrs.get_id(name) for name in file.attrs}
    plain = [name for name, x in kept.items() if x.shape == () and x.dtype.kind in "biufS"]
    said: dict[str, Any] = {name: file.attrs[name] for name in plain}
    return {
        k: x.decode(errors="replace") if isinstance(x, bytes) else x.item() for k, x in said.items()
    }


def with_attributes(file: h5py.File, about: Mapping[str, str | int | float]) -> None:
    """Adds what `in_attributes` reads."""
    for name, said in about.items():
        if isinstance(said, str):
            text = said.encode()
            file.attrs.create(name, text, dtype=h5py.string_dtype("utf-8", max(1, len(text))))
        else:
            file.attrs[name] = said


def in_hdf5(path: str, file: h5py.File, size: int) -> Source:
    """The arrays that lie in the file itself. It may name other files too, which are never opened:
    links to them are passed over, and arrays that are kept there are refused."""
    arrays: dict[str, h5py.Dataset] = {}
    groups: list[str] = []

    def walk(group: h5py.Group, head: str, depth: int) -> None:
        for name in group:
            if len(arrays) + len(groups) > 1_000_000:
                raise ConfigError(f"dataset={path} holds more than a million arrays")
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                continue
            inner = group[name]
            if isinstance(inner, h5py.Dataset):
                arrays[f"{head}{name}"] = inner
            elif isinstance(inner, h5py.Group) and depth < 3:  # a group may hold itself
                groups.append(f"{head}{name}")
                walk(inner, f"{head}{name}/", depth + 1)

    def read(name: str) -> np.ndarray:
        x = arrays[name]
        if x.is_virtual or x.external is not None or x.compression not in FILTERS:
            raise ConfigError(f"dataset={path}: {name} is not kept in the file itself as plain numbers")
        if x.dtype.kind not in "biuf":
            raise ConfigError(f"dataset={path}: {name} is {x.dtype}, expected numbers")
        check_size(path, math.prod(x.shape or (0,)) * x.dtype.itemsize, size)
        return np.asarray(x[()])

    walk(file, "", 0)
    return Source(tuple(arrays), read, tuple(groups), lambda: in_attributes(file))


def check_size(path: str, unpacked: int, size: int) -> None:
    if unpacked > (limit := files.MB + PACKED * size):
        raise ConfigError(f"dataset={path} unpacks to {unpacked:,} bytes; expected at most {limit:,}")


def write_dataset(
    path: str | Path,
    data: DataSet,
    more: Mapping[str, np.ndarray] | None = None,
    about: Mapping[str, str | int | float] | None = None,
) -> None:
    """Write a data set that `read_dataset` reads, as .hdf5 or .npz by the end of its name. What takes a
    byte, such as pictures, is compressed in .hdf5. In .npz all is.

    Args:
        more: arrays [n] beside it, by name.
        about: what the file says of itself, for `read_about`.
    Raises:
        ConfigError: the name ends otherwise.
        OSError: the disk failed.
    """
    path = Path(path)
    arrays = {name: np.asarray(vector_of(getattr(data, field))) for name, (field, _) in ARRAYS.items()}
    if isinstance(data.obs, dict):
        for field, name in PICTURES.items():
            arrays[name] = np.asarray(getattr(data, field)["vision"])
    if data.episodes:
        arrays["timeouts"] = np.asarray(data.truncated)
        last = np.append(np.diff(data.episodes.number) > 0, False)  # the very last one needs no mark
        if (cuts := last & ~(np.asarray(data.terminated) | arrays["timeouts"])).any():
            arrays["cuts"] = cuts
    arrays |= {f"{NAMED}{name}": np.asarray(x) for name, x in data.costs.items()} | dict(more or {})
    if path.suffix not in (".npz", ".hdf5"):
        raise ConfigError(f"{path}: expected a name that ends in .hdf5 or .npz")
    with files.replacing(path) as part:
        if path.suffix == ".npz":
            named: Any = arrays | ({ABOUT: np.array(json.dumps(dict(about)))} if about else {})
            np.savez_compressed(part, **named)
            return
        memory = io.BytesIO()  # HDF5 may crash the process where a disk fails
        with h5py.File(memory, "w", libver=("v108", "v108")) as file:  # texts beyond 64 kB
            for name, x in arrays.items():
                bytewise = x.dtype.itemsize == 1  # pictures and truth values; floats hardly shrink
                file.create_dataset(name, data=x, compression="lzf" if bytewise else None)
            with_attributes(file, about or {})
        part.write_bytes(memory.getbuffer())


def sha256(path: str) -> str:
    """The checksum of a data set's file.

    Raises:
        ConfigError: there is no such file.
    """
    return files.digest(found(path))


def found(path: str) -> Path:
    """The file of a data set; of a folder of Minari's, the one with its episodes."""
    file = Path(path).expanduser()
    if file.is_dir():
        places = (file / "main_data.hdf5", file / "data" / "main_data.hdf5")
        file = next((place for place in places if place.is_file()), file)
    if file.is_dir():
        raise ConfigError(
            f"dataset={path} is a folder without main_data.hdf5, as Minari has it; expected a file"
        )
    if not file.is_file():
        raise ConfigError(f"dataset={path}: there is no such file")
    return file

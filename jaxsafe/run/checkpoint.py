"""Checkpoints of a whole train state: written atomically, verified when read, no pickle.

    checkpoints/00000042/manifest.json   iteration, steps, updates, shapes, SHA-256 of every other file
    checkpoints/00000042/state/          an Orbax checkpoint of {leaf name: array}

A checkpoint is written under a temporary name and renamed when it is complete, so a folder
with a number for a name is whole unless the disk lost bytes; the checksums catch that.
Random keys are stored as their key data, empty leaves not at all. The replay of an off-policy
algorithm may be left out, as it can be large; a run that is resumed without it fills it anew.
"""

import contextlib
import json
import logging
import math
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import ml_dtypes
import numpy as np
import orbax.checkpoint as ocp

from jaxsafe.config import ConfigError
from jaxsafe.run import files
from jaxsafe.types import PyTree

KEEP = 2  # the newest ones that stay
REPLAY = "replay"  # the part of a train state that may be left out
SMALL_REPLAY = 2e9  # bytes up to which it is kept, unless the user says otherwise
NUMBER = re.compile(r"bool|bfloat16|float(16|32|64)|u?int(8|16|32|64)")  # dtypes of leaves
NAME = re.compile(r"[\w.'\[\]<>-]+")  # of a leaf
OVERHEAD = 64 * files.MB  # bytes by which the files may exceed their arrays

Kind = tuple[str, tuple[int, ...]]  # the dtype and shape of an array


class CheckpointError(ConfigError):
    """A checkpoint that cannot be used. The message is one line for the user."""


class NoRoom(CheckpointError):
    """A checkpoint that this machine has too little memory for now."""


class NotSaved(RuntimeError):
    """What could not be written, as on a full disk. The message is one line for the user."""


@contextlib.contextmanager
def writing_to(folder: Path) -> Iterator[None]:
    """What the disk refuses becomes NotSaved."""
    try:
        yield
    except OSError as error:
        raise NotSaved(f"cannot write to {folder}: {error.strerror}") from error


class Progress(NamedTuple):
    """How far a run is."""

    iteration: int
    steps: int  # environment steps of one seed
    updates: int  # gradient steps of one seed, at most


class Manifest(NamedTuple):
    """What a checkpoint says about itself."""

    at: Progress
    files: dict[str, str]  # path under the checkpoint -> SHA-256
    leaves: dict[str, Kind]
    since: int = 0  # the iteration from which on its replay holds everything, see types.Shared


def is_key(leaf: Any) -> bool:
    return jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def leaf_names(tree: PyTree) -> list[str]:
    paths = jax.tree_util.tree_flatten_with_path(tree)[0]
    return [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in paths]


def to_arrays(tree: PyTree) -> dict[str, np.ndarray]:
    """The leaves of `tree` on the host, by name; random keys as their data."""
    leaves = jax.tree.map(lambda x: jax.random.key_data(x) if is_key(x) else x, jax.tree.leaves(tree))
    return dict(zip(leaf_names(tree), map(np.asarray, jax.device_get(leaves)), strict=True))


def as_data(like: PyTree) -> dict[str, Any]:
    """What `to_arrays` gives for a tree of these shapes."""
    leaves = [jax.eval_shape(jax.random.key_data, x) if is_key(x) else x for x in jax.tree.leaves(like)]
    return dict(zip(leaf_names(like), leaves, strict=True))


def from_arrays(like: PyTree, arrays: dict[str, np.ndarray]) -> PyTree:
    """The inverse of `to_arrays`, in the structure of `like` (arrays or their shapes)."""
    leaves, treedef = jax.tree.flatten(like)
    restored = [
        jax.random.wrap_key_data(jax.numpy.asarray(arrays[name])) if is_key(leaf) else arrays[name]
        for name, leaf in zip(leaf_names(like), leaves, strict=True)
    ]
    return jax.tree.unflatten(treedef, restored)


@contextlib.contextmanager
def orbax_checkpointer() -> Iterator[ocp.Checkpointer]:
    """One that waits for no other process. What it raises it does not log as well, with a traceback of
    each of its threads."""
    index = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(
        primary_host=index, active_processes={index}, barrier_sync_key_prefix=f"process{index}"
    )
    handler = ocp.StandardCheckpointHandler(multiprocessing_options=alone)
    logger = logging.getLogger("absl")  # Orbax's
    logger.addFilter(no_traceback)
    try:
        with ocp.Checkpointer(handler, multiprocessing_options=alone) as orbax:
            yield orbax
    finally:
        logger.removeFilter(no_traceback)


def no_traceback(record: logging.LogRecord) -> bool:
    return not record.exc_info


def in_replay(name: str) -> bool:
    return name.split(".")[0] == REPLAY


def replay_bytes(like: PyTree) -> int:
    """What the replay of a train state takes, 0 without one; `like` is arrays or their shapes."""
    return sum(x.size * x.dtype.itemsize for name, x in as_data(like).items() if in_replay(name))


def keeps_replay(like: PyTree, wanted: bool | None) -> bool:
    """Whether checkpoints hold the replay of such a train state, by the setting `checkpoint_replay`."""
    return replay_bytes(like) <= SMALL_REPLAY if wanted is None else wanted


def save(folder: Path, ts: PyTree, at: Progress, since: int = 0, replay: bool = True) -> Path:
    """Write `ts` as a checkpoint under `folder`; it and the newest others stay, `KEEP` in all.

    Args:
        folder: holds the numbered checkpoints.
        ts: the train state.
        at: how far it is.
        since: the iteration from which on its replay holds everything.
        replay: whether to keep the replay.
    Raises:
        NotSaved: it could not be written (a full disk); earlier checkpoints stay.
    """
    target, part = folder / f"{at.iteration:08d}", folder / f"{at.iteration:08d}.part"
    try:
        for leftover in folder.glob("*.part"):  # of a process that was killed
            shutil.rmtree(leftover)
        files.make_folder(folder, part.name)
        named = zip(leaf_names(ts), jax.tree.leaves(ts), strict=True)
        arrays = to_arrays({name: x for name, x in named if replay or not in_replay(name)})
        with orbax_checkpointer() as orbax:
            orbax.save(
                (part / "state").absolute(),
                args=ocp.args.StandardSave({k: v for k, v in arrays.items() if v.size}),  # type: ignore[call-arg]
            )
        manifest = {
            **at._asdict(),
            "since": since,
            "files": {name: files.digest(part / name) for name in files.below(part)},
            "leaves": kinds(arrays),
        }
        files.write(part / "manifest.json", json.dumps(manifest, indent=1))
        for name in files.below(part):
            files.sync(part / name)
        if target.exists():
            shutil.rmtree(target)
        part.rename(target)
        files.sync(folder)
    except Exception as error:  # Orbax and TensorStore raise many kinds
        shutil.rmtree(part, ignore_errors=True)
        last = checkpoints(folder)
        kept = f"the last good one is {last[0]}" if last else "there is no earlier one"
        raise NotSaved(f"cannot write checkpoint {target}: {reason(error)}; {kept}") from error
    others = [path for path in checkpoints(folder) if path != target]
    for old in others[KEEP - 1 :]:
        shutil.rmtree(old, ignore_errors=True)
    return target


def restore(
    folder: Path, like: PyTree, warn: Callable[[str], None] | None = None
) -> tuple[PyTree, Manifest]:
    """The newest sound checkpoint under `folder`, in the structure of `like`.

    A replay that was left out comes back empty, and `since` in the manifest is then its iteration.

    Args:
        folder: holds the numbered checkpoints.
        like: arrays, or `jax.eval_shape`s, that fix names, shapes and dtypes.
        warn: told, in one line, of each checkpoint that is passed over as corrupt.
    Raises:
        CheckpointError: none is sound, or the newest sound one is of another train state.
    """
    arrays, manifest = load(folder, warn)
    expected = as_data(like)
    if replay_bytes(like) and not any(map(in_replay, arrays)):
        arrays |= {name: np.zeros(x.shape, x.dtype) for name, x in expected.items() if in_replay(name)}
        manifest = manifest._replace(since=manifest.at.iteration)
    arrays = joined_alike(arrays, expected)
    have, want = kinds(arrays), kinds(expected)
    for name in sorted({*have, *want}):
        if have.get(name) != want.get(name):
            raise CheckpointError(
                f"{folder} has another train state: {name} is {leaf_in_words(have.get(name))}, "
                f"not {leaf_in_words(want.get(name))}"
            )
    return from_arrays(like, arrays), manifest


def joined_alike(arrays: Mapping[str, Any], expected: Mapping[str, Any]) -> dict[str, Any]:
    """`arrays`, where what `expected` has as one array is joined, and what it has apart is split: Adam
    keeps a network's moments as one array on a GPU alone. Both are in the order of the train state."""

    made = dict(arrays)

    def parts_of(whole: str, its: tuple[int, ...], among: Mapping[str, Any]) -> dict[str, int]:
        """Names and sizes of the arrays that make up `whole`, of shape `its`; none if they misfit."""
        lead, last = its[:-1], its[-1:]
        parts = {k: x.shape for k, x in among.items() if k.startswith(f"{whole}.")}
        sizes = {k: math.prod(shape[len(lead) :]) for k, shape in parts.items()}
        alike = all(shape[: len(lead)] == lead for shape in parts.values())
        return sizes if alike and last == (sum(sizes.values()),) else {}

    for whole in arrays.keys() - expected.keys():
        if sizes := parts_of(whole, arrays[whole].shape, expected):
            split = np.split(made.pop(whole), np.cumsum(list(sizes.values()))[:-1], axis=-1)
            made |= {k: x.reshape(expected[k].shape) for k, x in zip(sizes, split, strict=True)}
    for whole in expected.keys() - arrays.keys():
        shape = tuple(expected[whole].shape)
        if sizes := parts_of(whole, shape, arrays):
            made[whole] = np.concatenate([made.pop(k).reshape(*shape[:-1], -1) for k in sizes], -1)
    return made


def load(
    folder: Path, warn: Callable[[str], None] | None = None
) -> tuple[dict[str, np.ndarray], Manifest]:
    """The newest sound checkpoint under `folder`, as {leaf name: array}."""
    problems = []
    warn = warn or (lambda line: print(line, file=sys.stderr))
    for path in checkpoints(folder):
        try:
            manifest = read_manifest(path)
            verify(path, manifest)
            arrays = read_leaves(path, manifest)
        except NoRoom as error:  # an older one would need as much
            raise NoRoom(f"{path}: {error}") from error
        except Exception as error:  # Orbax and TensorStore raise many kinds
            problems.append(f"{path} is corrupt ({reason(error)})")
            continue
        for problem in problems:
            warn(f"warning: {problem}; taking an older one")
        return arrays, manifest
    raise CheckpointError("; ".join(problems) or f"no checkpoint in {folder}")


def read_manifest(path: Path) -> Manifest:
    """What a checkpoint says about itself.

    Raises:
        ConfigError: it says something else.
    """
    file = path / "manifest.json"
    raw = files.read_json(file)
    with files.reading(file):
        leaves = {
            k: (str(dtype), tuple(int(n) for n in shape)) for k, (dtype, shape) in raw["leaves"].items()
        }
        at, since = Progress(*(int(raw[name]) for name in Progress._fields)), int(raw["since"])
        manifest = Manifest(at, {k: str(v) for k, v in raw["files"].items()}, leaves, since)
    if min(*at, since) < 0:
        raise ConfigError(f"{file}: expected an iteration and steps of at least 0")
    for name, (dtype, shape) in leaves.items():
        if not NAME.fullmatch(name) or not NUMBER.fullmatch(dtype) or min(shape, default=0) < 0:
            raise ConfigError(f"{file}: {name} is {leaf_in_words((dtype, shape))}; expected numbers")
    return manifest


def kinds(arrays: Mapping[str, Any]) -> dict[str, Kind]:
    return {name: (str(x.dtype), tuple(x.shape)) for name, x in arrays.items()}


def size_of(leaves: Mapping[str, Kind]) -> int:
    """The bytes of arrays of these dtypes and shapes."""
    return sum(dtype_of(dtype).itemsize * math.prod(shape) for dtype, shape in leaves.values())


def dtype_of(name: str) -> np.dtype:
    return np.dtype(ml_dtypes.bfloat16 if name == "bfloat16" else name)


def verify(path: Path, manifest: Manifest) -> None:
    """Raise CheckpointError or ConfigError unless the files are those that the manifest lists, and no
    larger than their arrays, which fit this machine."""
    present = set(files.below(path)) - {"manifest.json"}
    if present != set(manifest.files):
        odd = min(present ^ set(manifest.files))
        raise CheckpointError(f"{'unknown' if odd in present else 'missing'} file {odd}")
    size, room = size_of(manifest.leaves), host_memory()
    if size > room:
        raise NoRoom(f"its arrays need {size:.1e} bytes, this machine has {room:.1e} free")
    if (found := sum((path / name).lstat().st_size for name in present)) > 2 * size + OVERHEAD:
        raise CheckpointError(f"its files have {found:,} bytes, its arrays {size:,}")
    for name, expected in manifest.files.items():
        if files.digest(path / name) != expected:
            raise CheckpointError(f"checksum of {name} differs")


def host_memory() -> float:
    """Bytes of memory that a program can still have on this machine, or infinity where unknown."""
    limits = [math.inf]
    with contextlib.suppress(OSError, ValueError, LookupError):
        limits.append(in_proc("meminfo", "MemAvailable"))
    for path in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with contextlib.suppress(OSError, ValueError, LookupError):
            limits.append(float(Path(path).read_text()) - in_proc("self/status", "RssAnon"))
    return min(limits)


def in_proc(name: str, field: str) -> float:
    """Bytes that a file of Linux's /proc says."""
    rows = dict(line.split(":", 1) for line in Path("/proc", name).read_text().splitlines())
    return float(rows[field].split()[0]) * 1024


def check_stored(state: Path, leaves: Mapping[str, Kind], orbax: Any) -> None:
    """Raise CheckpointError unless Orbax's own files say the same of their arrays: it would read what
    they say."""
    stored = {k: v for k, v in orbax.metadata(state).item_metadata.tree.items() if v is not None}
    if stored.keys() != leaves.keys():
        raise CheckpointError(f"state/ holds {len(stored)} arrays, the manifest {len(leaves)}")
    for name, (dtype, shape) in leaves.items():
        have = stored[name]
        if (str(np.dtype(have.dtype)), tuple(have.shape)) != (dtype, shape):
            raise CheckpointError(f"{name} is {have.dtype}{list(have.shape)} in state/")
        chunk = have.storage.chunk_shape if have.storage else None
        if chunk is not None and math.prod(chunk) > max(math.prod(shape), 1):
            raise CheckpointError(f"{name} is stored in parts larger than itself")


def read_leaves(path: Path, manifest: Manifest) -> dict[str, np.ndarray]:
    """Read exactly the arrays that the manifest lists, as host arrays of those shapes and dtypes."""
    like = {  # one number each, whatever the shape
        k: np.broadcast_to(np.zeros((), dtype_of(dtype)), shape)
        for k, (dtype, shape) in manifest.leaves.items()
    }
    stored = {k: x for k, x in like.items() if x.size}
    with orbax_checkpointer() as orbax:
        check_stored((path / "state").absolute(), kinds(stored), orbax)
        restored = orbax.restore((path / "state").absolute(), args=ocp.args.StandardRestore(stored))  # type: ignore[call-arg]
    arrays = {k: restored[k] if k in stored else np.array(x) for k, x in like.items()}
    for name, kind in kinds(arrays).items():
        if kind != manifest.leaves[name]:
            raise CheckpointError(f"{name} is {leaf_in_words(kind)}")
    return arrays


def checkpoints(folder: Path) -> list[Path]:
    """The complete checkpoints under `folder`, newest first.

    Raises:
        ConfigError: one of them is a link.
    """
    found = folder.glob("[0-9]" * 8) if folder.is_dir() else ()
    found = (files.inside(folder, path.name) for path in found)
    return sorted((p for p in found if files.there(p / "manifest.json")), reverse=True)


def leaf_in_words(leaf: Kind | None) -> str:
    return "absent" if leaf is None else f"{leaf[0]}{list(leaf[1])}"


def reason(error: BaseException) -> str:
    """One short line for any exception."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    text = " ".join(str(error).split()) or type(error).__name__
    for known in ("No space left on device", "File too large", "Disk quota exceeded"):
        if known in text:
            return known
    return text if len(text) <= 160 else text[:157] + "..."

"""The files of a run folder, which a stranger may have made. Only this module opens them.

The path that a user types is trusted, and may be a link. What lies inside the folder is not: a link, a
pipe or a device is refused, and so is a file beyond its limit. Nothing is ever written through a name
that is already there. A new file gets a fresh name, and then takes the place of the old one.

This guards against what lies in a folder, not against a process that changes it at the same time.
"""

import contextlib
import csv
import errno
import fcntl
import hashlib
import io
import json
import lzma
import os
import stat
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from jaxsafe.config import ConfigError, one_line

KB, MB = 1 << 10, 1 << 20
LIMITS = {  # bytes that a file may have, packed or not
    "config.yaml": 256 * KB,
    "study.yaml": 256 * KB,
    "sweep.yaml": 4 * MB,
    "versions.json": 16 * MB,
    "manifest.json": 16 * MB,
    "evaluation.json": 64 * MB,
    "diverged.json": 64 * MB,
    "README.md": 16 * MB,
    "final.csv": 64 * MB,
    "curves.npz": 512 * MB,
    "metrics.csv": 1024 * MB,
    "metrics.csv.xz": 1024 * MB,
}
PACKED = 100  # times that unpacking may make a file larger; metrics become 4 times as large
DEEPEST = 20  # lists and dicts in each other
TOO_DEEP = f"{{}} holds more than {DEEPEST} lists or dicts in each other"
BROKEN = (  # what readers raise of a file that holds something else
    ValueError, TypeError, LookupError, ArithmeticError, AttributeError, RecursionError, MemoryError,
    EOFError, OSError, csv.Error, yaml.YAMLError, lzma.LZMAError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """Whatever is wrong with the file becomes a ConfigError of one line."""
    try:
        yield
    except ConfigError:
        raise
    except BROKEN as error:
        raise ConfigError(f"{path} cannot be read: {one_line(error)}") from error


# ---- folders ----------------------------------------------------------------------------------


def inside(folder: Path, *names: str) -> Path:
    """The folder folder/name/..., which is there as a real one or not at all.

    Raises:
        ConfigError: one on the way is a link, or no folder.
    """
    for name in names:
        folder = folder / name
        if os.path.lexists(folder) and not stat.S_ISDIR(folder.lstat().st_mode):
            raise ConfigError(f"{folder} is {kind_of(folder)}; expected a folder")
    return folder


def make_folder(folder: Path, *names: str) -> Path:
    """`inside`, made if it is not there."""
    path = inside(folder, *names)
    path.mkdir(parents=True, exist_ok=True)
    return path


def nearest_above(path: Path) -> Path:
    """The path itself or, where there is nothing of this name, the nearest one above that is there."""
    path = path.absolute()
    return next(each for each in (path, *path.parents) if os.path.lexists(each))


def try_writing(folder: Path) -> None:
    """Write in a folder or, where it is not there yet, in the nearest one above. Nothing of it stays.

    Raises:
        OSError: nobody can write there.
    """
    tempfile.TemporaryFile(dir=nearest_above(folder)).close()


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """The folder for one process alone. The system lets go of it if the process dies.

    Nothing is held where the file system cannot lock a folder, as on some networks.

    Raises:
        ConfigError: another process holds it.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno == errno.EWOULDBLOCK:
            os.close(descriptor)
            raise ConfigError(f"another process is training in {folder}") from error
    try:
        yield
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def in_turn(folder: Path) -> Iterator[None]:
    """The folder for one process and thread alone, once the others are done with it.

    As of `held`, nothing is held where the file system cannot lock a folder.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        with contextlib.suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def below(folder: Path) -> list[str]:
    """The names of all files at any depth below a folder, sorted.

    Raises:
        ConfigError: something there is neither a plain file nor a real folder, or there are too many.
    """
    found, todo = [], [folder]
    while todo:
        with os.scandir(todo.pop()) as entries:
            for entry in entries:
                path = Path(entry.path)
                if entry.is_dir(follow_symlinks=False):
                    todo.append(path)
                elif entry.is_file(follow_symlinks=False):
                    found.append(path.relative_to(folder).as_posix())
                else:
                    raise ConfigError(f"{path} is {kind_of(path)}; expected a plain file")
                if len(found) + len(todo) > 100_000:
                    raise ConfigError(f"{folder} holds more than 100,000 files")
    return sorted(found)


def runs_in(folder: Path) -> list[Path]:
    """The run folders right in a folder; links to others are passed over."""
    found = (path.parent for path in sorted(folder.glob("*/config.yaml")))
    return [path for path in found if not path.is_symlink()]


# ---- reading ----------------------------------------------------------------------------------


def there(path: Path) -> bool:
    """Whether there is anything of this name. What it is shows when it is opened."""
    return os.path.lexists(path)


def opened(path: Path) -> io.BufferedReader:
    """A plain file, for reading.

    Raises:
        ConfigError: it is a link or no plain file.
        OSError: there is none, or it cannot be read.
    """
    if not stat.S_ISREG(path.lstat().st_mode):
        raise ConfigError(f"{path} is {kind_of(path)}; expected a plain file")
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    return os.fdopen(handle, "rb")


def digest(path: Path) -> str:
    """The SHA-256 of a plain file."""
    with opened(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read(path: Path) -> bytes:
    """A whole file, within the limit of its name.

    Raises:
        ConfigError: it is no plain file, or too large, or it cannot be read.
    """
    with reading(path), opened(path) as file:
        size, limit = os.fstat(file.fileno()).st_size, LIMITS[path.name]
        if size > limit:
            raise ConfigError(f"{path} has {size:,} bytes; expected at most {limit:,}")
        return file.read(limit)


def read_text(path: Path) -> str:
    """`read`, as text. An .xz is unpacked, up to `PACKED` times its size."""
    data = read(path)
    with reading(path):
        if path.suffix == ".xz":
            limit = min(LIMITS[path.name], MB + PACKED * len(data))
            unpacker = lzma.LZMADecompressor(memlimit=256 * MB)
            text = unpacker.decompress(data, limit)
            if not unpacker.eof:
                raise ConfigError(f"{path} is cut off, or unpacks to more than {limit:,} bytes")
            data = text
        return data.decode()


def read_yaml(path: Path) -> Any:
    """Dicts with text as keys, lists and scalars. Nothing in the file is executed.

    Raises:
        ConfigError: it holds anything else, or it cannot be read.
    """
    text = read_text(path)
    with reading(path):
        check_events(text, path)
        found = yaml.load(text, LOADER)
        check_plain(found, path)
    return found


def check_events(text: str, path: Path) -> None:
    """Refuse what is costly to load: aliases, and levels, for each of which the loader calls itself."""
    depth = 0
    try:
        for event in yaml.parse(text, LOADER):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > DEEPEST:
                raise ConfigError(TOO_DEEP.format(path))
            if isinstance(event, yaml.AliasEvent):  # a few lines of them stand for billions of values
                raise ConfigError(f"{path} holds an alias, *{event.anchor}; expected plain values")
    except yaml.MarkedYAMLError as error:
        if error.context == "while increasing flow level":  # a bound of newer builds of libyaml
            raise ConfigError(TOO_DEEP.format(path)) from None
        raise


def read_json(path: Path) -> Any:
    """As `read_yaml`, of JSON."""
    text = read_text(path)
    with reading(path):
        found = json.loads(text)
        check_plain(found, path)
    return found


def check_plain(value: Any, path: Path, depth: int = 0) -> None:
    """Raise ConfigError unless a value is made of dicts with text as keys, lists and scalars."""
    if depth > DEEPEST:
        raise ConfigError(TOO_DEEP.format(path))
    if isinstance(value, dict):
        for name, inner in value.items():
            if not isinstance(name, str):
                raise ConfigError(f"{path} holds the name {name!r}; expected text")
            check_plain(inner, path, depth + 1)
    elif isinstance(value, list):
        for inner in value:
            check_plain(inner, path, depth + 1)
    elif value is not None and not isinstance(value, bool | int | float | str):
        raise ConfigError(f"{path} holds a {type(value).__name__}; expected numbers and text")


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an .npz, by name. None is made before the file is known to hold it.

    Raises:
        ConfigError: it is no plain file, an array is of objects, or they are too large.
    """
    data = read(path)
    with reading(path), zipfile.ZipFile(io.BytesIO(data)) as archive:
        members, limit = archive.infolist(), LIMITS[path.name]
        if (size := sum(x.file_size for x in members)) > min(limit, MB + PACKED * len(data)):
            raise ConfigError(f"{path} unpacks to {size:,} bytes; expected at most {limit:,}")
        return {
            x.filename.removesuffix(".npy"): array_in(archive.read(x), f"{path}, {x.filename}")
            for x in members
        }


def array_in(data: bytes, what: str) -> np.ndarray:
    """The array of an .npy file's bytes."""
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, _, dtype = header[version](file)
    count = int(np.prod(shape, dtype=object))
    if dtype.hasobject or count * dtype.itemsize != len(data) - file.tell():
        raise ConfigError(f"{what} is {dtype}{list(shape)} in {len(data)} bytes")
    return np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)


# ---- writing ----------------------------------------------------------------------------------


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """An OSError that names no file, as when the disk is full, names `path`."""
    try:
        yield
    except OSError as error:
        if error.strerror and error.filename is None:
            error.filename = str(path)
        raise


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A new empty file to write, of the same suffix, which takes the place of `path` at the end."""
    part = path.with_name(f".{path.stem}.{os.urandom(8).hex()}{path.suffix}")
    os.close(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666))
    try:
        with naming(path):
            yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write(path: Path, content: str | bytes) -> None:
    """Replace a file, whole or not at all."""
    with replacing(path) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


def appending(path: Path) -> io.TextIOWrapper:
    """A text file, made if it is not there, to write at its end.

    Raises:
        ConfigError: it is no plain file, or it has a second name, which may lie elsewhere.
    """
    if path.is_symlink():
        raise ConfigError(f"{path} is a link; expected a plain file")
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
    handle = os.open(path, flags, 0o666)
    about = os.fstat(handle)
    if not stat.S_ISREG(about.st_mode) or about.st_nlink > 1:
        os.close(handle)
        raise ConfigError(f"{path} is {kind_of(path)}; expected a plain file of one name")
    return os.fdopen(handle, "a", newline="")


def sync(path: Path) -> None:
    """Put a file or the entries of a folder on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def kind_of(path: Path) -> str:
    """What a name stands for, in a user's words."""
    mode = path.lstat().st_mode
    names = {
        stat.S_IFLNK: "a link",
        stat.S_IFDIR: "a folder",
        stat.S_IFREG: "a file",
        stat.S_IFIFO: "a pipe",
        stat.S_IFSOCK: "a socket",
        stat.S_IFCHR: "a device",
        stat.S_IFBLK: "a device",
    }
    return names.get(stat.S_IFMT(mode), "no file")

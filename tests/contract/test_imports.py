"""Who may import whom, and what a wheel must hold."""

import ast
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import jaxsafe

ROOT = Path(__file__).parent.parent.parent
SOURCES = ("jaxsafe", "envs", "algos")
# Rooms from the lowest to the highest; one may import those below it and its own.
ROOMS = (
    {"jaxsafe.types", "jaxsafe.config", "jaxsafe.nvidia"},
    {"jaxsafe.nn"},
    {"jaxsafe.learn"},
    {"jaxsafe.envs", "jaxsafe.algos"},
    {"jaxsafe.run"},
    {"jaxsafe.report"},
    {"jaxsafe.interop"},
    {"jaxsafe.commands"},
    {"jaxsafe.api"},
)
LEVEL = {room: level for level, rooms in enumerate(ROOMS) for room in rooms}
LINKS = (ROOT / "jaxsafe" / "envs", ROOT / "jaxsafe" / "algos")
MODULES = sorted(
    path
    for folder in SOURCES
    for path in (ROOT / folder).rglob("*.py")
    if not any(link in path.parents for link in LINKS)
)


def dotted(path: Path) -> str:
    """'jaxsafe.envs.check' of envs/check.py."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts if parts[0] == "jaxsafe" else ("jaxsafe", *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room_of(name: str) -> str | None:
    return next((room for room in LEVEL if name == room or name.startswith(f"{room}.")), None)


def imported(path: Path) -> set[str]:
    """Every module that `path` imports, by its full name, wherever in the file."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@pytest.mark.parametrize("path", MODULES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_imports_point_one_way(path):
    own = room_of(dotted(path))
    for name in imported(path):
        assert name.split(".")[0] not in ("envs", "algos", "scripts", "tests"), f"imports {name}"
        if own and (other := room_of(name)) and other != own:
            assert LEVEL[other] < LEVEL[own], f"{own} imports {name}"


def test_only_the_lazy_names_lead_to_the_api():
    users = {path for path in MODULES for name in imported(path) if name.startswith("jaxsafe.api")}
    assert users == {ROOT / "jaxsafe" / "__init__.py"}


@pytest.mark.parametrize(
    "cores, parts, threads",
    [
        (2, {}, 3),
        (2, {"JAX_NUM_CPU_DEVICES": "3"}, 7),
        (2, {"XLA_FLAGS": "--xla_force_host_platform_device_count=4"}, 9),
        (16, {}, 16),
    ],
)
def test_xla_has_two_threads_for_each_part_of_the_cpu_and_one_more(cores, parts, threads, monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: cores)
    monkeypatch.delenv("JAX_NUM_CPU_DEVICES", raising=False)
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    for name, value in parts.items():
        monkeypatch.setenv(name, value)
    assert jaxsafe._threads() == threads


def test_the_links_into_the_package_exist_and_are_relative():
    for name in ("envs", "algos"):
        link = ROOT / "jaxsafe" / name
        assert link.is_symlink() and link.readlink() == Path("..") / name


def build(kind: str, source: Path, out: Path) -> Path:
    """The 'wheel' or 'sdist' of a folder with our sources."""
    pytest.importorskip("setuptools", minversion="77")
    code = f"from setuptools.build_meta import build_{kind}; build_{kind}({str(out)!r})"
    done = subprocess.run([sys.executable, "-c", code], cwd=source, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (built,) = out.iterdir()
    return built


def test_the_sdist_and_its_wheel_hold_every_module_and_asset_and_no_tests(tmp_path):
    source, out = tmp_path / "source", tmp_path / "out"
    source.mkdir()
    for name in (
        "pyproject.toml",
        "MANIFEST.in",
        "README.md",
        "LICENSE",
        "CHANGELOG.md",
        "CITATION.cff",
    ):
        shutil.copy(ROOT / name, source)
    for name in ("jaxsafe", "envs", "algos", "tests"):
        ignored = shutil.ignore_patterns("__pycache__", "data")
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=ignored)
    with tarfile.open(build("sdist", source, out / "sdist")) as archive:
        archive.extractall(tmp_path, filter="data")
    (unpacked,) = tmp_path.glob("jaxsafe-*")
    assert not (unpacked / "tests").exists() and (unpacked / "CHANGELOG.md").exists()
    wheel = zipfile.ZipFile(build("wheel", unpacked, out / "wheel"))
    names = set(wheel.namelist())
    marker = ROOT / "jaxsafe" / "py.typed"
    kernels = [x for part in ("envs", "jaxsafe/nn") for x in (ROOT / part).rglob("*.cu")]
    for path in [*MODULES, marker, *(ROOT / "envs").rglob("*.xml"), *kernels]:
        inside = path.relative_to(ROOT).as_posix()
        assert (inside if inside.startswith("jaxsafe/") else f"jaxsafe/{inside}") in names
    (entries,) = (name for name in names if name.endswith("entry_points.txt"))
    assert b"jaxsafe = jaxsafe.commands.jaxsafe:main" in wheel.read(entries)

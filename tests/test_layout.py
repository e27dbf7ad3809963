"""Who may import whom, and what a wheel must hold."""

import ast
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FORBIDDEN = {
    "jaxsafe": ("jaxsafe.envs", "jaxsafe.algos"),
    "envs": ("jaxsafe.algos",),
    "algos": ("jaxsafe.envs",),
}
MODULES = sorted(p for folder in FORBIDDEN for p in (ROOT / folder).glob("*.py"))


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
    above = path == ROOT / "jaxsafe" / "api.py"  # the scripts as functions: it knows what they know
    banned = (*(() if above else FORBIDDEN[path.parent.name]), "envs", "algos", "scripts", "tests")
    for name in imported(path):
        assert not any(name == b or name.startswith(b + ".") for b in banned), f"imports {name}"


def test_only_the_lazy_names_lead_to_the_api():
    users = {path for path in MODULES for name in imported(path) if name.startswith("jaxsafe.api")}
    assert users == {ROOT / "jaxsafe" / "__init__.py"}


def test_the_links_into_the_package_exist_and_are_relative():
    for name in ("envs", "algos"):
        link = ROOT / "jaxsafe" / name
        assert link.is_symlink() and link.readlink() == Path("..") / name


def test_source_folders_are_flat():
    for folder in FORBIDDEN:
        nested = [p for p in (ROOT / folder).glob("*/**/*.py") if not p.parent.is_symlink()]
        nested = [p for p in nested if not any(a.is_symlink() for a in p.parents if ROOT in a.parents)]
        assert nested == []


def test_the_wheel_holds_every_module_and_asset(tmp_path):
    source, out = tmp_path / "source", tmp_path / "out"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        if (ROOT / name).exists():
            shutil.copy(ROOT / name, source)
    (source / "README.md").touch()
    for name in ("jaxsafe", "envs", "algos"):
        shutil.copytree(
            ROOT / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__")
        )
    code = f"from setuptools.build_meta import build_wheel; build_wheel({str(out)!r})"
    pytest.importorskip("setuptools", minversion="77")
    done = subprocess.run([sys.executable, "-c", code], cwd=source, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (wheel,) = out.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    marker = ROOT / "jaxsafe" / "py.typed"
    for path in [*MODULES, marker, *(ROOT / "envs" / "assets").glob("*.xml")]:
        inside = path.relative_to(ROOT).as_posix()
        assert (inside if inside.startswith("jaxsafe/") else f"jaxsafe/{inside}") in names

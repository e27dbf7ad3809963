import importlib
import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent.parent


sys.path.insert(0, str(ROOT / "docs"))


def script(name: str) -> Any:
    """A script of docs/, as a module."""
    return importlib.import_module(name)


def test_the_pages_of_algorithms_and_environments_are_those_of_the_code():
    pages = script("pages").pages()
    for folder in ("algorithms", "environments"):
        there = {*(ROOT / "docs" / folder).iterdir()}
        assert there == {path for path in pages if path.parent.name == folder}
    for path, text in pages.items():
        assert path.read_text() == text, f"{path.name}: run python docs/pages.py"


def test_the_tables_of_the_docs_are_those_of_the_code():
    tables = script("tables")
    for path, made in tables.TABLES.items():
        assert path.read_text().count("<!-- table:") == len(made)
        assert tables.filled(path) == path.read_text(), f"{path.name}: run python docs/tables.py"


def test_the_tables_of_measurements_are_those_of_the_studies_and_the_data():
    for path, text in script("measured").pages().items():
        assert path.read_text() == text, f"{path}: run python docs/measured.py"


def test_studies_are_small():
    folders = [path.parent for path in (ROOT / "docs" / "results").glob("*/study.yaml")]
    assert len(folders) >= 7
    for folder in folders:
        files = list(folder.iterdir())
        assert len(files) <= 4 and sum(file.stat().st_size for file in files) < 600_000, folder


def test_every_link_of_the_readme_leads_somewhere():
    for path in re.findall(r"\]\(([^)#]+)\)|src=\"([^\"]+)\"", (ROOT / "README.md").read_text()):
        target = "".join(path)
        assert target.startswith("https://") or (ROOT / target).exists(), target


def test_the_readme_is_one_screen_with_a_small_moving_picture():
    assert len((ROOT / "README.md").read_text()) < 5_000
    assert (ROOT / "docs/images/policy.gif").stat().st_size < 2_000_000

import importlib.util
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent


def script(name: str) -> Any:
    """A script of docs/, as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_pages_of_the_algorithms_are_those_of_the_code():
    pages = script("pages").pages()
    assert {path.name for path in (ROOT / "docs" / "algorithms").iterdir()} == {p.name for p in pages}
    for path, text in pages.items():
        assert path.read_text() == text, f"{path.name}: run python docs/pages.py"


def test_the_tables_of_the_readme_and_the_docs_are_those_of_the_code():
    tables = script("tables")
    for path, made in tables.TABLES.items():
        assert path.read_text().count("<!-- table:") == len(made)
        assert tables.filled(path) == path.read_text(), f"{path.name}: run python docs/tables.py"


def test_every_link_of_the_readme_leads_somewhere():
    for path in re.findall(r"\]\(([^)#]+)\)|src=\"([^\"]+)\"", (ROOT / "README.md").read_text()):
        target = "".join(path)
        assert target.startswith("https://") or (ROOT / target).exists(), target

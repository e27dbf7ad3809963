import importlib.util
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_the_tables_of_the_readme_are_those_of_the_registries():
    spec = importlib.util.spec_from_file_location("tables", ROOT / "docs" / "tables.py")
    assert spec and spec.loader
    tables = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tables)
    text = (ROOT / "README.md").read_text()
    assert text.count("<!-- table:") == 2
    assert tables.filled(text) == text


def test_every_link_of_the_readme_leads_somewhere():
    for path in re.findall(r"\]\(([^)#]+)\)|src=\"([^\"]+)\"", (ROOT / "README.md").read_text()):
        target = "".join(path)
        assert target.startswith("https://") or (ROOT / target).exists(), target

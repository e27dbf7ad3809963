"""What an algorithm may import is what docs/howto/own_algorithm.md lists."""

import ast
import importlib
import json
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
PAGE = (ROOT / "docs" / "howto" / "own_algorithm.md").read_text()
BORDER = {
    module: set(re.findall(r"`(\w+)`", names))
    for module, names in re.findall(r"^\| `(jaxsafe[\w.]+)` \| ([^|]+) \|", PAGE, re.M)
}


def imports(code: str) -> set[tuple[str, str]]:
    """(module, name) of everything that `code` imports from jaxsafe's rooms."""
    found = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("jaxsafe."):
            found |= {(node.module or "", alias.name) for alias in node.names}
        elif isinstance(node, ast.Import):
            assert not any(alias.name.startswith("jaxsafe.") for alias in node.names)
    return {(module, name) for module, name in found if not module.startswith("jaxsafe.algos")}


def beyond(code: str) -> set[tuple[str, str]]:
    return {(module, name) for module, name in imports(code) if name not in BORDER.get(module, set())}


def test_our_algorithms_import_what_the_page_lists_and_nothing_else():
    used = set()
    for path in (ROOT / "algos").glob("[a-z]*.py"):
        code = path.read_text()
        assert not beyond(code), f"{path.name}: {beyond(code)} is not on the page"
        used |= imports(code)
    assert {"on_policy", "Row", "Treatment", "Learner"} <= {name for _, name in used}


def test_the_examples_for_readers_stay_within_the_border():
    blocks = [b for b in re.findall(r"```python\n(.*?)```", PAGE, re.S) if "ROWS" in b]
    cells = json.loads((ROOT / "notebooks" / "own_algorithm.ipynb").read_text())["cells"]
    blocks += ["".join(c["source"]) for c in cells if c["cell_type"] == "code" and c["source"]]
    code = [b for b in blocks if "jaxsafe." in b and not b.lstrip().startswith(("%", "!"))]
    assert len(code) >= 2
    for block in code:
        plain = "\n".join(line for line in block.splitlines() if not line.startswith(("%", "!")))
        assert not beyond(plain), beyond(plain)


def test_every_name_on_the_page_exists():
    assert len(BORDER) > 15
    for module, names in BORDER.items():
        missing = names - vars(importlib.import_module(module)).keys()
        assert not missing, f"{module} has no {missing}"

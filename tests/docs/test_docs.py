"""The site's pages: what docs/hooks.py makes of the files. `mkdocs build --strict` builds them."""

import importlib
import re
import sys
from pathlib import Path

import pytest

from jaxsafe.envs.velocity import suite as velocities
from jaxsafe.report.tables import between_marks
from jaxsafe.run.arguments import compose

ROOT = Path(__file__).parent.parent.parent
DOCS = ROOT / "docs"
sys.path.insert(0, str(DOCS))
hooks = importlib.import_module("hooks")
equations = importlib.import_module("equations")
cells = importlib.import_module("cells")
PAGES = sorted(DOCS.rglob("*.md"))


def test_every_link_of_the_docs_leads_somewhere():
    for page in PAGES:
        text = re.sub(r"^(```.*?^```|    .*?$)", "", page.read_text(), flags=re.M | re.S)
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text):
            assert target.startswith("https://") or (page.parent / target).exists(), (page, target)


def test_every_anchor_of_the_docs_is_a_heading():
    def headings(page: Path) -> set[str]:
        lines = re.findall(r"^#+ (.*)$", page.read_text(), re.M)
        return {re.sub(r"[^\w\- ]", "", line.lower()).replace(" ", "-") for line in lines}

    found = 0
    for page in [*PAGES, ROOT / "README.md"]:
        text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S)
        for target, anchor in re.findall(r"\]\(([^)#:]*)#([^)]+)\)", text):
            assert anchor in headings(page.parent / target if target else page), (page, target, anchor)
            found += 1
    assert found > 5


@pytest.mark.parametrize(
    "page", [pytest.param("concepts.md", marks=pytest.mark.slow), "howto/several_constraints.md"]
)
def test_the_python_of_a_page_runs(page, capsys):
    blocks = re.findall(r"^```python\n(.*?)^```$", (DOCS / page).read_text(), re.M | re.S)
    assert blocks
    for text in blocks:
        exec(compile(text, page, "exec"), {})
    assert capsys.readouterr().out


def test_the_menu_has_every_page_once_by_a_short_title():
    entries = [entry for section in hooks.listed(DOCS) for pages in section.values() for entry in pages]
    found = [page for entry in entries for page in entry.values()]
    assert sorted(found) == sorted(str(page.relative_to(DOCS)) for page in PAGES)
    titles = [title for entry in entries for title in entry]
    assert max(map(len, titles)) <= 40 and "CPO" in titles


def test_the_site_loads_nothing_from_elsewhere():
    named = re.findall(r"assets/[\w./]+", (ROOT / "mkdocs.yml").read_text())
    assert "assets/katex/katex.min.js" in named and all((DOCS / name).exists() for name in named)
    style = (DOCS / "assets/katex/katex.min.css").read_text()
    fonts = re.findall(r"url\(([^)]+)\)", style)
    assert fonts and all((DOCS / "assets/katex" / font).exists() for font in fonts)
    assert (DOCS / "assets/katex/LICENSE").exists()


@pytest.mark.parametrize(
    "link, expected",
    [
        ("[a](../fidelity.md)", "[a](../fidelity.md)"),
        ("[a](../results/README.md#x)", "[a](../results/README.md#x)"),
        ("[a](../results)", "[a](../results/README.md)"),
        ("[a](../../envs/safety_gym/suite.py)", "[a](../source/envs/safety_gym/suite.py.txt)"),
        ("[a](../../scripts)", "[a](../source/scripts.txt)"),
        ("[a](../pages.py)", "[a](../source/docs/pages.py.txt)"),
        ('<img src="../images/car_push2.png" width="270">',
         '<img src="../images/car_push2.png" width="270">'),
        ("[a](#sweep)", "[a](#sweep)"),
        ("[a](https://example.org/x)", "[a](https://example.org/x)"),
        ("```text\n[a](../../envs/safety_gym/suite.py)\n```",
         "```text\n[a](../../envs/safety_gym/suite.py)\n```"),
    ],
)  # fmt: skip
def test_links_to_files_beside_the_site_lead_to_copies_of_them(link, expected):
    assert hooks.relinked(link, "docs/howto/several_gpus.md") == expected


def test_a_table_replaces_what_stands_between_its_marks_alone():
    for old in ("", "| old |\n", "| old |\n\nmore\n"):
        text = f"before\n<!-- table: a -->\n{old}<!-- end -->\nafter\n<!-- end -->\n"
        new = between_marks(text, {"a": "| new |"})
        assert new == "before\n<!-- table: a -->\n| new |\n<!-- end -->\nafter\n<!-- end -->\n"
    with pytest.raises(ValueError, match="no <!-- table: a -->"):
        between_marks("<!-- table: a -->\n", {"a": "| new |"})


def test_files_that_pages_link_to_are_there():
    found = hooks.sources(DOCS)
    assert {"algos/cpo.py", "CONTRIBUTING.md"} <= found
    assert all((ROOT / path).exists() for path in found)


def test_docstrings_show_fields_and_sections():
    fields = "State.\n\nobs: float [O], of\n    it.\nreward, cost: float [].\n\n"
    shown = "State.\n\n- `obs`: float [O], of\n    it.\n- `reward, cost`: float [].\n\n"
    args = "Args:\n    x: y.\nReturns:\n    z."
    assert hooks.laid_out(fields + args) == f"{shown}Args:\n    x: y.\n\nReturns:\n    z."
    assert hooks.laid_out("Does.\nSource: A\n    (2020).") == "Does.\n\n*Source:* A (2020)."


def test_every_task_of_the_suite_has_a_small_picture():
    found = {path.stem: path.stat().st_size for path in (DOCS / "images/environments").glob("*.jpg")}
    tasks = [f"{task}{level}" for task in ("goal", "button", "push") for level in "012"]
    drawn = {f"{robot}_{task}" for robot in ("point", "car", "doggo") for task in tasks}
    assert set(found) == drawn | set(velocities.suite())
    assert max(found.values()) <= 25_000


def test_equations_of_algorithms_are_typeset():
    line = equations.line
    assert line("Q' <- Q' + tau_x (Q - 1e-6)", {"tau_x"}) == (
        "<i>Q</i>′ ← <i>Q</i>′ + tau_x (<i>Q</i> − 1e-6)"
    )
    assert line("sum_j (y_c - lam)^2 <= cost_limit") == (
        "Σ<sub><i>j</i></sub> (<i>y</i><sub><i>c</i></sub> − <i>λ</i>)<sup>2</sup> ≤ cost_limit"
    )
    assert line("x'b of a < b, Dreamer's, a policy") == (
        "<i>x</i>′<i>b</i> of <i>a</i> &lt; <i>b</i>, Dreamer's, a policy"
    )
    page = "Before\n```text\nR  = c,   by `kappa_lr`\n     H\n```\nafter, `algo.kappa_lr`\n"
    assert equations.drawn(page) == (
        'Before\n<div class="equations"><table class="equations">'
        "<tr><td><i>R</i></td><td>= <i>c</i>,&emsp;by <code>kappa_lr</code></td></tr>"
        "<tr><td></td><td><i>H</i></td></tr></table></div>\nafter, `algo.kappa_lr`\n"
    )


def test_the_cells_of_what_is_shipped_are_of_what_a_run_has_that_names_no_preset():
    found = cells.asked()
    long = [cell for cell in found if cell.steps in ("", "1e7")]
    assert (len(found), len(long)) == (71, 46)
    for cell in long:
        task = [f"env={cell.env}", f"algo={cell.algo}"]
        assert compose([*task, *cell.shipped.split()]).algo == compose(task).algo, cell

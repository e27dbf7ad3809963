"""Tables of text in Markdown and LaTeX, from one notation: `code`, **bold**, ± and the arrows."""

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxsafe.config import ConfigError
from jaxsafe.report.stats import Estimate

# What LaTeX reads otherwise; the rest of Unicode that is used here it reads as it is.
LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{",
    "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"$<$", ">": r"$>$",
    "±": r"$\pm$", "↑": r"$\uparrow$", "↓": r"$\downarrow$",
}  # fmt: skip


class Table(NamedTuple):
    """A caption, names of columns and rows of cells; `left` columns stand left, the others right."""

    caption: str
    header: list[str]
    rows: list[list[str]]
    left: int = 1


def cell(e: Estimate, form: str = ".4g") -> str:
    """Mean and interval, '-' for what is not known. Fewer than three seeds have no interval."""
    if np.isnan(e.mean):
        return "-"
    interval = "" if e.low == e.high else f" [{e.low:{form}}, {e.high:{form}}]"
    return f"{e.mean:{form}}{interval}"


def number(x: float) -> str:
    return "-" if np.isnan(x) else f"{x:.9g}"


def markdown(table: Table) -> str:
    """The header and the rows, without the caption."""
    ends = ["---"] * table.left + ["---:"] * (len(table.header) - table.left)
    lines = ([text.replace("|", "\\|") for text in line] for line in (table.header, ends, *table.rows))
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def latex(table: Table) -> str:
    """A floating table; needs \\usepackage{booktabs}."""

    def line(cells: list[str]) -> str:
        return " & ".join(map(escaped, cells)) + r" \\"

    columns = "l" * table.left + "r" * (len(table.header) - table.left)
    lines = [
        r"\begin{table}", r"\centering", rf"\caption{{{escaped(table.caption)}}}",
        rf"\begin{{tabular}}{{{columns}}}", r"\toprule", line(table.header), r"\midrule",
        *map(line, table.rows), r"\bottomrule", r"\end{tabular}", r"\end{table}",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def escaped(text: str) -> str:
    text = "".join(LATEX.get(c, c) for c in text)
    text = re.sub(r"`(.+?)`", r"\\texttt{\1}", text)
    return re.sub(r"\*\*(.+?)\*\*", r"\\textbf{\1}", text)


def between_marks(text: str, written: Mapping[str, str], mark: str = "table") -> str:
    """`text` with these parts between the lines <!-- MARK: NAME --> and <!-- end -->.

    Raises:
        ConfigError: a name has no such lines.
    """
    for name, part in written.items():
        begin, end = f"<!-- {mark}: {name} -->\n", "<!-- end -->"
        before, begun, rest = text.partition(begin)
        _, ended, after = rest.partition(end)
        if not (begun and ended):
            raise ConfigError(f"no {begin.strip()} with {end} after it")
        text = before + begin + part + "\n" + end + after
    return text

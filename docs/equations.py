"""Equations of docstrings as the site shows them: `typeset`. On GitHub and in code they are text."""

import html
import re
from collections.abc import Collection

GREEK = {
    "alpha": "α", "beta": "β", "chi": "χ", "delta": "δ", "eps": "ε", "eta": "η", "gamma": "γ",
    "kappa": "κ", "lam": "λ", "mu": "μ", "nu": "ν", "phi": "φ", "pi": "π", "psi": "ψ", "rho": "ρ",
    "sigma": "σ", "tau": "τ", "theta": "θ", "xi": "ξ",
}  # fmt: skip
SIGNS = {"<-": "←", "->": "→", "<=": "≤", ">=": "≥", "!=": "≠", "+-": "±", "..": "…", " ~ ": " ∼ "}
OPERATORS = ("max", "min", "argmax", "argmin", "maximise", "minimise", "mean", "reduce", "sum")
WORDS = ("actor", "critic", "model", "new", "old", "pen", "raw", "safe")  # as indices
TOKEN = re.compile(
    r"`(?P<code>[^`]*)`"
    r"|(?P<name>[A-Za-z]{2,}'s\b|\d[\d.]*(?:e-?\d+)?)"
    r"|(?P<transposed>[A-Za-z]'(?=[A-Za-z]))"
    r"|(?<![A-Za-z_])(?P<base>[A-Za-z]+)(?P<prime>'*)(?:_(?P<sub>\{[^}]*\}|[A-Za-z0-9*]+))?(?!\w)"
    r"|(?P<word>[A-Za-z]\w*)"
    r"|(?P<minus>(?<![A-Za-z])-(?!-))"
    r"|\^(?P<sup>\{[^}]*\}|\([^)]*\)|[-*]?\w*)"
    r"|(?P<sign>" + "|".join(map(re.escape, SIGNS)) + ")"
    r"|(?P<other>.)",
    re.S,
)
ARTICLE = re.compile(r"\ba (?=[a-z]{3,}\b)(?!(?:and|for|from|the|with)\b)")


def line(text: str, options: Collection[str] = ()) -> str:
    """One line as HTML: Greek letters, variables in italics, indices and powers. What is in `options`
    is a name and stays one."""

    def shown(match: re.Match[str]) -> str:
        found = match.groupdict()
        if found["code"] is not None:
            return f"<code>{html.escape(found['code'])}</code>"
        if found["sup"] is not None:
            return f"<sup>{line(found['sup'].strip('{}'), options)}</sup>"
        if found["sign"]:
            return SIGNS[found["sign"]]
        if found["minus"]:
            return "−"
        if found["transposed"]:
            return f"<i>{found['transposed'][0]}</i>′"
        base, sub = found["base"], found["sub"]
        if base is None:
            return html.escape(match[0], quote=False)
        letter = len(base) == 1 or base in GREEK
        short = sub is None or sub[0] == "{" or len(sub) <= 2 or sub in (*GREEK, *WORDS)
        if f"{base}_{sub}" in options or not short or not (letter or base in OPERATORS):
            return html.escape(match[0], quote=False)
        drawn = "Σ" if base == "sum" and sub else GREEK.get(base, base)
        drawn = f"<i>{drawn}</i>" if letter else drawn
        drawn += "′" * len(found["prime"])
        return drawn if sub is None else f"{drawn}<sub>{line(sub.strip('{}'), options)}</sub>"

    parts = re.split(f"({ARTICLE.pattern})", text)  # an article is no variable
    drawn = [part if ARTICLE.match(part + "xxx") else TOKEN.sub(shown, part) for part in parts]
    return re.sub(r" {2,}", "&emsp;", "".join(drawn))


def typeset(block: str, options: Collection[str] = ()) -> str:
    """Lines of equations as a table, whose first column has labels: what stands before two spaces."""
    rows = []
    for text in block.splitlines():
        before, gap, after = text.partition("  ")
        label = gap and " = " not in before and not before.endswith((",", ";"))
        if before and label:
            cells = f"<td>{line(before, options)}</td><td>{line(after.strip(), options)}</td>"
        elif gap and not before:
            cells = f"<td></td><td>{line(text.strip(), options)}</td>"
        else:
            cells = f'<td colspan="2">{line(text, options)}</td>'
        rows.append(f"<tr>{cells}</tr>")
    return f'<div class="equations"><table class="equations">{"".join(rows)}</table></div>'


def drawn(page: str) -> str:
    """The page of an algorithm with its equations typeset."""
    options = set(re.findall(r"`algo\.(\w+)`", page))
    block = re.compile(r"^```text\n(?!jaxsafe )(.*?)\n```$", re.M | re.S)  # commands stay
    return block.sub(lambda m: typeset(m[1], options), page)

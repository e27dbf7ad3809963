"""Every table and figure of a comparison, as files."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from jaxsafe.report import plots, tables, trade_off
from jaxsafe.report.comparison_tables import (
    SCORES,
    aggregates,
    as_csv,
    details,
    improvements,
    known_of,
    notes,
    of_aggregates,
    of_improvements,
    results,
)
from jaxsafe.report.group import Group, period, suite
from jaxsafe.report.published import Published, beside
from jaxsafe.run import files


def write(
    groups: Sequence[Group], out: Path, published: Mapping[tuple[str, str], Published] | None = None
) -> str:
    """Write every table and figure into `out`; returns the tables of return and of cost as text."""
    published = published or {}
    both = suite(groups)
    scored = suite([g for g in groups if g.env in both.tasks and known_of(g, SCORES[0])])
    found = aggregates(scored) if scored.tasks else {}
    pairs = improvements(both) if both.tasks else {}
    main = [results(groups, metric, published) for metric in ("return", "cost")]
    rest = details(groups)
    if len(scored.tasks) > 1:
        rest.append(of_aggregates(scored, found))
    if pairs:
        rest.append(of_improvements(both, pairs))
    remarks = notes(groups)
    parts = [f"{t.caption}\n\n{tables.markdown(t)}" for t in (*main, *rest)]
    text = "\n".join([*parts, *([f"Notes: {'; '.join(remarks)}.\n"] if remarks else [])])
    files.make_folder(out)
    files.write(out / "results.md", text)
    latex = [f"% {line}\n" for line in remarks] + [tables.latex(t) for t in (*main, *rest)]
    files.write(out / "results.tex", "\n".join(latex))
    files.write(out / "results.csv", as_csv(groups, both, scored, found, pairs))
    plots.save(plots.learning(groups), out / "curves")
    known = {(g.env, g.name): beside(g, published) for g in groups}
    plots.save(trade_off.draw(groups, period(groups), known), out / "trade_off")
    for name in ("scores", "profiles"):
        for suffix in plots.FORMATS:
            (out / f"{name}.{suffix}").unlink(missing_ok=True)
    if found:
        plots.save(plots.normalised(list(scored.groups), SCORES, found), out / "scores")
        plots.save(plots.profiles(scored), out / "profiles")
    return "\n".join([*parts[:2], *(f"{line}\n" for line in remarks)])

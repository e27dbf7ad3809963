"""The summary of a sweep: a row a setting, as text, as CSV and as a figure."""

import csv
import io
import math
from pathlib import Path

from jaxsafe.learn.constraints import cost_title, limits_in_words
from jaxsafe.report import plots, stats, tables, trade_off
from jaxsafe.report.group import FEW, LATE, Group, clock, group, period
from jaxsafe.report.read import or_evaluated, read_one
from jaxsafe.report.tables import Table
from jaxsafe.run import files
from jaxsafe.run.divergence import seeds_in_words
from jaxsafe.run.settings import NO_EXTRAS, Extras
from jaxsafe.run.sweep_folder import read_folder


def rows_of(folder: Path, extras: Extras = NO_EXTRAS) -> list[Group]:
    """A row for each setting that has begun: of the last 10% of training or, where training has no
    episodes, of the final evaluation."""
    swept = read_folder(folder).swept
    runs = [or_evaluated(run) for path in files.runs_in(folder) for run in read_one(path, extras)]
    return group(runs, swept) if runs else []


def summarise(folder: Path, extras: Extras = NO_EXTRAS) -> str:
    """Write summary.md, .csv, .png and .svg of a sweep; returns the table."""
    rows = rows_of(folder, extras)
    text = markdown(rows)
    files.write(folder / "summary.md", text)
    files.write(folder / "summary.csv", as_csv(rows))
    title = period(rows)
    title += ", mean and 95% interval" * any(stats.has_interval(row.costs) for row in rows)
    title += f"\n{plots.ESTIMATED}" * any(row.estimated for row in rows)
    plots.save(trade_off.draw(rows, title), folder / "summary")
    return text


def columns(rows: list[Group]) -> list[str]:
    return [name.removesuffix(".name") for name in rows[0].by] if rows else []


def limited(rows: list[Group]) -> list[str]:
    """The cost, as '', and those that have limits of their own."""
    return sorted({"", *(name for r in rows for name in r.limits)})


def markdown(rows: list[Group]) -> str:
    costs = limited(rows)
    header = [
        *columns(rows),
        "seeds",
        clock(rows),
        "return",
        *map(cost_title, costs),
        "limit",
        "limit held",
    ]
    lines = [
        [
            *(tables.number(v) if isinstance(v, float) else str(v) for v in r.by.values()),
            str(len(r.costs)), f"{r.steps:,}", tables.cell(r.ret),
            *(tables.cell(r.estimate(cost_title(name))) for name in costs),
            limits_in_words(r.limits), r.held,
        ]
        for r in rows
    ]  # fmt: skip
    begun = [r.name for r in rows if r.estimated]
    final = [r.name for r in rows if r.evaluated]
    notes = ""
    if lost := [f"{r.name} ({seeds_in_words(r.diverged)})" for r in rows if r.diverged]:
        notes += f"\nDiverged, so no limit counts as held: {'; '.join(lost)}.\n"
    if begun:
        notes += f"\nNo episode ended yet: return and cost of {'; '.join(begun)} are estimates.\n"
    if few := [f"{r.name} ({r.few_episodes})" for r in rows if r.few_episodes]:
        notes += (
            f"\nFewer than {FEW} episodes ended in the {LATE}, too few to tell whether the limit is "
            f"held: {'; '.join(few)}.\n"
        )
    if final:
        of = "; ".join(final)
        notes += f"\nTraining has no episodes: return and cost of {of} are of the final evaluation.\n"
    return tables.markdown(Table("", header, lines)) + notes


def as_csv(rows: list[Group]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    costs = limited(rows)
    measured = ["return", *map(cost_title, costs)]
    bounds = [f"{m.replace(' ', '_')}{end}" for m in measured for end in ("", "_low", "_high")]
    limits = [f"cost_limit_{name}" if name else "cost_limit" for name in costs]
    writer.writerow([*columns(rows), "seeds", clock(rows), *bounds, *limits, "held"])
    for r in rows:
        head = [*r.by.values(), len(r.costs), r.steps]
        found = [x for m in measured for x in r.estimate(m)]
        writer.writerow([*head, *found, *(r.limits.get(name, math.nan) for name in costs), r.held])
    return out.getvalue()

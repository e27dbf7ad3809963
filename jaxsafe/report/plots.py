"""Pictures: the learning curves of a run; the curves, scores and profiles of several."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import EngFormatter

from jaxsafe.report import stats
from jaxsafe.report.group import Group, Suite
from jaxsafe.report.looks import styles
from jaxsafe.report.published import CurveEnd
from jaxsafe.report.stats import Estimate
from jaxsafe.run import files, run_folder

FORMATS = ("png", "svg")
WIDE = 10.5  # inches of the widest figure, which a page shrinks little
LONG = 30  # letters of a name in the legend that leave the panels too little room
LETTER = 0.06  # inches, of the legend
FINE = 100  # points of a run's curve, if it has more than twice as many iterations
ESTIMATED = "estimate, no episode ended yet"
RATES = {
    "train/cost_rate": "cost rate so far,\nper step of the policy",
    "train/overruled": "override rate of the shield",
}
PANELS = (("train/return", "return of an episode"), ("train/cost", "cost of an episode"))
# what evaluation during training adds to a panel: end of the column's name -> label and marker
EVALUATED = {"": ("evaluated, mean action", "o"), "_sampled": ("evaluated, sampled", "s")}


def by_seed(metrics: dict[str, np.ndarray], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps [T] and values [S, T] of one metric; NaN where a seed has no value yet."""
    clock = metrics[run_folder.step_column(metrics)]
    steps, seeds = np.unique(clock), np.unique(metrics["seed"])
    values = np.full((len(seeds), len(steps)), np.nan)
    values[np.searchsorted(seeds, metrics["seed"]), np.searchsorted(steps, clock)] = metrics[name]
    for row in values:
        carry(row)  # over iterations in which no episode ended
    return steps, values


def thinned(metrics: dict[str, np.ndarray], name: str) -> tuple[np.ndarray, np.ndarray]:
    """As `by_seed`. Where there are many steps, the values are means over a hundred equal stretches."""
    steps, values = by_seed(metrics, name)
    if len(steps) <= 2 * FINE:
        return steps, values
    edges = np.linspace(0, steps[-1], FINE + 1)
    return edges[1:], stretches(metrics, name, edges)


def curves(
    metrics: dict[str, np.ndarray],
    path: Path,
    title: str,
    cost_limit: float,
    own_limits: Mapping[str, float] = MappingProxyType({}),
) -> None:
    """Write the PNG: a line a seed, and for three seeds or more their mean and 95% interval. A point is
    an iteration or, of more than two hundred, the mean over a hundredth of training. Offline there may
    be nothing to draw, and then there is none.

    Evaluations during training are points on dashed lines, each the mean over seeds.

    Settings trained side by side have a colour each, and their own limits where those differ. Named
    costs with limits of their own have panels in place of `cost`'s.
    """
    # with each limit its column of metrics.csv, which is there where the settings differ in it
    limits = {
        f"train/cost_{name}": (limit, f"algo.cost_limits.{name}") for name, limit in own_limits.items()
    }
    panels = (
        *PANELS,
        *((name, f"{name.removeprefix('train/cost_')} of an episode") for name in limits),
    )
    limits = limits or {"train/cost": (cost_limit, "algo.cost_limit")}
    figure = Figure(figsize=(5 * len(panels), 4), layout="constrained")
    FigureCanvasAgg(figure)
    settings, drawn = run_folder.by_setting(metrics), False
    drawn_in = figure.subplots(1, len(panels))
    for axes, (name, what) in zip(drawn_in, panels, strict=True):
        for i, (setting, table) in enumerate(settings.items()):
            trained = name in table and len(table["steps"])
            drawn = drawn or trained
            if trained:
                column, estimated = drawn_of(table, name)
                draw_setting(axes, name, *thinned(table, column), f"C{i % 10}", setting, estimated)
            for end, (called, marker) in EVALUATED.items():
                if (column := name.replace("train/", "eval/") + end) in table:
                    look = {"marker": marker, "mfc": "none" if end else None, "color": f"C{i % 10}"}
                    label = called if trained or not setting else f"{setting}, {called}"
                    drawn = True
                    axes.plot(*evaluated(table, column), ls="--", lw=1, label=label, **look)
        if name in limits:
            common, column = limits[name]
            swept = {t[column][0]: i for i, t in enumerate(settings.values()) if column in t}
            for limit, i in (swept or {common: 3}).items():
                axes.axhline(limit, color=f"C{i % 10}", ls="--", lw=1, label=f"limit {limit:g}")
        axes.set(xlabel=axis_of(metrics), ylabel=what)
    figure.suptitle(title)
    legend(figure, drawn_in)
    if drawn:
        write(figure, path, dpi=120)


def calibration(risks: Mapping[str, Mapping[str, Sequence[float]]], path: Path, title: str) -> None:
    """Write the PNG: how often the risk that a shield saw came true, a line a setting, and below it how
    many steps had such a risk."""
    figure = Figure(figsize=(5, 5), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    above.axline((0, 0), slope=1, color="0.6", lw=1, ls="--", label="as foreseen")
    for i, (name, of) in enumerate(risks.items()):
        look = {"marker": "o", "color": f"C{i % 10}"}
        above.plot(of["risk"], of["violated"], label=name or "without the shield", **look)
        below.plot(of["risk"], of["steps"], ls="", **look)
    above.set(ylabel="share with a violation", xlim=(-0.03, 1.03), ylim=(-0.03, 1.03))
    below.set(xlabel="risk that the shield saw", ylabel="steps", yscale="log")
    below.yaxis.set_major_formatter(EngFormatter(sep=""))
    above.legend(frameon=False, fontsize="small")
    figure.suptitle(title)
    write(figure, path, dpi=120)


def drawn_of(table: Mapping[str, np.ndarray], name: str) -> tuple[str, bool]:
    """The column to draw for a metric: its estimate, and True, where no episode has ended yet."""
    other = run_folder.estimate_of(name)
    estimated = other in table and not np.isfinite(table[name]).any()
    return (other, True) if estimated else (name, False)


def evaluated(metrics: Mapping[str, np.ndarray], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Where a metric has values, as steps [T], and their means over seeds [T]."""
    known = np.isfinite(metrics[name])
    clock, values = metrics[run_folder.step_column(metrics)][known], metrics[name][known]
    steps = np.unique(clock)
    return steps, np.array([values[clock == step].mean() for step in steps])


def axis_of(metrics: Mapping[str, np.ndarray]) -> str:
    """What the axis of training is called."""
    known = metrics and run_folder.step_column(metrics) == "updates"
    return "gradient updates" if known else "environment steps"


def draw_setting(
    axes: Axes,
    measure: str,
    steps: np.ndarray,
    values: np.ndarray,
    color: str,
    setting: str,
    estimated: bool = False,
) -> None:
    """The curves of one setting, `values` [S, T]. Estimates are dashed."""
    alone, few, ls = len(values) == 1, not stats.has_interval(values), "--" if estimated else "-"
    look = {"lw": 1.2 if few else 0.6, "alpha": 1 if few else 0.4, "color": color, "ls": ls}
    lines = lines_or_dots(axes, steps, values.T, **look)
    label = ", ".join(filter(None, [setting, ESTIMATED * estimated]))
    if few:
        lines[0].set_label(label or ("" if alone else f"{len(values)} seeds"))
    else:
        label = label or f"mean of {len(values)} seeds"
        band(axes, measure, steps, values, label, color=color, ls=ls)
        axes.collections[-1].set_label(None if setting else "95% interval")


def band(
    axes: Axes, measure: str, steps: np.ndarray, values: np.ndarray, label: str, **style: Any
) -> None:
    """Mean over seeds and its 95% interval, of `values` [S, T] of `measure`."""
    e = stats.of_measure(measure, values)
    (line,) = lines_or_dots(axes, steps, e.mean, lw=2, label=label, **style)
    axes.fill_between(steps, e.low, e.high, color=line.get_color(), alpha=0.2, lw=0)


def lines_or_dots(axes: Axes, x: np.ndarray, y: np.ndarray | float, **style: Any) -> list[Line2D]:
    """`axes.plot`, but a single point, which is no line, is a dot."""
    lines = axes.plot(x, y, **style)
    for line in lines:
        if np.isfinite(np.asarray(line.get_ydata(), float)).sum() == 1:
            line.set(marker="o", clip_on=False)  # whole at the edge, where its run ends
    return lines


def traces(
    axes: Axes, measure: str, steps: np.ndarray, values: np.ndarray, label: str, **style: Any
) -> None:
    """A `band`; or a thin line a seed where so few have no interval."""
    if stats.has_interval(values):
        band(axes, measure, steps, values, label, **style)
        return
    first, *_ = lines_or_dots(axes, steps, values.T, lw=0.9, **style)
    first.set_label(label)


def learning(
    groups: Sequence[Group],
    looks: Mapping[str, dict[str, Any]] | None = None,
    ends: Mapping[tuple[str, str], CurveEnd] = MappingProxyType({}),
) -> Figure:
    """Return, cost and, where they are known, cost rate so far and override rate over training: a row a
    task, a line a setting.

    A point is the mean over one of at most 50 equal stretches of training, fewer of a run that is
    shorter than another; the band is the 95% interval over seeds. Fewer than three seeds are a thin
    line each. A line ends where the first of its seeds does. The panel holds all means and nearly all
    seeds. Intervals may reach beyond it.

    Args:
        groups: what to draw.
        looks: the `styles` of the settings; those of `groups` if it is left out.
        ends: where published curves end, by environment and name: a hollow diamond each.
    """
    envs = sorted({g.env for g in groups})
    names = ["train/return", "train/cost"]
    tables = [run.table for g in groups for run in g.runs]
    names += [name for name in RATES if any(name in table for table in tables)]
    figure = Figure(figsize=(3.4 * len(names), 2.5 * len(envs) + 0.3), layout="constrained")
    FigureCanvasAgg(figure)
    looks = looks or styles(groups)
    rows = figure.subplots(len(envs), len(names), squeeze=False)
    for env, panels in zip(envs, rows, strict=True):
        shown = [g for g in groups if g.env == env]
        draw_task(dict(zip(names, panels, strict=True)), shown, looks, ends)
    if any((g.env, g.name) in ends for g in groups):
        rows[0, 0].plot([], [], "D", mfc="none", ms=6, color="0.45", label="end of the published curve")
    legend(figure, rows.ravel(), looks)
    return figure


def draw_task(
    panels: Mapping[str, Axes],
    groups: Sequence[Group],
    looks: Mapping[str, dict[str, Any]],
    ends: Mapping[tuple[str, str], CurveEnd],
) -> None:
    """The row of one task in `learning`: `panels` by their metric."""
    runs = [run for g in groups for run in g.runs]
    longest = max(run.steps for run in runs)
    # of the longest run; in each stretch of the others is a row, too
    rows = [len(np.unique(run.table["iteration"])) * longest / run.steps for run in runs]
    count = min(50, *rows)
    held: dict[str, list[float]] = {name: [] for name in panels}  # what the panels must hold
    for g in groups:
        last = max(run.steps for run in g.runs)
        edges = np.linspace(0, last, max(1, int(count * last / longest)) + 1)
        for name, axes in panels.items():
            if all(name in run.table for run in g.runs):
                guess = g.estimated and name not in RATES
                column = run_folder.estimate_of(name) if guess else name
                values = np.concatenate([stretches(run.table, column, edges) for run in g.runs])
                label = f"{g.name}, {ESTIMATED}" if guess else g.name
                style = looks[g.name] | ({"ls": "--"} if guess else {})
                if np.isfinite(values).any():
                    traces(axes, name, edges[1:], values, label, **style)
                    held[name] += extent(values)
    colors = [looks[g.name]["color"] for g in groups]
    for limit, color in limit_colors([g.cost_limit for g in groups], colors, "0.4").items():
        panels["train/cost"].axhline(limit, color=color, ls="--", lw=1)
        held["train/cost"].append(limit)
    for g, color in zip(groups, colors, strict=True):
        if end := ends.get((g.env, g.name)):
            for name, y in (("train/return", end.ret), ("train/cost", end.cost)):
                look = {"mfc": "none", "ms": 6, "color": color, "clip_on": False, "zorder": 4}
                panels[name].plot(end.steps, y, "D", **look)
                held[name].append(y)
    clocks = " or ".join(dict.fromkeys(axis_of(run.table) for run in runs))
    for name, axes in panels.items():
        axes.set_visible(bool(axes.lines))  # not a rate that no run of this task has
        what = RATES.get(name) or f"{name.removeprefix('train/')} of an episode"
        frames = {"xlim": (0, longest), "ylim": frame(held[name])}
        axes.set(title=groups[0].env, xlabel=clocks, ylabel=what, **frames)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def limit_colors(limits: Sequence[float], colors: Sequence[str], grey: str) -> dict[float, str]:
    """The colour of each limit's line: of the one setting that it belongs to, or grey where the others
    have it, too. `limits` and `colors` are of settings; NaN is no limit."""
    known = [x for x in limits if not np.isnan(x)]
    alone = {x for x in known if known.count(x) == 1 and len({*known}) > 1}
    pairs = zip(limits, colors, strict=True)
    return {x: color if x in alone else grey for x, color in pairs if not np.isnan(x)}


def extent(values: np.ndarray) -> list[float]:
    """Ends of what a panel shows of `values` [S, T]: all means, and all but a few points of seeds."""
    means = values.mean(0)[np.isfinite(values).all(0)]
    return [*np.nanquantile(values, (0.02, 0.98)), *(f(means) for f in (min, max) if len(means))]


def frame(values: Sequence[float]) -> tuple[float, float] | None:
    """Ends of an axis that holds all finite values; None leaves them as they are."""
    finite = np.array([x for x in values if np.isfinite(x)])
    if not len(finite) or np.ptp(finite) == 0:
        return None
    margin = 0.06 * np.ptp(finite)
    return float(finite.min() - margin), float(finite.max() + margin)


def stretches(table: Mapping[str, np.ndarray], name: str, edges: np.ndarray) -> np.ndarray:
    """The mean of a metric of each seed over each stretch of steps (edges[i], edges[i + 1]], [S, T].

    A stretch without value has the one before it, NaN before the first and after the last row of the
    seed. A cost rate is the mean of all rates so far.
    """
    seeds = np.unique(table["seed"])
    found = np.full((len(seeds), len(edges) - 1), np.nan)
    for row, seed in zip(found, seeds, strict=True):
        of_seed = table["seed"] == seed
        values, steps = table[name][of_seed], table[run_folder.step_column(table)][of_seed]
        if name == "train/cost_rate":
            counts = np.cumsum(np.isfinite(values))
            values = np.nancumsum(values) / np.where(counts, counts, np.nan)
        known = np.isfinite(values)
        which = np.searchsorted(edges, steps, side="left") - 1
        count = np.bincount(which[known], minlength=len(row))
        total = np.bincount(which[known], values[known], minlength=len(row))
        end = which.max() + 1
        row[count > 0] = total[count > 0] / count[count > 0]
        carry(row[:end])
    return found


def carry(row: np.ndarray) -> None:
    """Fill NaN with the last finite value before it, in place."""
    finite = np.flatnonzero(np.isfinite(row))
    if len(finite):
        last = finite[np.maximum(np.searchsorted(finite, np.arange(len(row)), side="right") - 1, 0)]
        row[finite[0] :] = row[last[finite[0] :]]


def normalised(
    names: Sequence[str], metrics: Sequence[str], found: Mapping[tuple[str, str, str], Estimate]
) -> Figure:
    """Mean and IQM of each score with their intervals, a row a setting."""
    figure = Figure(figsize=(3 * len(metrics) + 1, 1.2 + 0.3 * len(names)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(metrics), sharey=True, squeeze=False)[0]
    for axes, metric in zip(panels, metrics, strict=True):
        for kind, color, shift in (("IQM", "C0", -0.12), ("mean", "0.5", 0.12)):
            es = [found[name, metric, kind] for name in names]
            error = [[e.mean - e.low for e in es], [e.high - e.mean for e in es]]
            ys = np.arange(len(names)) + shift
            axes.errorbar([e.mean for e in es], ys, xerr=error, fmt="o", ms=5, color=color, label=kind)
        axes.set(title=metric, yticks=range(len(names)), yticklabels=names)
        axes.grid(axis="x", alpha=0.3)
    panels[0].set_ylim(len(names) - 0.5, -0.5)
    legend(figure, panels)
    return figure


def profiles(suite: Suite) -> Figure:
    """The share of seeds above each normalised return, and above each cost in limits."""
    figure, panels = grid(2, size=(3.2, 3.4))
    looks = styles([gs[0] for gs in suite.groups.values()])
    labels = ("normalised return", "cost / limit")
    for axes, label in zip(panels, labels, strict=True):
        samples = {
            name: [
                g.values(label) if label == labels[0] else g.costs / (g.cost_limit or np.nan)
                for g in gs
            ]
            for name, gs in suite.groups.items()
        }
        values = np.concatenate([x for xs in samples.values() for x in xs])
        values = values[np.isfinite(values)]
        if len(values):
            thresholds = np.linspace(min(0, values.min()), max(1.2, values.max()) * 1.02, 201)
            for name, xs in samples.items():
                if all(np.isfinite(x).all() for x in xs):
                    e = stats.profile(xs, thresholds)
                    axes.plot(thresholds, e.mean, label=name, **looks[name])
                    axes.fill_between(
                        thresholds, e.low, e.high, color=looks[name]["color"], alpha=0.15, lw=0
                    )
        axes.axvline(1, color="0.5", ls="--", lw=1)
        axes.set(xlabel=label, ylabel="share of seeds above", ylim=(-0.02, 1.02))
    legend(figure, panels, looks)
    figure.suptitle(", ".join(suite.tasks) if len(suite.tasks) < 4 else f"{len(suite.tasks)} tasks")
    return figure


# ---- what the figures share ------------------------------------------------------------------


def grid(count: int, size: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    """A figure of `count` panels, two beside each other or, of many, three, with room for a legend."""
    columns = min(2 if count <= 4 else 3, max(1, count))
    rows = -(-max(1, count) // columns)
    stretch = {1: 1.3, 2: 1.5, 3: 1.0}[columns]
    figure = Figure(figsize=(stretch * size[0] * columns, size[1] * rows), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels[count:]:
        axes.set_axis_off()
    return figure, list(panels[:count])


def legend(figure: Figure, panels: Iterable[Axes], names: Iterable[str] = ()) -> None:
    """One legend for all panels, `names` first. It stands on the right of a figure that has room there.
    If the figure is wide, a name is long or there are many, it stands below. The figure grows to hold
    it."""
    entries: dict[str, Any] = dict.fromkeys(names)
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries[label] = entries.get(label) or handle
    entries = {label: handle for label, handle in entries.items() if handle}
    if not entries:
        return
    longest, width = max(map(len, entries)), figure.get_figwidth()
    look = {"frameon": False, "fontsize": "small"}
    if longest <= LONG and width <= 0.8 * WIDE and len(entries) <= 4 * figure.get_figheight():
        figure.set_figwidth(width + 0.6 + LETTER * longest)
        figure.legend(entries.values(), entries.keys(), loc="outside right upper", **look)
        return
    column = 0.7 + LETTER * longest  # inches, with the handle
    figure.set_figwidth(max(width, column))
    fitting = max(1, min(len(entries), int(figure.get_figwidth() / column)))
    rows = -(-len(entries) // fitting)
    figure.set_figheight(figure.get_figheight() + 0.3 + 0.19 * rows)  # inches: a margin, rows
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=fitting, **look)


def write(figure: Figure, path: Path, **how: Any) -> None:
    """Replace `path` with the figure. Names in it are shown as they are, not read as mathematics."""
    for text in figure.findobj(Text):
        text.set_parse_math(False)  # type: ignore[attr-defined]
    with files.replacing(path) as part:
        figure.savefig(part, **how)


def save(figure: Figure, path: Path) -> None:
    """Write `path` with each suffix; the same figure is the same file."""
    for suffix in FORMATS:
        with matplotlib.rc_context({"svg.hashsalt": "jaxsafe"}):
            about = {"Date": None} if suffix == "svg" else None
            write(figure, path.with_suffix(f".{suffix}"), dpi=120, metadata=about)
        figure.set_layout_engine("none")  # is laid out, and the next file is like it

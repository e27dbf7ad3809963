"""The figure of return against cost: settings as points, and a sweep of limits as a line."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxsafe.learn.constraints import cost_title
from jaxsafe.report.group import Group, has_limit
from jaxsafe.report.looks import MARKERS, styles
from jaxsafe.report.plots import PANELS, frame, grid, legend, limit_colors
from jaxsafe.report.published import Published
from jaxsafe.report.stats import Estimate, has_interval

REACH = 4  # limits that the cost axis shows, where points lie farther out
NUMBER = 0.04  # of a panel's width and height, which the number of a limit takes
STRIP = 0.3  # of a panel's width, for the figures of those points
GREY = "0.45"


class Point(NamedTuple):
    """What a row made, in one panel."""

    row: Group
    ret: Estimate
    cost: Estimate
    limit: float  # NaN where it has none
    costs: np.ndarray  # [S]
    style: dict[str, Any]  # its colour and line
    published: Published | None
    swept: bool = False  # others in the panel differ from it in their limit alone


def draw(
    rows: Sequence[Group],
    title: str,
    published: Mapping[tuple[str, str], Published | None] = MappingProxyType({}),
    looks: Mapping[str, dict[str, Any]] | None = None,
) -> Figure:
    """Return against cost of each row of a comparison: a panel an environment or, where named costs
    have limits of their own, each of these.

    A point is the mean over seeds, with its 95% interval if it `has_interval`. Each limit is a dashed
    line: grey, or in the colour of the one setting it belongs to. Rows that differ in their limit alone
    are a line through their points, in the order of the limits. The number of each limit stands on its
    point, in one box where points lie on each other, and each limit is a tick on the axis of cost.
    Without such rows, grey steps are the Pareto front of the means within their limits. A hollow
    diamond is the mean that was published.

    The frame holds all seeds, means and limits. Intervals may reach beyond it. It ends at `REACH`
    limits, unless most points lie beyond. The strip on its right has an arrow for each mean beyond it,
    with its return and cost.

    Args:
        rows: the settings, each on one environment.
        title: what the figures are of.
        published: means to set beside the rows, by environment and name.
        looks: the `styles` of the rows, which are made if it is left out.
    """
    looks = looks or styles(rows)
    places = sorted({(row.env, name) for row in rows for name in row.limits or [""]})
    figure, panels = grid(len(places), size=(3.4, 3.3))
    for axes, (env, name) in zip(panels, places, strict=True):
        points = [
            Point(
                row,
                row.ret,
                row.estimate(cost_title(name)),
                row.limits.get(name, np.nan),
                row.values(cost_title(name)),
                looks[row.name],
                None if name else published.get((env, row.name)),
            )
            for row in rows
            if row.env == env
        ]
        draw_panel(axes, points)
        axes.set(title=env, xlabel=f"{name or 'cost'} of an episode", ylabel=PANELS[0][1])
    legend(figure, panels, [*looks, *(without_limit(row) for row in rows)])
    figure.suptitle(title, wrap=True)
    return figure


def draw_panel(axes: Axes, points: Sequence[Point]) -> None:
    chains = in_chains(points)
    points = [p for chain in chains for p in chain]
    most = cut(points)
    # None would hold an axis at 0 to 1, wherever the points lie
    axes.set(**{name: ends for name, ends in frames(points, most).items() if ends})
    for chain in chains:
        draw_chain(axes, chain, most)
    if limits := {p.limit for p in points if p.swept}:
        axes.xaxis.remove_overlapping_locs = False  # a limit of 10 is a tick, too, beside a label of 10
        axes.set_xticks(sorted(limits), minor=True)
        axes.tick_params("x", which="minor", direction="in", length=8, width=1.5, color=GREY)
        axes.plot([], [], "|", color=GREY, ms=8, mew=1.5, label="cost limits, the numbers on points")
    elif kept := [(p.cost.mean, p.ret.mean) for p in points if keeps_limit(p)]:
        axes.plot(*front(kept), color="0.8", lw=3, zorder=0, label="front within the limit")
    draw_limits(axes, [p for p in points if not p.swept])
    for (ret, cost), color in theirs(points).items():
        if cost <= most:
            axes.plot(cost, ret, "D", mfc="none", ms=6, color=color)
    if theirs(points):
        axes.plot([], [], "D", mfc="none", ms=6, color=GREY, label="published, same colour")
    draw_beyond(axes, points, most)


def draw_chain(axes: Axes, chain: Sequence[Point], most: float) -> None:
    """Means, intervals and seeds. Of several points also the line through them, and their limits."""
    first = chain[0]
    color, marker = first.style["color"], MARKERS[first.style["ls"]]
    label = without_limit(first.row) if first.swept else first.row.name
    for i, p in enumerate(chain):
        axes.plot(p.costs, p.row.returns, ".", color=color, ms=4, alpha=0.5)
        look = {"fmt": marker, "ms": 5, "lw": 1, "color": color, "label": "" if i else label}
        if has_interval(p.costs):
            look["xerr"] = [[p.cost.mean - p.cost.low], [p.cost.high - p.cost.mean]]
            look["yerr"] = [[p.ret.mean - p.ret.low], [p.ret.high - p.ret.mean]]
        axes.errorbar(p.cost.mean, p.ret.mean, **look)
    if not first.swept:
        return
    axes.plot([p.cost.mean for p in chain], [p.ret.mean for p in chain], color=color, lw=1)
    for heap in heaps(axes, [p for p in chain if p.cost.mean <= most]):
        x, y = np.mean([(p.cost.mean, p.ret.mean) for p in heap], axis=0)
        axes.text(x, y, ", ".join(f"{p.limit:g}" for p in heap), **boxed(color, "round"))


def heaps(axes: Axes, chain: Sequence[Point]) -> list[list[Point]]:
    """The points, those together whose numbers would cover each other."""
    width, height = np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())

    def near(p: Point, q: Point) -> bool:
        x, y = p.cost.mean - q.cost.mean, p.ret.mean - q.ret.mean
        return bool(abs(x) < NUMBER * width and abs(y) < NUMBER * height)

    found: list[list[Point]] = []
    for p in chain:
        heap = next((heap for heap in found if near(p, heap[0])), None)
        if heap is None:
            found.append([p])
        else:
            heap.append(p)
    return found


def boxed(color: str, shape: str) -> dict[str, Any]:
    """How the number of a limit looks, in a box of its line's colour."""
    box = {"boxstyle": f"{shape},pad=0.15", "fc": "white", "ec": color, "lw": 0.8}
    return {"size": 7, "ha": "center", "va": "center", "bbox": box}


def in_chains(points: Sequence[Point]) -> list[list[Point]]:
    """The points of rows that differ in their limit alone, in the order of the limits and in one style:
    that of a row whose name has no limit, or the first's."""
    found: dict[str, list[Point]] = {}
    for p in points:
        found.setdefault(without_limit(p.row), []).append(p)
    chains = []
    for name, chain in found.items():
        style = next((p for p in chain if p.row.name == name), chain[0]).style
        chain = [p._replace(style=style, swept=len(chain) > 1) for p in chain]
        chains.append(sorted(chain, key=lambda p: p.limit))
    return chains


def without_limit(row: Group) -> str:
    """The name of a row, less its limits."""
    kept = {k: v for k, v in row.by.items() if not k.startswith("algo.cost_limit")}
    return row._replace(by=kept).name


def keeps_limit(p: Point) -> bool:
    """Whether the algorithm has a limit, and the mean is within."""
    return has_limit(p.row.algo) and p.cost.mean <= p.limit


def cut(points: Sequence[Point]) -> float:
    """Where the axis of cost ends at the latest; infinite where most points would lie beyond."""
    limits = [p.limit for p in points if p.limit > 0]
    means = [p.cost.mean for p in points if np.isfinite(p.cost.mean)]
    most = REACH * max(limits, default=np.inf)
    return most if 2 * sum(mean <= most for mean in means) >= len(means) else np.inf


def frames(points: Sequence[Point], most: float) -> dict[str, tuple[float, float] | None]:
    """`xlim` and `ylim`, which hold what costs at most `most`."""
    within = [p for p in points if p.cost.mean <= most]
    known = [p.published for p in points if p.published and p.published.cost[0] <= most]
    costs = [x for p in within for x in (*p.costs, p.cost.mean)] + [x.cost[0] for x in known]
    returns = [x for p in within for x in (*p.row.returns, p.ret.mean)] + [x.ret[0] for x in known]
    x = frame([*(x for x in costs if x <= most), *(p.limit for p in points)])
    if x and np.isfinite(most) and beyond(points, most):
        x = (x[0], x[0] + (most - x[0]) / (1 - STRIP))
    return {"xlim": x, "ylim": frame(returns)}


def draw_limits(axes: Axes, points: Sequence[Point]) -> None:
    colors = [p.style["color"] for p in points]
    for limit, color in limit_colors([p.limit for p in points], colors, "0.5").items():
        axes.axvline(limit, color=color, ls="--", lw=1, label="cost limit" if color == "0.5" else "")


class Beyond(NamedTuple):
    """A mean that costs more than the axis shows."""

    ret: float
    cost: float
    color: str
    hollow: bool  # it was published
    limit: str = ""  # of a sweep


def beyond(points: Sequence[Point], most: float) -> list[Beyond]:
    """The means that cost more than `most`, the highest return first."""
    found = [
        Beyond(p.ret.mean, p.cost.mean, p.style["color"], False, f"{p.limit:g}" if p.swept else "")
        for p in points
    ]
    found += [Beyond(*mean, color, True) for mean, color in theirs(points).items()]
    return sorted((x for x in found if x.cost > most), key=lambda x: -x.ret)


def draw_beyond(axes: Axes, points: Sequence[Point], most: float) -> None:
    """A strip on the right, with a row for each mean that costs more than `most`."""
    if not (found := beyond(points, most)):
        return
    low, high = axes.get_xlim()
    ticks = MaxNLocator(5).tick_values(low, most)
    axes.set_xticks([x for x in ticks if low <= x <= most])
    axes.axvspan(most, high, color="0.95", lw=0, zorder=3)
    look: dict[str, Any] = {"transform": axes.transAxes, "zorder": 4}
    gap = min(0.065, 0.9 / len(found))  # of the height of the panel
    rows = [("return", "cost"), *((short(x.ret), short(x.cost)) for x in found)]
    for i, cells in enumerate(rows):
        for x, text in zip((1 - 0.4 * STRIP, 0.985), cells, strict=True):
            color = "0.2" if i else GREY
            axes.text(x, 0.96 - gap * i, text, ha="right", va="center", size=7, color=color, **look)
    for i, x in enumerate(found, 1):
        place = (1 - 0.92 * STRIP, 0.96 - gap * i)
        if x.limit:
            axes.text(*place, x.limit, **boxed(x.color, "rarrow"), **look)
        else:
            face = "none" if x.hollow else x.color
            axes.plot(*place, ">", ms=5, color=x.color, mfc=face, **look)
    axes.plot([], [], ">", ms=5, color=GREY, label="costs more than the axis shows")


def theirs(points: Sequence[Point]) -> dict[tuple[float, float], str]:
    """The published means, as return and cost, with the colour of the first setting each is beside."""
    found: dict[tuple[float, float], str] = {}
    for p in points:
        if p.published:
            found.setdefault((p.published.ret[0], p.published.cost[0]), p.style["color"])
    return found


def short(x: float) -> str:
    return f"{x:,.0f}" if abs(x) >= 100 else f"{x:.3g}"


def front(points: Sequence[tuple[float, float]]) -> tuple[list[float], list[float]]:
    """The corners of the steps under which no point costs less and returns more."""
    xs: list[float] = []
    ys: list[float] = []
    for cost, ret in sorted(p for p in points if np.isfinite(p).all()):
        if not ys or ret > ys[-1]:
            xs += [cost, cost] if ys else [cost]
            ys += [ys[-1], ret] if ys else [ret]
    return xs, ys

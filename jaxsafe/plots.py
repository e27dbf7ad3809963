"""Pictures: learning curves, and what a sweep's settings earn against what they cost."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxsafe import run_folder

LIMIT = "algo.cost_limit"  # a column of metrics.csv where the settings differ in it
PANELS = (("train/return", "return of an episode"), ("train/cost", "cost of an episode"))


def by_seed(metrics: dict[str, np.ndarray], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps [T] and values [S, T] of one metric; NaN where a seed has no value yet."""
    steps, seeds = np.unique(metrics["steps"]), np.unique(metrics["seed"])
    values = np.full((len(seeds), len(steps)), np.nan)
    values[np.searchsorted(seeds, metrics["seed"]), np.searchsorted(steps, metrics["steps"])] = metrics[
        name
    ]
    for row in values:  # carry the last finite value over iterations in which no episode ended
        finite = np.flatnonzero(np.isfinite(row))
        if len(finite):
            last = finite[np.maximum(np.searchsorted(finite, np.arange(len(row)), side="right") - 1, 0)]
            row[finite[0] :] = row[last[finite[0] :]]
    return steps, values


def interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean over seeds and its 95 % bootstrap interval, each [T], of values [S, T]."""
    picks = np.random.default_rng(0).integers(len(values), size=(1000, len(values)))
    counts = np.apply_along_axis(np.bincount, 1, picks, minlength=len(values))
    low, high = np.percentile(counts @ values / len(values), [2.5, 97.5], axis=0)
    return values.mean(0), low, high


def curves(
    metrics: dict[str, np.ndarray],
    path: Path,
    title: str,
    cost_limit: float,
    own_limits: Mapping[str, float] = MappingProxyType({}),
) -> None:
    """Write the PNG: a thin line a seed, and for several seeds their mean and 95 % interval.

    Settings trained side by side have a colour each, and their own limits where those differ. Named
    costs with limits of their own have panels instead of a limit on the sum.
    """
    named = {f"train/cost_{name}": limit for name, limit in own_limits.items()}
    panels = (*PANELS, *((name, f"{name.removeprefix('train/cost_')} of an episode") for name in named))
    figure = Figure(figsize=(5 * len(panels), 4), layout="constrained")
    FigureCanvasAgg(figure)
    settings = run_folder.by_setting(metrics)
    for axes, (name, label) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        for i, (setting, table) in enumerate(settings.items()):
            if name in table and len(table["steps"]):
                draw(axes, *by_seed(table, name), f"C{i % 10}", setting)
        if name in named:
            axes.axhline(named[name], color="C3", ls="--", lw=1, label=f"limit {named[name]:g}")
        if name == "train/cost" and not named:
            own = {t[LIMIT][0]: i for i, t in enumerate(settings.values()) if LIMIT in t}
            for limit, i in (own or {cost_limit: 3}).items():
                axes.axhline(limit, color=f"C{i % 10}", ls="--", lw=1, label=f"limit {limit:g}")
        axes.set(xlabel="environment steps", ylabel=label)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize="small")
    figure.suptitle(title)
    figure.savefig(path, dpi=120)


def draw(axes: Axes, steps: np.ndarray, values: np.ndarray, color: str, setting: str) -> None:
    """The curves of one setting, `values` [S, T]."""
    alone = len(values) == 1
    lines = axes.plot(steps, values.T, color=color, lw=1.2 if alone else 0.6, alpha=1 if alone else 0.4)
    if not alone:
        mean, low, high = interval(values)
        axes.plot(steps, mean, color=color, lw=2, label=setting or f"mean of {len(values)} seeds")
        band = None if setting else "95 % interval"
        axes.fill_between(steps, low, high, color=color, alpha=0.2, lw=0, label=band)
    elif setting:
        lines[0].set_label(setting)


def trade_off(rows: Sequence[Any], path: Path, title: str) -> None:
    """Write the PNG: return against cost of each row of a sweep's table, an environment a panel.

    A point is the mean over seeds with its 95 % interval, each limit a dashed line: grey, or in the
    colour of the one setting it belongs to.
    """
    envs = list(dict.fromkeys(row.env for row in rows))
    figure = Figure(figsize=(6.5 * max(1, len(envs)), 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, env in zip(figure.subplots(1, max(1, len(envs)), squeeze=False)[0], envs, strict=False):
        shown = [row for row in rows if row.env == env]
        limits = [row.cost_limit for row in shown]
        for i, row in enumerate(shown):
            color = f"C{i % 10}"
            axes.plot(row.costs, row.returns, ".", color=color, ms=4, alpha=0.5)
            axes.errorbar(
                row.cost.mean,
                row.ret.mean,
                xerr=[[row.cost.mean - row.cost.low], [row.cost.high - row.cost.mean]],
                yerr=[[row.ret.mean - row.ret.low], [row.ret.high - row.ret.mean]],
                fmt="o",
                color=color,
                label=row.name,
            )
            if row.cost_limit not in limits[:i]:
                line = color if limits.count(row.cost_limit) == 1 and len(set(limits)) > 1 else "0.5"
                axes.axvline(row.cost_limit, color=line, ls="--", lw=1)
        axes.set(title=env, xlabel=PANELS[1][1], ylabel=PANELS[0][1])
        axes.legend(frameon=False, fontsize="small")
    figure.suptitle(title)
    figure.savefig(path, dpi=120)

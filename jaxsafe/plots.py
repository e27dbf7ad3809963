"""Learning curves as a picture: return, and cost with its limit."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

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


def curves(metrics: dict[str, np.ndarray], path: Path, title: str, cost_limit: float) -> None:
    """Write the PNG: a thin line a seed, and for several seeds their mean and 95 % interval."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (name, label) in zip(figure.subplots(1, 2), PANELS, strict=True):
        if name in metrics and len(metrics["steps"]):
            steps, values = by_seed(metrics, name)
            alone = len(values) == 1
            axes.plot(steps, values.T, color="C0", lw=1.2 if alone else 0.6, alpha=1 if alone else 0.4)
            if not alone:
                mean, low, high = interval(values)
                axes.plot(steps, mean, color="C0", lw=2, label=f"mean of {len(values)} seeds")
                axes.fill_between(steps, low, high, color="C0", alpha=0.2, lw=0, label="95 % interval")
        if name == "train/cost":
            axes.axhline(cost_limit, color="C3", ls="--", lw=1, label=f"limit {cost_limit:g}")
        axes.set(xlabel="environment steps", ylabel=label)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize="small")
    figure.suptitle(title)
    figure.savefig(path, dpi=120)

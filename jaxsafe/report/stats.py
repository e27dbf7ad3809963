"""Estimates over seeds and tasks with their 95% intervals.

A sample holds one task's values, one a seed: float [S] or, of T numbers at once, [S, T]. Several
samples are several tasks, whose numbers of seeds may differ. An interval says what other seeds would
give on the same tasks. Where a task has fewer than three seeds there is none (`has_interval`).

- Means have Student's t interval, over several tasks with Welch's degrees of freedom.
- Interquartile means have a t interval with the standard error of the stratified bootstrap, which
  resamples seeds within each task. It covers a little more than 95%.
- Shares (profiles, probabilities of improvement) have the stratified bootstrap's percentiles, which
  stay between 0 and 1. With five seeds on one task these cover about 85%.

Percentiles alone would cover 80 to 89% for means of 4 to 8 seeds; a test simulates both.

Source: Student (1908), "The Probable Error of a Mean"; Welch (1947), "The Generalization of `Student's'
Problem when Several Different Population Variances are Involved"; Agarwal et al. (2021), "Deep
Reinforcement Learning at the Edge of the Statistical Precipice", whose library rliable defines `mean`,
`iqm`, `probability_of_improvement` and the profile alike. A test holds this module to its numbers.
SciPy computes them, because rliable 1.2 cannot be imported beside pandas 3, passes its seed on to
nothing and takes seconds for a pair of algorithms.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy  # scipy.stats takes a second to import, and is imported at its first use

DRAWS = 10_000  # bootstrap samples
CONFIDENCE = 0.95
LEAST = 3  # seeds of a task; Student's t of two is 12.7 standard errors, and says little
DRAWN_AT_ONCE = 10_000_000  # numbers drawn at once
# what the names of measures end in that are at most 1, beside the shares of episodes over a limit
SHARES = ("violation rate", "override rate", "overruled", "Brier score")


class Estimate(NamedTuple):
    """A number with its 95% interval; floats, or float [T]."""

    mean: float  # or another statistic
    low: float
    high: float

    def map(self, rising: Callable[[float], float]) -> "Estimate":
        """That of a rising function of the number, as a float each."""
        return Estimate(*(float(rising(x)) for x in self))


def has_interval(*samples: np.ndarray) -> bool:
    """Whether each sample [S, ...] has seeds enough for an interval, in tables and figures alike."""
    return min(map(len, samples)) >= LEAST


def mean(*samples: np.ndarray, axis: int = 0) -> np.ndarray:
    """The mean over tasks of the means over seeds."""
    return np.mean([x.mean(axis) for x in samples], axis=0)


def iqm(*samples: np.ndarray, axis: int = 0) -> np.ndarray:
    """The interquartile mean over all seeds of all tasks: without the lowest and highest quarter."""
    return scipy.stats.trim_mean(np.concatenate(samples, axis), 0.25, axis)


def estimate(
    *samples: np.ndarray, statistic: Callable[..., np.ndarray] = mean, draws: int = DRAWS
) -> Estimate:
    """`statistic` of the samples and its interval.

    Args:
        samples: float [S] or [S, T], a task each.
        statistic: `mean`, `iqm`, or a share `statistic(*samples, axis)` over the axis of seeds.
        draws: bootstrap samples.
    Returns:
        Floats or float [T]: NaN where a value is; an interval of no width unless it `has_interval`.
    """
    columns = [np.asarray(x, float).reshape(len(x), -1) for x in samples]
    known = np.all([np.isfinite(x).all(0) for x in columns], axis=0)
    columns = [x[:, known] for x in columns]
    shape = np.shape(samples[0])[1:]
    found = np.full((3, *known.shape), np.nan)
    if known.any():
        found[:, known] = middle = statistic(*columns, axis=0)
        if has_interval(*columns):
            if statistic is mean:
                found[1:, known] = middle + welch(columns) * np.array([[-1.0], [1.0]])
            else:
                found[1:, known] = bootstrapped(columns, statistic, middle, draws)
    return Estimate(*(x.reshape(shape) if shape else x.item() for x in found))


def of_measure(
    name: str, *samples: np.ndarray, statistic: Callable[..., np.ndarray] = mean
) -> Estimate:
    """`estimate` of a measure with this name in tables. Its interval stops where the measure does.

    Shares, as of episodes over a limit or of steps overruled, are at most 1. Costs, rates and lengths
    are at least 0, unless a value shows that this environment's are not.
    """
    e = estimate(*samples, statistic=statistic)
    share = name.endswith(SHARES) or " over " in name
    positive = share or "return" not in name
    least = 0.0 if positive and not any((x < 0).any() for x in samples) else -np.inf
    ends = np.clip(e[1:], least, 1.0 if share else np.inf)
    return Estimate(e.mean, *(x if np.ndim(x) else float(x) for x in ends))


def welch(columns: Sequence[np.ndarray]) -> np.ndarray:
    """Half the width of the mean's interval, float [T], of samples [S, T] with two seeds or more."""
    seeds = np.array([[len(x)] for x in columns])
    parts = np.array([x.var(0, ddof=1) for x in columns]) / seeds / len(columns) ** 2  # [tasks, T]
    error_sq = parts.sum(0)
    denominator = (parts**2 / (seeds - 1)).sum(0)
    freedom = np.divide(error_sq**2, denominator, out=np.ones_like(error_sq), where=denominator > 0)
    return scipy.stats.t.ppf((1 + CONFIDENCE) / 2, freedom) * np.sqrt(error_sq)


def bootstrapped(
    columns: Sequence[np.ndarray],
    statistic: Callable[..., np.ndarray],
    middle: np.ndarray,
    draws: int,
) -> np.ndarray:
    """Low and high end of an interval by the stratified bootstrap, float [2, T]."""
    found = scipy.stats.bootstrap(
        columns,
        statistic,
        n_resamples=draws,
        confidence_level=CONFIDENCE,
        batch=max(1, DRAWN_AT_ONCE // sum(x.size for x in columns)),
        vectorized=True,
        axis=0,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    if statistic is not iqm:
        return np.array(found.confidence_interval)
    seeds = np.array([len(x) for x in columns])
    error = found.standard_error * np.sqrt(np.mean(seeds / (seeds - 1)))  # a sample's, not its draws'
    width = scipy.stats.t.ppf((1 + CONFIDENCE) / 2, (seeds - 1).sum()) * error
    return np.array([middle - width, middle + width])


def probability_of_improvement(ours: Sequence[np.ndarray], theirs: Sequence[np.ndarray]) -> Estimate:
    """P(a seed of `ours` > a seed of `theirs`), the mean over tasks; equal values count one half.

    Args:
        ours, theirs: float [S] for each task, in the same order of tasks.
    """
    both = partial(_share_above, tasks=len(ours))
    return estimate(*ours, *theirs, statistic=both)


def _share_above(*samples: np.ndarray, axis: int, tasks: int) -> np.ndarray:
    def share(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        x, y = np.moveaxis(x, axis, -1)[..., :, None], np.moveaxis(y, axis, -1)[..., None, :]
        return ((x > y) + 0.5 * (x == y)).mean((-2, -1))

    return np.mean([share(*xy) for xy in zip(samples[:tasks], samples[tasks:], strict=True)], axis=0)


def profile(samples: Sequence[np.ndarray], thresholds: np.ndarray) -> Estimate:
    """The performance profile: the share of seeds above each threshold, the mean over tasks, [T]."""

    def share(*above: np.ndarray, axis: int) -> np.ndarray:
        return mean(*above, axis=axis)

    return estimate(*(x[:, None] > thresholds for x in samples), statistic=share, draws=2_000)

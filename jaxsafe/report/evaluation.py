"""What evaluation says of a run: estimates over its seeds, in a table and in evaluation.json."""

import math
from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from jaxsafe.envs.wrap import raw_steps
from jaxsafe.learn.constraints import limits_of
from jaxsafe.report import scores, stats
from jaxsafe.report.stats import Estimate
from jaxsafe.run import memory, run_folder
from jaxsafe.run.divergence import read_lost, seeds_in_words
from jaxsafe.run.evaluate import Episodes, Told, evaluated, keys_of_episodes, make_play, measures, quiet
from jaxsafe.run.policies import RunPolicies
from jaxsafe.run.programs import members
from jaxsafe.types import PyTree


class Scores(NamedTuple):
    """What evaluation found for one setting."""

    name: str  # '' where there is but one
    limits: dict[str, float]  # of named costs, where those have their own; else of '', the cost
    episodes: int  # of all its seeds
    rows: dict[str, Estimate]
    seeds: dict[str, list[float]]  # the mean over the episodes of each
    calibration: dict[str, list[float]]  # of a shield's risk, empty without one: see `calibrated`
    typical: int  # which of the first seed's episodes has the median return
    diverged: tuple[int, ...] = ()  # the seeds that did in training

    def __str__(self) -> str:
        lost = f"\ndiverged in training: {seeds_in_words(self.diverged)}" if self.diverged else ""
        return table(self.rows) + lost


def evaluate(
    run: RunPolicies,
    num: int,
    seed: int,
    data: PyTree = (),
    sampled: bool = False,
    told: Told = quiet,
) -> list[Scores]:
    """`num` fresh episodes of each seed in each setting, with mean actions or `sampled` ones.

    Of a run on a data set there are DSRL's scores too and, with `data`, the data's own episodes. How
    far it is, is `told`.
    """
    settings = run.settings
    keys = keys_of_episodes(seed, num, settings.train.seeds, len(settings.configs))
    memory.check_episodes(run.env, num, len(keys))
    play = make_play(run.algo, keys, told)
    episodes, course = evaluated(play, run.learned, sampled)
    examined = settings.row.examine(run.algo, run.learned, course, play, sampled)
    tables = list(run_folder.by_setting(run_folder.read_metrics(run.folder)).values())
    cost_names = run.algo.task(jax.tree.map(lambda x: x[0], run.learned)).cost_names
    seeds, by_setting, lost = settings.train.num_seeds, [], read_lost(run.folder)
    for i, member in enumerate(members(settings.configs, settings.train)[::seeds]):
        of_setting = Episodes(*(x[i * seeds : (i + 1) * seeds] for x in episodes))
        limits, metrics = limits_of(member.config), tables[i] if i < len(tables) else {}
        found = measures(of_setting, cost_names, limits)
        found |= {name: x[i * seeds : (i + 1) * seeds] for name, x in examined.measures.items()}
        counts = examined.calibration
        of_risk = {} if counts is None else calibrated(counts[i * seeds : (i + 1) * seeds].sum(0))
        rows = summary(settings.env_name, found, limits.get(""), metrics, raw_steps(run.env))
        if settings.train.dataset is not None:
            rows |= dsrl_scores(settings.env_name, rows, limits.get(""))
            rows |= of_data(data, limits.get(""))
        by_seed = {name: values.mean(1).tolist() for name, values in found.items()}
        size = of_setting.ret.size
        typical = int(np.argsort(of_setting.ret[0])[num // 2])
        diverged = tuple(x.seed for x in lost if x.setting == member.setting)
        by_setting.append(
            Scores(member.setting, limits, size, rows, by_seed, of_risk, typical, diverged)
        )
    return by_setting


def calibrated(counts: np.ndarray) -> dict[str, list[float]]:
    """How often a foreseen probability came true, from `counts` [3, parts] of `Row.examine`.

    Of each part of [0, 1] that has any: `steps`, how many; `risk`, the mean probability; `violated`,
    the share that came true. Empty if no part has.
    """
    steps, risk, violated = counts[:, counts[0] > 0].astype(float)
    if not len(steps):
        return {}
    return {
        "steps": steps.tolist(),
        "risk": (risk / steps).tolist(),
        "violated": (violated / steps).tolist(),
    }


def summary(
    env_name: str,
    found: Mapping[str, np.ndarray],
    cost_limit: float | None,
    metrics: dict[str, np.ndarray],
    repeat: int = 1,
) -> dict[str, Estimate]:
    """The rows of the table: `measures`, then the cost rate of training and normalised scores.

    `cost_limit` is None where named costs have limits in its place. Then there is no normalised
    violation. One step of the policy has `repeat` of the environment, of which published rates are.
    """
    rows = {name: estimate_over_seeds(name, values) for name, values in found.items()}
    rate = cost_rate(metrics)
    if rate is not None:
        rows["cost rate (training)"] = stats.of_measure("cost rate", rate)
    if env_name in scores.CHARACTERISTIC:
        rows["normalised return"] = rows["return"].map(partial(scores.normalized_return, env_name))
        if cost_limit is not None:
            violation = rows["cost"].map(lambda x: scores.normalized_violation(env_name, x, cost_limit))
            if len(found["cost"]) > 1:  # not linear: seeds within the limit do not excuse the others
                of_seeds = scores.normalized_violation(env_name, found["cost"].mean(1), cost_limit)
                violation = stats.of_measure("normalised violation", of_seeds)
            rows["normalised violation"] = violation
        if rate is not None:
            rows["normalised cost rate"] = rows["cost rate (training)"].map(
                lambda x: scores.normalized_cost_rate(env_name, x / repeat)
            )
    return rows


def dsrl_scores(
    env_name: str, rows: dict[str, Estimate], cost_limit: float | None
) -> dict[str, Estimate]:
    """DSRL's normalised scores. Its return needs the task's reference, its cost only the limit."""
    found = {}
    if env_name in scores.DSRL:
        found["DSRL return"] = rows["return"].map(partial(scores.dsrl_return, env_name))
    if cost_limit is not None:
        found["DSRL cost"] = rows["cost"].map(lambda x: scores.dsrl_cost(x, cost_limit))
    return found


def of_data(data: PyTree, cost_limit: float | None) -> dict[str, Estimate]:
    """Of the whole episodes of a data set: mean return and cost, and the best return of a safe one.

    The costs of its episodes are not told apart, so no episode is known to be safe without a
    `cost_limit`.
    """
    if not data or not data.episodes:
        return {}
    _, _, ret, cost, whole = (np.asarray(x) for x in data.episodes)
    ret, cost = ret[whole], cost[whole]
    if not len(ret):
        return {}
    found = {"data return": ret.mean(), "data cost": cost.mean()}
    if cost_limit is not None and (safe := cost <= cost_limit).any():
        found["data best safe return"] = ret[safe].max()
    return {name: Estimate(float(x), float(x), float(x)) for name, x in found.items()}


def estimate_over_seeds(name: str, values: np.ndarray) -> Estimate:
    """Mean of the measure `name`, `values` [S, N], and its interval over seeds.

    The means of seeds hold the spread of episodes, too. Two seeds have no interval. With one seed it
    covers the episodes alone, not what another seed would give.
    """
    return stats.of_measure(name, values.mean(1) if len(values) > 1 else values[0])


def cost_rate(metrics: dict[str, np.ndarray]) -> np.ndarray | None:
    """Total training cost over total training steps of the policy, [S]; None if unknown.

    `metrics` are the columns of metrics.csv.
    """
    if "train/cost_rate" not in metrics or not len(metrics["seed"]):
        return None
    rates = metrics["train/cost_rate"]  # of one iteration; all have the same number of steps
    seeds, known = metrics["seed"], np.isfinite(rates)
    of_seeds = (rates[known & (seeds == seed)] for seed in np.unique(seeds))
    return np.array([x.mean() if len(x) else np.nan for x in of_seeds])  # NaN: every step was bad


def table(rows: dict[str, Estimate]) -> str:
    """Aligned plain text: a row each, mean and interval. A single number has no interval."""

    def line(name: str, e: Estimate) -> str:
        interval = "" if e.low == e.high == e.mean else f"[{e.low:10.4g}, {e.high:10.4g} ]"
        return f"{name:<22}{e.mean:>10.4g}   {interval}".rstrip()

    return "\n".join([f"{'':<22}{'mean':>10}   95% interval", *(line(n, e) for n, e in rows.items())])


def as_json(rows: dict[str, Estimate]) -> dict[str, dict[str, float | None]]:
    """{'return': {'mean': 1.5, 'low': 1.2, 'high': 1.8}, ...}, with null for what is not finite."""
    return {
        name: {k: x if math.isfinite(x) else None for k, x in e._asdict().items()}
        for name, e in rows.items()
    }

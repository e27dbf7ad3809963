"""The tables of a comparison.

Figures of a seed are those of the last 10% of its training, but for the cost rate, which is of all of
it. Where training plays no episodes, they are of its final evaluation. Tasks stand apart; across them
only normalised scores, and comparisons within a task, are averaged.
"""

import csv
import io
import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from jaxsafe.learn.constraints import limits_in_words
from jaxsafe.report import scores, stats, tables
from jaxsafe.report.group import FEW, LATE, Group, Suite, clock, differing, period, suite, tasks_of
from jaxsafe.report.published import Published, beside
from jaxsafe.report.stats import Estimate
from jaxsafe.report.tables import Table
from jaxsafe.run.divergence import seeds_in_words

FINAL = (
    "final return", "final cost", "final violation rate", "final discounted return",
    "final discounted cost",
)  # fmt: skip
SCORES = ("normalised return", "normalised violation", "normalised cost rate")
STATISTICS = {"mean": stats.mean, "IQM": stats.iqm}


def results(
    groups: Sequence[Group], metric: str, published: Mapping[tuple[str, str], Published]
) -> Table:
    """Return or cost: a row a setting, with what was published below it, and a column a task."""
    envs = tasks_of(groups)
    at = {(g.name, g.env): g for g in groups}
    limits = {limits_in_words(g.limits) for g in groups}
    safe = [g for g in groups if g.held == "yes" and not np.isnan(g.ret.mean) and len(limits) == 1]
    best = {env: max((g.ret.mean for g in safe if g.env == env), default=None) for env in envs}
    rows = []
    for name in dict.fromkeys(g.name for g in groups):
        ours, theirs, source = [f"`{name}`"], [], ""
        for env in envs:
            g = at.get((name, env))
            e = g.estimate(metric) if g else Estimate(np.nan, np.nan, np.nan)
            text, beyond, known = tables.cell(e, ".2f"), "", None
            if g and metric == "return" and g in safe and e.mean == best[env]:
                text = f"**{text}**"
            if g and (known := beside(g, published)):
                mean, spread = known.ret if metric == "return" else known.cost
                beyond = " ↑" * (e.mean > mean + spread) + " ↓" * (e.mean < mean - spread)
                theirs.append(f"{mean:.2f} ± {spread:.2f}")
                source = known.source
            else:
                theirs.append("-")
            ours.append(text + beyond)
        rows.append(ours)
        if source:
            rows.append([source, *theirs])
    what = "Return" if metric == "return" else "Cost"
    caption = f"{what} of an episode, {period(groups)}: mean and 95% interval over seeds."
    if not all(stats.has_interval(g.costs) for g in groups):
        caption += " Fewer than three seeds have no interval."
    if len(limits) == 1 and (words := next(iter(limits))) != "-":
        caption += f" Cost limit {words}."
    if metric == "return" and safe:
        caption += " Bold: the highest return of a task whose mean cost is within the limit."
    if published:
        caption += " ↑ ↓: the mean lies above or below the published spread."
    return Table(caption, ["", *envs], rows)


def details(groups: Sequence[Group]) -> list[Table]:
    """What else is known of each setting on each task."""
    groups = sorted(groups, key=lambda g: g.env)
    known = [m for m in ("violation rate", "cost rate") if any(known_of(g, m) for g in groups)]
    header = ["task", "setting", "seeds", clock(groups), "return, IQM", "cost, IQM", "limit", "held"]
    header += known
    rows = [
        [
            f"`{g.env}`", f"`{g.name}`", str(len(g.costs)), f"{g.steps:,}",
            *(tables.cell(g.estimate(m, stats.iqm)) for m in ("return", "cost")),
            limits_in_words(g.limits), g.held,
            *(tables.cell(g.estimate(m), ".3g") for m in known),
        ]
        for g in groups
    ]  # fmt: skip
    caption = (
        "Each task. IQM: interquartile mean over seeds. Held: whether the mean cost is within the "
        "limit; unclear where it is not but its interval is or, of two seeds, one is; diverged where a "
        "seed stopped learning. Violation rate: the share of iterations, in the last 10%, whose mean "
        "cost of an episode is over the limit. Cost rate: total cost over "
        "total steps of the policy in training; an action that is repeated is one step."
    )
    out = [Table(caption, header, rows, left=2)]
    scored = [g for g in groups if known_of(g, SCORES[0])]
    if scored:
        rows = [
            [f"`{g.env}`", f"`{g.name}`", *(tables.cell(g.estimate(m), ".3g") for m in SCORES)]
            for g in scored
        ]
        caption = "Safety Gym's normalised scores: 1 is unconstrained PPO, a violation of 0 the limit."
        out.append(Table(caption, ["task", "setting", *(m.split(" ", 1)[1] for m in SCORES)], rows, 2))
    every = dict.fromkeys(m for g in groups for run in g.runs for m in run.values)
    costs = [m for m in every if m.startswith("cost ") and m != "cost rate"]
    if len(costs) > 1:
        rows = [
            [f"`{g.env}`", f"`{g.name}`", *(tables.cell(g.estimate(m)) for m in costs)] for g in groups
        ]
        caption = f"Each cost of an episode, {period(groups)}."
        out.append(Table(caption, ["task", "setting", *(m.split(" ", 1)[1] for m in costs)], rows, 2))
    evaluated = [g for g in groups if known_of(g, "final return")]
    if evaluated:
        header = ["task", "setting", *(m.removeprefix("final ") for m in FINAL)]
        rows = [
            [f"`{g.env}`", f"`{g.name}`", *(tables.cell(g.estimate(m)) for m in FINAL)]
            for g in evaluated
        ]
        caption = (
            "The final policy: the mean action, over fresh episodes of each seed. Violation rate: the "
            "share of episodes whose cost is over the limit. Discounted: by the learner's factors."
        )
        out.append(Table(caption, header, rows, 2))
    return out


def known_of(g: Group, metric: str) -> bool:
    return any(metric in run.values for run in g.runs)


def aggregates(s: Suite) -> dict[tuple[str, str, str], Estimate]:
    """Mean and IQM of each score over tasks and seeds, by setting, score and statistic."""
    return {
        (name, metric, kind): stats.of_measure(metric, *s.samples(name, metric), statistic=statistic)
        for name in s.groups
        for metric in SCORES
        for kind, statistic in STATISTICS.items()
    }


def improvements(s: Suite) -> dict[tuple[str, str, str], Estimate]:
    """P(a seed of one setting beats one of another), in return (higher) and in cost (lower)."""
    return {
        (a, b, measure): stats.probability_of_improvement(*(s.samples(name, measure) for name in pair))
        for a, b in itertools.combinations(s.groups, 2)
        for measure, pair in {"return": (a, b), "cost": (b, a)}.items()
    }


def in_words(envs: Sequence[str]) -> str:
    return f"{len(envs)} tasks ({', '.join(envs)})" if len(envs) > 1 else envs[0]


def of_aggregates(s: Suite, found: Mapping[tuple[str, str, str], Estimate]) -> Table:
    columns = [(metric, kind) for metric in SCORES for kind in STATISTICS]
    header = ["setting", *(f"{metric.split(' ', 1)[1]}, {kind}" for metric, kind in columns)]
    rows = [[f"`{n}`", *(tables.cell(found[n, *c], ".3g") for c in columns)] for n in s.groups]
    caption = (
        f"Normalised scores over {in_words(s.tasks)}: mean and interquartile mean, stratified 95% "
        "intervals."
    )
    return Table(caption, header, rows)


def of_improvements(s: Suite, pairs: Mapping[tuple[str, str, str], Estimate]) -> Table:
    rows = [
        [f"`{a}`", f"`{b}`", *(tables.cell(pairs[a, b, m], ".2f") for m in ("return", "cost"))]
        for a, b, metric in pairs
        if metric == "return"
    ]
    caption = (
        f"Probability of improvement over {in_words(s.tasks)}: that a seed of X has the higher "
        "return, or the lower cost, than one of Y."
    )
    return Table(caption, ["X", "Y", "higher return", "lower cost"], rows, 2)


def notes(groups: Sequence[Group]) -> list[str]:
    """What a reader of the figures should know."""
    lines = []
    for name, values in differing(groups).items():
        lines.append(f"averaged over {name} ({', '.join(map(str, values))})")
    for run in (run for g in groups for run in g.runs):
        if not run.ended:
            done, end, unit = run.progress
            lines.append(f"unfinished: {run.config['run_dir']}, at {done:,} of {end:,} {unit}")
        if run.diverged:
            which = seeds_in_words(run.diverged)
            lines.append(f"diverged, so no limit counts as held: {run.config['run_dir']}, {which}")
        if run.estimated:
            lines.append(f"estimates, as no episode ended yet: {run.config['run_dir']}")
    for g in (g for g in groups if g.few_episodes):
        lines.append(
            f"too few episodes in the {LATE} to tell whether the limit is held: {g.name} on {g.env}, "
            f"{g.few_episodes} of at least {FEW}"
        )
    envs = tasks_of(groups)
    if left := [env for env in envs if env not in suite(groups).tasks]:
        lines.append(f"not in comparisons across tasks, as a setting lacks them: {', '.join(left)}")
    if unscored := [env for env in envs if env not in scores.CHARACTERISTIC]:
        lines.append(
            f"without normalised scores, as there are no published ones: {', '.join(unscored)}"
        )
    return list(dict.fromkeys(lines))


def as_csv(groups: Sequence[Group], both: Suite, scored: Suite, found: Mapping, pairs: Mapping) -> str:
    """Every estimate, a row each. `found` is of the tasks in `scored`, `pairs` of those in `both`."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    by = list(groups[0].by)
    writer.writerow(["task", *by, "seeds", "metric", "statistic", "value", "low", "high"])
    for g in groups:
        for metric in dict.fromkeys(m for run in g.runs for m in run.values):
            for kind, statistic in STATISTICS.items():
                e = g.estimate(metric, statistic)
                writer.writerow([g.env, *g.by.values(), len(g.costs), metric, kind, *e])

    def head(s: Suite, name: str) -> list:
        of = s.groups[name]
        return [" ".join(s.tasks), *of[0].by.values(), sum(len(g.costs) for g in of)]

    for (name, metric, kind), e in found.items():
        writer.writerow([*head(scored, name), metric, kind, *e])
    for (a, b, metric), e in pairs.items():
        writer.writerow([*head(both, a), metric, f"P(better than {b})", *e])
    return out.getvalue()

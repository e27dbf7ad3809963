"""Write the tables and figures that are made from measurements: python docs/measured.py

Those of docs/results come from its studies (see jaxsafe/report/studies.py), those on speed from
docs/data. Each table stands between <!-- measured: NAME --> and <!-- end -->.
"""

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import cells
import matplotlib.pyplot as plt
import numpy as np

from jaxsafe.commands.study import states
from jaxsafe.report import plots, scores, stats, studies, trade_off
from jaxsafe.report.comparison_tables import SCORES, aggregates
from jaxsafe.report.group import Group, group, has_limit, ordered, suite
from jaxsafe.report.looks import styles
from jaxsafe.report.published import Published, beside, read_published
from jaxsafe.report.read import SettingRun, read
from jaxsafe.report.study_files import holds_study
from jaxsafe.report.tables import between_marks, cell

HERE = Path(__file__).parent
RESULTS, DATA = HERE / "results", HERE / "data"
STUDIES = [x for x in sorted(RESULTS.glob("*/study.yaml")) if holds_study(x.parent)]
LIMIT = 25.0  # of an episode, in the published tables
TABLE = ("goal", "button", "push")  # the studies that together are the table of results
EXTRA = ("crpo", "ipo", "pdo", "ppo_penalty")  # trained on two tasks alone, so in no table of ten
# OmniSafe: evaluated policies. We know of no constrained table of Push.
PUBLISHED = read_published(RESULTS / "published.csv")
SWEEP = "jaxsafe, all passes"  # `solver` of the rows that are compared with each other
SHOWN = ("cpo", "cppo_pid", "cup", "focops", "p3o", "pcpo", "ppo_lag", "rcpo", "trpo_lag", "trpo_pid")
EARLY = ("ppo_early_terminated", "trpo_early_terminated")  # evaluated in cut episodes there
TASKS = [
    f"{robot}_{task}{n}" for task in ("goal", "button") for n in "12" for robot in ("point", "car")
]


def constrained(algo: str) -> bool:
    """Whether an algorithm has a limit, and episodes that do not end at it."""
    return has_limit(algo) and algo not in EARLY


def beyond(value: float, spread: tuple[float, float]) -> float:
    """By how much `value` is outside mean ± spread; 0 within."""
    mean, width = spread
    return float(np.sign(value - mean) * max(0.0, abs(value - mean) - width))


def their_curves() -> dict[tuple[str, str], tuple[str, str]]:
    """Return and cost at the end of OmniSafe's training by (env, algorithm); '' where unreadable."""
    with (RESULTS / "published_curves.csv").open() as file:
        return {(r["env"], r["algo"]): (r["return"], r["cost"]) for r in csv.DictReader(file)}


def outside(training: Sequence[Group], final: Sequence[Group]) -> str:
    """The cells whose evaluated policies lie outside the spread of the published ones, and beside them
    what both made in training."""
    curves, before = their_curves(), {(g.env, g.name): g for g in training}
    lines = ["| run | ours | OmniSafe | return | cost | ours, training | their curve |"]
    lines.append("|---|---:|---:|---:|---:|---:|---:|")
    within, count = 0, 0
    for g in sorted(final, key=lambda g: (g.name, g.env)):
        theirs = None if g.name in EARLY else beside(g, PUBLISHED)
        if theirs is None:
            continue
        off = beyond(g.ret.mean, theirs.ret), beyond(g.cost.mean, theirs.cost)
        count, within = count + 1, within + (not any(off))
        if any(off):
            trained = before[g.env, g.name]
            cells = [f"{g.ret.mean:.1f}, {g.cost.mean:.0f}"]
            cells.append(f"{theirs.ret[0]:.1f}, {theirs.cost[0]:.0f}")
            cells += [f"{x:+.2g}" if x else "" for x in off]
            cells.append(f"{trained.ret.mean:.1f}, {trained.cost.mean:.0f}")
            cells.append(", ".join(x or "-" for x in curves.get((g.env, g.name), ())))
            lines.append(f"| `{g.env}` `{g.name}` | {' | '.join(cells)} |")
    summary = f"{within} of {count} cells lie within the published spreads in both return and cost."
    return "\n".join([summary, "", *lines])


class Policy(NamedTuple):
    """What evaluated policies made."""

    ret: float
    cost: float
    algo: str
    study: str = ""
    limit: float = LIMIT
    interval: str = ""


def best() -> str:
    """On each task our policies that earn most at a cost of at most 25, with an interval of the return,
    and OmniSafe's at 27.5, of algorithms that have a limit of 25 or, ours, of less."""
    ours: dict[str, list[Policy]] = {env: [] for env in TASKS}
    theirs: dict[str, list[Policy]] = {env: [] for env in TASKS}
    for path in STUDIES:
        for run in studies.evaluated(read([path.parent])):
            limit = run.limits.get("", np.inf)
            sees_lidars = run.config.get("env.observation") != "coordinates"
            if run.env in ours and limit <= LIMIT and sees_lidars and len(run.seeds) >= 5:
                ret, cost = stats.of_measure("return", run.values["return"]), run.values["cost"].mean()
                interval, algo = f" [{ret.low:.1f}, {ret.high:.1f}]", run.config["algo.name"]
                made = Policy(ret.mean, cost, algo, path.parent.name, limit, interval)
                ours[run.env].append(made)
    for (env, algo), known in PUBLISHED.items():
        if env in theirs and known.cost_limit == LIMIT:
            theirs[env].append(Policy(known.ret[0], known.cost[0], algo))

    def most(policies: Sequence[Policy], cost: float) -> Policy:
        return max(x for x in policies if x.cost <= cost and constrained(x.algo))

    lines = ["| | OmniSafe, at most 27.5 | ours, at most 25 | study |", "|---|---:|---:|---|"]
    met = []
    for env in TASKS:
        known, made = most(theirs[env], 27.5), most(ours[env], LIMIT)
        met += [f"`{env}`"] if made.ret >= known.ret else []
        cells = [f"{x.ret:.1f}{x.interval}, {x.cost:.0f} `{x.algo}`" for x in (known, made)]
        cells[1] += f", limit {made.limit:g}" if made.limit < LIMIT else ""
        lines.append(f"| `{env}` | {' | '.join(cells)} | [{made.study}]({made.study}/README.md) |")
    summary = (
        f"By means ours earn at least as much on {len(met)} of {len(TASKS)} tasks: {', '.join(met)}."
    )
    return "\n".join([summary, "", *lines])


def mean_actions(runs: Sequence[SettingRun]) -> str:
    """By how much the mean actions of final policies earn and cost more than their sampled ones, by
    task: means over the algorithms with a limit that were evaluated both ways."""
    lines = ["| | algorithms | return | cost |", "|---|---:|---:|---:|"]
    found: dict[str, list[tuple[float, float]]] = {}
    for run in runs:
        if constrained(run.config["algo.name"]) and "final sampled cost" in run.values:
            ret, cost = (
                (run.values[f"final {k}"] - run.values[f"final sampled {k}"]).mean()
                for k in ("return", "cost")
            )
            found.setdefault(run.env, []).append((ret, cost))
    means = {env: np.mean(changes, axis=0) for env, changes in found.items()}
    for env, (ret, cost) in sorted(means.items(), key=lambda item: -item[1][1]):
        lines.append(f"| `{env}` | {len(found[env])} | {ret:+.1f} | {cost:+.1f} |")
    every = np.array([change for changes in found.values() for change in changes])
    ret, cost = (stats.estimate(x) for x in every.T)
    lines.append(f"| all | {len(every)} | {cell(ret, '+.1f')} | {cell(cost, '+.1f')} |")
    return "\n".join(lines)


def left() -> str:
    """Which studies have runs that were cut off or are not begun, and how many of how many are done."""
    lines = ["| studies with runs that are not done | done | listed |", "|---|---:|---:|"]
    for path in sorted(RESULTS.glob("*/study.yaml")):
        study = studies.read(path.parent)
        done = list(states(study).values()).count("done")
        if done < len(study.runs):
            page = f"[{study.title}]({path.parent.name}/README.md)"
            lines.append(f"| {page} | {done} | {len(study.runs)} |")
    return "\n".join(lines)


def apart(groups: Sequence[Group], known: Mapping[tuple[str, str], Published]) -> str:
    """The table of all tasks, with early termination below it."""
    early = [g for g in groups if g.name in EARLY]
    rest = [g for g in groups if g.name not in EARLY]
    words = "Early termination. Episodes end at the limit in training, and in OmniSafe's evaluation:"
    return f"{studies.matrix(rest, known)}\n\n{words}\n\n{studies.matrix(early, known)}"


def held(training: Sequence[Group], final: Sequence[Group]) -> str:
    """In how many constrained cells the cost is at most 1.2 times the limit, ours and OmniSafe's:
    evaluated policies beside evaluated policies, training beside training."""
    pairs = [(g, beside(g, PUBLISHED)) for g in final if constrained(g.name)]
    known = [(g.cost.mean, theirs.cost[0]) for g, theirs in pairs if theirs]
    curves = their_curves()
    ends = [(g, curves.get((g.env, g.name), ("", ""))[1]) for g in training if has_limit(g.name)]
    trained = [(g.cost.mean, float(cost)) for g, cost in ends if cost]

    def count(pairs: Sequence[tuple[float, float]]) -> str:
        (ours, at), (theirs, their_at) = (
            [sum(cost <= most for cost in costs) for most in (30, 25)]
            for costs in zip(*pairs, strict=True)
        )
        return f"{ours} of {len(pairs)} cells, OmniSafe's in {theirs} (to 25 in {at} and {their_at})"

    return (
        f"A cost of 30 is a fifth over the limit. A cell is an algorithm with a limit on one "
        f"task. Counted are those that OmniSafe published. Our evaluated policies keep to 30 in "
        f"{count(known)}. At the end of training ours do in {count(trained)}."
    )


def conventions(ours: Sequence[Group], theirs: Sequence[Group]) -> str:
    """Return and cost of the same runs without and with `compat=omnisafe`, and OmniSafe's."""
    usual = {(g.env, g.name): g for g in ours}
    lines = ["| | `compat=none` | `compat=omnisafe` | OmniSafe |", "|---|---:|---:|---:|"]
    for g in sorted(theirs, key=lambda g: (g.name, g.env)):
        known = PUBLISHED[(g.env, g.name)]
        cells = [f"{x.ret.mean:.1f}, {x.cost.mean:.1f}" for x in (usual[(g.env, g.name)], g)]
        cells.append("{:.1f} ± {:.1f}, {:.1f} ± {:.1f}".format(*known.ret, *known.cost))
        lines.append(f"| `{g.env}` `{g.name}` | {' | '.join(cells)} |")
    return "\n".join(lines)


def benchmark_rows(file: str) -> list[dict]:
    return [json.loads(line) for line in (DATA / file).read_text().splitlines()]


def latest(rows: Sequence[dict], *keys: str) -> dict[tuple, dict]:
    """Of rows that were measured again, the last, by the values of `keys`."""
    return {tuple(row[key] for key in keys): row for row in rows if all(key in row for key in keys)}


def whole_sweep(row: dict) -> bool:
    """Of settled environments with random actions on one H200, from when all sizes were measured."""
    return row["algo"] is None and bool(row.get("warmup")) and row.get("solver") == SWEEP


def throughput_table() -> str:
    """Thousands of environment steps a second on one H200, by task and number of environments."""
    rows = filter(whole_sweep, benchmark_rows("benchmark_h200.jsonl"))
    found = latest(list(rows), "env", "num_envs")
    tasks = {env for env, _ in found}
    sizes = sorted(
        size for size in {size for _, size in found} if all((env, size) in found for env in tasks)
    )
    lines = ["| environments |" + "".join(f" {size:,} |" for size in sizes)]
    lines.append("|---|" + "---:|" * len(sizes))
    for env in sorted({env for env, _ in found}):
        cells = (found.get((env, size)) for size in sizes)
        texts = (f"{row['env_steps_per_s'] / 1e3:,.0f}" if row else "" for row in cells)
        lines.append(f"| {env} | {' | '.join(texts)} |")
    return "\n".join(lines)


def velocity_speeds() -> str:
    """Environment steps a second of the velocity tasks on one H200."""
    of_all = benchmark_rows("benchmark_h200.jsonl")
    rows = [r for r in of_all if r["env"].endswith("_velocity") and r["algo"] is None]
    lines = ["| | environments | steps/s | slowest, fastest run |", "|---|---:|---:|---:|"]
    for (env, size), r in sorted(latest(rows, "env", "num_envs").items()):
        rates = f"{r['env_steps_per_s']:,.0f} | {r['slowest']:,.0f}, {r['fastest']:,.0f}"
        lines.append(f"| {env} | {size:,} | {rates} |")
    return "\n".join(lines)


def engine_jax() -> str:
    """Environment steps a second of engine jax, with MJX's solver and with ours."""
    lines = [
        "| | device | environments | MJX's solver | ours | compiled in, s |",
        "|---|---|---:|---:|---:|---:|",
    ]
    files = ("benchmark_h200.jsonl", "benchmark_cpu.jsonl")
    rows = [r for file in files for r in benchmark_rows(file) if r.get("engine") == "jax"]
    key = ("env", "device", "num_envs")
    theirs = latest([r for r in rows if r["solver"].startswith("MJX")], *key)
    for (env, device, size), r in sorted(latest(rows, *key).items()):
        before = theirs.get((env, device, size))
        shown = f"{before['env_steps_per_s']:,.0f}" if before else ""
        cells = f"{size:,} | {shown} | {r['env_steps_per_s']:,.0f} | {r['compile_s']:.0f}"
        lines.append(f"| {env} | {device} | {cells} |")
    return "\n".join(lines)


def algorithm_speeds() -> str:
    """Environment steps a second of every algorithm's training, 16 seeds, and of PPO-Lagrangian's."""
    rows = [r for r in benchmark_rows("benchmark_h200.jsonl") if r["algo"] and "peer" not in r]
    rows = [r for r in rows if "xla_flags" not in r]  # without its tuning the learner is half as fast
    rows = [r for r in rows if r.get("solver") != SWEEP]  # with which the others were not measured
    shape = {"env": "point_goal1", "num_seeds": 16, "num_envs": 512, "horizon": 40}
    rows = [r for r in rows if r.get("warmup") and all(r[k] == v for k, v in shape.items())]
    found = latest(rows, "algo")
    beside = found[("ppo_lag",)]["env_steps_per_s"]
    lines = ["| | steps/s | slowest, fastest run | of `ppo_lag` |", "|---|---:|---:|---:|"]
    for (algo,), r in sorted(found.items()):
        rate = r["env_steps_per_s"]
        ends = f"{r['slowest']:,.0f}, {r['fastest']:,.0f}"
        lines.append(f"| `{algo}` | {rate:,.0f} | {ends} | {rate / beside:.2f} |")
    return "\n".join(lines)


def training_rows() -> list[tuple[float, str, int, int, int | str]]:
    """Environment steps a second of PPO-Lagrangian's training on one H200, ours and CRAX's, the fastest
    first; with its name, seeds, environments of a seed and horizon."""
    rows = benchmark_rows("benchmark_h200.jsonl")
    whole = {"env": "point_goal1", "algo": "ppo_lag", "devices": 1}
    ours = [r for r in rows if r.get("warmup") and all(r.get(k) == v for k, v in whole.items())]
    # rows that name no solver are from when there was no other
    ours = [r for r in ours if r.get("solver", SWEEP) == SWEEP and "xla_flags" not in r]
    theirs = [r for r in rows if r.get("peer") == "crax" and r["algo"]]
    found = [
        (r["env_steps_per_s"], "jaxsafe", *shape)
        for shape, r in latest(ours, "num_seeds", "num_envs", "horizon").items()
    ]
    found += [
        (r["env_steps_per_s"], f"CRAX {r['crax-bench']}, its defaults", 1, size, "")
        for (size,), r in latest(theirs, "num_envs").items()
    ]
    return sorted(found, reverse=True)


def training_speeds() -> str:
    lines = ["| | seeds | environments of a seed | horizon | steps/s |", "|---|---:|---:|---:|---:|"]
    for rate, name, seeds, size, horizon in training_rows():
        lines.append(f"| {name} | {seeds} | {size:,} | {horizon} | {round(rate, -4):,.0f} |")
    return "\n".join(lines)


def off_policy_speeds() -> str:
    """Environment steps a second of SAC's training on one H200, ours and that of peers with as many
    environments and gradient steps, the fastest first. `after`: steps of each of our environments."""
    rows = [r for r in benchmark_rows("benchmark_h200.jsonl") if (r["algo"] or "").startswith("sac")]
    ours = latest(
        [r | {"options": r.get("options", "")} for r in rows if "peer" not in r],
        "env", "num_seeds", "options",
    )  # fmt: skip
    theirs = latest([r for r in rows if "peer" in r], "peer")
    names = {"brax-sac": "Brax {brax}, SAC", "crax-sac-lag": "CRAX {crax-bench}, SAC-Lagrangian"}
    own = {"sac": "jaxsafe, SAC", "sac_lag": "jaxsafe, SAC-Lagrangian"}
    told = "algo.hidden_dtype=bfloat16", "bfloat16"
    found = [
        (", ".join([own[r["algo"]], *options.replace(*told).split()]), seeds, r)
        for (_, seeds, options), r in ours.items()
    ]
    found += [(names[peer].format(**r), 1, r) for (peer,), r in theirs.items()]
    lines = [
        "| | task | seeds | after | steps/s | slowest, fastest run |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for name, seeds, r in sorted(found, key=lambda x: -x[2]["env_steps_per_s"]):
        rates = f"{r['env_steps_per_s']:,.0f} | {r['slowest']:,.0f}, {r['fastest']:,.0f}"
        lines.append(f"| {name} | `{r['env']}` | {seeds} | {r.get('warmup', '')} | {rates} |")
    return "\n".join(lines)


def training_bars(path: Path) -> None:
    """The README's figure of speed: `training_rows`."""
    rows = training_rows()[::-1]
    figure, axes = plt.subplots(figsize=(9, 0.4 + 0.4 * len(rows)), layout="constrained")
    labels = [
        f"{name.partition(',')[0]}, {seeds} seed{'s' * (seeds > 1)} of {size:,}"
        for _, name, seeds, size, _ in rows
    ]
    colors = ["C0" if name == "jaxsafe" else "0.6" for _, name, *_ in rows]
    bars = axes.barh(labels, [rate for rate, *_ in rows], color=colors)
    axes.bar_label(bars, [f"{round(rate, -4):,.0f}" for rate, *_ in rows], padding=4)
    axes.set(xlabel="environment steps / s while training", xlim=(0, 1.12 * rows[-1][0]))
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)


def throughput(path: Path) -> None:
    """Environment steps a second, random actions, against the number of environments; on the GPU those
    of settled environments."""
    figure, axes = plt.subplots(figsize=(7, 4.5))
    for file, style in (("benchmark_h200.jsonl", "o-"), ("benchmark_cpu.jsonl", "s--")):
        found: dict[str, dict[int, float]] = {}
        for row in benchmark_rows(file):
            whole = "peer" in row or ("cpu" in file and row["engine"] == "c") or whole_sweep(row)
            if row["algo"] is None and whole and not row.get("vision"):
                what = f"{row['peer']}: {row['env']}" if "peer" in row else row["env"]
                points = found.setdefault(what, {})
                points[row["num_envs"]] = row["env_steps_per_s"]  # the last, if measured again
        device = "H200" if "h200" in file else "2 CPU cores"
        for env, points in sorted(found.items()):
            axes.loglog(*zip(*sorted(points.items()), strict=True), style, label=f"{env}, {device}")
    axes.set_xlabel("environments")
    axes.set_ylabel("environment steps / s")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(path, dpi=130, bbox_inches="tight", metadata={"Software": None})
    plt.close(figure)


def learning(runs: Sequence[SettingRun], path: Path) -> None:
    """Return and cost over training on car_goal1 of four algorithms, with the limit: the README's."""
    names = ("ppo", "ppo_lag", "trpo_lag", "cpo")
    figure, panels = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
    chosen = [run for run in runs if run.env == "car_goal1" and run.config["algo.name"] in names]
    groups = group(chosen, ["algo.name"])
    edges = np.linspace(0, max(run.steps for run in chosen), 51)
    looks = styles(groups)
    for g in sorted(groups, key=lambda g: names.index(g.name)):
        for axes, name in zip(panels, ("train/return", "train/cost"), strict=True):
            values = np.concatenate([plots.stretches(run.table, name, edges) for run in g.runs])
            plots.band(axes, name, edges[1:] / 1e6, values, g.name, **looks[g.name])
    panels[1].axhline(25, color="0.4", ls="--", lw=1, label="limit")
    for axes, what in zip(panels, ("return", "cost"), strict=True):
        axes.set(xlabel="million environment steps", ylabel=f"{what} of an episode")
    panels[1].legend(ncols=2, fontsize=8)
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)


def gains(algorithms: Sequence[str], tasks: Sequence[str], window: tuple[float, float]) -> str:
    """Return, cost and its swing by the settings of the margin, between two counts of steps.

    The swing is the standard deviation of means over 20 iterations, for each seed, and then its mean.
    """
    names = [f"algo.{name}" for name in ("violation_gain", "margin_lr", "margin_max")]
    settings: dict[tuple, dict[str, SettingRun]] = {}
    for run in read([RESULTS / "margin"]):
        algo = run.config["algo.name"]
        known = np.isfinite(run.values.get(f"return {studies.window_name(*window)}", np.nan)).all()
        if algo in algorithms and run.env in tasks and known:
            key = (algo, *(run.config[name] for name in names))
            settings.setdefault(key, {})[run.env] = run
    lines = [f"| | gain | rate | bound | {' | '.join(tasks)} |"]
    lines.append("|---|---:|---:|---:|" + "---:|" * len(tasks))
    for (algo, gain, rate, most), by_task in sorted(settings.items(), key=lambda item: item[0]):
        cells = []
        for run in map(by_task.get, tasks):
            what = (f"{k} {studies.window_name(*window)}" for k in ("return", "cost", "swing"))
            cells.append(
                "{:.1f}, {:.1f} ± {:.1f}".format(*(run.values[k].mean() for k in what)) if run else ""
            )
        bound = "none" if most == float("inf") else f"{most:g}"
        lines.append(f"| `{algo}` | {gain:g} | {rate:g} | {bound} | {' | '.join(cells)} |")
    return "\n".join(lines)


def kept(runs: Sequence[SettingRun]) -> str:
    """How much of the cost that CPO's steps promise to take off comes true, on Goal and Button."""
    found = [run for run in runs if run.config["algo.name"] == "cpo" and "push" not in run.env]
    promised = np.concatenate([run.values["promised"] for run in found])
    shares = [run.values["kept"].mean() for run in found]
    mean, least, most = (100 * f(shares) for f in (np.mean, min, max))
    return (
        f"A step promises {promised.min():.2f} to {promised.max():.2f} less cost a step, of which "
        f"{mean:.1f}% come true ({least:.1f} to {most:.1f}% by task)."
    )


def attempts() -> str:
    """What was tried on point_goal1 before the defaults of today, over whole trainings."""
    lines = ["| run | environments x steps | seeds | return | cost |", "|---|---|---:|---:|---:|"]
    for run in read([RESULTS / "first_attempts"]):
        whole = run.steps >= run.config["total_steps"] and run.env == "point_goal1"
        if whole and run.config["algo.name"] != "trpo_pid":
            names = {"cpo": ("margin_lr", "target_kl"), "ppo_lag": ("dual_lr",)}
            algo = run.config["algo.name"]
            options = "".join(f", `{k}={run.config[f'algo.{k}']:g}`" for k in names[algo])
            shape = f"{run.config['algo.num_envs']} x {run.config['algo.horizon']}"
            ret, cost = (cell(stats.of_measure(k, run.values[k]), ".2f") for k in ("return", "cost"))
            lines.append(f"| `{algo}`{options} | {shape} | {len(run.seeds)} | {ret} | {cost} |")
    return "\n".join(lines)


def dsrl() -> str:
    """DSRL's normalised scores after 1e5 updates, by task, algorithm and the share of `ppo_lag`."""
    cells: dict[tuple[str, str], dict[str, str]] = {}
    for run in read([RESULTS / "offline"]):
        if run.config["total_updates"] > 1e5 or "final return" not in run.values:
            continue
        ret = scores.dsrl_return(run.env, run.values["final return"].mean())
        cost = scores.dsrl_cost(run.values["final cost"].mean(), run.config["algo.cost_limit"])
        shown = f"**{ret:.2f}, {cost:.1f}**" if cost <= 1 else f"{ret:.2f}, {cost:.1f}"
        row = cells.setdefault((run.env, run.config["algo.name"]), {})
        row[Path(run.config["dataset"]).stem] = shown
    shares = ("0.25", "0.50", "0.75")
    lines = [f"| | | {' | '.join(shares)} |", "|---|---|" + "---:|" * len(shares)]
    for (env, algo), row in sorted(cells.items()):
        lines.append(f"| `{env}` | `{algo}` | {' | '.join(row.get(x, '') for x in shares)} |")
    return "\n".join(lines)


def devices() -> str:
    """The same training on one, two and four GPUs."""
    lines = ["| GPUs | environments of a seed | estimated return | estimated cost | seconds |"]
    lines.append("|---:|---:|---:|---:|---:|")
    for run in read([RESULTS / "devices"]):
        found = (stats.of_measure(k, run.values[f"{k} estimate"]) for k in ("return", "cost"))
        shape = f"{run.config['devices']} | {run.config['algo.num_envs']:,}"
        seconds = 60 * run.values["minutes"].max()
        lines.append(f"| {shape} | {' | '.join(cell(x, '.1f') for x in found)} | {seconds:.1f} |")
    return "\n".join(lines)


def is_navigation(run: SettingRun) -> bool:
    """Whether it is one of the ten runs of SAC-Lagrangian that stand beside the table."""
    asked = {"algo.name": "sac_lag", "preset": "navigation", "algo.cost_limit": 25}
    return all(run.config[name] == value for name, value in asked.items())


def pages() -> dict[Path, str]:
    """The text of every page with tables of measurements, by its path."""
    runs = read([RESULTS / name for name in TABLE])
    runs = [run for run in runs if run.config["algo.name"] not in EXTRA]
    groups = ordered(group(runs, ["algo.name"]))
    final = ordered(group(studies.evaluated(runs), ["algo.name"]))
    theirs = read([RESULTS / "omnisafe"])
    theirs = [run for run in theirs if run.config["compat"] == "omnisafe"]
    margin = ["car_goal2", "point_button1", "point_goal2"]
    written = {
        RESULTS / "README.md": {
            "matrix": apart(groups, {}),
            "evaluated": apart(final, PUBLISHED),
            "held": held(groups, final),
            "left": left(),
        },
        RESULTS / "published.md": {
            "best": best(),
            "outside": outside(groups, final),
            "held": held(groups, final),
        },
        RESULTS / "cells.md": {"cells": cells.table(PUBLISHED)},
        RESULTS / "causes" / "README.md": {"mean actions": mean_actions(runs)},
        RESULTS / "omnisafe" / "README.md": {
            "conventions": conventions(groups, group(theirs, ["algo.name"]))
        },
        RESULTS / "margin" / "README.md": {
            "kept": kept(runs),
            "gains": gains(["cpo", "pcpo"], margin, (3e6, 5.4e6)),
            "slow gains": gains(["pcpo"], ["car_button2", "point_goal2"], (9e6, 1.01e7)),
        },
        RESULTS / "first_attempts" / "README.md": {"attempts": attempts()},
        RESULTS / "devices" / "README.md": {"devices": devices()},
        RESULTS / "offline" / "README.md": {"normalised": dsrl()},
        HERE.parent / "README.md": {"held": held(groups, final)},
        HERE / "benchmark.md": {"speeds": algorithm_speeds()},
        HERE / "performance.md": {
            "throughput": throughput_table(),
            "velocity": velocity_speeds(),
            "training": training_speeds(),
            "off-policy": off_policy_speeds(),
            "engine jax": engine_jax(),
        },
    }
    found = {path.parent / "README.md": studies.page(studies.read(path.parent))[0] for path in STUDIES}
    for path, parts in written.items():
        found[path] = between_marks(found.get(path) or path.read_text(), parts, "measured")
    return found


def main() -> None:
    throughput(HERE / "images" / "throughput.png")
    training_bars(HERE / "images" / "speed.png")
    for path in STUDIES:
        studies.write_page(studies.read(path.parent))
    runs = read([RESULTS / name for name in TABLE])
    learning(runs, HERE / "images" / "learning.png")
    shown = [run for run in studies.evaluated(runs) if run.config["algo.name"] in SHOWN]
    groups = ordered(group(shown, ["algo.name"]))
    published = {(g.env, g.name): beside(g, PUBLISHED) for g in groups}
    picture = trade_off.draw(groups, "evaluated policies", published)
    studies.save_small(picture, RESULTS / "images" / "trade_off.png")
    runs += [run for run in read([RESULTS / "off_policy"]) if is_navigation(run)]
    scored = suite([g for g in ordered(group(runs, ["algo.name"])) if g.name not in EXTRA])
    picture = plots.normalised(list(scored.groups), SCORES, aggregates(scored))
    studies.save_small(picture, RESULTS / "images" / "scores.png")
    for path, text in pages().items():
        path.write_text(text)


if __name__ == "__main__":
    main()

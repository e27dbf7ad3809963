"""Draw the curves of these runs and write the tables of README.md and ../../README.md:

    python docs/results/make.py

Each folder holds the metrics of one command (versions.json has it), compressed. The runs compared, in
tables and figures: python scripts/plot.py docs/results --published docs/results/published.csv
"""

import csv
import importlib
import json
import lzma
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from jaxsafe.report import plots, scores, stats, tables
from jaxsafe.report.group import Group, group, ordered
from jaxsafe.report.published import beside, read_published
from jaxsafe.report.read import read
from jaxsafe.run import run_folder

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]
marked, run = importlib.import_module("tables"), importlib.import_module("run")
# OmniSafe: evaluated policies. We know of no constrained table of Push.
PUBLISHED = read_published(HERE / "published.csv")
SWEEP = "jaxsafe, and dynamics"  # `solver` of the rows that are compared with each other
# Why cells lie outside the published spread, by algorithm, or of one task alone.
FIRST = "first-order learners earn less there (see below)"
SAMPLED = "sampled actions while training; the final policy is within"
BUTTON = "not known; unconstrained learners earn up to 3 more here on Button, and cost less on Car's"
PRICE = "OmniSafe's conventions, which make up most of it on Goal 1 (see below)"
UNSAFE = "at these settings nobody earns on Button: theirs lose 0.6 to 3.1, ours 1.3 at most"
WHOLE = "training ends an episode once its cost exceeds the limit; their evaluation, once it reaches it"
GAIN_TASKS = ["car_goal2", "point_button1", "point_goal2"]
BUTTONS = [f"{robot}_button{level}" for robot in ("point", "car") for level in (1, 2)]
REASONS = {
    "cpo": "here the cost is [held at the limit](#holding-cpo-at-the-limit), there it stays above",
    "pcpo": "there the reward's step lacks H^-1; here the cost [comes down](#holding-cpo-at-the-limit)",
    "cppo_pid": FIRST,
    "p3o": f"{FIRST}, and little of that is the penalty per episode",
    "ppo_saute": FIRST,
    "ppo_simmer_pid": FIRST,
    "ppo_early_terminated": WHOLE,
    "trpo_early_terminated": WHOLE,
    "trpo": SAMPLED,
    "npg": SAMPLED,
    "trpo_lag": PRICE,
    "trpo_pid": PRICE,
    "focops": "its multiplier is at its bound of 2 (`algo.lam_max`)",
    "pg": "a slip there: their training curve costs 58",
    "cup": FIRST,
    "car_goal1 rcpo": "the crest of a swing of 4 million steps: the last 40% make 21.3 at a cost of 25",
    "point_button2 rcpo": "within their training curve; the policies of their table cost 45",
    "car_button1 trpo_lag": "here as their curve, which is that of RCPO, too: 0.7 at cost 23",
    "car_goal1 trpo_lag": "here above their curve, which is that of RCPO, too: 21.8 at cost 24",
    "car_goal2 trpo_lag": "sampled actions while training; the final policy is within, as theirs",
    "car_button1 trpo_pid": "within their training curve",
    "car_goal2 ppo_saute": "few seeds: the interval is 25 to 35",
    "car_goal2 ppo_simmer_pid": "few seeds",
}
REASONS |= {f"{task} {algo}": BUTTON for task in BUTTONS for algo in ("npg", "trpo")}
REASONS |= {
    f"{task} {algo}_{kind}": UNSAFE
    for task in BUTTONS
    for algo in ("ppo", "trpo")
    for kind in ("saute", "simmer_pid")
}
# Where a run's evaluation.json was not kept: what its command printed.
PRINTED = {
    "point_goal1-ppo_lag": "19.21 [15.68, 21.97], cost 22.91 [18.99, 27.05]",
    "point_goal1-cpo": "20.34 [18.71, 21.86], cost 19.24 [14.78, 23.79]",
    "point_goal1-cpo-published": "22.64 and 21.11, cost 26.75 and 38.90",  # a command a seed
}


def final_policy(name: str) -> str:
    """20 episodes of each seed's mean action, at the end of the training command."""
    file = HERE / name / "evaluation.json"
    if not file.exists():
        return PRINTED.get(name, "-")
    rows = json.loads(file.read_text())
    text = {k: "{:.2f} [{:.2f}, {:.2f}]".format(*rows[k]) for k in ("return", "cost")}
    return f"{text['return']}, cost {text['cost']}"


def last_tenth(metrics: dict[str, np.ndarray], name: str) -> str:
    """Mean over the last 10% of training, and its 95% interval over seeds."""
    return tables.cell(stats.estimate(run_folder.last_tenth(metrics, name)), ".2f")


def published(config: dict[str, Any]) -> str:
    """What others report of a setting, or where that is nothing constrained, unconstrained PPO."""
    env, algo = config["env"]["name"], config["algo"]["name"]
    known = PUBLISHED.get((env, algo))
    if known and known.holds_for(config["env"].get("rules", "safety_gym")):
        (ret, ret_std), (cost, cost_std) = known.ret, known.cost
        return f"{known.source} {ret:.2f} ± {ret_std:.2f}, cost {cost:.2f} ± {cost_std:.2f}"
    if ppo := scores.CHARACTERISTIC.get(env):
        return f"none (unconstrained PPO: {ppo.ret:.4g}, cost {ppo.cost:.4g})"
    return "none"


def row(name: str, metrics: dict[str, np.ndarray], *more: str) -> str:
    figures = (last_tenth(metrics, f"train/{what}") for what in ("return", "cost"))
    minutes = f"{metrics['seconds'].max() / 60:.1f}"
    what = " ".join(f"`{part}`" for part in name.split("-", 2))
    return f"| {' | '.join([what, str(len(np.unique(metrics['seed']))), *figures, *more, minutes])} |"


def all_runs() -> str:
    """A row for each folder."""
    lines = [
        "| run | seeds | return, last 10% | cost, last 10% | final policy | published | minutes |",
        "|---|---:|---:|---:|---|---|---:|",
    ]
    for path in sorted(HERE.glob("*/config.yaml")):
        name, metrics = path.parent.name, run_folder.read_metrics(path.parent)
        known = published(run_folder.read_config(path.parent))
        lines.append(row(name, metrics, final_policy(name), known))
    return "\n".join(lines)


def beyond(value: float, spread: tuple[float, float]) -> float:
    """By how much `value` is outside mean ± spread; 0 within."""
    mean, width = spread
    return float(np.sign(value - mean) * max(0.0, abs(value - mean) - width))


def outside(groups: Sequence[Group]) -> str:
    """The cells whose mean lies outside the published spread, the published training curve, and why."""
    with (HERE / "published_curves.csv").open() as file:
        curves = {(r["env"], r["algo"]): (r["return"], r["cost"]) for r in csv.DictReader(file)}
    lines, within, count = ["| run | return | cost | ours | their curve | why |"], 0, 0
    lines.append("|---|---:|---:|---:|---:|---|")
    for g in sorted(groups, key=lambda g: (g.name, g.env)):
        if theirs := beside(g, PUBLISHED):
            off = beyond(g.ret.mean, theirs.ret), beyond(g.cost.mean, theirs.cost)
            count, within = count + 1, within + (not any(off))
            if any(off):
                figures = (f"{x:+.2g}" if x else "" for x in off)
                why = REASONS.get(f"{g.env} {g.name}") or REASONS[g.name]
                ours = f"{g.ret.mean:.1f}, {g.cost.mean:.0f}"
                curve = ", ".join(x or "-" for x in curves.get((g.env, g.name), ()))
                lines.append(
                    f"| `{g.env}` `{g.name}` | {' | '.join(figures)} | {ours} | {curve} | {why} |"
                )
    summary = f"{within} of {count} cells lie within the published spreads in both."
    return "\n".join([summary, "", *lines])


def held(groups: Sequence[Group]) -> str:
    """How many constrained cells cost at most 1.2 times the limit, ours in training and published."""
    free = {"pg", "npg", "trpo", "ppo"}
    cells = [(g, beside(g, PUBLISHED)) for g in groups if g.name not in free]
    kept = [theirs for g, theirs in cells if g.cost.mean <= 30]
    costs = [theirs.cost[0] for _, theirs in cells if theirs]
    return (
        f"While training ours cost at most 30, a fifth over the limit, in {len(kept)} of {len(cells)} "
        f"constrained cells; of the {len(costs)} with a published figure ours do in "
        f"{sum(map(bool, kept))}, OmniSafe's evaluated policies in {sum(c <= 30 for c in costs)}."
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


def by_algorithm(groups: Sequence[Group]) -> str:
    """Return and cost of each algorithm on each task, and below them what is published."""
    tasks = sorted({g.env for g in groups})
    found = {(g.env, g.name): g for g in groups}
    lines = [f"| | {' | '.join(f'`{env}`' for env in tasks)} |", "|---|" + "---:|" * len(tasks)]
    for algo in sorted({g.name for g in groups}):
        cells = []
        for env in tasks:
            figures = []
            if g := found.get((env, algo)):
                figures.append(f"{g.ret.mean:.1f}, {g.cost.mean:.1f}")
                if theirs := beside(g, PUBLISHED):
                    figures.append(f"*{theirs.ret[0]:.1f}, {theirs.cost[0]:.1f}*")
            cells.append("<br>".join(figures))
        lines.append(f"| `{algo}` | {' | '.join(cells)} |")
    return "\n".join(lines)


def benchmark_rows(file: str) -> list[dict]:
    return [json.loads(line) for line in (HERE / file).read_text().splitlines()]


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
    largest = [row for (_, size), row in sorted(found.items()) if size == sizes[-1]]
    memory = (f"{row['env']} {row['memory_bytes'] / 2**30:.1f}" for row in largest)
    lines += ["", f"Memory with {sizes[-1]:,}, GiB: {', '.join(memory)}."]
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


def gains(algos: Sequence[str], tasks: Sequence[str], begin: float, end: float) -> str:
    """Return, cost and its swing by the settings of the margin, between two counts of steps.

    The swing is the standard deviation of means over 20 iterations, for each seed, and then its mean.
    """
    settings: dict[tuple, dict[str, list]] = {}
    with lzma.open(HERE / "gain.csv.xz", "rt") as file:
        for row in csv.DictReader(file):
            known = row["task"] in tasks and row["algo"] in algos
            if known and begin < float(row["steps"]) <= end:
                key = (
                    row["algo"],
                    *(float(row[k]) for k in ("violation_gain", "margin_lr", "margin_max")),
                )
                settings.setdefault(key, {}).setdefault(row["task"], []).append(row)
    lines = [
        f"| | gain | rate | bound | {' | '.join(tasks)} |",
        "|---|---:|---:|---:|" + "---:|" * len(tasks),
    ]
    for (algo, gain, rate, most), by_task in sorted(settings.items(), key=lambda item: item[0]):
        cells = []
        for rows in map(by_task.get, tasks):
            if not rows:
                cells.append("")
                continue
            ret, cost = (np.array([float(r[k]) for r in rows]) for k in ("return", "cost"))
            seeds = np.array([r["seed"] for r in rows])
            own = [cost[seeds == s] for s in np.unique(seeds)]
            swing = np.mean([c[: len(c) // 20 * 20].reshape(-1, 20).mean(1).std() for c in own])
            cells.append(f"{ret.mean():.1f}, {cost.mean():.1f} ± {swing:.1f}")
        bound = "none" if most == float("inf") else f"{most:g}"
        lines.append(f"| `{algo}` | {gain:g} | {rate:g} | {bound} | {' | '.join(cells)} |")
    return "\n".join(lines)


def kept() -> str:
    """How much of the cost that CPO's steps promise to take off comes true, on Goal and Button.

    The slope, over 20 iterations each, of the change of the violation on the sum of promises.
    """
    promised, shares = [], []
    for path in sorted(HERE.glob("*[12]-cpo")):
        if "push" in path.name:
            continue
        metrics, slopes = run_folder.read_metrics(path), []
        for seed in np.unique(metrics["seed"]):
            violation, promise = (
                metrics[f"train/{k}"][metrics["seed"] == seed] for k in ("violation", "objective_c")
            )
            spans = (len(violation) // 20, 20)
            violation, sums = (x[: np.prod(spans)].reshape(spans) for x in (violation, promise))
            slopes.append(np.polyfit(sums.sum(1)[:-1], np.diff(violation.mean(1)), 1)[0])
            promised.append(-promise.mean())
        shares.append(np.mean(slopes))
    mean, least, most = (100 * f(shares) for f in (np.mean, min, max))
    return (
        f"A step promises {min(promised):.2f} to {max(promised):.2f} less cost a step, of which "
        f"{mean:.1f}% come true ({least:.1f} to {most:.1f}% by task)."
    )


def algorithm_speeds() -> str:
    """Environment steps a second of every algorithm's training, 16 seeds, and of PPO-Lagrangian's."""
    rows = [r for r in benchmark_rows("benchmark_h200.jsonl") if r["algo"] and "peer" not in r]
    rows = [r for r in rows if "xla_flags" not in r]  # without its tuning the learner is half as fast
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


def throughput(path: Path) -> None:
    """Environment steps a second, random actions, against the number of environments; on the GPU those
    of settled environments."""
    figure, axes = plt.subplots(figsize=(7, 4.5))
    for file, style in (("benchmark_h200.jsonl", "o-"), ("benchmark_cpu.jsonl", "s--")):
        found: dict[str, dict[int, float]] = {}
        for row in benchmark_rows(file):
            whole = "peer" in row or ("cpu" in file and row["engine"] == "c") or whole_sweep(row)
            if row["algo"] is None and whole:
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
    figure.savefig(path, dpi=130, bbox_inches="tight")
    plt.close(figure)


def figures(groups: Sequence[Group]) -> None:
    """Curves of every task, of the main algorithms and of the others, and return against cost."""
    for name, main in (("curves", True), ("curves_others", False)):
        plots.save(
            plots.learning([g for g in groups if (g.name in run.MAIN) == main]), HERE / name, ["png"]
        )
    known = {(g.env, g.name): beside(g, PUBLISHED) for g in groups}
    plots.save(plots.trade_off(groups, "last 10 % of training", known), HERE / "trade_off", ["png"])


def main() -> None:
    throughput(HERE / "throughput.png")
    runs = [x for x in read([HERE]) if x.config["preset"] == "fast"]
    ours, theirs = (
        ordered(group([x for x in runs if x.config["compat"] == c], ["algo.name"]))
        for c in ("none", "omnisafe")
    )
    groups = [g for g in ours if g.name in run.ALGOS]
    figures(groups)
    for path, name, table in (
        (HERE / "README.md", "runs", all_runs()),
        (HERE / "README.md", "outside", outside(groups)),
        (HERE / "README.md", "held", held(groups)),
        (HERE / "README.md", "conventions", conventions(groups, theirs)),
        (HERE / "README.md", "speeds", algorithm_speeds()),
        (HERE / "README.md", "kept", kept()),
        (HERE / "README.md", "gains", gains(["cpo", "pcpo"], GAIN_TASKS, 3e6, 5.4e6)),
        (
            HERE / "README.md",
            "slow gains",
            gains(["pcpo"], ["car_button2", "point_goal2"], 9e6, 1.01e7),
        ),
        (HERE.parent / "performance.md", "throughput", throughput_table()),
        (HERE.parent / "performance.md", "engine jax", engine_jax()),
        (HERE.parent.parent / "README.md", "results", by_algorithm(groups)),
    ):
        path.write_text(marked.replaced(path.read_text(), {name: table}, "measured"))
    for path in sorted((HERE / "ablations").glob("*.csv.xz")):
        print(row(path.name.removesuffix(".csv.xz"), run_folder.read_table(path)))


if __name__ == "__main__":
    main()

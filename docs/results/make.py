"""Draw the curves and print the numbers of these runs: python docs/results/make.py

Each folder holds the metrics of one command (versions.json has it), compressed.
"""

import csv
import io
import json
import lzma
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from jaxsafe import plots, run_folder
from jaxsafe.evaluation import estimate

HERE = Path(__file__).parent
LIMIT = 25.0
# Return and cost, mean and spread. OmniSafe: benchmarks/on-policy, Table 2, 1e7 steps, evaluated
# policies. Safety Gym: unconstrained PPO, 1e7 steps; we know of no constrained table.
PUBLISHED = {
    "point_goal1-ppo_lag": "OmniSafe 12.96 ± 6.95, cost 25.80 ± 34.99",
    "point_goal1-cpo": "OmniSafe 20.46 ± 1.38, cost 28.84 ± 7.76",
    "point_goal1-ppo_lag-published": "OmniSafe 12.96 ± 6.95, cost 25.80 ± 34.99",
    "point_goal1-cpo-published": "OmniSafe 20.46 ± 1.38, cost 28.84 ± 7.76",
    "car_push1-ppo_lag": "none (unconstrained PPO: 3.085, cost 61.94)",
    "car_push1-cpo": "none (unconstrained PPO: 3.085, cost 61.94)",
}
# Where a run's evaluation.json was not kept: what its command printed.
PRINTED = {
    "point_goal1-ppo_lag": "19.21 [15.68, 21.97], cost 22.91 [18.99, 27.05]",
    "point_goal1-cpo": "20.34 [18.71, 21.86], cost 19.24 [14.78, 23.79]",
    "point_goal1-cpo-published": "22.64 and 21.11, cost 26.75 and 38.90",  # a command a seed
}


def read(path: Path) -> dict[str, np.ndarray]:
    """The columns of a metrics.csv.xz."""
    with lzma.open(path) as file:
        rows = list(csv.DictReader(io.TextIOWrapper(file)))
    return {k: np.array([float(r[k] or "nan") for r in rows]) for k in rows[0]}


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
    e = estimate(run_folder.last_tenth(metrics, name)[:, None])
    return f"{e.mean:.2f} [{e.low:.2f}, {e.high:.2f}]"


def throughput(path: Path) -> None:
    """Environment steps a second, random actions, against the number of environments."""
    figure, axes = plt.subplots(figsize=(7, 4.5))
    for file, style in (("benchmark_h200.jsonl", "o-"), ("benchmark_cpu.jsonl", "s--")):
        found: dict[str, dict[int, float]] = {}
        for line in (HERE / file).read_text().splitlines():
            row = json.loads(line)
            if row["algo"] is None:
                what = f"{row['peer']}: {row['env']}" if "peer" in row else row["env"]
                best = found.setdefault(what, {})
                best[row["num_envs"]] = max(best.get(row["num_envs"], 0), row["env_steps_per_s"])
        device = "H200" if "h200" in file else "2 CPU cores"
        for env, points in sorted(found.items()):
            axes.loglog(*zip(*sorted(points.items()), strict=True), style, label=f"{env}, {device}")
    axes.set_xlabel("environments")
    axes.set_ylabel("environment steps / s")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(path, dpi=130, bbox_inches="tight")
    plt.close(figure)


def main() -> None:
    throughput(HERE / "throughput.png")
    print("| run | seeds | return | cost (limit 25) | final policy | published | minutes |")
    print("|---|---:|---:|---:|---|---|---:|")
    for name in PUBLISHED:
        metrics = read(HERE / name / "metrics.csv.xz")
        plots.curves(metrics, HERE / f"{name}.png", name.replace("-", ", "), LIMIT)
        print(
            f"| {name} | {len(np.unique(metrics['seed']))} | {last_tenth(metrics, 'train/return')} | "
            f"{last_tenth(metrics, 'train/cost')} | {final_policy(name)} | {PUBLISHED[name]} | "
            f"{metrics['seconds'].max() / 60:.1f} |"
        )
    for path in sorted((HERE / "ablations").glob("*.csv.xz")):
        metrics = read(path)
        print(
            f"| {path.name.removesuffix('.csv.xz')} | {len(np.unique(metrics['seed']))} | "
            f"{last_tenth(metrics, 'train/return')} | {last_tenth(metrics, 'train/cost')} | - | - | "
            f"{metrics['seconds'].max() / 60:.1f} |"
        )


if __name__ == "__main__":
    main()

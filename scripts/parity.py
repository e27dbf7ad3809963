"""Replay recordings of the original engine: python scripts/parity.py RECORDING... [--engine c]

Prints the errors of each component on well-conditioned steps and on all, the events that differ, and
'pass' or what is past its tolerance. Exit status: 0 all pass, 1 some do not, 2 bad input.
"""

import platform
import sys
from importlib.metadata import version
from pathlib import Path

from jaxsafe.commands.jaxsafe import leaving_at_ctrl_c

with leaving_at_ctrl_c():
    import jax
    import numpy as np

    from jaxsafe.commands.guard import guarded
    from jaxsafe.config import ConfigError
    from jaxsafe.envs.safety_gym.recording import Comparison, Recording, compare
    from jaxsafe.run.flags import Parser

FORCES = ("accelerometer", "touch")
BODIES = ("robot pose", "robot velocity", "object pose", "object velocity", "reward")
COLUMNS = (
    "recording",
    "steps",
    "strict",
    "pose",
    "velocity",
    "reward",
    "obs",
    "forces",
    "events",
    "result",
)


def largest(comparison: Comparison, names: list[str]) -> float:
    """The largest error of some components on well-conditioned steps."""
    return max((comparison.errors[n][comparison.strict].max(initial=0) for n in names), default=0.0)


def differing(comparison: Comparison) -> tuple[int, int]:
    """Events that differ, and how many of them the recording marks undecided."""
    mismatches = np.array(list(comparison.mismatches.values()))
    return int(mismatches.sum()), int((mismatches & comparison.undecided).sum())


def report(comparison: Comparison) -> str:
    strict = comparison.strict
    lines = [
        f"{comparison.name}, engine {comparison.engine}: {len(strict)} steps, "
        f"{strict.mean():.1%} well-conditioned (strict)",
        f"  {'':24}{'strict: max':>13}{'p99':>10}{'all: max':>13}{'p99':>10}",
    ]
    for name, error in comparison.errors.items():
        bounded = error[strict] if strict.any() else np.zeros(1)
        values = (bounded.max(), np.quantile(bounded, 0.99), error.max(), np.quantile(error, 0.99))
        lines.append(
            f"  {name:24}"
            + "".join(f"{v:{w}.1e}" for v, w in zip(values, (13, 10, 13, 10), strict=True))
        )
    for name, differs in comparison.mismatches.items():
        undecided = (differs & comparison.undecided).sum()
        lines.append(f"  {name:24}{differs.sum():>13} events differ, {undecided} of them undecided")
    lines += [f"  {line}" for line in comparison.failures() or ["pass"]]
    return "\n".join(lines)


def verdict(comparison: Comparison) -> str:
    """'pass', or on how many strict steps something is past its tolerance."""
    if not comparison.failures():
        return "pass"
    steps = int(np.any([comparison.past(name) for name in comparison.errors], axis=0).sum())
    return f"{steps} step{'s' * (steps > 1)} past" if steps else "events"


def row(comparison: Comparison) -> str:
    seen = [n for n in comparison.errors if n not in BODIES and not n.startswith("cost")]
    forces = [n for n in seen if n.startswith(FORCES)]
    rest = [n for n in seen if n not in forces]
    groups = (["robot pose"], ["robot velocity"], ["reward"], rest, forces)
    errors = (f"{largest(comparison, names):.0e}" for names in groups)
    count, undecided = differing(comparison)
    cells = (
        comparison.name,
        str(len(comparison.strict)),
        f"{comparison.strict.mean():.1%}",
        *errors,
        f"{count} ({undecided})" if count else "0",
        verdict(comparison),
    )
    return f"| {' | '.join(cells)} |"


def table(comparisons: list[Comparison]) -> str:
    packages = ", ".join(f"{name} {version(name)}" for name in ("mujoco", "mujoco-mjx", "jax"))
    device = jax.devices()[0]
    where = platform.machine() if device.platform == "cpu" else device.device_kind
    steps = sum(len(c.strict) for c in comparisons)
    counts = np.array([differing(c) for c in comparisons]).sum(0)
    return "\n".join(
        [
            f"| {' | '.join(COLUMNS)} |",
            "|---|" + "---:|" * (len(COLUMNS) - 2) + "---|",
            *map(row, comparisons),
            "",
            f"Engine `{comparisons[0].engine}`, {packages}, on {device.platform} ({where}): "
            f"{steps} steps, {counts[0]} events differ, {counts[1]} of them undecided.",
            "",
        ]
    )


def command(argv: list[str] | None) -> int:
    parser = Parser(description="Replay recordings of the original engine.")
    parser.add_argument("recordings", nargs="+", type=Path, metavar="RECORDING", help=".npz files")
    parser.add_argument("--engine", default="auto", help="auto (default), c, warp or jax")
    parser.add_argument("--awake", type=int, metavar="K", help="vases, and gremlins, simulated at once")
    parser.add_argument("--table", type=Path, metavar="FILE", help="also write a Markdown table")
    args = parser.parse_args(argv)
    comparisons = []
    for path in args.recordings:
        comparisons.append(compare(Recording(path), args.engine, args.awake))
        print(report(comparisons[-1]), flush=True)
    if args.table:
        try:
            args.table.write_text(table(comparisons))
        except OSError as error:
            raise ConfigError(f"--table: {error}") from error
    return int(any(c.failures() for c in comparisons))


def main(argv: list[str] | None = None) -> int:
    return guarded(lambda: command(argv))


if __name__ == "__main__":
    sys.exit(main())

"""Runs and sweeps compared by any field of their configs, in tables and figures.

    jaxsafe plot RUNS... [env=MODULE:NAME] [algo=MODULE:NAME] [--by FIELD ...] [--published CSV]
                 [--out DIR]

    OUT/results.md, .tex    return and cost, a row a setting, a column a task; what else is known
    OUT/results.csv         every estimate, a row each
    OUT/curves.png, .svg    return, cost and cost rate over training, mean and 95% interval
    OUT/trade_off.png, .svg return against cost, with the limit and the Pareto front
    OUT/scores.png, .svg    Safety Gym's normalised scores over all tasks, mean and IQM
    OUT/profiles.png, .svg  the share of seeds beyond each normalised return and cost

The figures of a seed are those of the last 10% of its training. Its cost rate is of all its training,
and of steps of the policy, which with `env.wrap.action_repeat` are several of the environment.
Where training plays no episodes, as from a data set, they are those of its final evaluation.
Runs on your own environment or algorithm are read once that is named, as it is imported.
Tasks stand apart. Only normalised scores, and comparisons within a task, are averaged over tasks.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from jaxsafe.commands.guard import guarded
from jaxsafe.config import ConfigError
from jaxsafe.report.comparison import write
from jaxsafe.report.group import group, ordered, telling
from jaxsafe.report.published import read_published
from jaxsafe.report.read import or_evaluated, read
from jaxsafe.run.flags import Parser
from jaxsafe.run.settings import DEFAULT, load


def main() -> int:
    """Exit status: 2 for bad input, 1 for a failed disk."""
    return guarded(command)


def command() -> int:
    parser = Parser(
        description=(__doc__ or "").partition("\n")[0],
        epilog=(__doc__ or "").partition("\n\n")[2],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "runs", nargs="+", metavar="RUNS",
        help="run folders, sweeps, or folders of them; and env=MODULE:NAME, algo=MODULE:NAME, your own "
        "code, if the runs have some",
    )  # fmt: skip
    parser.add_argument(
        "--by", nargs="+", metavar="FIELD", default=[],
        help="fields that tell settings apart, such as algo.cost_limit; runs with the same values are "
        "averaged (default: the algorithm and all settings in which the runs differ)",
    )  # fmt: skip
    parser.add_argument(
        "--published", type=Path, metavar="CSV", help="published figures to show beside the runs"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("comparison"),
        metavar="DIR",
        help="folder to write to (default comparison)",
    )
    args = parser.parse_args()
    published = read_published(args.published) if args.published else {}
    runs = [or_evaluated(run) for run in read(folders_among(args.runs))]
    by = [name for name in args.by if name != "env.name"] if args.by else telling(runs)
    groups = ordered(group(runs, by))
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out {args.out}: {error.strerror}") from error
    print(f"{len(runs)} run{'s' * (len(runs) > 1)} by {', '.join(by or args.by)}", file=sys.stderr)
    print(write(groups, args.out, published) + f"written: {args.out}")
    return 0


def folders_among(words: Sequence[str]) -> list[Path]:
    """The words that are folders. The others name the user's code, which is imported.

    Raises:
        ConfigError: no word is a folder, or code cannot be imported.
    """
    folders = []
    for word in words:
        kind, _, name = word.partition("=")
        if kind in DEFAULT and ":" in name and not Path(word).exists():
            load(kind, name)
        else:
            folders.append(Path(word))
    if not folders:
        raise ConfigError(f"{' '.join(words)}: expected run folders beside it")
    return folders

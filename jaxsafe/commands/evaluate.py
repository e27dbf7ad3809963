"""The command evaluate: fresh episodes of the policies of a run."""

import functools
from pathlib import Path

from rich.console import Console

from jaxsafe.commands.guard import guarded
from jaxsafe.config import EpisodeCount, Seed
from jaxsafe.learn.constraints import limits_in_words, limits_of
from jaxsafe.report.evaluation import evaluate
from jaxsafe.run.arguments import beside_a_run
from jaxsafe.run.devices import use_compilation_cache
from jaxsafe.run.flags import Parser, number
from jaxsafe.run.interrupts import Interrupts
from jaxsafe.run.policies import CODE, open_run
from jaxsafe.run.progress import Reporter


def main() -> int:
    """Exit status: 2 for bad input, 130 if stopped."""
    return guarded(command)


def command() -> int:
    parser = Parser(
        description="Play fresh episodes with the policies of a run, and print what they earn and cost."
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="a run folder")
    parser.add_argument(
        "code",
        nargs="*",
        default=(),  # without one argparse says that it is required
        metavar=", ".join((*CODE, "algo.NAME=VALUE")),
        help="your own environment, algorithm or robot, if the run has one; "
        "other settings that a planner or a shield acts by",
    )
    parser.add_argument("--seed", type=number(Seed), default=1, help="seed of the episodes (default 1)")
    parser.add_argument(
        "--episodes",
        type=number(EpisodeCount),
        default=100,
        help="episodes for each seed of the run (default 100)",
    )
    parser.add_argument(
        "--sampled", action="store_true", help="sample actions instead of taking their mean"
    )
    args = parser.parse_args()
    use_compilation_cache()
    code, acts_by = beside_a_run(args.code)
    run = open_run(args.run.expanduser(), code, acts_by=acts_by)
    settings = run.settings
    alone = len(settings.configs) == 1
    limit = f" | cost limit {limits_in_words(limits_of(settings.algo))}" if alone else ""
    print(
        f"{settings.env_name} | {settings.algo_name} | "
        f"{settings.num_members} x {args.episodes} episodes, "
        f"{'sampled' if args.sampled else 'mean'} actions{limit}"
        + "".join(f" | {text}" for text in args.code if text not in code),
        flush=True,
    )
    report = Reporter(Console(stderr=True, highlight=False, soft_wrap=True))
    with report, Interrupts(functools.partial(print, flush=True)) as stop:
        stop.nothing_to_save = "stopped"
        scores = evaluate(run, args.episodes, args.seed, sampled=args.sampled, told=report.going)
    for s in scores:
        if not alone:
            print(f"\n{s.name} | cost limit {limits_in_words(s.limits)}")
        print(s)
    return 0

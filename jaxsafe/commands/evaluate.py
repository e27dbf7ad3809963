"""scripts/evaluate.py: fresh episodes of the policies of a run."""

import argparse
import functools
from pathlib import Path

from jaxsafe.commands.guard import guarded
from jaxsafe.config import ConfigError
from jaxsafe.learn.constraints import in_words, limits_of
from jaxsafe.report.evaluation import evaluate
from jaxsafe.run.arguments import fail
from jaxsafe.run.devices import use_compilation_cache
from jaxsafe.run.interrupts import Interrupts
from jaxsafe.run.policies import open_run


def main() -> int:
    """Exit status: 2 for bad input, 130 if stopped."""
    return guarded(command)


def command() -> int:
    parser = argparse.ArgumentParser(description="Evaluate the policy of a run over fresh episodes.")
    parser.error = fail  # type: ignore[method-assign]
    parser.add_argument("run", type=Path, metavar="RUN", help="a run folder")
    parser.add_argument(
        "code",
        nargs="*",
        metavar="env=MODULE:NAME, algo=MODULE:NAME",
        help="where the run's environment or algorithm is code of yours",
    )
    parser.add_argument("--seed", type=int, default=1, help="of the fresh episodes (default 1)")
    parser.add_argument("--episodes", type=int, default=100, help="for each seed (default 100)")
    args = parser.parse_args()
    if args.episodes < 1 or args.seed < 0:
        raise ConfigError("--episodes must be at least 1 and --seed at least 0")
    use_compilation_cache()
    run = open_run(args.run.expanduser(), args.code)
    settings = run.settings
    alone = len(settings.configs) == 1
    limit = f" | cost limit {in_words(limits_of(settings.algo))}" if alone else ""
    print(
        f"{settings.env_name} | {settings.algo_name} | "
        f"{settings.train.num_seeds} x {args.episodes} episodes, deterministic policy{limit}",
        flush=True,
    )
    with Interrupts(functools.partial(print, flush=True)) as stop:
        stop.nothing_to_save = "stopped"
        scores = evaluate(run, args.episodes, args.seed)
    for s in scores:
        if not alone:
            print(f"\n{s.name} | cost limit {in_words(s.limits)}")
        print(s)
    return 0

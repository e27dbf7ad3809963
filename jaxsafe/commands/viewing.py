"""What scripts/render.py and scripts/watch.py share: their arguments, and the policies named there."""

import argparse
from pathlib import Path
from typing import NamedTuple

from jaxsafe.config import ConfigError
from jaxsafe.run.arguments import fail
from jaxsafe.run.devices import use_compilation_cache
from jaxsafe.run.policies import Actor, open_run

MAX_SEED = 2**31 - 1


class What(NamedTuple):
    """What there is to look at."""

    folders: list[Path]  # of runs
    options: list[str]  # env=..., env.OPTION=..., algo=MODULE:NAME

    def actors(self, index: int) -> list[Actor]:
        """Policy number `index` of each run."""
        return [open_run(folder, self.options).actor(index) for folder in self.folders]


def parser_of(description: str, what: str, more: str) -> argparse.ArgumentParser:
    """With what both scripts take."""
    parser = argparse.ArgumentParser(description=description)
    parser.error = fail  # type: ignore[method-assign]
    parser.add_argument("what", nargs="+", metavar=what, help=more)
    parser.add_argument("--index", type=int, default=0, help="which of a run's policies (default 0)")
    parser.add_argument("--seed", type=int, default=1, help="of the (first) episode (default 1)")
    return parser


def parse(parser: argparse.ArgumentParser) -> tuple[argparse.Namespace, What]:
    args = parser.parse_args()
    use_compilation_cache()
    if not 0 <= args.seed <= MAX_SEED:
        raise ConfigError(f"--seed {args.seed}: expected 0 to {MAX_SEED}")
    options = [text for text in args.what if is_option(text)]
    folders = [Path(text).expanduser() for text in args.what if text not in options]
    for text in options if folders else ():
        if not text.startswith(("env=", "algo=")):
            raise ConfigError(
                f"{text}: with a run, expected env=MODULE:NAME alone, or algo=MODULE:NAME, if its "
                "environment or algorithm is yours"
            )
    return args, What(folders, options)


def is_option(text: str) -> bool:
    return text.startswith(("env=", "env.")) or (text.startswith("algo=") and ":" in text)

"""What the commands render and watch share: their arguments, and the policies named there."""

import argparse
from pathlib import Path
from typing import NamedTuple

from jaxsafe.config import ConfigError, Index, Seed
from jaxsafe.run.arguments import beside_a_run
from jaxsafe.run.devices import use_compilation_cache
from jaxsafe.run.flags import Parser, number
from jaxsafe.run.policies import ONLY_CODE, ROBOT, RunPolicy, open_run


class Targets(NamedTuple):
    """What there is to look at."""

    folders: list[Path]  # of runs
    options: list[str]  # env=..., env.OPTION=..., algo=MODULE:NAME, algo.OPTION=...

    def policies(self, index: int) -> list[RunPolicy]:
        """Policy number `index` of each run."""
        code, acts_by = beside_a_run(self.options)
        return [open_run(folder, code, acts_by=acts_by).one(index) for folder in self.folders]


def parser_of(description: str, what: str, more: str) -> argparse.ArgumentParser:
    """With what both scripts take."""
    parser = Parser(description=description)
    parser.add_argument("what", nargs="+", metavar=what, help=more)
    parser.add_argument(
        "--index",
        type=number(Index),
        default=0,
        help="which policy of a run, from 0",
    )
    parser.add_argument("--seed", type=number(Seed), default=1, help="of the first episode (default 1)")
    return parser


def parse(parser: argparse.ArgumentParser) -> tuple[argparse.Namespace, Targets]:
    args = parser.parse_args()
    use_compilation_cache()
    options = [text for text in args.what if is_option(text)]
    folders = [Path(text).expanduser() for text in args.what if text not in options]
    for text in options if folders else ():
        if not text.startswith(("env=", "algo=", "algo.", f"{ROBOT}=")):
            raise ConfigError(f"{text}: {ONLY_CODE}")
    return args, Targets(folders, options)


def is_option(text: str) -> bool:
    return text.startswith(("env=", "env.", "algo.")) or (text.startswith("algo=") and ":" in text)

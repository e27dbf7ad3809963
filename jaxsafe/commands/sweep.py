"""The command sweep: train a grid of settings, and summarise it."""

import argparse
import shlex
import sys
from pathlib import Path

from jaxsafe.commands.guard import guarded
from jaxsafe.commands.jaxsafe import called
from jaxsafe.report.finish import finish
from jaxsafe.report.sweep_summary import summarise
from jaxsafe.run import files, sweep
from jaxsafe.run.arguments import read_values
from jaxsafe.run.flags import Parser
from jaxsafe.run.progress import Reporter
from jaxsafe.run.sweep_folder import open_folder
from jaxsafe.run.sweep_plan import plan

EPILOG = """\
Options are those of training (jaxsafe train --help), and

  max_parallel=N   how many settings x seeds are trained at once (default: as many as the memory holds)
  run_dir=FOLDER   the folder of the sweep (default: runs/sweep-ENV-ALGO-HASH, a hash of the settings)

Give the same command again to go on after a stop."""


def main() -> int:
    """Exit status as of train.py."""
    return guarded(command)


def command() -> int:
    parser = Parser(
        description="Train a grid of settings: jaxsafe sweep algo=ppo_lag algo.cost_limit=5,10,25",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("options", nargs="*", metavar="key=value[,value...]")
    parser.add_argument(
        "--summary", type=Path, metavar="SWEEP", help="only write the summary of this sweep again"
    )
    args = parser.parse_args()
    given = read_values(args.options)  # this imports what is the user's code
    if args.summary:
        print(summarise(args.summary), end="")
        return 0
    asked = plan(given.options, given.several)
    open_folder(asked)  # the summary of another sweep is not written again
    resume_command = f"{called('sweep')} {shlex.join(sys.argv[1:])}"
    try:
        return sweep.train(asked, resume_command, Reporter(), sweep.After(finish, summarise))
    finally:
        if files.there(asked.folder / "sweep.yaml"):
            print(summarise(asked.folder) + f"sweep folder: {asked.folder}", flush=True)

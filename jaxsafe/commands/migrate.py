"""scripts/migrate.py: a config of OmniSafe, or of Safety Gym's Engine, as a command line."""

import argparse
import shlex
import sys
from pathlib import Path

from jaxsafe.commands.guard import guarded
from jaxsafe.interop import migrate
from jaxsafe.run.arguments import fail


def main() -> int:
    """Exit status 2 for a file that has no counterpart."""
    return guarded(command)


def command() -> int:
    about = migrate.__doc__ or ""
    parser = argparse.ArgumentParser(
        description=about.partition("\n")[0],
        epilog=about.partition("\n\n")[2],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.error = fail  # type: ignore[method-assign]
    parser.add_argument("source", choices=("omnisafe", "safety_gym"))
    parser.add_argument("config", type=Path, metavar="CONFIG")
    parser.add_argument("--algo", default="", help="OmniSafe's name (default: the file's)")
    parser.add_argument("--env", default="", help="OmniSafe's name, or ours (default: the file's)")
    args = parser.parse_args()
    tree = migrate.read(args.config)
    if args.source == "omnisafe":
        algo = args.algo or (args.config.stem if args.config.stem in migrate.algorithms() else "")
        found = migrate.omnisafe(tree, algo, args.env)
    else:
        found = migrate.safety_gym(tree)
    print(migrate.report(found.lines), file=sys.stderr, flush=True)
    print(shlex.join(["python", "scripts/train.py", *found.argv]))
    return 0

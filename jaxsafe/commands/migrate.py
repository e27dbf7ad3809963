"""The command migrate: configs of OmniSafe and Safety Gym, commands of AMBS and ALF, as ours."""

import argparse
import shlex
import sys
from pathlib import Path

from jaxsafe.commands.guard import guarded
from jaxsafe.commands.jaxsafe import called
from jaxsafe.interop import migrate
from jaxsafe.interop.migrate import from_commands
from jaxsafe.run.flags import Parser

COMMANDS = {"ambs": from_commands.ambs, "alf": from_commands.alf}


def main() -> int:
    """Exit status 2 for a file that has no counterpart."""
    return guarded(command)


def command() -> int:
    about = migrate.__doc__ or ""
    parser = Parser(
        description=about.partition("\n")[0],
        epilog=f"{about.partition(chr(10) * 2)[2]}\n{from_commands.__doc__}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "source", choices=("omnisafe", "safety_gym", *COMMANDS), help="what CONFIG is from"
    )
    parser.add_argument("config", metavar="CONFIG", help="a file; of ambs and alf a command in quotes")
    parser.add_argument("--algo", default="", help="OmniSafe's name of the algorithm")
    parser.add_argument("--env", default="", help="OmniSafe's name of the environment, or ours")
    args = parser.parse_args()
    path = Path(args.config)
    if args.source in COMMANDS:
        found = COMMANDS[args.source](args.config)
    elif args.source == "omnisafe":
        algo = args.algo or (path.stem if path.stem in migrate.algorithms() else "")
        found = migrate.omnisafe(migrate.read_file(path), algo, args.env)
    else:
        found = migrate.safety_gym(migrate.read_file(path))
    print(migrate.report(found.lines), file=sys.stderr, flush=True)
    print(f"{called('train')} {shlex.join(found.argv)}")
    return 0

"""The command render: film the policies of runs."""

import sys
from pathlib import Path

from jaxsafe.commands import viewing
from jaxsafe.commands.guard import guarded
from jaxsafe.config import ConfigError
from jaxsafe.report.film import check_video, film, key_of, labels
from jaxsafe.run.policies import CODE, check_same_task


def main() -> int:
    """Exit status: 2 for bad input, 1 where nothing can be rendered."""
    return guarded(command)


def command() -> int:
    parser = viewing.parser_of(
        "Film one episode of the policy of a run, or of several runs side by side in one layout.",
        "RUN",
        f"run folders, and your own environment, algorithm or robot: {', '.join(CODE)}; other settings "
        "that a planner or a shield acts by: algo.NAME=VALUE",
    )
    parser.add_argument(
        "--out",
        type=Path,
        help="the .mp4 or .gif to write (default RUN/video.mp4, for several runs compared.mp4)",
    )
    args, what = viewing.parse(parser)
    folders = what.folders
    if not folders:
        raise ConfigError(f"{what.options[0]}: expected a run folder too")
    several = len(folders) > 1
    out = args.out or (Path("compared.mp4") if several else folders[0] / "video.mp4")
    check_video(out)
    policies = what.policies(args.index)
    check_same_task(folders, [policy.settings for policy in policies])
    names = labels(folders, [policy.settings.algo_name for policy in policies]) if several else None
    task = policies[0].settings.env_name
    print(f"filming {len(policies)} x 1 episode of {task} ...", file=sys.stderr)
    film(policies, out, key_of(args.seed), names)
    print(out)
    return 0

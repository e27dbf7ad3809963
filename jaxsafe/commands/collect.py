"""The command collect: a data set from trained policies."""

import argparse
import functools
import sys
import time
from pathlib import Path
from typing import Any

from jaxsafe.commands.guard import guarded
from jaxsafe.config import ConfigError, Seed, convert, nearest
from jaxsafe.run import files
from jaxsafe.run.collect import Ingredient, Size, data_file, shares, write
from jaxsafe.run.devices import use_compilation_cache
from jaxsafe.run.flags import Parser
from jaxsafe.run.interrupts import Interrupts
from jaxsafe.run.policies import CODE, open_run

OPTIONS = {"size": 1e6, "out": "data.hdf5", "actions": "sampled", "seed": 1}

EPILOG = f"""\
  jaxsafe collect runs/ppo:0.5 runs/ppo_lag:0.5 size=1e6 out=mixed.hdf5

  size=1e6         transitions in all
  out=data.hdf5    the file to write, .hdf5 or .npz
  actions=sampled  or mean
  seed=1           of the episodes

If a run has an environment, algorithm or robot of your own, name it: {", ".join(CODE)}."""


def main() -> int:
    """Exit status: 2 for bad input, 1 for a failed disk, 130 if stopped."""
    return guarded(command)


def command() -> int:
    parser = Parser(
        description="Record whole episodes of trained policies in a data set.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "words",
        nargs="+",
        metavar="RUN:SHARE",
        help="run folders, each with its share of the transitions",
    )
    words = parser.parse_args().words
    given = dict(word.split("=", 1) for word in words if is_option(word))
    code = [f"{k}={v}" for k, v in given.items() if k not in OPTIONS]
    for name in given:
        if name not in (*OPTIONS, *(text.partition("=")[0] for text in CODE)):
            raise ConfigError(f"unknown option {name}{nearest(name, OPTIONS)}")
    size, out, sampled, seed = settings(OPTIONS | given)
    if files.there(out):
        raise ConfigError(f"out={out}: this data set is there already; name another file, or delete it")
    recipe = shares([word for word in words if not is_option(word)])
    use_compilation_cache()
    with Interrupts(functools.partial(print, flush=True)) as stop:
        stop.nothing_to_save = "stopped; nothing is written"
        runs = [Ingredient(open_run(folder, code), share) for folder, share in recipe]
        begun = time.perf_counter()
        print(f"playing episodes with {size:,} steps ...", file=sys.stderr, flush=True)
        made = write(out, runs, size, seed, sampled)
    episodes = made.data.episodes
    print(
        f"{out}: {len(made.data.reward):,} transitions in {len(episodes.ret):,} episodes, return "
        f"{episodes.ret.mean():.4g}, cost {episodes.cost.mean():.4g}, "
        f"in {time.perf_counter() - begun:.1f} s"
    )
    return 0


def is_option(word: str) -> bool:
    """Whether a word is 'size=1e6' or the like, and not a folder as 'runs/000-ppo.horizon=128'."""
    name, equals, _ = word.partition("=")
    return bool(equals) and all(part.isidentifier() for part in name.split("."))


def settings(given: dict[str, Any]) -> tuple[int, Path, bool, int]:
    """size, out, whether actions are sampled, seed."""
    numbers = {}
    for name, kind in (("size", Size), ("seed", Seed)):
        try:
            text = str(given[name])
            numbers[name] = convert(int(text) if text.isdecimal() else float(text), kind, name)
        except ValueError as error:
            if isinstance(error, ConfigError):
                raise
            raise ConfigError(f"{name}={given[name]}: expected a number") from error
    if given["actions"] not in ("sampled", "mean"):
        raise ConfigError(f"actions={given['actions']}{nearest(given['actions'], ('sampled', 'mean'))}")
    return numbers["size"], data_file(given["out"]), given["actions"] == "sampled", numbers["seed"]

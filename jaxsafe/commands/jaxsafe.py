"""The command `jaxsafe`: `jaxsafe train algo=cpo` does what `python scripts/train.py algo=cpo` does."""

import importlib
import sys
from importlib.metadata import version
from pathlib import Path

COMMANDS = {
    "train": "train a policy, then evaluate and film it",
    "sweep": "train a grid of settings and seeds, and summarise it",
    "evaluate": "play fresh episodes with the policy of a run",
    "plot": "compare runs in tables and figures",
    "render": "film the policy of a run",
    "watch": "watch a policy as it acts, or drive a robot",
    "collect": "record a data set from trained policies",
    "migrate": "turn a config of another library into a command",
    "benchmark": "measure environments and training",
    "study": "train what a study lacks, and draw its page",
}


def main() -> int:
    """Exit status of the command; 2 for one that there is not, 130 if stopped before it begins."""
    name, *rest = sys.argv[1:] or ["--help"]
    if name in ("-h", "--help"):
        print(overview())
        return 0
    if name == "--version":
        print(f"jaxsafe {version('jaxsafe')}")
        return 0
    if name not in COMMANDS:
        from jaxsafe.config import nearest  # late: it imports JAX, which takes a second

        print(f"error: unknown command {name}{nearest(name, COMMANDS)}", file=sys.stderr)
        return 2
    sys.argv = [f"jaxsafe {name}", *rest]
    try:
        command = importlib.import_module(f"jaxsafe.commands.{name}")  # takes some seconds
    except KeyboardInterrupt:
        print("error: stopped before it began", file=sys.stderr)
        return 130
    return command.main()


def overview() -> str:
    lines = [f"  {name:<10} {text}" for name, text in COMMANDS.items()]
    head = "usage: jaxsafe COMMAND ...\n\nSafe reinforcement learning in JAX.\n"
    return "\n".join([head, *lines, "\njaxsafe COMMAND --help says more."])


def called(name: str) -> str:
    """How the user would type the command `name`: as the one that runs now."""
    if Path(sys.argv[0]).name.startswith("jaxsafe "):
        return f"jaxsafe {name}"
    return f"python scripts/{name}.py"

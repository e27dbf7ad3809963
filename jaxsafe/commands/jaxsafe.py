"""The command `jaxsafe`: `jaxsafe train algo=cpo` does what `python scripts/train.py algo=cpo` does."""

import contextlib
import importlib
import os
import signal
import sys
from collections.abc import Iterator
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
    """Exit status of the command; 2 for one that there is not."""
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
    return run(name)


def run(name: str) -> int:
    """Exit status of the command `name`, whose arguments are in `sys.argv`. To import it takes some
    seconds, in which Ctrl-C ends the process with 130."""
    with leaving_at_ctrl_c():
        command = importlib.import_module(f"jaxsafe.commands.{name}")
    return command.main()


@contextlib.contextmanager
def leaving_at_ctrl_c() -> Iterator[None]:
    """Ctrl-C is one line and the end of the process. As an exception, an extension that is imported may
    lose it, make another one of it, or crash."""

    def leave(*_: object) -> None:
        os.write(2, b"error: stopped before it began\n")
        os._exit(130)

    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:  # as it is in the background
        signal.signal(signal.SIGINT, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def overview() -> str:
    lines = [f"  {name:<10} {text}" for name, text in COMMANDS.items()]
    head = "usage: jaxsafe COMMAND ...\n\nSafe reinforcement learning in JAX.\n"
    return "\n".join([head, *lines, "\njaxsafe COMMAND --help says more."])


def called(name: str) -> str:
    """How the user would type the command `name`: as the one that runs now."""
    if Path(sys.argv[0]).name.startswith("jaxsafe "):
        return f"jaxsafe {name}"
    return f"python scripts/{name}.py"

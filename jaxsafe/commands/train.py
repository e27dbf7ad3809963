"""scripts/train.py: train a policy, then evaluate and film it."""

import shlex
import sys
from pathlib import Path
from typing import Any

from rich.console import Console

from jaxsafe.commands.guard import guarded
from jaxsafe.report.finish import finish
from jaxsafe.run import distributed, session
from jaxsafe.run.arguments import each_job
from jaxsafe.run.progress import Report
from jaxsafe.run.session import Session
from jaxsafe.run.settings import Settings, settle


def main() -> int:
    """Exit status: 2 for bad input, 1 for a failed disk, 130 if stopped."""

    def command() -> int:
        each_job(sys.argv[1:], job)
        return 0

    return guarded(command)


def job(config: dict[str, Any], number: int | None) -> None:
    """One run; `number` is its own in a --multirun."""
    status = guarded(lambda: train(config, number))  # here already: of a job that raises, Hydra prints
    if status:  # the overrides
        distributed.give_up(status)
        raise SystemExit(status)


def train(config: dict[str, Any], number: int | None) -> int:
    settings = settle(config)
    options = settings.train
    at = None
    if number is None:
        at = distributed.position(
            options.coordinator, options.num_processes, options.process_index, options.devices
        )
    with distributed.joined(at):
        report = Report(Console(quiet=True) if at and at.index else None)
        folder = session.agree_on_folder(settings, number, report.line)
        env, program = session.prepare(settings)
        again = command_again(settings, folder)
        again += f" in each of the {at.count} processes" if at else ""
        return session.run(Session(settings, folder, env, program, again), report, finish)


def command_again(settings: Settings, folder: Path) -> str:
    """The command that continues a run; it names the code of the user's that is to be imported."""
    names = {"env": settings.env_name, "algo": settings.algo_name}
    code = [f" {kind}={name}" for kind, name in names.items() if ":" in name]
    return f"python scripts/train.py resume={shlex.quote(str(folder))}{''.join(code)}"

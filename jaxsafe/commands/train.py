"""The command train: train a policy, then evaluate and film it."""

import shlex
import sys
from pathlib import Path
from typing import Any

from rich.console import Console

from jaxsafe.commands.guard import guarded
from jaxsafe.commands.jaxsafe import called
from jaxsafe.report.finish import finish
from jaxsafe.run import distributed, help, session
from jaxsafe.run.arguments import argument
from jaxsafe.run.hydra_jobs import each_job
from jaxsafe.run.progress import Reporter
from jaxsafe.run.session import Session
from jaxsafe.run.settings import Settings, settings_from_config, yours


def main() -> int:
    """Exit status: 2 for bad input, 1 for a failed disk or a lack of memory, 3 if it diverged, 130 if
    stopped."""

    def command() -> int:
        if {"-h", "--help"} & {*sys.argv}:
            print(help.text([word for word in sys.argv[1:] if "=" in word]), end="")
            return 0
        each_job(sys.argv[1:], job)
        return 0

    return guarded(command)


def job(config: dict[str, Any], number: int | None) -> None:
    """One run; `number` is its own in a --multirun."""
    # guarded here, not only in `main`: Hydra prints the overrides of a job that raises
    status = guarded(lambda: train(config, number))
    if status:
        distributed.exit_all_if_joined(status)
        raise SystemExit(status)


def train(config: dict[str, Any], number: int | None) -> int:
    settings = settings_from_config(config)
    options = settings.train
    at = None
    if number is None:
        at = distributed.position_from_options(
            options.coordinator, options.num_processes, options.process_index, options.devices
        )
    with distributed.joined(at):
        report = Reporter(Console(quiet=True) if at and at.index else None)
        folder = session.agree_on_folder(settings, number, report.line)
        env, program = session.prepare(settings)
        command = resume_command(settings, folder)
        command += f" in each of the {at.count} processes" if at else ""
        return session.run(Session(settings, folder, env, program, command), report, finish)


def resume_command(settings: Settings, folder: Path) -> str:
    """The command that continues a run. It names what no run folder may set, as the user's code."""
    given = {"resume": folder, **yours(settings)}
    return f"{called('train')} {shlex.join(argument(name, value) for name, value in given.items())}"

"""Where metrics go beside the run folder: a callback of the caller's, or Weights & Biases."""

import hashlib
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxsafe.config import ConfigError
from jaxsafe.run.checkpoint import Progress
from jaxsafe.run.programs import Member

# (how far each seed is, metrics by name: float32 [members], NaN where there is no value) -> None
Callback = Callable[[Progress, dict[str, np.ndarray]], None]

LONGEST = 100  # letters of a folder's name in the id of a run of Weights & Biases, which takes 128


def check_logger(name: str) -> None:
    """Raise ConfigError where `logger=name` lacks its package."""
    if name == "wandb":
        import_wandb()


def import_wandb() -> Any:
    try:
        import wandb  # type: ignore[import-not-found]
    except ImportError as error:
        raise ConfigError("logger=wandb: it is not installed: pip install 'jaxsafe[wandb]'") from error
    return wandb


def wandb_callback(folder: Path, config: dict[str, Any], members: Sequence[Member]) -> "WandbRun":
    """What logs to a run of Weights & Biases that is called like the run folder.

    A resumed run goes on in the same one, as long as its folder stays where it is.
    """
    name = re.sub(r"[^\w.=-]+", "_", folder.name)[:LONGEST]
    place = hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:8]
    how = {
        "project": "jaxsafe",
        "name": folder.name,
        "id": f"{name}-{place}",
        "dir": str(folder),
        "config": config,
        "resume": "allow",
    }
    return WandbRun(how, members)


class WandbRun:
    """A callback that logs to a run of Weights & Biases. The run begins and ends with its context.

    Several members have a name each, as in 'train/cost/seed1'.

    Args:
        how: the arguments of `wandb.init`.
        members: of the program.
    """

    def __init__(self, how: dict[str, Any], members: Sequence[Member]):
        self.how, self.members = how, members
        self.run: Any = None

    def __enter__(self) -> "WandbRun":
        self.run = import_wandb().init(**self.how)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.run.finish(exit_code=int(kind is not None))

    def __call__(self, clock: Progress, metrics: dict[str, np.ndarray]) -> None:
        row = {
            f"{name}{suffix(member, self.members)}": float(values[i])
            for name, values in metrics.items()
            for i, member in enumerate(self.members)
            if np.isfinite(values[i])
        }
        self.run.log(row | {"steps": clock.steps, "updates": clock.updates}, step=clock.iteration)


def suffix(member: Member, members: Sequence[Member]) -> str:
    """What tells a member from the others: '', '/seed1' or '/algo.clip=0.1/seed1'."""
    setting = f"/{member.setting}" if member.setting else ""
    return f"{setting}/seed{member.seed}" if len(members) > 1 else ""

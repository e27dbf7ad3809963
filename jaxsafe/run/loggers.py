"""Where metrics go beside the run folder: a callback of the caller's, or Weights & Biases."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxsafe.config import ConfigError
from jaxsafe.run.checkpoint import Progress
from jaxsafe.run.programs import Member

# (how far each seed is, metrics by name: float32 [members], NaN where there is no value) -> None
Callback = Callable[[Progress, dict[str, np.ndarray]], None]


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


def wandb_callback(folder: Path, config: dict[str, Any], members: Sequence[Member]) -> Callback:
    """What logs to a run of Weights & Biases that is called like the run folder.

    Several members have a name each, as in 'train/cost/seed1'. A resumed run goes on in the same one.
    """
    run = import_wandb().init(
        project="jaxsafe",
        name=folder.name,
        id=folder.name,
        dir=str(folder),
        config=config,
        resume="allow",
    )

    def log(clock: Progress, metrics: dict[str, np.ndarray]) -> None:
        row = {
            f"{name}{suffix(member, members)}": float(values[i])
            for name, values in metrics.items()
            for i, member in enumerate(members)
            if np.isfinite(values[i])
        }
        run.log(row | {"steps": clock.steps, "updates": clock.updates}, step=clock.iteration)

    return log


def suffix(member: Member, members: Sequence[Member]) -> str:
    """What tells a member from the others: '', '/seed1' or '/algo.clip=0.1/seed1'."""
    setting = f"/{member.setting}" if member.setting else ""
    return f"{setting}/seed{member.seed}" if len(members) > 1 else ""

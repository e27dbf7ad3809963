"""What a run counts: iterations, environment steps and gradient steps, the last two of one seed.

A run ends at `total_updates` gradient steps where that is given, else at `total_steps` environment
steps. What a user reads names environment steps, or gradient steps where an update takes no
environment step.
"""

from pathlib import Path
from typing import NamedTuple

from jaxsafe.config import ConfigError
from jaxsafe.run.checkpoint import Progress
from jaxsafe.run.settings import TrainConfig
from jaxsafe.types import Clocks


class Unit(NamedTuple):
    """What is shown of how far a run is."""

    name: str  # 'steps' or 'updates', which are columns of metrics.csv too
    each: int  # in one iteration

    def at(self, iteration: int) -> int:
        return iteration * self.each

    def crosses(self, every: int, iteration: int) -> bool:
        """Whether `iteration` reaches or passes a multiple of `every`; never one of 0."""
        return every > 0 and self.at(iteration) // every > self.at(iteration - 1) // every


def unit(clocks: Clocks) -> Unit:
    return Unit("steps", clocks.steps) if clocks.steps else Unit("updates", clocks.gradient_steps)


def after(iteration: int, clocks: Clocks) -> Progress:
    return Progress(iteration, iteration * clocks.steps, iteration * clocks.gradient_steps)


def iterations(train_cfg: TrainConfig, clocks: Clocks) -> int:
    """Iterations of a whole run: as many as `total_updates` or `total_steps` needs, rounded up.

    Raises:
        ConfigError: an update does not take any of the steps that are to be counted.
    """
    name, total = end(train_cfg)
    kinds = {"steps": ("environment", clocks.steps), "updates": ("gradient", clocks.gradient_steps)}
    kind, each = kinds[name]
    if not each:
        raise ConfigError(f"total_{name}={total}: the algorithm takes no {kind} steps")
    return -(-total // each)


def end(train_cfg: TrainConfig) -> tuple[str, int]:
    """What ends a run, 'steps' or 'updates', and how many."""
    if train_cfg.total_updates is not None:
        return "updates", train_cfg.total_updates
    return "steps", train_cfg.total_steps


def ended(train_cfg: TrainConfig, done: Progress) -> bool:
    """Whether a run that is so far is at its end."""
    name, total = end(train_cfg)
    return getattr(done, name) >= total


def check_end(train_cfg: TrainConfig, done: Progress, folder: Path) -> None:
    """Raise ConfigError if the run in `folder`, which is so far, is beyond its end by an iteration or
    more."""
    name, total = end(train_cfg)
    reached = getattr(done, name)
    if reached - reached // max(1, done.iteration) >= total:
        raise ConfigError(
            f"total_{name}={total}: {folder} has {reached:,} {name} already; expected at least as many"
        )

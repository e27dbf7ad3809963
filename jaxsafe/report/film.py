"""Films of policies as they act."""

import os
from pathlib import Path

import jax

from jaxsafe.config import ConfigError, one_line
from jaxsafe.envs.view import render
from jaxsafe.envs.view.backend import NoDisplay
from jaxsafe.run import files
from jaxsafe.run.policies import RunPolicy


class NoVideo(RuntimeError):
    """Nothing to render with. The message is one line for the user."""


def check_video(path: Path) -> None:
    """Raise ConfigError where no film could be written. Makes no folder."""
    if path.suffix not in (".mp4", ".gif"):
        raise ConfigError(f"{path}: expected a name that ends in .mp4 or .gif")
    place = path.absolute()
    there = next(part for part in (place, *place.parents) if os.path.exists(part))
    if there != place and not there.is_dir():
        raise ConfigError(f"{path}: {there} is not a folder")
    if path.is_dir() or not os.access(there, os.W_OK):
        raise ConfigError(f"{path} cannot be written")


def key_of(seed: int) -> jax.Array:
    """The key of the episode that a film of this seed shows."""
    return jax.random.fold_in(jax.random.key(seed), 0x66696C6D)


def film(
    policies: list[RunPolicy], path: Path, key: jax.Array, labels: list[str] | None = None
) -> None:
    """Write one episode of each deterministic policy as a video, side by side in labelled panels.

    Args:
        key: of the episode, as evaluation has it.
    Raises:
        NoVideo: this machine has neither EGL nor OSMesa nor a display.
    """
    try:
        films = [
            render.render_episode(a.env, a.player, key, label=label)
            for a, label in zip(policies, labels or [None] * len(policies), strict=True)
        ]
    except NoDisplay as error:
        raise NoVideo(one_line(error)) from error
    path.parent.mkdir(parents=True, exist_ok=True)
    with files.replacing(path) as part:
        render.write_video(render.side_by_side(films), part)


def labels(folders: list[Path], algos: list[str]) -> list[str]:
    """The algorithms' names; where two are the same, with the end of each folder that tells."""
    if len({*algos}) == len(algos):
        return algos
    places = [folder.resolve().parts for folder in folders]
    for n in range(1, max(map(len, places)) + 1):
        tails = [Path(*parts[-n:]) for parts in places]
        if len({*tails}) == len({*places}):
            break
    return [f"{algo}, {tail}" for algo, tail in zip(algos, tails, strict=True)]

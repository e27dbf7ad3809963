"""sweep.yaml in the folder of a sweep: what was asked, and how many members of a group run at once."""

from pathlib import Path
from typing import Any, NamedTuple

import yaml

from jaxsafe.config import ConfigError, flat
from jaxsafe.run import checkpoint, files
from jaxsafe.run.plain import differences
from jaxsafe.run.sweep_plan import Sweep, compared_settings


class Saved(NamedTuple):
    """What sweep.yaml holds."""

    swept: list[str]  # as of `Sweep`
    parallel: dict[str, int]  # members that run at once, by group
    groups: dict[str, dict[str, Any]]  # as of `compared_settings`


def open_folder(sweep: Sweep) -> dict[str, int]:
    """How many members of each group run at once, as far as the folder's sweep knows already.

    Raises:
        ConfigError: the folder holds something else.
    """
    if not files.there(sweep.folder / "sweep.yaml"):
        if sweep.folder.exists() and (not sweep.folder.is_dir() or any(sweep.folder.iterdir())):
            raise ConfigError(f"run_dir={sweep.folder} holds something else than a sweep")
        return {}
    saved = read_folder(sweep.folder)
    other = f"{sweep.folder} belongs to another sweep"
    if [*sweep.groups] != [*saved.groups]:
        raise ConfigError(f"{other}, of {', '.join(saved.groups)}; choose another run_dir")
    for name, settings in sweep.groups.items():
        pairs = differences(compared_settings(settings), flat(saved.groups[name]))
        for key, (here, there) in pairs.items():
            raise ConfigError(f"{other}: {key} is {there} there, {here} here; choose another run_dir")
    return saved.parallel


def read_folder(folder: Path) -> Saved:
    path = folder / "sweep.yaml"
    if not files.there(path):
        raise ConfigError(f"{folder} is not a sweep's folder: it has no sweep.yaml")
    found = files.read_yaml(path)
    kinds = {"swept": list, "parallel": dict, "groups": dict}
    if not isinstance(found, dict) or not all(
        isinstance(found.get(k), kind) for k, kind in kinds.items()
    ):
        raise ConfigError(f"{path} does not describe a sweep")
    if not all(isinstance(name, str) for name in found["swept"]):
        raise ConfigError(f"{path}: expected the names of options as swept")
    return Saved(*(found[k] for k in kinds))


def write_folder(sweep: Sweep, parallel: dict[str, int]) -> None:
    asked = {name: compared_settings(settings) for name, settings in sweep.groups.items()}
    saved = Saved(sweep.swept, parallel, asked)
    with checkpoint.writing_to(sweep.folder):
        sweep.folder.mkdir(parents=True, exist_ok=True)
        files.write(sweep.folder / "sweep.yaml", yaml.safe_dump(saved._asdict(), sort_keys=False))

"""From options to the groups of a sweep.

Floats of the algorithm are arrays to the program, so their grid and the seeds are the members of one.
Any other option with several values makes a group, and so a program, of each value.
"""

import hashlib
import itertools
import json
import math
import re
from pathlib import Path
from typing import Any, NamedTuple

from jaxsafe.config import Amount, ConfigError, convert, flat, is_float
from jaxsafe.run import distributed
from jaxsafe.run.plain import as_text, merged, repeated
from jaxsafe.run.settings import (
    DEFAULT,
    MOST,
    NO_EXTRAS,
    NOT_COMPARED,
    Extras,
    Settings,
    find_algo,
    make_env,
    nested,
    settings_from_options,
)

OF_THE_SWEEP = ("max_parallel", "run_dir")  # options that are not those of one run


class Sweep(NamedTuple):
    """What is to be trained."""

    swept: list[str]  # the options with several values, as `flat` names them
    groups: dict[str, Settings]  # by the name of their folders
    folder: Path
    max_parallel: int | None


def plan(given: dict[str, Any], several: dict[str, list[Any]], extras: Extras = NO_EXTRAS) -> Sweep:
    """The groups of a sweep, every one of them checked.

    Args:
        given: the options with one value, as `settings_from_options` takes them, and `max_parallel`.
        several: those with several values, by name: 'env', 'seed', 'algo.clip'.
        extras: environments and algorithms beside the registered ones.
    Raises:
        ConfigError: an option that no run could use, or nothing to sweep.
    """
    check_names(given, several)
    max_parallel = convert(given.get("max_parallel"), Amount | None, "max_parallel")
    given, folder = {k: v for k, v in given.items() if k not in OF_THE_SWEEP}, given.get("run_dir")
    if not several:
        settings_from_options(given, extras)  # what is wrong with an option comes first
        raise ConfigError(
            "nothing to sweep: give an option several values, as in algo.cost_limit=5,10,25, "
            "or train one setting with the command train"
        )
    check_grid(several)
    floats = floats_among(several, given, extras)
    grid = combinations({name: several[name] for name in floats})
    side_by_side = {name: [setting[name] for setting in grid] for name in floats}
    groups, known = {}, set()
    for chosen in combinations({k: v for k, v in several.items() if k not in floats}):
        settings = settings_from_options(merged(given, nested(side_by_side | chosen)), extras)
        if (text := json.dumps(settings.plain(), sort_keys=True)) in known:
            words = ", ".join(f"{k}={as_text(v)}" for k, v in chosen.items())
            raise ConfigError(f"{words}: these settings occur twice")
        known.add(text)
        algo = settings.row.make(make_env(settings))
        for cfg in settings.configs:
            algo.clocks(cfg)  # refuses settings that do not fit each other
        groups[folder_name(len(groups), settings, chosen)] = settings
    swept = [f"{k}.name" if k in DEFAULT else k for k in several]
    where = Path(folder).expanduser() if folder else default_folder(groups)
    return Sweep(swept, groups, where, max_parallel)


def check_names(given: dict[str, Any], several: dict[str, list[Any]]) -> None:
    """Refuse options that a sweep does not take, or takes one value of."""
    for name in {**given, **several}:
        if name == "resume":
            raise ConfigError("resume: a sweep goes on when the same command is given again")
        if name in distributed.OPTIONS:
            raise ConfigError(f"{name}: a sweep is one process")
    for name in OF_THE_SWEEP:
        if name in several:
            raise ConfigError(f"{name}: expected one value")


def check_grid(several: dict[str, list[Any]]) -> None:
    """Refuse a value that occurs twice, and more settings than anybody trains."""
    for name, values in several.items():
        if (value := repeated(values)) is not None:
            raise ConfigError(f"{name}={as_text(value)} occurs twice")
    if (count := math.prod(map(len, several.values()))) > MOST:
        raise ConfigError(f"{count:,} settings: expected at most {MOST:,} in a sweep")


def floats_among(several: dict[str, list[Any]], given: dict[str, Any], extras: Extras) -> list[str]:
    """The options that are floats of the algorithm; of several algorithms the first one tells."""
    algos = several.get("algo") or [given.get("algo", {}).get("name", DEFAULT["algo"])]
    kind = find_algo(algos[0], extras).config
    return [k for k in several if k.startswith("algo.") and is_float(kind, k.removeprefix("algo."))]


def combinations(values: dict[str, list[Any]]) -> list[dict[str, Any]]:
    """Each choice of one value for every name; the last name changes fastest."""
    return [dict(zip(values, chosen, strict=True)) for chosen in itertools.product(*values.values())]


# ---- names of folders --------------------------------------------------------------------------


def folder_name(number: int, settings: Settings, chosen: dict[str, Any]) -> str:
    rest = [f"{k}={as_text(v)}" for k, v in chosen.items() if k not in DEFAULT]
    name = "-".join([f"{number:03d}", settings.label, *rest])
    return re.sub(r"[^\w.=+-]+", "_", name)[:100]


def default_folder(groups: dict[str, Settings]) -> Path:
    first = next(iter(groups.values()))
    text = json.dumps([compared_settings(s) for s in groups.values()], sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    return Path("runs") / f"sweep-{first.label}-{digest}"


def compared_settings(settings: Settings) -> dict[str, Any]:
    """What a sweep's folder must agree on."""
    return {k: v for k, v in flat(settings.plain()).items() if k not in NOT_COMPARED}

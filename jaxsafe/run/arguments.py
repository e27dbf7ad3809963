"""`key=value` arguments as plain values, in Hydra's grammar, without its composition.

`jaxsafe.run.hydra_jobs` makes the same checks of the arguments of train before Hydra sees them, because
Hydra's own errors are long.
"""

import math
import re
from pathlib import Path
from typing import Any, NamedTuple

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override, OverrideType, RangeSweep
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from jaxsafe.config import ConfigError, convert
from jaxsafe.run.settings import DEFAULT, MOST, Settings, load, nested, settings_from_options

ERRORS = (HydraException, OmegaConfBaseException)  # of arguments that only Hydra can judge


class Given(NamedTuple):
    """What the arguments of a sweep say."""

    options: dict[str, Any]  # those with one value, as `settings_from_options` takes them
    several: dict[str, list[Any]]  # those with several, by name: 'seed', 'env', 'algo.clip'


def compose(texts: list[str]) -> Settings:
    """The settings that train.py would have from these arguments."""
    given = read_values(texts)
    for name in given.several:
        raise ConfigError(f"{name}: expected one value")
    return settings_from_options(given.options)


def read_values(texts: list[str]) -> Given:
    """The values of `key=value` and `key=value,value,...`, with environments and algorithms that are
    the user's code imported.

    Raises:
        ConfigError: an argument that cannot be read, or that is no `key=value`.
    """
    overrides = [parse(text) for text in texts]
    check_grid(overrides)
    for override in overrides:
        check_kind(override)
        import_named_code(override)
    several = {o.key_or_group: choices(o) for o in overrides if o.is_sweep_override()}
    options = nested({o.key_or_group: o.value() for o in overrides if not o.is_sweep_override()})
    resolved: Any = OmegaConf.to_container(OmegaConf.create(options), resolve=True)
    return Given(resolved, several)


def beside_a_run(texts: list[str]) -> tuple[list[str], dict[str, Any]]:
    """What stands beside a run folder: the user's own code, and other values of settings that its
    policies act by, as algo.delta=0.5, by name."""
    settings = [text for text in texts if text.startswith("algo.")]
    given = read_values(settings)
    for name in given.several:
        raise ConfigError(f"{name}: expected one value")
    return [text for text in texts if text not in settings], given.options.get("algo", {})


def parse(text: str) -> Override:
    try:
        return OverridesParser.create().parse_override(text)
    except HydraException as error:
        raise ConfigError(
            f"cannot read {text!r}; expected key=value without spaces, as algo.cost_limit=5,10 or "
            "env.vision_size=[60,40]"
        ) from error


def argument(name: str, value: str | Path) -> str:
    """'name=value', with quotes around a value that Hydra would read as something else."""
    text = str(value)
    try:
        if parse(f"{name}={text}").value() == text:
            return f"{name}={text}"
    except ConfigError:
        pass
    text = re.sub(r"(\\*)('|\Z)", lambda found: 2 * found[1] + found[2].replace("'", "\\'"), text)
    return f"{name}='{text}'"


def import_named_code(override: Override) -> None:
    """Import the user's code that env= or algo= names."""
    if override.key_or_group in DEFAULT and not override.is_delete():
        for name in names_in(override):
            load(override.key_or_group, name)


def names_in(override: Override) -> list[str]:
    """The values of env= or algo=."""
    several = override.is_sweep_override()
    values = override.sweep_iterator() if several else [override.value()]
    return [convert(value, str, override.key_or_group) for value in values]


def check_kind(override: Override) -> None:
    if override.type is not OverrideType.CHANGE or override.package is not None:
        text = override.input_line
        raise ConfigError(f"{text}: options are set with key=value, without '+', '~' or '@'")


# ---- several values of an option -------------------------------------------------------------


def choices(override: Override) -> list[Any]:
    """The values of an option that has several."""
    key = override.key_or_group
    return [parse(f"{key}={text}").value() for text in override.sweep_string_iterator()]


def check_grid(overrides: list[Override]) -> None:
    """Refuse more settings than anybody trains, before they are listed."""
    count = math.prod(count_of(o) for o in overrides if o.is_sweep_override())
    if count > MOST:
        raise ConfigError(f"{count:,} settings: expected at most {MOST:,} in a sweep")


def count_of(override: Override) -> int:
    """How many values an option has, at least 1."""
    value, text = override.value(), override.input_line
    if isinstance(value, RangeSweep):
        ends = [float(x) for x in (value.start, value.stop, value.step) if x is not None]
        if len(ends) < 3 or not all(map(math.isfinite, ends)) or not ends[2]:
            raise ConfigError(f"{text}: expected range(start,stop,step) of finite numbers, step not 0")
        count = math.ceil((ends[1] - ends[0]) / ends[2])
    elif isinstance(value, ChoiceSweep):
        count = len(value.list)
    else:
        raise ConfigError(f"{text}: name the values; a pattern or an interval has none")
    if count < 1:
        raise ConfigError(f"{text} holds no value")
    return count

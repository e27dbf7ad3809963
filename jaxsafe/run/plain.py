"""Plain values: dicts, lists and scalars of Python, as config.yaml has them."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxsafe.config import ConfigError


def to_plain(value: Any, name: str = "") -> Any:
    """Dicts, lists and scalars of Python only, as YAML writes and reads them.

    Raises:
        ConfigError: a value that has no such form.
    """
    if isinstance(value, Mapping):
        return {str(k): to_plain(v, f"{name}.{k}" if name else str(k)) for k, v in value.items()}
    if isinstance(value, list | tuple | range):
        return [to_plain(v, f"{name}[{i}]") for i, v in enumerate(value)]
    if isinstance(value, np.generic | np.ndarray | jax.Array):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ConfigError(
        f"{name}={value!r}: expected a number, a string, true or false, None, a list or a dict"
    )


def as_text(value: Any) -> str:
    """A plain value as it is typed on the command line: [a,b], {a:1}, true, null."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(as_text, value))}]"
    if isinstance(value, dict):
        return f"{{{','.join(f'{k}:{as_text(v)}' for k, v in value.items())}}}"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return str(value)


def merged(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """`old` with the values of `new`, dicts in dicts likewise."""
    out = dict(old)
    for name, value in new.items():
        inside = isinstance(value, dict) and isinstance(out.get(name), dict)
        out[name] = merged(out[name], value) if inside else value
    return out


def replaced(options: dict[str, Any], new: dict[str, Any], where: str = "") -> dict[str, Any]:
    """`options` with some values replaced; `new` has them by name, as `config.flat` names them."""
    return {
        k: replaced(v, new, f"{where}{k}.") if isinstance(v, dict) else new.get(f"{where}{k}", v)
        for k, v in options.items()
    }


def differences(a: dict[str, Any], b: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """The names that have not the same value in both, with both values."""
    pairs = {name: (a.get(name), b.get(name)) for name in {**a, **b}}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


def repeated(values: Iterable[Any]) -> Any:
    """The first value that was there before; None if all differ. 5 and 5.0 are the same."""

    def key(value: Any) -> Any:
        if isinstance(value, list | tuple):
            return tuple(map(key, value))
        return value if isinstance(value, int | float) else repr(value)

    known = set()
    for value in values:
        if (found := key(value)) in known:
            return value
        known.add(found)
    return None


def together(settings: list[Any]) -> Any:
    """Settings as one, with a list where they differ: the inverse of `settings.settings_in`."""
    first = settings[0]
    if isinstance(first, dict):
        return {name: together([each[name] for each in settings]) for name in first}
    return first if all(each == first for each in settings) else settings

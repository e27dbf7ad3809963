"""What a migration finds: a command line, and what became of each key; and the files it reads."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from jaxsafe.config import ConfigError, one_line
from jaxsafe.run.arguments import argument
from jaxsafe.run.plain import as_text


class Line(NamedTuple):
    """What became of a key: `text` is its options, or why it has none; `lost` if it asked for more."""

    key: str
    value: Any
    text: str
    lost: bool = False


class Migrated(NamedTuple):
    argv: list[str]  # after scripts/train.py
    lines: list[Line]


def as_option(key: str, value: Any) -> str:
    """An option as train.py reads it."""
    return argument(key, value) if isinstance(value, str) else f"{key}={as_text(value)}"


def flatten(tree: Any, head: str = "") -> dict[str, Any]:
    """{'train_cfgs.device': 'cpu', ...}"""
    if not isinstance(tree, dict):
        raise ConfigError(f"{head or 'the file'}: expected names with values, not {tree!r}")
    found: dict[str, Any] = {}
    for name, value in tree.items():
        deeper = isinstance(value, dict)
        found |= flatten(value, f"{head}{name}.") if deeper else {f"{head}{name}": value}
    return found


def read_file(path: Path) -> dict[str, Any]:
    """A .json or .yaml file. Executes nothing from it."""
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot read {path}: {one_line(error)}") from error
    if path.suffix not in (".json", ".yaml", ".yml"):
        raise ConfigError(f"{path}: expected a name that ends in .json or .yaml")
    try:
        tree = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)
        flatten(tree)
    except (json.JSONDecodeError, yaml.YAMLError, RecursionError) as error:
        raise ConfigError(f"{path} is no {path.suffix[1:].upper()}: {one_line(error)}") from error
    return tree


def report(lines: list[Line]) -> str:
    """A line a key; what the command does not do comes last."""
    return "\n".join(
        f"{'no counterpart: ' * line.lost}{line.key}={as_text(line.value)}: {line.text}"
        for line in sorted(lines, key=lambda line: line.lost)
    )

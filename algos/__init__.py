"""The algorithms by name: the rows at the end of every module in this folder, and those that `load` or
`register` adds."""

import importlib
import pkgutil

from jaxsafe.config import ConfigError, import_object
from jaxsafe.learn.row import Row


def listed() -> dict[str, Row]:
    """The `ROWS` of every module in this folder, in the order of their names.

    Raises:
        ValueError: two modules have a row of the same name.
    """
    found: dict[str, Row] = {}
    for module in pkgutil.iter_modules(__path__):
        rows = importlib.import_module(f"{__name__}.{module.name}").ROWS
        if twice := sorted(rows.keys() & found.keys()):
            raise ValueError(f"algos/{module.name}.py: another module has a row {twice[0]!r} already")
        found |= rows
    return dict(sorted(found.items()))


ALGOS = listed()


def register(name: str, row: Row) -> None:
    """Add an algorithm of your own; a name that is there already is replaced.

    Raises:
        ConfigError: `row` is no Row.
    """
    if not isinstance(row, Row):
        raise ConfigError(f"algo={name}: expected a jaxsafe.algos.Row, not {type(row).__name__}")
    ALGOS[name] = row


def load(address: str) -> None:
    """Import the row 'module:name', from the working directory too, and register it as that address.

    This executes the module, so an address comes from the user, never from a file.

    Raises:
        ConfigError: no such module, nothing of that name in it, or no Row.
    """
    register(address, import_object("algo", address))


__all__ = ["ALGOS", "Row", "load", "register"]

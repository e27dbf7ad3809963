"""What the commands' argparse parsers share: numbers with bounds, and errors in one line."""

import argparse
import contextlib
from collections.abc import Callable
from typing import Any, NoReturn

from jaxsafe.config import ConfigError, convert, kind_in_words


class Parser(argparse.ArgumentParser):
    """A parser whose errors are lines for the user, like all others. Options may stand anywhere."""

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        return self.parse_intermixed_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        raise ConfigError(message)


def number(kind: Any) -> Callable[[str], Any]:
    """What argparse calls for an option that is a number within the bounds of the annotated `kind`."""

    def read(text: str) -> Any:
        value: Any = text
        with contextlib.suppress(ValueError):
            value = float(text)
            value = int(text)
        try:
            return convert(value, kind, "")
        except ConfigError as error:
            raise argparse.ArgumentTypeError(f"{text}: expected {kind_in_words(kind)}") from error

    return read

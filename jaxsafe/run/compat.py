"""Conventions of other libraries: `compat=omnisafe` sets the options that do as OmniSafe does.

`preset=published` has the settings of OmniSafe's figures, `compat=omnisafe` its conventions. Each
convention is an option of our own algorithms that can be set alone, and stands in the class of that
option (`jaxsafe.learn.conventions`).

Source: OmniSafe @15603dd.
"""

from typing import Any

from jaxsafe.learn.conventions import conventions

COMPAT = ("none", "omnisafe")


def overrides(compat: str, config: type) -> dict[str, Any]:
    """The options of `config` that `compat`, a name in COMPAT, sets."""
    if compat == "none":
        return {}
    return {k: v for convention in conventions(config) for k, v in convention.options.items()}

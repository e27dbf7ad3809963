"""What OmniSafe does that the papers do not, as options of ours.

A config class names its conventions in `CONVENTIONS`, beside the options that they set. A class that
inherits these options inherits the conventions.
"""

from typing import Any, NamedTuple


class Convention(NamedTuple):
    """options: what reproduces it. theirs, ours: what OmniSafe does, and what we do without it."""

    options: dict[str, Any]
    theirs: str
    ours: str


def conventions(config: type) -> list[Convention]:
    """The conventions of a config class, those of its bases first."""
    named = (vars(cls).get("CONVENTIONS", ()) for cls in reversed(config.__mro__))
    return [convention for several in named for convention in several]

"""How the reference shows docstrings: fields described one a line, as `name: what`, become a list."""

import re
from typing import Any

from griffe import Extension

FIELD = re.compile(r"^(?=[a-z_])([\w, ]+(?:\([\w, ]+\))?(?: \[[^\]]*\])?): (?=\S)", re.M)


def as_lists(text: str) -> str:
    """`text` with each paragraph whose lines begin with such fields, the first included, as a list."""
    blocks = text.split("\n\n")
    for i, block in enumerate(blocks):
        if FIELD.match(block) and not block.startswith((" ", "-")):
            items = FIELD.sub(r"- `\1`: ", block)
            blocks[i] = re.sub(r"\n(?!- )\s*", "\n    ", items)
    return "\n\n".join(blocks)


class Fields(Extension):
    """Loaded by mkdocstrings, see mkdocs.yml."""

    def on_object(self, *, obj: Any, **kwargs: Any) -> None:
        if obj.docstring:
            obj.docstring.value = as_lists(obj.docstring.value)

"""How the reference shows docstrings, see mkdocs.yml: an extension of griffe, which reads them."""

import sys
from pathlib import Path
from typing import Any

from griffe import Extension

sys.path.insert(0, str(Path(__file__).parent))
from hooks import laid_out


class LaidOut(Extension):
    def on_object(self, *, obj: Any, **kwargs: Any) -> None:
        if obj.docstring:
            obj.docstring.value = laid_out(obj.docstring.value)

"""Shapes such as ``(*batch, k)`` in docstrings, whose stars Markdown would take for emphasis."""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

CODE_OR_STAR = re.compile(r"(``.*?``|```.*?```)|\*(?=\w)", re.DOTALL)


class Stars(Extension):
    """Escapes a star in front of a word, where it is not code."""

    def on_object(self, *, obj: Object, **kwargs: Any) -> None:
        """Called for everything that has been read."""
        if obj.docstring is not None:
            obj.docstring.value = CODE_OR_STAR.sub(lambda found: found.group(1) or "\\*", obj.docstring.value)

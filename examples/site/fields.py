"""Docstrings that name fields or arguments line by line, "name: what it is", read as a list on the site."""

import re
from typing import Any

import griffe

FIELD = re.compile(r"^(\*?[a-z_]\w*(?:, \*?[a-z_]\w*)*|\"\w+\"): ", re.M)
FURTHER = re.compile(r"(?<=\.)  ([a-z_]\w*): ")  # a second one in the same line


class Fields(griffe.Extension):
    """Make list items of such lines; those of sections as Args are indented and stay."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite an object's docstring."""
        if obj.docstring is not None:
            lines = FURTHER.sub(r"\n\1: ", obj.docstring.value)
            lines = FIELD.sub(r"- `\1`: ", lines)
            obj.docstring.value = re.sub(r"^(?!- `|\s)(.+)\n(?=- `)", r"\1\n\n", lines, flags=re.M)

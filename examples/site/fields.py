"""Docstrings that name fields or arguments line by line, "name: what it is", read as a list on the site."""

import re
from typing import Any

import griffe

FIELD = re.compile(r"^(\*?[a-z_]\w*(?:, \*?[a-z_]\w*)*|\"\w+\"): ", re.M)
FURTHER = re.compile(r"(?<=\.)  ([a-z_]\w*): ")  # a second one in the same line


def listed(text: str) -> str:
    """The text with such lines as a list."""
    items = FIELD.sub(r"- `\1`: ", FURTHER.sub(r"\n\1: ", text))
    return re.sub(r"^(?!- `|\s)(.+)\n(?=- `)", r"\1\n\n", items, flags=re.M)


class Fields(griffe.Extension):
    """Rewrite docstrings; the items of sections as Args are indented and stay."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite an object's docstring."""
        if obj.docstring is not None:
            obj.docstring.value = listed(obj.docstring.value)

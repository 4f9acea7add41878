"""Command lines for people to copy, as the shells of this system read them."""

import os
import re
import shlex
from collections.abc import Iterable

BARE = re.compile(r"[\w:./\\][\w:./\\+-]*|--?[a-z][a-z-]*", re.ASCII)  # stands for itself in cmd and PowerShell
EXPANDED = re.compile('["“”„$`]')  # has a meaning within PowerShell's double quotes, some of which are curly
CLOSING = re.compile("(['‘’‚‛])")  # PowerShell's single quotes; two of them are one that is meant


def command_line(words: Iterable[str], windows: bool = os.name == "nt") -> str:
    """Words as one line for the shells of POSIX, or for cmd and PowerShell alike.

    Those two share the quotes "...".  A word with $ or ` goes into PowerShell's own '...', as it expands them in "...";
    cmd has no such quotes, and no way to keep %NAME% of a variable that is set.  Programs on Windows read a backslash
    before " as keeping it (CommandLineToArgvW), so it is doubled there.
    """
    return " ".join(map(_windows_word if windows else shlex.quote, words))


def _windows_word(word: str) -> str:
    if BARE.fullmatch(word):
        return word
    whole = re.sub(r"\\+$", r"\g<0>\g<0>", word)
    return "'" + CLOSING.sub(r"\1\1", whole) + "'" if EXPANDED.search(word) else f'"{whole}"'

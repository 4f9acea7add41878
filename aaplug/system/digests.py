"""Hashes (SHA-256, in hex) of what a result depends on, so that a continued run can tell whether anything changed."""

import hashlib
import re
from collections.abc import Iterable
from os import PathLike

from aaplug.system.errors import FormatError, reason

MEMORY_ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")  # in `repr` of a function, and of an object without one of its own


def digest_of_files(paths: Iterable[str | PathLike[str]]) -> str:
    """Hash of the files' contents, one after another.

    Raises:
        FormatError: a file cannot be read.
    """
    digest = hashlib.sha256()
    for path in paths:
        try:
            with open(path, "rb") as stream:
                hashlib.file_digest(stream, lambda: digest)
        except OSError as error:
            raise FormatError(path, f"cannot be read: {reason(error)}") from error
    return digest.hexdigest()


def digest_of_values(value: object) -> str:
    """Hash of dataclasses, names and numbers by their text; functions in it count by name, not by address."""
    return hashlib.sha256(MEMORY_ADDRESS.sub("", repr(value)).encode()).hexdigest()

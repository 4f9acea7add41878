"""What a result depends on, as hashes (SHA-256, in hex), so that a continued run can tell whether anything changed."""

import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

from aaplug.system.errors import FormatError, UsageError, listing, reason

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
    """Hash of dataclasses, names and numbers by their text; functions in it count by name, not by address.

    Lambdas, and what a function defines, share names, and count by their code and what that holds.  Objects whose text
    does not say all count by their fields, and tensors by their numbers.
    """
    digest = hashlib.sha256(_text(value))
    for text in _texts(value, frozenset()):
        digest.update(text)
    return digest.hexdigest()


def _text(value: object) -> bytes:
    return MEMORY_ADDRESS.sub("", repr(value)).encode()


def _texts(value: Any, above: frozenset[int]) -> Iterator[bytes]:
    """What a value is made of, which its text may not say.  above: `id` of what it is a part of."""
    parts: Iterable[Any] = ()
    if id(value) in above or isinstance(value, type | ModuleType):
        return
    if isinstance(value, Mapping):
        parts = value.values()
    elif isinstance(value, list | tuple):
        parts = value
    elif isinstance(value, set | frozenset):
        parts = sorted(value, key=_text)
    elif isinstance(value, partial):
        parts = value.func, value.args, value.keywords
    elif isinstance(value, CodeType):
        yield value.co_code + _text(value.co_names)
        parts = value.co_consts
    elif isinstance(value, FunctionType) and "<" in value.__qualname__:
        cells = [cell.cell_contents for cell in value.__closure__ or ()]
        parts = value.__code__, value.__defaults__, value.__kwdefaults__, cells
    elif is_dataclass(value):
        parts = [getattr(value, field.name) for field in fields(value)]
    elif hasattr(value, "__array__"):
        array: Any = value
        yield np.ascontiguousarray(array.detach().cpu() if hasattr(array, "detach") else array).tobytes()
    elif hasattr(value, "__dict__") and not isinstance(value, FunctionType):
        parts = vars(value).values()
    else:
        yield _text(value)
    for part in parts:
        yield from _texts(part, above | {id(value)})


def check_request(path: Path, before: Mapping[str, Any], now: Mapping[str, Any], anew: str) -> None:
    """Refuse to continue what was asked for otherwise; path: where that is written.  anew: how to start again."""
    if changed := [*_changes(before, now)]:
        what = f"is of another request or another aaplug ({listing(changed)} changed since)"
        raise UsageError(str(path), f"{what}; repeat that request, or {anew}")


def _changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    """The keys whose values differ; those of mappings with that of the mapping, such as `versions.torch`."""
    for key in dict.fromkeys((*now, *before)):
        old, new = before.get(key), now.get(key)
        if isinstance(old, dict) and isinstance(new, dict):
            yield from (f"{key}.{inner}" for inner in _changes(old, new))
        elif old != new:
            yield key

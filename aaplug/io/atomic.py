"""Files that appear whole or not at all.

Bytes go to a temporary file beside the output, which takes the output's name only once all of them
are on the disk.  Whatever interrupts the writing, the old file stays as it was and the temporary
one is removed.
"""

import os
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from aaplug.core.errors import OutputError

TOKEN_BYTES = 8  # random bytes in a temporary file's name: 2^64 names


@contextmanager
def replacing(path: Path, overwrite: bool) -> Iterator[BinaryIO]:
    """A binary stream whose content becomes `path` when the block ends without an exception.

    Keep the block to writing: any OSError in it is reported as a failure to write `path`.

    Raises:
        OutputError: the output exists and `overwrite` is false, or nothing can be written there.
    """
    _check_target(path, overwrite)
    target = Path(os.path.realpath(path))  # a link stays a link and its target is replaced
    temporary = target.with_name(f".aaplug-{secrets.token_hex(TOKEN_BYTES)}.tmp")
    with _worded_for_users(path):
        with _removed_on_failure(temporary):
            with open(temporary, "xb") as stream:  # "x": never through somebody else's file or link
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(temporary, target)
        _sync_folder(target.parent)


def check_output(path: Path, overwrite: bool, inputs: Iterable[Path] = ()) -> None:
    """Refuse an output that must not be written, before any work and creating nothing.

    Raises:
        OutputError: the output is one of the inputs (whatever `overwrite` says), exists and
            `overwrite` is false, or has no folder.
    """
    for source in inputs:
        if _same_file(path, source):
            raise OutputError(path, f"is also the input {source}; give the output another name")
    _check_target(path, overwrite)


def _check_target(path: Path, overwrite: bool) -> None:
    try:
        if path.is_dir():
            raise OutputError(path, "is a folder; name a file in it")
        if path.exists() and not path.is_file():
            raise OutputError(path, "is not an ordinary file")
        if path.exists() and not overwrite:
            raise OutputError(path, "exists; pass --overwrite to replace it")
        if not Path(os.path.realpath(path)).parent.is_dir():
            raise OutputError(path, "cannot be written: its folder does not exist; make it first")
    except (OSError, ValueError) as error:  # no access, a name too long, or one with a NUL in it
        raise OutputError(path, f"cannot be written: {_reason(error)}") from error


def _same_file(a: Path, b: Path) -> bool:
    with suppress(OSError, ValueError):  # one of them does not exist: they are not the same
        return os.path.samefile(a, b)
    return False


@contextmanager
def _removed_on_failure(temporary: Path) -> Iterator[None]:
    try:
        yield
    except BaseException:  # Ctrl-C too
        with suppress(OSError):
            temporary.unlink()
        raise


@contextmanager
def _worded_for_users(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(path, f"cannot be written: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    strerror = error.strerror if isinstance(error, OSError) else None
    return (strerror or str(error)).lower()


def _sync_folder(folder: Path) -> None:
    """Make the new name itself last; systems that cannot open a folder do this on their own."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

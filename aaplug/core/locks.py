"""Locks that end with their process, and removal of what killed processes left behind.

A lock is the system's own (flock) on an open file or folder.  It ends with its process, also after kill -9, so no lock
is ever stale.  Where the system has none, nothing is refused and nothing is removed.
"""

import importlib.util
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

OURS = ".aaplug-"  # begins the name of every temporary file beside an output
CAN_LOCK = importlib.util.find_spec("fcntl") is not None
SCRATCH = "aaplug-"  # begins the name of every folder of temporary files


def lock(descriptor: int, wait: bool = False) -> bool:
    """Lock an open file or folder; false if another process, or another part of this one, holds it."""
    if not CAN_LOCK:
        return True
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    return True


@contextmanager
def new_file(path: Path) -> Iterator[None]:
    """Make an empty file and lock it inside the block, so that `remove_left` lets it be.

    Raises:
        OSError: a process holds it already, or it cannot be made.
    """
    with suppress(FileNotFoundError):
        _remove_unless_held(path)
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            lock(descriptor, wait=True)
            if not path.exists():  # removed before it was locked
                continue
            yield
            return
        finally:
            os.close(descriptor)


@contextmanager
def scratch(parent: str | None = None) -> Iterator[Path]:
    """A locked folder for temporary files, removed at the end; and remove those of dead processes beside it.

    parent: the folder that it is in; None for the system's.
    """
    with tempfile.TemporaryDirectory(prefix=SCRATCH, dir=parent, ignore_cleanup_errors=True) as name:
        descriptor = os.open(name, os.O_RDONLY)
        try:
            lock(descriptor, wait=True)
            remove_left(Path(name).parent, SCRATCH)
            yield Path(name)
        finally:
            os.close(descriptor)


@cache
def remove_left(folder: Path, start: str) -> None:
    """Remove the files and folders here whose names begin so and that no process holds; once for each folder."""
    with suppress(OSError):
        for entry in _named(folder, start):
            with suppress(OSError):  # somebody else's, or gone
                _remove_unless_held(entry)


def _named(folder: Path, start: str) -> Iterable[Path]:
    with os.scandir(folder) as entries:
        return [folder / entry.name for entry in entries if entry.name.startswith(start) and not entry.is_symlink()]


def _remove_unless_held(path: Path) -> None:
    if not CAN_LOCK:
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        if lock(descriptor):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    finally:
        os.close(descriptor)

"""Locks that end with their process, and removal of what killed processes left behind.

A lock is the system's own (flock) on an open file.  It ends with its process, also after kill -9, so no lock is ever
stale.  Windows has no flock, but neither removes nor renames a file that is open, so that being open is the lock of a
new file.  On a file system without locks nothing is refused and nothing of others is removed.  Only names that aaplug
alone gives are ever removed: hidden files beside outputs, and folders of temporary files that hold a mark.
"""

import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import BinaryIO

OUR_PREFIX = ".aaplug-"  # begins the name of every temporary file beside an output; 16 hex digits and a suffix follow
OUR_FILE_NAME = re.compile(r"\.aaplug-[0-9a-f]{16}(\.\w+)?", re.ASCII)
SCRATCH_PREFIX = "aaplug-scratch-"  # begins the name of every folder of temporary files
SAFE_FLAGS = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOFOLLOW", 0)  # neither waits for a pipe nor follows a link
LOCK_FILE_NAME = "aaplug.lock"  # the locked file in such a folder
OPEN_IS_HELD = os.name == "nt"  # Windows neither removes nor renames a file that is open


def lock(descriptor: int, wait: bool = False) -> bool | None:
    """Lock an open file: true if this process holds it now, false if another does, None if nothing locks here."""
    try:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except (ImportError, OSError):  # Windows, or a file system without locks
        return None
    return True


@contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """Make an empty file and lock it inside the block, so that nobody removes it; `let_move` comes before a new name.

    Raises:
        OSError: a process holds it already, or it cannot be made.
    """
    with suppress(FileNotFoundError):
        _remove_unless_held(path, unsure=True)
    while True:
        with open(path, "x+b", buffering=0) as file:
            if lock(file.fileno(), wait=True) and not _is_at(file.fileno(), path):  # removed before it was locked
                continue
            yield file
            return


def let_move(file: BinaryIO) -> None:
    """Close a new file that is to be renamed or removed, where the system does neither with one that is open."""
    if OPEN_IS_HELD:
        file.close()


@contextmanager
def scratch(parent: str | None = None) -> Iterator[Path]:
    """A folder for temporary files, removed at the end; and remove those of dead processes beside it.

    parent: the folder that it is in; None for the system's.
    """
    while True:
        temporary = tempfile.TemporaryDirectory(prefix=SCRATCH_PREFIX, dir=parent, ignore_cleanup_errors=True)
        with temporary as name, ExitStack() as stack:
            folder = Path(name)
            try:
                stack.enter_context(new_file(folder / LOCK_FILE_NAME))
            except FileNotFoundError:  # removed before it was locked
                continue
            remove_left(folder.parent)
            yield folder
            return


@cache
def remove_left(folder: Path) -> None:
    """Remove what dead processes left in a folder: files beside outputs, folders of temporary files; once for each."""
    with suppress(OSError):
        for path in [folder / entry.name for entry in os.scandir(folder)]:
            with suppress(OSError):  # somebody else's, or gone
                if OUR_FILE_NAME.fullmatch(path.name):
                    _remove_unless_held(path)
                elif path.name.startswith(SCRATCH_PREFIX) and not path.is_symlink():
                    _remove_unless_held(path / LOCK_FILE_NAME, path)


def _remove_unless_held(path: Path, folder: Path | None = None, unsure: bool = False) -> None:
    """Remove a file, or the folder that it marks, if it is ordinary and no process holds it.

    unsure: remove it also where nothing tells whether a process holds it.
    """
    if OPEN_IS_HELD:
        with suppress(PermissionError):  # a process holds it
            path.unlink()
            if folder is not None:
                shutil.rmtree(folder)
        return
    descriptor = os.open(path, os.O_RDWR | SAFE_FLAGS)
    try:
        free = lock(descriptor)
        if os.path.isfile(path) and (unsure if free is None else free) and _is_at(descriptor, path):
            path.unlink() if folder is None else shutil.rmtree(folder)
    finally:
        os.close(descriptor)


def _is_at(descriptor: int, path: Path) -> bool:
    """True while the path names the open file."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.lstat(path))
    except FileNotFoundError:
        return False

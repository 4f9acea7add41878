"""Files that appear whole or not at all, and never in place of an input.

A temporary file beside the output takes the output's name once all of its bytes are on the disk.  If writing fails or
is interrupted, the old file is unchanged and the temporary file is removed.

The folder of an output is made where it does not exist, and removed if writing fails and it is empty.

Functions raise OutputError for an output that exists while `overwrite` is false or cannot be written.
Inside `writing` they raise it, whatever `overwrite` says, for an output that is an input, also through symbolic or hard
links.
"""

import errno
import hashlib
import os
import secrets
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from os import PathLike
from pathlib import Path
from typing import BinaryIO

from aaplug.system.contracts import contract
from aaplug.system.errors import OutputError, listing, of_system, reason
from aaplug.system.locks import OUR_PREFIX, let_move, new_file, remove_left

TOKEN_BYTES = 8  # random bytes in a temporary file's name: 2^64 names
HASH_DIGITS = 16  # in the name of a claim

FileId = tuple[int, int | str]  # device, and number on it, or path where a drive gives 0: the same for every name
AnyPath = str | PathLike[str]
_open_outputs = list[AnyPath]()  # of the blocks of `writing` in this process
_inputs = dict[FileId, AnyPath]()  # of these blocks and of those that ended inside them


@contract
@contextmanager
def replacing(path: AnyPath, overwrite: bool) -> Iterator[BinaryIO]:
    """Yield a binary stream whose content becomes `path` when the block ends without an exception.

    The block should only write: any OSError in it is reported as a failure to write `path`.
    """
    with replacing_file(path, overwrite) as temporary, open(temporary, "wb") as stream:
        yield stream


def write_file(path: AnyPath, content: bytes, overwrite: bool) -> None:
    """Write a file whose content is known, whole or not at all; raises OutputError as `replacing`."""
    with replacing(path, overwrite) as stream:
        stream.write(content)


@contextmanager
def replacing_file(path: AnyPath, overwrite: bool, suffix: str = ".tmp") -> Iterator[Path]:
    """Like `replacing`, for libraries that open their file themselves: yields an empty file that ends in `suffix`."""
    path = Path(path)
    check_output(path, overwrite)
    target = Path(os.path.realpath(path))  # a link stays a link; its target is replaced
    temporary = target.with_name(f"{OUR_PREFIX}{secrets.token_hex(TOKEN_BYTES)}{suffix}")
    remove_left(target.parent)
    with output_folder(target.parent):
        try:
            with new_file(temporary) as held:
                let_move(held)  # whatever writes it opens it, or replaces it
                yield temporary
                _sync(temporary, os.O_RDWR)
                os.replace(temporary, target)
        except BaseException as error:  # Ctrl-C too
            with suppress(OSError):
                temporary.unlink()
            if cause := of_system(error):
                raise OutputError(path, f"cannot be written: {reason(cause)}") from error
            raise
    with suppress(OSError):  # makes the new name permanent; some systems cannot open a folder
        _sync(target.parent, os.O_RDONLY)


@contextmanager
def told_by_library() -> Iterator[None]:
    """Raise as OSError what a library that writes a file tells as RuntimeError, such as a full disk."""
    try:
        yield
    except RuntimeError as error:
        raise of_system(error) or OSError(errno.EIO, str(error)) from error


@contextmanager
def claimed(path: AnyPath) -> Iterator[None]:
    """Keep other processes from writing an output, a file or a folder, while the block runs.

    Raises OutputError if another process is writing it, or nothing can be written beside it.
    """
    path = Path(os.path.realpath(path))
    name = OUR_PREFIX + hashlib.sha256(os.fsencode(path.name)).hexdigest()[:HASH_DIGITS]
    mark = path / name if path.is_dir() else path.with_name(name)
    with ExitStack() as stack:
        try:
            held = stack.enter_context(new_file(mark))
        except FileExistsError as error:
            raise OutputError(path, "is being written by another process") from error
        except OSError as error:
            raise OutputError(path, f"cannot be written: {reason(error)}") from error
        stack.callback(mark.unlink, missing_ok=True)
        stack.callback(let_move, held)
        yield


@contextmanager
def writing(
    path: AnyPath | None, check: Callable[[], object], inputs: Iterable[AnyPath], folder: bool = False
) -> Iterator[None]:
    """Claim an output while the block writes it; None claims nothing.  Raises as `claimed` and `make_folder`.

    check: refuses what must not be written; called once the output is claimed, as others may have written meanwhile.
    inputs: files that nothing in this process replaces before the outermost block ends.
    folder: the output is one.
    """
    if path is None:
        yield
        return
    with ExitStack() as stack:
        _open_outputs.append(path)
        try:
            _inputs.update(_ids_of(inputs))
            stack.enter_context(output_folder(path if folder else Path(os.path.realpath(path)).parent))
            stack.enter_context(claimed(path))
            check()
            yield
        finally:
            _open_outputs.remove(path)
            if not _open_outputs:
                _inputs.clear()


def check_output(path: AnyPath, overwrite: bool, inputs: Iterable[AnyPath] = ()) -> None:
    """Refuse an output that must not be written, before any work; one of these inputs too."""
    path = Path(path)
    refuse_inputs([path], inputs)
    try:
        if path.is_dir():
            raise OutputError(path, "is a folder; name a file in it")
        if path.exists() and not path.is_file():
            raise OutputError(path, "is not an ordinary file")
        if path.exists() and not overwrite:
            raise OutputError(path, "exists; pass `overwrite` to replace it")
        target = Path(os.path.realpath(path))
        if target.is_symlink():
            raise OutputError(path, "is a link that leads to itself")
        above = next(parent for parent in target.parents if parent.exists())
        if not above.is_dir():
            raise OutputError(path, f"cannot be written: {above} is no folder")
    except (OSError, ValueError) as error:  # no access, a name too long, or a NUL in it
        raise OutputError(path, f"cannot be written: {reason(error)}") from error


def check_name(path: AnyPath) -> None:
    """Refuse an output whose name the file system does not take, or a folder that may not be looked into."""
    try:
        os.lstat(os.path.join(path, "."))
    except (FileNotFoundError, NotADirectoryError):
        return
    except (OSError, ValueError) as error:
        raise OutputError(path, f"cannot be written: {reason(error)}") from error


def make_folder(path: AnyPath) -> Path:
    """Make a folder and its parents where they do not exist, and return it."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(path, f"cannot be made: {reason(error)}") from error
    return Path(path)


@contextmanager
def output_folder(path: AnyPath) -> Iterator[Path]:
    """Make a folder for the outputs of the block; if it fails, remove what was made and is still empty."""
    path = Path(path)
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    make_folder(path)
    try:
        yield path
    except BaseException:
        with suppress(OSError):  # one that is not empty stays, and so do those that hold it
            for folder in missing:
                folder.rmdir()
        raise


def refuse_existing(paths: Sequence[Path], overwrite: bool, resume: bool | None = None) -> None:
    """Check, before any work, that none of these files of one folder exists, unless they may be replaced.

    resume: whether the run that wrote them goes on; None where no run can.
    """
    folder = paths[0].parent
    check_name(folder)
    if folder.exists() and not folder.is_dir():
        raise OutputError(folder, "is a file; name a folder")
    refuse_inputs(paths)
    existing = [path.name for path in paths if path.exists()]
    if existing and not (overwrite or resume):
        hint = "pass `overwrite` to replace files" + ", or `resume` to go on" * (resume is not None)
        raise OutputError(folder, f"already holds {listing(existing, most=3)}; {hint}")


def refuse_inputs(paths: Iterable[AnyPath], inputs: Iterable[AnyPath] = ()) -> None:
    """Refuse outputs that are one of these inputs, or one inside `writing`."""
    sources = _inputs | _ids_of(inputs)
    for file_id, path in _ids_of(paths).items():
        if file_id in sources:
            raise OutputError(path, f"is also the input {sources[file_id]}; give the output another name")


def _ids_of(paths: Iterable[AnyPath]) -> dict[FileId, AnyPath]:
    """The files that exist, without folders."""
    ids = dict[FileId, AnyPath]()
    for path in paths:
        with suppress(OSError, ValueError):
            if os.path.isfile(path):
                status = os.stat(path)
                ids[status.st_dev, status.st_ino or os.path.realpath(path)] = path
    return ids


def _sync(path: Path, mode: int) -> None:
    descriptor = os.open(path, mode)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

"""Output folders: making them, and refusing to replace what they hold."""

from collections.abc import Sequence
from pathlib import Path

from aaplug.core.errors import OutputError, listing


def refuse_existing(paths: Sequence[Path], overwrite: bool) -> None:
    """Check, before any work, that none of these files of one folder exists, unless they may be replaced.

    Raises:
        OutputError: a file exists and `overwrite` is false, or the folder is a file.
    """
    folder = paths[0].parent
    if folder.exists() and not folder.is_dir():
        raise OutputError(folder, "is a file; name a folder")
    existing = [path.name for path in paths if path.exists()]
    if existing and not overwrite:
        raise OutputError(folder, f"already holds {listing(existing, most=3)}; pass `overwrite`")


def make_folder(folder: Path) -> None:
    """Make a folder and its parents.

    Raises:
        OutputError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            folder, f"cannot be made: {(error.strerror or str(error)).lower()}"
        ) from error

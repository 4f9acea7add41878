"""Output folders and the refusal to replace what stands in them."""

from collections.abc import Sequence
from pathlib import Path

from aaplug.core.errors import OutputError, listing


def refuse_existing(paths: Sequence[Path], overwrite: bool) -> None:
    """Stop before any work if one of the files, all in one folder, exists and may not be replaced.

    Raises:
        OutputError: a file exists and `overwrite` is false, or the folder is a file.
    """
    folder = paths[0].parent
    if folder.exists() and not folder.is_dir():
        raise OutputError(folder, "is a file; name a folder")
    existing = [path.name for path in paths if path.exists()]
    if existing and not overwrite:
        raise OutputError(folder, f"holds {listing(existing, most=3)} already; pass --overwrite")


def make_folder(folder: Path) -> None:
    """Make a folder and those above it.

    Raises:
        OutputError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            folder, f"cannot be made: {(error.strerror or str(error)).lower()}"
        ) from error

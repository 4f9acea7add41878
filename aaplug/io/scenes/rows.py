"""Parts of every scene format: its options, errors of libraries as ours, rows of a table, limits."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aaplug.core.conventions import SpzAxes, SpzVersion
from aaplug.io.limits import limit, whole_limit
from aaplug.system.contracts import check_fields, contract
from aaplug.system.errors import AaplugError, FormatError, reason

HEAD_BYTES = 64  # of a file, passed to each format's `sniff`
MAX_REASON = 200  # characters of a library's message


@dataclass(frozen=True)
class SceneFileOptions:
    """The user's choices, see `read_scene` and `write_scene`, of which each format uses those that concern it.

    Raises UsageError if there are no such axes, or no such version.
    """

    allow_checkpoint: bool = False
    spz_axes: SpzAxes = "auto"
    spz_version: SpzVersion = 4

    def __post_init__(self) -> None:
        check_fields(self)


@contract
@contextmanager
def library_errors(path: Path) -> Iterator[None]:
    """Report whatever a library raises about a damaged file as one FormatError."""
    try:
        with np.errstate(all="ignore"):  # NaN is reported by `faults_of`
            yield
    except AaplugError:
        raise
    except MemoryError as error:
        raise FormatError(path, "does not fit into memory") from error
    except OSError as error:
        raise FormatError(path, f"cannot be read: {reason(error)}") from error
    except Exception as error:  # plyfile, numpy, zlib, zipfile, Pillow and torch raise all kinds
        what = " ".join(str(error).split())[:MAX_REASON]
        raise FormatError(path, f"is damaged and cannot be read: {what}") from error


def by_name(*ends: str, start: bytes = b"") -> Callable[[Path, bytes], bool]:
    """What recognizes files by the end of their names, and by their first bytes after white space."""
    return lambda path, head: path.name.lower().endswith(ends) and head.lstrip().startswith(start)


def read_rows(path: Path, dtype: np.dtype, start: int, stop: int, offset: int = 0) -> np.ndarray:
    """The rows from start up to stop of a table that begins at the byte `offset`."""
    with library_errors(path):
        rows = np.fromfile(path, dtype, stop - start, offset=offset + start * dtype.itemsize)
    if len(rows) != stop - start:
        raise FormatError(path, "was cut short while it was being read")
    return rows


@contract
def check_count(path: Path, count: int) -> None:
    """Refuse a scene of more Gaussians than the limit GAUSSIANS."""
    most = whole_limit("GAUSSIANS")
    if count > most:
        raise FormatError(path, f"holds {count:,} Gaussians and the limit is {most:,}; AAPLUG_GAUSSIANS raises it")


def check_growth(path: Path, inflated: int, compressed: int) -> None:
    """Refuse compressed bytes that announce a larger size than a real scene would have."""
    if inflated > limit("INFLATE") * compressed + limit("SLACK"):
        many = f"announce {inflated:,}, more than {limit('INFLATE'):g} times as many"
        bomb = "it is damaged or a decompression bomb (AAPLUG_INFLATE raises the limit)"
        raise FormatError(path, f"its {compressed:,} compressed bytes {many}; {bomb}")

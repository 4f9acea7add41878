"""A .ply file as tables: the Gaussians' rows, read when asked for, and everything else, kept to be written back.

numpy reads the Gaussians' rows; plyfile reads text, skips lists and converts big-endian tables.

Functions raise FormatError for a file that breaks its format.
"""

import io
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement
from torch import Tensor

from aaplug.io.ply_header import LITTLE, TEXT, Header
from aaplug.io.scenes.rows import read_rows
from aaplug.io.values import read_part
from aaplug.system.errors import FormatError


@dataclass(frozen=True, eq=False)
class Table:
    """The Gaussians' rows in a file, or in memory if they had to be parsed.  stamp: of the file when it was opened."""

    path: Path
    offset: int
    count: int
    dtype: np.dtype
    stamp: tuple[int, int]
    parsed: np.ndarray | None = None

    def read(self, start: int, stop: int) -> np.ndarray:
        """The rows from start up to stop."""
        if self.parsed is not None:
            return np.array(self.parsed[start:stop])  # of a file that is mapped
        self._check_unchanged()
        return read_rows(self.path, self.dtype, start, stop, self.offset)

    def take(self, rows: Tensor) -> np.ndarray:
        """The rows with these indices."""
        table = self.parsed
        if table is None:
            self._check_unchanged()
            shape = (max(1, self.count),)  # none cannot be mapped
            table = np.memmap(self.path, self.dtype, "r", self.offset, shape) if self.count else np.empty(0, self.dtype)
        return np.array(table[rows.numpy()])

    def _check_unchanged(self) -> None:
        if stamp_of(self.path) != self.stamp:
            raise FormatError(self.path, "changed while it was being read")


@dataclass(frozen=True)
class Document:
    """A whole file: its header, the Gaussians' table, and what gives the other tables as little-endian bytes.

    before, after: raise FormatError if the file is not there or was cut short.
    """

    header: Header
    table: Table | None = None
    before: Callable[[], bytes] = bytes
    after: Callable[[], bytes] = bytes


def stamp_of(path: Path) -> tuple[int, int]:
    """A file's size and time of change."""
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def document_of(path: Path, header: Header, stamp: tuple[int, int]) -> Document:
    """Locate the tables of a file; parse those that numpy cannot read."""
    vertex = header.vertex
    if header.coding == LITTLE and not any(e.lists for e in header.elements):
        start = header.start_of(vertex)
        table, end = Table(path, start, vertex.count, vertex.dtype, stamp), start + vertex.least_size
        places = (header.size, start), (end, stamp[0])
        return Document(header, table, *(partial(read_part, path, a, b - a) if a < b else bytes for a, b in places))
    elements, at = _parsed(header), header.elements.index(vertex)
    data, *others = elements[at].data, _little(elements[:at]), _little(elements[at + 1 :])
    table = Table(path, 0, len(data), data.dtype, stamp, np.asarray(data))
    return Document(header, table, *(partial(bytes, each) for each in others))


def _parsed(header: Header) -> tuple[PlyElement, ...]:
    """All tables; a header that plyfile cannot read is given to it in ASCII and without empty lines."""
    with open(header.path, "rb") as file, warnings.catch_warnings(action="ignore"):  # numpy's, about empty lists
        stream = file
        if not header.content.isascii() or len(header.content) < header.size:
            file.seek(header.size)
            stream = io.BytesIO(header.content.decode("ascii", "replace").encode("ascii", "replace") + file.read())
        elements = PlyData.read(stream, mmap="r").elements
        if header.coding != TEXT:  # with lists, the header does not tell the size
            spare = -stream.tell() + stream.seek(0, io.SEEK_END)
            if spare:
                raise FormatError(header.path, f"has {spare:,} bytes after its last element; it is damaged")
    return elements


def _little(elements: Iterable[PlyElement]) -> bytes:
    stream, data = io.BytesIO(), PlyData(list(elements), byte_order="<")
    data.write(stream)
    return stream.getvalue()[len(data.header) + 1 :]

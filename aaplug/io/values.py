"""Values from files that nobody vouches for: bounded, typed, finite, and named when they are wrong.

Lengths are in world units, sizes and focal lengths in px.  Every complaint is a `FormatError` that
gives the file, the entry, the field, what was expected and what was found.
"""

import json
import math
import os
import reprlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.errors import FormatError
from aaplug.io.limits import whole_limit

HEAD_LIMIT = 64 * 2**10  # bytes: enough to meet an entry's keys when a file's format is guessed
MAX_FOCAL = 1e9  # px: no lens sees so little, and what follows from it stays finite
ORTHONORMAL = 1e-3  # the most that an entry of R·Rᵀ may be off the identity's


@dataclass(frozen=True)
class Place:
    """Where in a file a value stands, for messages."""

    file: Path
    entry: str

    def error(self, problem: str) -> FormatError:
        """A complaint about this entry as a whole."""
        return FormatError(self.file, f"{self.entry}: {problem}")

    def wrong(self, field: str, expected: str, got: object) -> FormatError:
        """A complaint about one field."""
        return self.error(f"{field} should be {expected}, not {reprlib.repr(got)}")


@dataclass(frozen=True)
class Entry:
    """One JSON object, read field by field.

    Each reading raises FormatError if the field is not what it should be.
    """

    place: Place
    fields: dict[str, Any]

    def __contains__(self, field: str) -> bool:
        return field in self.fields

    def value(self, field: str) -> Any:
        """The field as it stands."""
        if field not in self.fields:
            raise self.place.error(f"{field} is missing")
        return self.fields[field]

    def number(self, field: str) -> float:
        """A finite number."""
        return number(self.value(field), self.place, field)

    def focal(self, field: str) -> float:
        """A focal length, in px."""
        return focal(self.value(field), self.place, field)

    def pixels(self, field: str) -> int:
        """The length of an image's side, in px."""
        return pixels(self.value(field), self.place, field)

    def text(self, field: str) -> str:
        """Printable text."""
        return text(self.value(field), self.place, field)

    def vector(self, field: str, length: int) -> Float[Tensor, " length"]:
        """Finite numbers, `length` of them."""
        cells = numbers(self.value(field), length, self.place, field)
        return torch.tensor(cells, dtype=torch.float64)

    def matrix(self, field: str, rows: int, columns: int) -> Float[Tensor, "rows columns"]:
        """Finite numbers, a list a row."""
        value = self.value(field)
        expected = f"{rows} rows of {columns} numbers"
        if not isinstance(value, list) or len(value) != rows:
            raise self.place.wrong(field, expected, value)
        cells = [numbers(row, columns, self.place, field) for row in value]
        return torch.tensor(cells, dtype=torch.float64)


def number(value: object, place: Place, field: str) -> float:
    """`value` as a finite number.

    Raises:
        FormatError: it is none.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise place.wrong(field, "a number", value)
    if not -math.inf < value < math.inf or abs(value) > torch.finfo(torch.float64).max:
        raise place.wrong(field, "a finite number", value)
    return float(value)


def numbers(value: object, length: int, place: Place, field: str) -> list[float]:
    """`value` as a list of `length` finite numbers.

    Raises:
        FormatError: it is none.
    """
    if not isinstance(value, list) or len(value) != length:
        raise place.wrong(field, f"{length} numbers", value)
    return [number(item, place, field) for item in value]


def focal(value: object, place: Place, field: str) -> float:
    """`value` as a focal length, in px.

    Raises:
        FormatError: it is none.
    """
    real = number(value, place, field)
    if not 0 < real <= MAX_FOCAL:
        raise place.wrong(field, f"above 0 and at most {MAX_FOCAL:g} px", value)
    return real


def pixels(value: object, place: Place, field: str) -> int:
    """`value` as the length of an image's side, in px.

    Raises:
        FormatError: it is none.
    """
    real, most = number(value, place, field), whole_limit("CAMERA_SIDE")
    if not (1 <= real <= most and real.is_integer()):
        raise place.wrong(field, f"a whole number of px from 1 to {most}", value)
    return int(real)


def text(value: object, place: Place, field: str) -> str:
    """`value` as printable text, so that nothing odd ends up in a terminal or a path.

    Raises:
        FormatError: it is none.
    """
    if not isinstance(value, str) or not value or not value.isprintable():
        raise place.wrong(field, "printable text", value)
    return value


def pose(
    rotation: Float[Tensor, "3 3"], translation: Float[Tensor, " 3"], place: Place, field: str
) -> Float[Tensor, "4 4"]:
    """A rigid motion whose rotation is exactly orthonormal.

    Raises:
        FormatError: `rotation` is further from a rotation than rounding explains.
    """
    error = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max().item()
    if not error <= ORTHONORMAL:
        raise place.error(
            f"{field} should be a rotation: R·Rᵀ is {error:.2g} off the identity, "
            f"{ORTHONORMAL:g} allowed"
        )
    if torch.linalg.det(rotation) <= 0:
        raise place.error(f"{field} should be a rotation, but it mirrors (its determinant is -1)")
    left, _, right = torch.linalg.svd(rotation)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = left @ right
    motion[:3, 3] = translation
    return motion


def inverse(motion: Float[Tensor, "4 4"], place: Place, field: str) -> Float[Tensor, "4 4"]:
    """The rigid motion back.

    Raises:
        FormatError: it leaves the range of numbers.
    """
    back = torch.eye(4, dtype=torch.float64)
    back[:3, :3] = motion[:3, :3].T
    back[:3, 3] = -back[:3, :3] @ motion[:3, 3]
    if not back.isfinite().all():
        raise place.wrong(field, "a position within reach", motion[:3, 3].tolist())
    return back


def rigid(entry: Entry, field: str) -> Float[Tensor, "4 4"]:
    """A field that holds a 4×4 rigid motion, with 0 0 0 1 in its last row.

    Raises:
        FormatError: it holds none.
    """
    motion = entry.matrix(field, 4, 4)
    if not torch.allclose(motion[3], torch.eye(4, dtype=torch.float64)[3]):
        raise entry.place.wrong(f"{field}'s last row", "0 0 0 1", motion[3].tolist())
    return motion


def read_bounded(path: Path, limit: int) -> bytes:
    """A file's bytes.

    Raises:
        FormatError: it is longer than `limit`, no file, or may not be read.
    """
    if not os.path.isfile(path):  # a pipe would make us wait for ever
        raise FormatError(path, "there is no such file")
    try:
        with path.open("rb") as file:
            data = file.read(limit + 1)
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror}") from error
    if len(data) > limit:
        raise FormatError(
            path, f"is longer than {limit} bytes, the most that is read of such a file"
        )
    return data


def read_json(path: Path) -> Any:
    """A JSON document.

    Raises:
        FormatError: the file is none, is longer than the limit, or holds NaN or Infinity.
    """
    return parse_json(read_bounded(path, whole_limit("JSON")), path)


def parse_json(data: bytes, path: Path) -> Any:
    """The JSON document in these bytes of the file `path`.

    Raises:
        FormatError: they are none, or hold NaN or Infinity.
    """
    try:
        return json.loads(data.decode("utf-8-sig"), parse_constant=_refuse)
    except (RecursionError, MemoryError) as error:
        raise FormatError(path, "its JSON is nested too deeply") from error
    except ValueError as error:
        raise FormatError(path, f"should be JSON: {error}") from error


def entries(
    path: Path, what: str, items: object, shared: dict[str, Any] | None = None
) -> list[Entry]:
    """A JSON list's objects, each laid over the fields that all share.

    Raises:
        FormatError: it is not a list of objects, or is empty.
    """
    if not isinstance(items, list) or not items:
        raise FormatError(
            path, f"should hold a list of {what}s, at least one, not {reprlib.repr(items)}"
        )
    return [_entry(Place(path, f"{what} {i}"), item, shared or {}) for i, item in enumerate(items)]


def head(path: Path) -> bytes:
    """A file's first bytes, none if it cannot be read; to guess a format, so nothing is raised."""
    if not os.path.isfile(path):
        return b""
    try:
        with path.open("rb") as file:
            return file.read(HEAD_LIMIT)
    except OSError:
        return b""


def mentions(path: Path, keys: Sequence[str]) -> bool:
    """Whether one of the keys of a JSON object is met early in the file."""
    start = head(path)
    return any(f'"{key}"'.encode() in start for key in keys)


def _entry(place: Place, item: object, shared: dict[str, Any]) -> Entry:
    if not isinstance(item, dict):
        raise place.wrong("it", "an object", item)
    return Entry(place, {**shared, **item})


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no finite number")

"""Values from untrusted files: their size, type and range are checked before they are used.

Sizes and focal lengths are in px.  A function that raises, raises `FormatError` and nothing else; it names the file,
the entry and the field, and says what was expected and what was found.
"""

import json
import os
import reprlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import MAX_FOCAL
from aaplug.io.limits import whole_limit
from aaplug.system.errors import FormatError, printable, reason

Value = TypeVar("Value")

HEAD_LIMIT = 64 * 2**10  # bytes searched for keys when a format is guessed
MIN_LENGTH = 1e-6  # a shorter quaternion counts as no rotation
MIN_FOCAL = 1e-6  # px: far below any real lens; what is computed from it stays finite


@dataclass(frozen=True)
class Place:
    """The place of a value in a file, for error messages."""

    file: Path
    entry: str

    def error(self, problem: str) -> FormatError:
        """An error about the whole entry."""
        return FormatError(self.file, f"{self.entry}: {problem}")

    def wrong(self, field: str, expected: str, got: object) -> FormatError:
        """An error about one field."""
        return self.error(f"{field} should be {expected}, not {reprlib.repr(got)}")

    def expect(self, right: bool, field: str, expected: str, got: object) -> None:
        """Raise `wrong` unless the value of a field is right."""
        if not right:
            raise self.wrong(field, expected, got)


@dataclass(frozen=True)
class Entry:
    """One JSON object."""

    place: Place
    fields: dict[str, Any]

    def __contains__(self, field: str) -> bool:
        return field in self.fields

    def value(self, field: str) -> Any:
        """The field, unchecked."""
        if field not in self.fields:
            raise self.place.error(f"{field} is missing")
        return self.fields[field]

    def get(self, field: str, check: Callable[[object, Place, str], Value], default: Value | None = None) -> Value:
        """The field as `check`, one of the functions below, returns it; `default` where it is missing, unless None."""
        if default is not None and field not in self.fields:
            return default
        return check(self.value(field), self.place, field)

    def entry(self, field: str) -> "Entry":
        """A JSON object."""
        value = self.value(field)
        self.place.expect(isinstance(value, dict), field, "an object", value)
        return Entry(Place(self.place.file, field), value)

    def vector(self, field: str, length: int) -> Float[Tensor, " length"]:
        """A list of `length` finite numbers."""
        return torch.tensor(numbers(self.value(field), length, self.place, field), dtype=torch.float64)

    def matrix(self, field: str, rows: int, columns: int) -> Float[Tensor, "rows columns"]:
        """A list of rows, each a list of finite numbers."""
        value = self.value(field)
        right = isinstance(value, list) and len(value) == rows
        self.place.expect(right, field, f"{rows} rows of {columns} numbers", value)
        cells = [numbers(row, columns, self.place, field) for row in value]
        return torch.tensor(cells, dtype=torch.float64)


def number(value: object, place: Place, field: str) -> float:
    """`value` as a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise place.wrong(field, "a number", value)
    place.expect(abs(value) <= torch.finfo(torch.float64).max, field, "a finite number", value)
    return float(value)


def numbers(value: object, length: int, place: Place, field: str) -> list[float]:
    """`value` as a list of `length` finite numbers."""
    if not isinstance(value, list) or len(value) != length:
        raise place.wrong(field, f"{length} numbers", value)
    return [number(item, place, field) for item in value]


def focal(value: object, place: Place, field: str) -> float:
    """`value` as a focal length, in px."""
    real = number(value, place, field)
    place.expect(MIN_FOCAL <= real <= MAX_FOCAL, field, f"from {MIN_FOCAL:g} to {MAX_FOCAL:g} px", value)
    return real


def natural(value: object, place: Place, field: str, most: int, least: int = 0, unit: str = "") -> int:
    """`value` as a whole number from `least` to `most`, in a unit."""
    real = number(value, place, field)
    right = least <= real <= most and real.is_integer()
    place.expect(right, field, f"a whole number{unit} from {least} to {most}", value)
    return int(real)


def unit(quats: Float[Tensor, "n 4"], place: Place, field: str = "rotation") -> Float[Tensor, "n 4"]:
    """Quaternions of length 1."""
    lengths = quats.norm(dim=1, keepdim=True)
    wrong = ~((lengths > MIN_LENGTH) & lengths.isfinite())[:, 0]  # squares of large numbers are infinite
    place.expect(not wrong.any(), field, "finite and not zero", quats.tolist()[int(wrong.int().argmax())])
    return quats / lengths


def pixels(value: object, place: Place, field: str) -> int:
    """`value` as the side of an image, in px."""
    return natural(value, place, field, whole_limit("CAMERA_SIDE"), 1, " of px")


def text(value: object, place: Place, field: str) -> str:
    """`value` as printable text: no control characters reach a terminal or a path."""
    if not isinstance(value, str) or not value or printable(value) != value:
        raise place.wrong(field, "printable text", value)
    return value


def read_start(path: Path, size: int) -> bytes:
    """The first bytes of a file, or all if it has fewer."""
    return read_part(path, 0, size, short=True)


def start_of(path: Path, size: int = HEAD_LIMIT) -> bytes:
    """The first bytes of a file; none if it cannot be read.  Never raises."""
    try:
        return read_start(path, size)
    except FormatError:
        return b""


def read_part(path: Path, start: int, size: int, short: bool = False) -> bytes:
    """`size` bytes of a file from `start`; fewer are an error unless `short`."""
    if not os.path.isfile(path):  # reading a pipe would block
        raise FormatError(path, "is not an ordinary file" if os.path.exists(path) else "cannot be read: no such file")
    try:
        with path.open("rb") as file:
            file.seek(start)
            data = file.read(size)
    except OSError as error:
        raise FormatError(path, f"cannot be read: {reason(error)}") from error
    if len(data) < size and not short:
        raise FormatError(path, "was cut short while it was being read")
    return data


def visible(folder: Path) -> list[Path]:
    """What a folder holds, by name, without hidden files such as macOS's ._0001.jpg; nothing if it cannot be listed."""
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError:
        return []


def read_bounded(path: Path, limit: int) -> bytes:
    """The bytes of a file that is not longer than `limit`."""
    data = read_start(path, limit + 1)
    if len(data) > limit:
        raise FormatError(path, f"is longer than {limit} bytes, the limit for such a file")
    return data


def read_json(path: Path) -> Any:
    """A JSON document without NaN and Infinity."""
    return parse_json(read_bounded(path, whole_limit("JSON")), path)


def parse_json(data: bytes, path: Path) -> Any:
    """The JSON in these bytes of the file `path`."""

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is not a finite number")

    try:
        return json.loads(data.decode("utf-8-sig"), parse_constant=refuse)
    except (RecursionError, MemoryError) as error:
        raise FormatError(path, "its JSON is nested too deeply") from error
    except ValueError as error:
        raise FormatError(path, f"should be JSON: {error}") from error


def object_of(document: object, path: Path, entry: str, what: str, key: str | None = None) -> Entry:
    """A JSON document that should be an object with `what`, or at least with `key`."""
    if not isinstance(document, dict) or (key is not None and key not in document):
        raise FormatError(path, f"should be an object with {what}")
    return Entry(Place(path, entry), document)


def entries(path: Path, what: str, items: object, shared: dict[str, Any] | None = None) -> list[Entry]:
    """The objects of a JSON list, at least one; `shared` fields apply where an object does not have its own."""
    if not isinstance(items, list) or not items:
        raise FormatError(path, f"should hold a list of {what}s, at least one, not {reprlib.repr(items)}")
    places = [Place(path, f"{what} {i}") for i in range(len(items))]
    for place, item in zip(places, items, strict=True):
        place.expect(isinstance(item, dict), "it", "an object", item)
    return [Entry(place, {**(shared or {}), **item}) for place, item in zip(places, items, strict=True)]


def mentions(path: Path, keys: Sequence[str]) -> bool:
    """True if one of these JSON keys stands in the first bytes of the file; False if it cannot be read."""
    start = start_of(path)
    return any(f'"{key}"'.encode() in start for key in keys)

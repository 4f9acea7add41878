"""The header of a .ply file: read with bounds and checked before anything is allocated, and edited line by line.

A header is lines of text from "ply" to "end_header", here without line ends and empty lines.  Comments may use any
encoding: each byte is kept as one character.  The header declares elements (tables) of `count` rows; a row consists of
properties (columns): scalars, or lists with a stored length.  Sizes are in bytes.

Functions raise FormatError for a file that breaks its format.
"""

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from aaplug.io.limits import whole_limit
from aaplug.io.values import start_of
from aaplug.system.errors import MAX_VALUE_CHARACTERS, FormatError

MAX_COUNT_DIGITS = 18  # still an int64
ENCODING = "latin-1"  # one character per byte
LITTLE, BIG, TEXT = "binary_little_endian", "binary_big_endian", "ascii"
MIN_TEXT_SIZE = 2  # bytes of a value in text: a digit and a separator
PACKED = re.compile(rb"property\s+uint\w*\s+packed_position")  # in a .compressed.ply
CODES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip  # numpy's name of each type
LENGTHS = [[], *(["list", kind] for kind in CODES)]  # words before a column's type: of a scalar, and of a list


@dataclass(frozen=True)
class Element:
    """A table.

    codes: numpy's name of each column's type, of a list that of its stored length.  lists: the columns that are lists.
    """

    name: str
    count: int
    codes: dict[str, str] = field(default_factory=dict)
    lists: list[str] = field(default_factory=list)

    @property
    def dtype(self) -> np.dtype:
        """A row in a little-endian file, all lists empty."""
        return np.dtype([(name, f"<{code}") for name, code in self.codes.items()])

    @property
    def least_size(self) -> int:
        """Size of the table if all lists are empty."""
        return self.count * self.dtype.itemsize


@dataclass(frozen=True)
class Header:
    """A header's lines and what they declare.  path: for messages.  coding: LITTLE, BIG or TEXT.  size: in its file."""

    path: str
    lines: tuple[str, ...]
    newline: str
    elements: tuple[Element, ...]
    coding: str
    size: int

    @cached_property
    def content(self) -> bytes:
        """The lines with their ends."""
        return "".join(line + self.newline for line in self.lines).encode(ENCODING)

    @property
    def comments(self) -> list[str]:
        """The comments, in order, without the word "comment"."""
        return [_comment(line) for line in self.lines if _keyword(line) == "comment"]

    @property
    def vertex(self) -> Element:
        """The table of Gaussians."""
        for element in self.elements:
            if element.name == "vertex":
                return element
        raise FormatError(self.path, "has no element 'vertex'; is it a Gaussian splatting scene?")

    def start_of(self, element: Element) -> int:
        """Where a table begins in the file, if the tables before it have no lists."""
        return self.size + sum(e.least_size for e in self.elements[: self.elements.index(element)])

    def commented(self, added: Iterable[str], dropped: Collection[re.Pattern[str]] = ()) -> "Header":
        """The header without comments of these patterns, and with others before the first element."""
        unwanted = {c for c in self.comments if any(pattern.fullmatch(c) for pattern in dropped)}
        lines = [x for x in self.lines if _keyword(x) != "comment" or _comment(x) not in unwanted]
        first = next(i for i, x in enumerate(lines) if _keyword(x) in ("element", "end_header"))
        lines[first:first] = [f"comment {comment}" for comment in added]
        return parse(self.path, lines, self.newline)

    def rewritten(self, count: int | str, dropped: Collection[str] = (), added: Iterable[str] = ()) -> "Header":
        """The header of a little-endian file with `count` vertices, without some columns, with others (float) added."""
        lines: list[str] = []
        inside = False
        for line in self.lines:
            words = line.split()
            if inside and words[:1] in (["element"], ["end_header"]):
                lines += [f"property float {name}" for name in added]
            if words[:1] == ["element"]:
                inside = words[1] == "vertex"
                line = re.sub(r"(vertex\s+)\d+", rf"\g<1>{count}", line) if inside else line
            if words[:1] == ["format"]:
                line = f"format {LITTLE} 1.0"
            if not (inside and words[:1] == ["property"] and words[-1] in dropped):
                lines.append(line)
        return parse(self.path, lines, self.newline)


def read_header(path: Path) -> Header:
    """Read and check the header, within the limits HEADER and HEADER_LINES."""
    most, most_lines = whole_limit("HEADER"), whole_limit("HEADER_LINES")
    with path.open("rb") as stream:
        head = stream.read(most)
    newline = b"\r\n" if head.startswith(b"ply\r\n") else b"\n"
    if not head.startswith(b"ply" + newline):
        raise FormatError(path, "is not a .ply file: its first line is not 'ply'")
    last = newline + b"end_header"
    end = head.find(last + newline)
    if end < 0:
        where = f"in its first {most:,} bytes" if len(head) == most else "in the file"
        raise FormatError(path, f"no line 'end_header' {where}; it is cut short or not a .ply")
    lines = (head[:end] + last).split(newline)
    if len(lines) > most_lines:
        raise FormatError(path, f"the header has {len(lines)} lines, more than the {most_lines} allowed")
    decoded = (line.decode(ENCODING) for line in lines if line)
    return parse(str(path), decoded, newline.decode(), end + len(last + newline))


def is_packed(path: Path) -> bool:
    """True if a .ply's header declares the packed words of a .compressed.ply.  Never raises."""
    return bool(PACKED.search(start_of(path, whole_limit("HEADER")).partition(b"end_header")[0]))


def parse(path: str, lines: Iterable[str], newline: str, size: int | None = None) -> Header:
    """Parse a header's lines; `size` is that of the header in its file."""
    lines = tuple(lines)
    elements, formats = dict[str, Element](), list[list[str]]()
    for number, line in enumerate(lines[1:-1], start=2):
        match line.split():
            case ["comment" | "obj_info", *_] | []:
                pass
            case _ if not line.isascii():
                raise FormatError(path, f"line {number} of the header is not ASCII: {line[:MAX_VALUE_CHARACTERS]!r}")
            case ["format", *words]:
                formats.append(words)
            case ["element", name, count]:
                if not re.fullmatch(r"\d+", count, re.ASCII) or len(count) > MAX_COUNT_DIGITS:
                    got = repr(count[:MAX_VALUE_CHARACTERS])
                    raise FormatError(path, f"element {name!r} has the impossible count {got}")
                if name in elements:
                    raise FormatError(path, f"element {name!r} is declared twice")
                elements[name] = Element(name, int(count))
            case ["property", *length, kind, column] if elements and kind in CODES and length in LENGTHS:
                *_, element = elements.values()
                if column in element.codes:
                    raise FormatError(path, f"property of {element.name} {column!r} is declared twice")
                element.codes[column] = CODES[length[-1] if length else kind]
                element.lists.extend([column] if length else [])
            case _:
                raise FormatError(path, f"line {number} of the header is not PLY: {line[:MAX_VALUE_CHARACTERS]!r}")
    coding = next((coding for coding in (LITTLE, BIG, TEXT) if formats == [[coding, "1.0"]]), None)
    if coding is None:
        words = " and ".join(" ".join(words)[:MAX_VALUE_CHARACTERS] for words in formats) or "none"
        raise FormatError(path, f"its format is {words}; known are {LITTLE}, {BIG} and {TEXT}, each 1.0")
    size = sum(len(line + newline) for line in lines) if size is None else size
    return Header(path, lines, newline, tuple(elements.values()), coding, size)


def check_size(header: Header, actual: int) -> None:
    """Compare the file's size with what the header promises, before anything is allocated."""
    if header.coding == TEXT:
        least = header.size + sum(e.count * len(e.codes) * MIN_TEXT_SIZE for e in header.elements)
        if actual < least - 1:  # the last line may lack its line end
            need = f"the values that its header promises need {least:,} bytes at least"
            raise FormatError(header.path, f"is cut short: {need}, and it has {actual:,}")
        return
    least = header.size + sum(e.least_size for e in header.elements)
    if actual < least:
        vertex = header.vertex
        room = (actual - header.start_of(vertex)) // max(1, vertex.dtype.itemsize)
        what = f"its header promises {least:,} bytes and it has {actual:,}"
        whole = f"{max(0, min(vertex.count, room)):,} of {vertex.count:,} Gaussians are whole"
        raise FormatError(header.path, f"is cut short: {what}; {whole}; get the file again")
    if actual > least and not any(e.lists for e in header.elements):
        what = f"has {actual - least:,} bytes more than the {least:,} its header promises"
        raise FormatError(header.path, f"{what}; it is damaged or was padded, cut it to that size if you trust it")


def _keyword(line: str) -> str:
    return (line.split(None, 1) or [""])[0]


def _comment(line: str) -> str:
    return line.strip()[len("comment") :].strip()

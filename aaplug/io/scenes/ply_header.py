"""A .ply file's header: a bounded look before anything is allocated, and edits that keep the rest.

A header is lines of ASCII from "ply" to "end_header", here without their line ends.  It declares
elements (tables) of `count` rows, each row made of properties (columns): scalars, or lists of a
stored length.  Sizes are in bytes.
"""

import re
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from aaplug.errors import FormatError

MAX_HEADER = 128 * 1024  # bytes; a scene's header has about 2 KB
MAX_LINES = 1000  # a scene's header has about 70
MAX_COUNT_DIGITS = 18  # still an int64
MAX_SHOWN = 60  # characters of an offending line in a message
FORMAT = ["binary_little_endian", "1.0"]
CODES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip  # numpy's name of each type; its digit is the size


@dataclass(frozen=True)
class Property:
    """A column: its values' type and, for lists, the type of their stored length."""

    name: str
    code: str
    length_code: str | None = None

    @property
    def least_size(self) -> int:
        """Size of the value, or of an empty list."""
        return int((self.length_code or self.code)[1:])


@dataclass(frozen=True)
class Element:
    """A table."""

    name: str
    count: int
    properties: tuple[Property, ...] = ()

    @property
    def stride(self) -> int:
        """Size of a row, lists counted as empty."""
        return sum(p.least_size for p in self.properties)

    @property
    def least_size(self) -> int:
        """Size of the table, lists counted as empty."""
        return self.count * self.stride

    @property
    def lists(self) -> list[str]:
        """Names of the columns that hold lists."""
        return [p.name for p in self.properties if p.length_code]

    @property
    def names(self) -> list[str]:
        """Names of all columns."""
        return [p.name for p in self.properties]


@dataclass(frozen=True)
class Header:
    """The header's lines as they stand in the file `path`, and what they declare."""

    path: str
    lines: tuple[str, ...]
    newline: str
    elements: tuple[Element, ...]

    @cached_property
    def text(self) -> str:
        """All of it, up to the last line's end."""
        return "".join(line + self.newline for line in self.lines)

    @property
    def comments(self) -> list[str]:
        """The comments' words, in order."""
        return [_comment(line) for line in self.lines if _keyword(line) == "comment"]

    @property
    def vertex(self) -> Element:
        """The table of Gaussians.

        Raises:
            FormatError: there is none.
        """
        for element in self.elements:
            if element.name == "vertex":
                return element
        raise FormatError(self.path, "has no element 'vertex'; is it a Gaussian splatting scene?")

    def without_comments(self, unwanted: Callable[[str], object]) -> "Header":
        """The header less the comments for which `unwanted` holds."""
        kept = (x for x in self.lines if _keyword(x) != "comment" or not unwanted(_comment(x)))
        return parse(self.path, kept, self.newline)

    def with_comments(self, comments: Iterable[str]) -> "Header":
        """The header with comments added before the first element."""
        first = next(
            i for i, x in enumerate(self.lines) if _keyword(x) in ("element", "end_header")
        )
        added = [f"comment {comment}" for comment in comments]
        return parse(self.path, [*self.lines[:first], *added, *self.lines[first:]], self.newline)

    def with_vertex(self, count: int, dropped: Collection[str], added: Iterable[str]) -> "Header":
        """The header with `count` vertices, columns `dropped`, and float columns `added` last."""
        lines: list[str] = []
        inside = False
        for line in self.lines:
            words = line.split()
            if inside and words[:1] in (["element"], ["end_header"]):
                lines += [f"property float {name}" for name in added]
            if words[:1] == ["element"]:
                inside = words[1] == "vertex"
                line = re.sub(r"(vertex\s+)\d+", rf"\g<1>{count}", line) if inside else line
            if not (inside and words[:1] == ["property"] and words[-1] in dropped):
                lines.append(line)
        return parse(self.path, lines, self.newline)


def read_header(path: Path) -> Header:
    """Read and check the header, looking at no more than 128 KiB of the file.

    Raises:
        FormatError: it is not a header, ends nowhere, or declares something twice or impossible.
    """
    with path.open("rb") as stream:
        head = stream.read(MAX_HEADER)
    newline = b"\r\n" if head.startswith(b"ply\r\n") else b"\n"
    if not head.startswith(b"ply" + newline):
        raise FormatError(path, "is not a .ply file: its first line is not 'ply'")
    end = head.find(newline + b"end_header" + newline)
    if end < 0:
        where = f"in its first {MAX_HEADER:,} bytes" if len(head) == MAX_HEADER else "in the file"
        raise FormatError(path, f"no line 'end_header' {where}; it is cut short or no .ply")
    lines = (head[:end] + newline + b"end_header").split(newline)
    if len(lines) > MAX_LINES:
        raise FormatError(
            path, f"the header has {len(lines)} lines, more than the {MAX_LINES} allowed"
        )
    return parse(str(path), _plain(path, lines), newline.decode())


def parse(path: str, lines: Iterable[str], newline: str) -> Header:
    """Understand a header's lines.

    Raises:
        FormatError: a line is not PLY, or a count, type or name is impossible or appears twice.
    """
    lines = tuple(lines)
    elements: list[Element] = []
    formats: list[list[str]] = []
    for number, line in enumerate(lines[1:-1], start=2):
        match line.split():
            case ["comment" | "obj_info", *_]:
                pass
            case [] if line:  # spaces only; plyfile takes an empty line for the file's end
                pass
            case ["format", *words]:
                formats.append(words)
            case ["element", name, count]:
                elements.append(Element(name, _count(path, name, count)))
            case ["property", *words] if elements and (column := _property(words)):
                grown = (*elements[-1].properties, column)
                elements[-1] = Element(elements[-1].name, elements[-1].count, grown)
            case _:
                raise FormatError(
                    path, f"line {number} of the header is not PLY: {line[:MAX_SHOWN]!r}"
                )
    _check_format(path, formats)
    _check_unique(path, elements)
    return Header(path, lines, newline, tuple(elements))


def check_size(header: Header, actual: int) -> None:
    """Compare the file's size with what the header promises; nothing is allocated for a lie.

    Raises:
        FormatError: the file is shorter or longer.
    """
    least = len(header.text) + sum(e.least_size for e in header.elements)
    if actual < least:
        whole, promised = _whole_rows(header, actual), header.vertex.count
        raise FormatError(
            header.path,
            f"is cut short: its header promises {least:,} bytes and it has {actual:,}; "
            f"{whole:,} of {promised:,} Gaussians are whole; get the file again",
        )
    if actual > least and not any(e.lists for e in header.elements):
        raise FormatError(
            header.path,
            f"has {actual - least:,} bytes more than the {least:,} its header promises; "
            "it is damaged or was padded, cut it to that size if you trust it",
        )


def _whole_rows(header: Header, actual: int) -> int:
    before = header.elements[: header.elements.index(header.vertex)]
    room = actual - len(header.text) - sum(e.least_size for e in before)
    return max(0, min(header.vertex.count, room // max(1, header.vertex.stride)))


def _keyword(line: str) -> str:
    return (line.split(None, 1) or [""])[0]


def _comment(line: str) -> str:
    return line.strip()[len("comment") :].strip()


def _plain(path: Path, lines: list[bytes]) -> list[str]:
    for number, line in enumerate(lines, start=1):
        if not line.isascii():
            raise FormatError(
                path,
                f"line {number} of the header is not ASCII; replace those letters by plain ones",
            )
    return [line.decode("ascii") for line in lines]


def _count(path: str, name: str, count: str) -> int:
    if not re.fullmatch(r"\d+", count, re.ASCII) or len(count) > MAX_COUNT_DIGITS:
        raise FormatError(path, f"element {name!r} has the impossible count {count[:MAX_SHOWN]!r}")
    return int(count)


def _property(words: list[str]) -> Property | None:
    match words:
        case ["list", length, kind, name] if length in CODES and kind in CODES:
            return Property(name, CODES[kind], CODES[length])
        case [kind, name] if kind in CODES:
            return Property(name, CODES[kind])
    return None


def _check_format(path: str, formats: list[list[str]]) -> None:
    if formats != [FORMAT]:
        found = " and ".join(" ".join(words)[:MAX_SHOWN] for words in formats) or "none"
        raise FormatError(
            path,
            f"its format is {found}; only {' '.join(FORMAT)} is supported yet: "
            "convert it, for example with splat-transform",
        )


def _check_unique(path: str, elements: list[Element]) -> None:
    names = [("element", e.name) for e in elements]
    names += [(f"property of {e.name}", name) for e in elements for name in e.names]
    seen: set[tuple[str, str]] = set()
    for kind, name in names:
        if (kind, name) in seen:
            raise FormatError(path, f"{kind} {name!r} is declared twice")
        seen.add((kind, name))

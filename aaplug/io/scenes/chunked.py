"""Indexes of scenes in chunks, of which the finest level is read: PlayCanvas's streamed SOG and XGRIDS' LCC2.

lod-meta.json, version 1 (developer.playcanvas.com, "The Streamed SOG Format"): names of unbundled SOGs, and a tree.
The `lods` of a node tell for each level the number of the file, and which of its rows are the node's.

.lcc2 (developer.playcanvas.com, "The LCC2 Format"; github.com/xgrids/LCC2Whitepaper): names of .sog or .spz, and a tree
whose leaves hold the finest level.

Both may name a file of far splats, the environment, which belongs to every level.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from aaplug.core.gaussians import Gaussians
from aaplug.io.gltf import natural
from aaplug.io.limits import whole_limit
from aaplug.io.scenes import sog, spz
from aaplug.io.scenes.lcc import CREDIT, turned_from_z_up
from aaplug.io.scenes.options import SceneFileOptions
from aaplug.io.scenes.packed import rows_of
from aaplug.io.scenes.rows import check_count, library_errors
from aaplug.io.scenes.scene import Scene
from aaplug.io.values import Entry, Place, object_of, parse_json, read_bounded, read_start, text
from aaplug.system.errors import FormatError, counted

HEAD_BYTES = 64  # of a chunk, which tell its format
TRAILING_COMMA = re.compile(rb",(\s*[}\]])")  # some writers of .lcc2 leave one at the end of a list


@dataclass(frozen=True)
class Stretch:
    """Rows of a file: its number, the first row, and how many; None for all."""

    file: int
    start: int
    count: int | None


class Listing(NamedTuple):
    """What an index names: files, stretches of the finest level, and the file of far splats."""

    files: list[str]
    stretches: list[Stretch]
    environment: str | None


@dataclass(frozen=True)
class Rows:
    """Rows of a chunk, as `rows_of` joins them."""

    chunk: Scene
    start: int
    count: int

    def load(self, start: int, stop: int) -> Gaussians:
        """Those from start up to stop."""
        return self.chunk.load(self.start + start, self.start + stop)


@dataclass(frozen=True)
class ChunkedFormat:
    """Indexes of one suffix.

    listing: reads the root.  turned: puts the scene into OpenCV's axes.
    """

    name: str
    listing: Callable[[Entry], Listing]
    turned: Callable[[Gaussians], Gaussians] = lambda scene: scene
    notes: tuple[str, ...] = ()

    def sniff(self, path: Path, head: bytes) -> bool:
        """True for JSON whose name ends so."""
        return f".{path.name.lower()}".endswith(f".{self.name}") and head.lstrip().startswith(b"{")

    def open_scene(self, path: Path, options: SceneFileOptions) -> Scene:
        """The finest level and the far splats; see `SceneFormat`."""
        with library_errors(path):
            data = TRAILING_COMMA.sub(rb"\1", read_bounded(path, whole_limit("JSON")))
            listing = self.listing(object_of(parse_json(data, path), path, "its tree", "a tree of chunks"))
            numbers = sorted({stretch.file for stretch in listing.stretches})
            chunks = {number: _chunk(path, listing.files[number], options) for number in numbers}
            pieces = [_rows(path, chunks[stretch.file], stretch) for stretch in listing.stretches]
            count, held = (sum(each.count for each in several) for several in (pieces, chunks.values()))
            if count > held or not chunks:
                raise FormatError(path, f"names {count:,} Gaussians in files that hold {held:,}")
            opened = [*chunks.values()]
            if listing.environment is not None:
                opened.append(_chunk(path, listing.environment, options))
                pieces.append(Rows(opened[-1], 0, opened[-1].count))
        first, count = opened[0], sum(piece.count for piece in pieces)
        check_count(path, count)
        for chunk in opened:
            if (chunk.convention, chunk.fused, chunk.flat) != (first.convention, first.fused, first.flat):
                raise FormatError(path, f"names files of several rules of drawing: {first.path}, {chunk.path}")
        degree = max(chunk.sh_degree for chunk in opened)
        others = tuple(file for chunk in opened for file in (chunk.path, *chunk.others) if file is not None)
        notes = (f"the finest level, in {counted(len(chunks), 'file')}", *self.notes)

        def load(start: int, stop: int) -> Gaussians:
            return self.turned(rows_of(pieces, degree, start, stop))

        said = {"convention": first.convention, "fused": first.fused, "flat": first.flat, "others": others}
        return Scene(path, self.name, count, degree, load, first.evidence, notes=notes, **said)


def _chunk(path: Path, name: str, options: SceneFileOptions) -> Scene:
    """A file of Gaussians in the folder of the index."""
    file = path.parent / name
    if not file.resolve().is_relative_to(path.parent.resolve()):
        raise FormatError(path, f"names {name!r}, which leads out of its folder")
    head = read_start(file, HEAD_BYTES)
    if sog.sniff(file, head):
        return sog.open_scene(file, options)
    if spz.sniff(file, head):
        axes = "opencv" if options.spz_axes == "auto" else options.spz_axes  # as those of SOGs in such an index
        return spz.open_scene(file, replace(options, spz_axes=axes))
    raise FormatError(path, f"names {name!r}, which is neither a SOG nor a .spz")


def _rows(path: Path, chunk: Scene, stretch: Stretch) -> Rows:
    start, left = stretch.start, chunk.count - stretch.start
    count = left if stretch.count is None else stretch.count
    if not 0 <= count <= left:
        raise FormatError(path, f"names {count:,} rows from {start:,} of {chunk.path}, which has {chunk.count:,}")
    return Rows(chunk, start, count)


def _nodes(root: Entry, children: str) -> Iterator[tuple[Entry, bool]]:
    """The nodes of a tree, and whether each is a leaf, in the order of the file."""
    waiting = [root]
    while waiting:
        node = waiting.pop()
        below = node.fields.get(children) or []
        below = [*below.values()] if isinstance(below, dict) else below
        right = isinstance(below, list) and all(isinstance(each, dict) for each in below)
        node.place.expect(right, children, "a list of nodes", below)
        yield node, not below
        waiting += [Entry(node.place, each) for each in reversed(below)]


def _names(value: object, place: Place, field: str) -> list[str]:
    place.expect(isinstance(value, list), field, "a list of files", value)
    return [text(each, place, field) for each in value] if isinstance(value, list) else []


def _stretch(entry: Entry, key: str, start: str, files: list[str]) -> Stretch:
    most, place = whole_limit("GAUSSIANS"), entry.place
    first = natural(entry.fields.get(start, 0), place, start, most)
    count = natural(entry.value("count"), place, "count", most) if "count" in entry else None
    return Stretch(natural(entry.value(key), place, key, len(files) - 1), first, count)


def _streamed_sog(root: Entry) -> Listing:
    version, files = root.value("version"), root.get("filenames", _names)
    root.place.expect(version == 1, "version", "1", version)
    levels = [node.entry("lods") for node, _ in _nodes(root.entry("tree"), "children") if "lods" in node]
    stretches = [_stretch(level.entry("0"), "file", "offset", files) for level in levels if "0" in level]
    environment = root.get("environment", text) if "environment" in root else None
    return Listing(files, stretches, environment)


def _lcc2(root: Entry) -> Listing:
    tree = root.entry("root")
    files = tree.get("splatFiles" if "splatFiles" in tree else "files", _names)
    held = [node.entry("data") for node, leaf in _nodes(tree, "child") if leaf and "data" in node]
    stretches = [_stretch(data.entry("3dgs"), "name", "start", files) for data in held if "3dgs" in data]
    far = tree.entry("data") if "data" in tree else tree
    number = natural(far.entry("env").value("name"), tree.place, "env", len(files) - 1) if "env" in far else None
    return Listing(files, stretches, None if number is None else files[number])


FORMATS = (ChunkedFormat("lod-meta.json", _streamed_sog), ChunkedFormat("lcc2", _lcc2, turned_from_z_up, (CREDIT,)))

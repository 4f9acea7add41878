"""Indexes of scenes in chunks, of which the finest level is read: PlayCanvas's streamed SOG and XGRIDS' LCC2.

lod-meta.json, version 1 (developer.playcanvas.com, "The Streamed SOG Format"): names of unbundled SOGs, and a tree.
The `lods` of a node tell for each level the number of the file, and which of its rows are the node's.

.lcc2 (developer.playcanvas.com, "The LCC2 Format"; github.com/xgrids/LCC2Whitepaper): names of .sog or .spz, and a tree
whose leaves hold the finest level.

Both may name a file of far splats, the environment, which belongs to every level.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from aaplug.core.gaussians import Gaussians
from aaplug.io import STREAM_INDEXES
from aaplug.io.limits import whole_limit
from aaplug.io.scenes import sog, spz
from aaplug.io.scenes.lcc import CREDIT, turned_from_z_up
from aaplug.io.scenes.packed import Piece, in_a_row
from aaplug.io.scenes.rows import HEAD_BYTES, SceneFileOptions, check_count, library_errors
from aaplug.io.scenes.scene import Scene
from aaplug.io.values import Entry, Place, natural, object_of, parse_json, read_bounded, read_start, text
from aaplug.system.errors import FormatError, counted

TRAILING_COMMA = re.compile(rb",(\s*[}\]])")  # some writers of .lcc2 leave one at the end of a list


@dataclass
class Chunks:
    """The files that an index names, each of which is opened once, in its folder."""

    path: Path
    options: SceneFileOptions
    opened: dict[Path, Scene] = field(default_factory=dict)

    def open(self, name: str) -> Scene:
        """One file, however its name is spelt."""
        file = self.path.parent / name
        place = file.resolve()
        if place in self.opened:
            return self.opened[place]
        if not place.is_relative_to(self.path.parent.resolve()):
            raise FormatError(self.path, f"names {name!r}, which leads out of its folder")
        head = read_start(file, HEAD_BYTES)
        format = next((each for each in (sog, spz) if each.sniff(file, head)), None)
        if format is None:
            raise FormatError(self.path, f"names {name!r}, which is neither a SOG nor a .spz")
        axes = "opencv" if self.options.spz_axes == "auto" else self.options.spz_axes  # SOGs' in such an index
        self.opened[place] = format.open_scene(file, replace(self.options, spz_axes=axes))
        check_count(self.path, sum(chunk.count for chunk in self.opened.values()))  # before more are unpacked
        return self.opened[place]

    def rows(self, names: list[str], entry: Entry, key: str, start: str) -> Piece:
        """The rows that an entry names by the number of the file, their first one and how many, or all from there."""
        chunk = self.open(names[natural(entry.value(key), entry.place, key, len(names) - 1)])
        first = natural(entry.fields.get(start, 0), entry.place, start, chunk.count)
        left = chunk.count - first
        count = natural(entry.fields.get("count", left), entry.place, "count", left)
        return Piece(count, chunk.sh_degree, lambda start, stop: chunk.load(first + start, first + stop))


@dataclass(frozen=True)
class ChunkedFormat:
    """Indexes of one suffix.

    pieces: of the finest level and the environment, from the root.  turned: puts the scene into OpenCV's axes.
    """

    name: str
    pieces: Callable[[Entry, Chunks], list[Piece]]
    turned: Callable[[Gaussians], Gaussians] = lambda scene: scene
    notes: tuple[str, ...] = ()

    def sniff(self, path: Path, head: bytes) -> bool:
        """True for JSON whose name ends so."""
        return f".{path.name.lower()}".endswith(f".{self.name}") and head.lstrip().startswith(b"{")

    def open_scene(self, path: Path, options: SceneFileOptions) -> Scene:
        """The finest level and the environment; see `SceneFormat`."""
        with library_errors(path):
            data, chunks = TRAILING_COMMA.sub(rb"\1", read_bounded(path, whole_limit("JSON"))), Chunks(path, options)
            pieces = self.pieces(object_of(parse_json(data, path), path, "its tree", "a tree of chunks"), chunks)
        opened, rows = [*chunks.opened.values()], in_a_row(pieces)
        held = sum(chunk.count for chunk in opened)
        if rows.length > held or not opened:
            raise FormatError(path, f"names {rows.length:,} Gaussians in files that hold {held:,}")
        first = opened[0]
        for chunk in opened:
            if (chunk.convention, chunk.fused, chunk.flat) != (first.convention, first.fused, first.flat):
                raise FormatError(path, f"names files of several rules of drawing: {first.path}, {chunk.path}")
        others = tuple(file for chunk in opened for file in chunk.files)
        notes = (f"the finest level, in {counted(len(opened), 'file')}", *self.notes)
        turned = rows._replace(load=lambda start, stop: self.turned(rows.load(start, stop)))
        facts = first.evidence, first.convention, first.fused, first.flat
        return Scene(path, self.name, *turned, *facts, notes=notes, others=others)


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


def _streamed_sog(root: Entry, chunks: Chunks) -> list[Piece]:
    version, names = root.value("version"), root.get("filenames", _names)
    root.place.expect(version == 1, "version", "1", version)
    levels = [node.entry("lods") for node, _ in _nodes(root.entry("tree"), "children") if "lods" in node]
    pieces = [chunks.rows(names, level.entry("0"), "file", "offset") for level in levels if "0" in level]
    if "environment" in root:
        far = chunks.open(root.get("environment", text))
        pieces.append(Piece(far.count, far.sh_degree, far.load))
    return pieces


def _lcc2(root: Entry, chunks: Chunks) -> list[Piece]:
    tree = root.entry("root")
    names = tree.get("splatFiles" if "splatFiles" in tree else "files", _names)
    leaves = [node.entry("data") for node, leaf in _nodes(tree, "child") if leaf and "data" in node]
    pieces = [chunks.rows(names, data.entry("3dgs"), "name", "start") for data in leaves if "3dgs" in data]
    far = tree.entry("data") if "data" in tree else tree
    return [*pieces, chunks.rows(names, far.entry("env"), "name", "start")] if "env" in far else pieces


FORMATS = (
    ChunkedFormat(STREAM_INDEXES["sog"], _streamed_sog),
    ChunkedFormat("lcc2", _lcc2, turned_from_z_up, (CREDIT,)),
)

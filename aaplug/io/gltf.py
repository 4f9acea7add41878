"""glTF 2.0, .gltf and .glb: the document with its buffers and accessors, of cameras and of scenes.

Buffers lie in the file itself or in files of its folder, never beyond, and are read part by part: a document takes no
more memory than its JSON.  Every function raises FormatError for a file that breaks its format.
"""

import base64
import binascii
import json
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.projection import rotation_matrices
from aaplug.io.limits import whole_limit
from aaplug.io.values import Entry, Place, entries, natural, object_of, parse_json, read_bounded, read_part, text, unit
from aaplug.system.errors import FormatError

MAGIC, VERSION, JSON_CHUNK, BINARY_CHUNK = b"glTF", 2, 0x4E4F534A, 0x004E4942
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<II")
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}  # by componentType
FLOAT = 5126
PARTS = {"translation": 3, "rotation": 4, "scale": 3}  # of a node's transform, with their numbers


@dataclass(frozen=True)
class Buffer:
    """A stretch of a file, or of bytes in memory."""

    path: Path
    size: int
    start: int = 0
    held: bytes | None = None

    def read(self, start: int, size: int) -> bytes:
        """`size` bytes from `start`, which lie in the buffer."""
        at = self.start + start
        return read_part(self.path, at, size) if self.held is None else self.held[at : at + size]


Table = tuple[int, Callable[[int, int], np.ndarray]]  # its rows, and what reads those from start up to stop as float32


class Gltf:
    """The document of a file."""

    def __init__(self, path: Path) -> None:
        start = read_part(path, 0, HEADER.size, short=True)
        self.path, self.binary = path, Buffer(path, 0)
        if start.startswith(MAGIC):
            chunks = dict(reversed(list(_chunks(path))))  # the first of a kind counts
            if JSON_CHUNK not in chunks:
                raise FormatError(path, "should hold a JSON chunk, as .glb files do")
            self.binary = chunks.get(BINARY_CHUNK, self.binary)
            if chunks[JSON_CHUNK].size > whole_limit("JSON"):
                raise FormatError(path, f"has a JSON chunk longer than {whole_limit('JSON')} bytes, the limit for one")
            data = chunks[JSON_CHUNK].read(0, chunks[JSON_CHUNK].size)
        else:
            data = read_bounded(path, whole_limit("JSON"))
        self.root = object_of(parse_json(data, path), path, "it", "'asset', as glTF has", "asset")
        version = self.root.entry("asset").get("version", text)
        self.root.place.expect(version.startswith("2."), "asset.version", "2", version)
        self.files, self._lists = list[Path](), dict[str, list[Entry]]()  # files beside it, that were read
        self._buffers, self._numbers = dict[Place, Buffer](), 0  # that were looked for; read into memory

    def items(self, key: str) -> list[Entry]:
        """The objects of a list of the document."""
        if key not in self._lists:
            self._lists[key] = entries(self.path, key, self.root.value(key)) if key in self.root else []
        return self._lists[key]

    def item(self, key: str, owner: Entry, field: str) -> Entry:
        """The object that a field points to."""
        items = self.items(key)
        return items[natural(owner.value(field), owner.place, field, len(items) - 1)]

    def view(self, owner: Entry, field: str = "bufferView") -> tuple[Buffer, Entry]:
        """The bytes of the buffer view that a field names, and its entry."""
        view = self.item("bufferViews", owner, field)
        view.place.expect("extensions" not in view, "extensions", "none", view.fields.get("extensions"))
        entry = self.item("buffers", view, "buffer")
        if entry.place not in self._buffers:
            self._buffers[entry.place] = self._buffer(entry)
        buffer = self._buffers[entry.place]
        start = natural(view.fields.get("byteOffset", 0), view.place, "byteOffset", buffer.size)
        size = natural(view.value("byteLength"), view.place, "byteLength", buffer.size - start)
        return Buffer(buffer.path, size, buffer.start + start, buffer.held), view

    def accessor(self, owner: Entry, field: str, kind: str, types: tuple[int, ...] = (FLOAT,)) -> Table:
        """The table of numbers that a field names, of this type, dense, with one of these component types."""
        entry = self.item("accessors", owner, field)
        component, normalized = entry.fields.get("componentType"), entry.fields.get("normalized", False)
        right = entry.fields.get("type") == kind and component in types and "sparse" not in entry
        what = f"a dense {kind} with a componentType of {', '.join(map(str, types))}"
        entry.place.expect(right and isinstance(normalized, bool), field, what, entry.fields)
        assert isinstance(component, int)
        buffer, view = self.view(entry)
        dtype, width = np.dtype(TYPES[component]), WIDTHS[kind]
        item = width * dtype.itemsize
        stride = natural(view.fields.get("byteStride", item), view.place, "byteStride", 252)
        start = natural(entry.fields.get("byteOffset", 0), entry.place, "byteOffset", buffer.size)
        count = natural(entry.value("count"), entry.place, "count", buffer.size)
        inside = count > 0 and stride >= item and start + (count - 1) * stride + item <= buffer.size
        entry.place.expect(inside, field, f"values inside its {buffer.size:,} bytes", entry.fields)

        def read(first: int, stop: int) -> np.ndarray:
            if first >= stop:
                return np.zeros((0, width), np.float32)
            data = buffer.read(start + first * stride, (stop - first - 1) * stride + item)
            table = np.ndarray((stop - first, width), dtype, data, 0, (stride, dtype.itemsize)).astype(np.float32)
            return np.maximum(table / np.iinfo(dtype).max, -1) if normalized and component != FLOAT else table

        return count, read

    def numbers(self, owner: Entry, field: str, kind: str) -> Float[Tensor, "n c"]:
        """The finite numbers of the accessor that a field names, all in float64; rotations may be integers.

        Accessors may share their bytes, so that what is read from a document has a limit in all.
        """
        count, read = self.accessor(owner, field, kind, tuple(TYPES) if kind == "VEC4" else (FLOAT,))
        most, place = whole_limit("JSON") // 4, self.item("accessors", owner, field).place
        self._numbers += count * WIDTHS[kind]
        place.expect(self._numbers <= most, "count", f"at most {most:,} numbers in all", count)
        values = read(0, count)
        place.expect(bool(np.isfinite(values).all()), "it", "finite", "NaN or infinity")
        return torch.from_numpy(values.astype(np.float64))

    @cached_property
    def parents(self) -> dict[int, int | None]:
        """The node above each node, None above a root; every node stands after the one above it."""
        nodes = self.items("nodes")
        parents: dict[int, int | None] = dict.fromkeys(range(len(nodes)))
        for above, node in enumerate(nodes):
            children = node.fields.get("children", [])
            node.place.expect(isinstance(children, list), "children", "a list of nodes", children)
            parents |= {natural(child, node.place, "children", len(nodes) - 1): above for child in children}
        graph = {node: () if parent is None else (parent,) for node, parent in parents.items()}
        try:
            return {node: parents[node] for node in TopologicalSorter(graph).static_order()}
        except CycleError as error:
            raise FormatError(self.path, "its nodes lie in a circle") from error

    def _buffer(self, buffer: Entry) -> Buffer:
        if "uri" not in buffer:
            return self.binary
        address = buffer.get("uri", text)
        if address.startswith("data:"):
            try:
                held = base64.b64decode(address.partition(",")[2], validate=True)
            except (binascii.Error, ValueError) as error:
                raise buffer.place.wrong("uri", "Base64", address[:40]) from error
            return Buffer(self.path, len(held), 0, held)
        try:
            file, home = (self.path.parent / unquote(address)).resolve(), self.path.parent.resolve()
            beside = "://" not in address and file.is_relative_to(home)
            buffer.place.expect(beside, "uri", "a file in the same folder", address)
            size = file.stat().st_size
        except FileNotFoundError as error:
            raise FormatError(self.path, f"refers to {unquote(address)}, which is not there") from error
        except (OSError, RuntimeError, ValueError) as error:
            raise buffer.place.wrong("uri", "a file's name", address) from error
        if file not in self.files:
            self.files.append(file)
        return Buffer(file, size)


def local(node: Entry, moved: Mapping[str, Float[Tensor, "f _"]]) -> Float[Tensor, "f 4 4"]:
    """A node's own transforms: its matrix, or its translation, rotation and scale; one at rest.

    moved: what an animation makes of these three at some times, by name.
    """
    if "matrix" in node and not moved:
        return node.vector("matrix", 16).view(1, 4, 4).mT
    parts = {name: node.vector(name, width)[None] for name, width in PARTS.items() if name in node} | {**moved}
    motions = torch.eye(4, dtype=torch.float64).repeat(max(map(len, parts.values()), default=1), 1, 1)
    if "rotation" in parts:
        motions[:, :3, :3] = rotation_matrices(unit(parts["rotation"], node.place).roll(1, dims=1))
    if "scale" in parts:
        motions[:, :3, :3] *= parts["scale"][:, None]
    if "translation" in parts:
        motions[:, :3, 3] = parts["translation"]
    return motions


def glb_start(document: dict[str, Any], binary: int, room: int = 0) -> bytes:
    """All of a .glb that goes before its binary chunk of so many bytes; the JSON padded to at least `room` bytes."""
    data = json.dumps(document, separators=(",", ":")).encode()
    data += b" " * max(room - len(data), -len(data) % 4)
    size = HEADER.size + 2 * CHUNK.size + len(data) + binary
    chunk = CHUNK.pack(len(data), JSON_CHUNK) + data
    return HEADER.pack(MAGIC, VERSION, size) + chunk + CHUNK.pack(binary, BINARY_CHUNK)


def _chunks(path: Path) -> Iterator[tuple[int, Buffer]]:
    """The chunks of a .glb, by kind."""
    at, size = HEADER.size, path.stat().st_size
    while at + CHUNK.size <= size:
        length, kind = CHUNK.unpack(read_part(path, at, CHUNK.size))
        at += CHUNK.size
        if length > size - at:
            raise FormatError(path, f"a chunk of {length} bytes expected, {size - at} left; the file is cut short")
        yield kind, Buffer(path, length, at)
        at += length

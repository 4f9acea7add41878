"""glTF scenes by KHR_gaussian_splatting (ratified 2025): .glb, .gltf with a .bin beside it, and .spz.glb.

A primitive of points has the attributes POSITION, ROTATION (xyzw), SCALE (linear), OPACITY (0 to 1) and the harmonics
SH_DEGREE_l_COEF_n, of degree 0 to 3.  Floats are written, and COLOR_0 for programs that draw points; the integers that
the extension allows are read.  A .spz.glb holds a .spz of version 2 instead (KHR_gaussian_splatting_compression_spz_2,
a draft), its numbers in glTF's axes, as CesiumJS takes them; degree 0 is named by COLOR_0 alone there.

glTF's axes are x left, y up, z forward: a half turn about z leads to and from OpenCV's.  Transforms of nodes are
applied, where they turn, move and scale alike along all axes.  glTF has no word for a convention: it stays in a record
of ours in the primitive's `extras`.
"""

import io
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import accumulate, chain
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.gaussians import Gaussians, joined
from aaplug.io.atomic import replacing, write_file
from aaplug.io.gltf import FLOAT, MAGIC, Gltf, Table, glb_start, local
from aaplug.io.scenes import spz
from aaplug.io.scenes.packed import Piece, bytes_of, half_turn_about_z, in_a_row, logit_of, replacing_group, standing
from aaplug.io.scenes.record import KEY, Facts, holdable, read_record, record_of
from aaplug.io.scenes.rows import SceneFileOptions, check_count, library_errors
from aaplug.io.scenes.scene import Scene
from aaplug.io.values import Entry, entries
from aaplug.system.errors import FormatError, OutputError

SPLATS, SPZ = "KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"
UNDERSTOOD = (SPLATS, SPZ, "KHR_mesh_quantization")  # what a file may require
PREFIX = f"{SPLATS}:"
SIGNED, UNSIGNED = (FLOAT, 5120, 5122), (FLOAT, 5121, 5123)  # types of components: float, and 8 and 16 bits
BYTES, VERTICES, POINTS = 5121, 34962, 0  # a componentType, a target and a mode
COLOUR = "COLOR_0"
MOST_DEGREE = 3
MOST_BYTES = 2**32 - 1  # of a .glb, whose size is 32 bits
ROOM = 8192  # bytes of JSON, padded so that the smallest and largest position can be filled in at the end
LINEAR_NOTE = "its colours are linear, and are taken as they are"
EVIDENCE = "glTF does not say: assumed classic (3DGS default)"


def harmonics(degree: int) -> list[str]:
    """The attributes of all harmonics up to a degree."""
    return [f"{PREFIX}SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)]


@dataclass(frozen=True)
class GltfFormat:
    """Files of one suffix.  Raises as `SceneFormat` and `WritableFormat`."""

    name: str
    keeps: tuple[str, ...] = ("harmonics", "record")

    def sniff(self, path: Path, head: bytes) -> bool:
        """True for the magic of a .glb that is not called .spz.glb, and for the suffix .gltf of JSON."""
        if self.name == "gltf":
            return path.suffix.lower() == ".gltf" and head.lstrip().startswith(b"{")
        return head.startswith(MAGIC) and (self.name == "spz.glb") == path.name.lower().endswith(".spz.glb")

    def open_scene(self, path: Path, options: SceneFileOptions) -> Scene:
        """All primitives of splats that nodes place, or that none does, as one scene."""
        with library_errors(path):
            document = Gltf(path)
            wanted = document.root.fields.get("extensionsRequired", [])
            unknown = [each for each in wanted if each not in UNDERSTOOD] if isinstance(wanted, list) else [wanted]
            document.root.place.expect(not unknown, "extensionsRequired", f"of {', '.join(UNDERSTOOD)}", unknown)
            pieces, count, facts, colours = list[Piece](), 0, Facts(EVIDENCE), list[object]()
            for primitive, splats, motion in _primitives(document):
                pieces.append(_piece(document, primitive, splats, motion))
                count += pieces[-1].length
                check_count(path, count)  # before more is unpacked
                facts = read_record(path, primitive.entry("extras").fields if "extras" in primitive else {}, facts)
                colours.append(splats.fields.get("colorSpace"))
            if not pieces:
                raise FormatError(path, f"holds no points with the extension {SPLATS}; is it a mesh?")
        notes = [f"{len(pieces)} primitives"] * (len(pieces) > 1) + [LINEAR_NOTE] * ("lin_rec709_display" in colours)
        return Scene(path, self.name, *in_a_row(pieces), *facts, notes=tuple(notes), others=tuple(document.files))

    def write(
        self, path: Path, parts: Iterable[Gaussians], count: int, overwrite: bool, options: SceneFileOptions
    ) -> None:
        """Write a scene: a .glb part by part, others at once."""
        held = (half_turn_about_z(holdable(path, part, self.name, MOST_DEGREE)) for part in parts)
        if self.name == "glb":
            _write_glb(path, held, count, overwrite)
            return
        scene, buffer = joined([*held]), io.BytesIO()
        document = _Document(path, scene, len(scene))
        document.add(scene, buffer if self.name == "gltf" else None)
        if self.name == "spz.glb":
            blob = spz.packed(path, scene, 2, "RUB")
            blob += bytes(-len(blob) % 4)
            write_file(path, glb_start(document.json(blob=len(blob)), len(blob)) + blob, overwrite)
        else:
            name = f"{path.stem}.bin"

            def whole(names: Mapping[str, str]) -> bytes:
                return json.dumps(document.json(uri=names[name]), separators=(",", ":")).encode()

            replacing_group(path, {name: buffer.getvalue()}, whole, overwrite)


FORMATS = (GltfFormat("spz.glb"), GltfFormat("glb"), GltfFormat("gltf"))


# Reading


def _primitives(document: Gltf) -> Iterator[tuple[Entry, Entry, Float[Tensor, "4 4"]]]:
    """Primitives of splats, their extension, and the transforms that place them."""
    nodes = document.items("nodes")
    motions: dict[int | None, Float[Tensor, "4 4"]] = {None: torch.eye(4, dtype=torch.float64)}
    for index, above in document.parents.items():
        motions[index] = motions[above] @ local(nodes[index], {})[0]
    holders = [(index, node) for index, node in enumerate(nodes) if "mesh" in node]
    places = [(document.item("meshes", node, "mesh"), motions[index]) for index, node in holders]
    for mesh, motion in places or [(mesh, motions[None]) for mesh in document.items("meshes")]:
        for each in entries(document.path, "primitive", mesh.value("primitives")):
            primitive = Entry(mesh.place, each.fields)
            extensions = primitive.entry("extensions") if "extensions" in primitive else primitive
            if SPLATS in extensions:
                yield primitive, extensions.entry(SPLATS), motion


def _piece(document: Gltf, primitive: Entry, splats: Entry, motion: Float[Tensor, "4 4"]) -> Piece:
    place = primitive.place
    place.expect(primitive.fields.get("mode") == POINTS, "mode", "0 (points)", primitive.fields.get("mode"))
    kernel = splats.fields.get("kernel", "ellipse")
    place.expect(kernel == "ellipse", "kernel", "ellipse", kernel)
    inner = splats.entry("extensions") if "extensions" in splats else splats
    if SPZ in inner:
        view, _ = document.view(inner.entry(SPZ))
        header, sections, _ = spz.parsed(document.path, view.read(0, view.size))
        count, degree, load = header.count, header.degree, partial(spz.rows, header, sections, "RDF")
    else:
        attributes = primitive.entry("attributes")
        degree = max((d for d in range(MOST_DEGREE + 1) if harmonics(d)[-1] in attributes), default=0)
        kinds = {"ROTATION": ("VEC4", SIGNED), "SCALE": ("VEC3", SIGNED), "OPACITY": ("SCALAR", UNSIGNED)}
        tables = {key: document.accessor(attributes, PREFIX + key, *kind) for key, kind in kinds.items()}
        tables["POSITION"] = document.accessor(attributes, "POSITION", "VEC3", tuple({*SIGNED, *UNSIGNED}))
        tables |= {name: document.accessor(attributes, name, "VEC3") for name in harmonics(degree)}
        counts = {count for count, _ in tables.values()}
        place.expect(len(counts) == 1, "attributes", "as many rows each", sorted(counts))
        count, load = counts.pop(), partial(_read, tables, degree)
    return Piece(count, degree, lambda start, stop: standing(load(start, stop), motion, place))


def _read(tables: dict[str, Table], degree: int, start: int, stop: int) -> Gaussians:
    def column(name: str) -> Tensor:
        return torch.from_numpy(tables[name][1](start, stop))

    sh = torch.stack([column(name) for name in harmonics(degree)], dim=1)
    quats, opacities = column("ROTATION").roll(1, dims=1), logit_of(column("OPACITY")[:, 0])
    return Gaussians(column("POSITION"), quats, column("SCALE").log(), opacities, sh)


# Writing


class _Document:
    """The layout of a file of at most `count` Gaussians: a stretch of the buffer for each attribute."""

    def __init__(self, path: Path, first: Gaussians, count: int) -> None:
        widths = {"POSITION": 12, f"{PREFIX}ROTATION": 16, f"{PREFIX}SCALE": 12, f"{PREFIX}OPACITY": 4}
        self.widths = widths | {COLOUR: 4} | dict.fromkeys(harmonics(first.sh_degree), 12)  # bytes a Gaussian
        *starts, self.size = (count * width for width in accumulate(self.widths.values(), initial=0))
        self.starts = dict(zip(self.widths, starts, strict=True))
        self.path, self.first, self.count = path, first, 0
        self.box = first.means[:0]  # smallest and largest position, once there is one

    def add(self, part: Gaussians, stream: BinaryIO | io.BytesIO | None, begin: int = 0) -> None:
        """Count a part, and write its attributes into the buffer that begins there in a stream."""
        if stream is not None:
            rgba = torch.cat([part.base_colours, part.opacities[:, None]], dim=1)
            values = [part.means, part.unit_quats.roll(-1, dims=1), part.scales, part.opacities]
            columns = [each.contiguous().numpy().astype("<f4") for each in (*values, *part.sh.unbind(dim=1))]
            columns.insert(4, bytes_of(rgba * 255))
            for (name, start), column in zip(self.starts.items(), columns, strict=True):
                stream.seek(begin + start + self.count * self.widths[name])
                stream.write(column.tobytes())
        self.count += len(part)
        if len(means := torch.cat([self.box, part.means])):
            self.box = torch.stack([means.amin(dim=0), means.amax(dim=0)])

    def json(self, uri: str | None = None, blob: int | None = None) -> dict[str, Any]:
        """The document; `blob`: the size of a .spz that holds the rows, instead of the attributes."""
        if not self.count:
            raise OutputError(self.path, "glTF cannot hold a scene without Gaussians; write a .ply")
        views, accessors, names, used = list[dict[str, Any]](), list[dict[str, Any]](), dict[str, int](), [SPLATS]
        for name, width in self.widths.items():
            if blob is not None and name in harmonics(0):  # CesiumJS takes one more attribute for no harmonics at all
                continue
            names[name] = len(accessors)
            kind = {4: "SCALAR", 12: "VEC3", 16: "VEC4"}[width]
            accessor = {"componentType": FLOAT, "count": self.count, "type": kind}
            if name == COLOUR:
                accessor |= {"componentType": BYTES, "type": "VEC4", "normalized": True}
            if name == "POSITION":
                accessor |= dict(zip(("min", "max"), self.box.tolist(), strict=True))
            if blob is None:
                accessor["bufferView"] = len(views)
                stretch = {"byteOffset": self.starts[name], "byteLength": self.count * width}
                views.append({"buffer": 0, **stretch, "target": VERTICES})
            accessors.append(accessor)
        splats: dict[str, Any] = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
        splats |= {"sortingMethod": "cameraDistance", "projection": "perspective"}
        required = {}
        if blob is not None:
            views, used = [{"buffer": 0, "byteLength": blob}], [SPLATS, SPZ]
            splats["extensions"], required = {SPZ: {"bufferView": 0}}, {"extensionsRequired": used}
        primitive = {"attributes": names, "mode": POINTS, "extensions": {SPLATS: splats}}
        primitive["extras"] = {KEY: record_of(self.first)}
        return {
            "asset": {"version": "2.0", "generator": "aaplug"},
            "extensionsUsed": used,
            **required,
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [primitive]}],
            "buffers": [{"byteLength": self.size if blob is None else blob} | ({"uri": quote(uri)} if uri else {})],
            "bufferViews": views,
            "accessors": accessors,
        }


def _write_glb(path: Path, parts: Iterable[Gaussians], count: int, overwrite: bool) -> None:
    """The JSON goes first and is known last, so it is padded and filled in at the end."""
    parts = iter(parts)
    first = next(parts)
    document, room = _Document(path, first, count), ROOM + 4 * len(json.dumps(record_of(first)))
    start = len(glb_start({}, 0, room))
    if start + document.size > MOST_BYTES:
        raise OutputError(path, f"a .glb has at most {MOST_BYTES:,} bytes, {document.size:,} needed; write a .ply")
    with replacing(path, overwrite) as stream:
        for part in chain([first], parts):
            document.add(part, stream, start)
        stream.truncate(start + document.size)
        stream.seek(0)
        stream.write(glb_start(document.json(), document.size, room))
        assert stream.tell() == start, (stream.tell(), start)

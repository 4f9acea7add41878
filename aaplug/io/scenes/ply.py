"""INRIA's .ply scenes, read and written through plyfile so that nothing in them is lost.

A Gaussian is a row of the element "vertex": x y z, f_dc_0..2, f_rest_*, opacity (a logit),
scale_0..2 (natural logarithms), rot_0..3 (wxyz, any length), all float32, in any order and between
any other columns.  k: coefficients a channel; f_rest is channel-major: f_rest_(c·(k − 1) + j) is
coefficient 1 + j of channel c.  Mip-Splatting adds filter_3D.  Rows are counted from 0.  What is
not a Gaussian's parameter stays in the document and is written back to the byte.
"""

import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from plyfile import PlyData, PlyElement
from torch import Tensor

from aaplug.errors import FormatError, OutputError, listing
from aaplug.gaussians import Convention, Gaussians, Origin
from aaplug.io.atomic import replacing
from aaplug.io.scenes.ply_header import Header, Property, check_size, parse, read_header
from aaplug.io.scenes.ply_tags import FILTER_COLUMN, meaning, stating

REST_COUNTS = (0, 9, 24, 45)  # f_rest columns of degrees 0 to 3: 3((d + 1)² − 1)
REST_COUNT_4 = 72  # of degree 4
REST = re.compile(r"f_rest_\d+")
REQUIRED = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
NORMALS = ("nx", "ny", "nz")  # unused; 3DGS writes them and some readers expect them
SHORTEST_QUATERNION = 1e-12  # below this torch's `normalize` gives no unit quaternion
CHUNK = 1 << 16  # rows copied at a time: 16 MB

name = "ply"
log = logging.getLogger("aaplug")


@dataclass(frozen=True)
class Document:
    """The whole file.

    elements: all tables, memory-mapped where they hold no lists.
    other_size: bytes of all tables but the Gaussians'.
    """

    header: Header
    elements: tuple[PlyElement, ...] = ()
    other_size: int = 0


@dataclass(frozen=True)
class Fault:
    """Rows of a column that no renderer can use."""

    text: str
    rows: Bool[Tensor, " n"]

    def __str__(self) -> str:
        rows = self.rows.nonzero().flatten()
        more = f" (and {len(rows) - 1} more)" if len(rows) > 1 else ""
        return f"row {int(rows[0])}{more} has {self.text}"


class _Verbatim(PlyData):
    """Tables under a header that is written as it stands instead of in plyfile's words."""

    def __init__(self, elements: list[PlyElement], text: str) -> None:
        super().__init__(elements, byte_order="<")
        self._text = text

    @property
    def header(self) -> str:
        return self._text.removesuffix("\n")  # which plyfile adds


def sniff(path: Path, head: bytes) -> bool:
    """Whether this is a .ply file, be it a scene or not."""
    return head.startswith((b"ply\n", b"ply\r"))


def read(
    path: Path, *, convention: Convention | None, drop_bad: bool, max_gaussians: int
) -> Gaussians:
    """Read a scene; see `aaplug.io.scenes.read_scene`.

    Raises:
        FormatError: the file is no scene, is damaged, or has unusable rows and not `drop_bad`.
    """
    with _library_errors(path):
        header = read_header(path)
        check_size(header, path.stat().st_size)
        _check_columns(header)
        _check_number(header, max_gaussians)
        said = meaning(header)
        document = _load(path, header)
        scene = _fill(document)
    if convention:
        said = replace(said, convention=convention, evidence="given by --convention")
    origin = Origin(str(path), name, said.evidence, document, torch.arange(len(scene)))
    scene = replace(scene, convention=said.convention, fused=said.fused, origin=origin)
    return _without_faults(scene, path, drop_bad)


def write(path: Path, scene: Gaussians, overwrite: bool) -> None:
    """Write a scene; see `aaplug.io.scenes.write_scene`.

    Raises:
        OutputError: the file exists and `overwrite` is false, or it cannot be written.
    """
    origin = scene.origin if scene.origin and scene.origin.format == name else None
    document = origin.document if origin else Document(_plain_header(scene))
    header = _updated(document.header, scene, new=origin is None)
    vertex = PlyElement.describe(_records(header, scene, document, origin), "vertex")
    tables = [vertex if e.name == "vertex" else e for e in document.elements] or [vertex]
    size = len(header.text) + header.vertex.least_size + document.other_size
    with replacing(path, overwrite) as stream:
        _Verbatim(tables, header.text).write(stream)
        if stream.tell() != size:
            raise OutputError(path, f"{stream.tell():,} bytes were written instead of {size:,}")


def columns(scene: Gaussians) -> dict[str, Float[Tensor, " n"]]:
    """A view of each parameter under its column's name: the one place that knows the layout."""
    k = scene.sh.shape[1]
    named = {axis: scene.means[:, i] for i, axis in enumerate("xyz")}
    named |= {f"f_dc_{c}": scene.sh[:, 0, c] for c in range(3)}
    named |= {
        f"f_rest_{c * (k - 1) + j}": scene.sh[:, 1 + j, c] for c in range(3) for j in range(k - 1)
    }
    named |= {"opacity": scene.logit_opacities}
    named |= {f"scale_{i}": scene.log_scales[:, i] for i in range(3)}
    named |= {f"rot_{i}": scene.quats[:, i] for i in range(4)}
    return named if scene.filter_3d is None else named | {FILTER_COLUMN: scene.filter_3d}


@contextmanager
def _library_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except FormatError:
        raise
    except MemoryError as error:
        raise FormatError(path, "does not fit into memory") from error
    except OSError as error:
        raise FormatError(
            path, f"cannot be read: {(error.strerror or str(error)).lower()}"
        ) from error
    except Exception as error:  # plyfile raises its own, ValueError, OverflowError and others
        raise FormatError(path, f"cannot be read as .ply: {error}") from error


def _check_columns(header: Header) -> None:
    vertex = header.vertex
    known = {p.name: p for p in vertex.properties}
    if vertex.lists:
        raise FormatError(
            header.path,
            f"vertex property {listing(vertex.lists)} is a list; a scene has numbers only",
        )
    missing = [column for column in REQUIRED if column not in known]
    if missing:
        raise FormatError(header.path, _about_missing(missing, known))
    used = [p for p in known.values() if _is_parameter(p.name)]
    wrong = [p.name for p in used if p.code != "f4"]
    if wrong:
        raise FormatError(
            header.path, f"{listing(wrong)} must be float (float32); convert the file to float32"
        )
    _check_rest(header.path, [n for n in known if REST.fullmatch(n)])


def _about_missing(missing: list[str], known: dict[str, Property]) -> str:
    if "packed_position" in known:
        return "is a compressed .ply, not supported yet; make it a plain one with splat-transform"
    if {"scale_0", "scale_1"} <= known.keys() and "scale_2" in missing:
        return "has two scales only: it looks like 2DGS, not supported yet"
    return (
        f"vertex lacks {', '.join(missing)}, which a 3DGS .ply has; is it a point cloud or a mesh?"
    )


def _check_rest(path: str, rest: list[str]) -> None:
    if len(rest) == REST_COUNT_4:
        raise FormatError(path, "has 72 f_rest columns (degree 4), not supported yet")
    if len(rest) not in REST_COUNTS:
        raise FormatError(
            path, f"has {len(rest)} f_rest columns; degrees 0 to 3 have 0, 9, 24 or 45"
        )
    gaps = [f"f_rest_{i}" for i in range(len(rest)) if f"f_rest_{i}" not in rest]
    if gaps:
        raise FormatError(path, f"has {len(rest)} f_rest columns, but not {listing(gaps)}")


def _check_number(header: Header, max_gaussians: int) -> None:
    count = header.vertex.count
    if count > max_gaussians:
        raise FormatError(
            header.path,
            f"holds {count:,} Gaussians and the limit is {max_gaussians:,}; raise --max-gaussians",
        )


def _is_parameter(column: str) -> bool:
    return column in REQUIRED or column == FILTER_COLUMN or bool(REST.fullmatch(column))


def _load(path: Path, header: Header) -> Document:
    with path.open("rb") as stream:
        data = PlyData.read(stream, mmap="r")
        end = stream.tell()
    size = path.stat().st_size
    if end != size:  # only where other elements hold lists; without them the size is known before
        raise FormatError(path, f"has {size - end:,} bytes after its last element; it is damaged")
    other_size = size - len(header.text) - header.vertex.least_size
    return Document(header, data.elements, other_size)


def _fill(document: Document) -> Gaussians:
    """The parameters as tensors, copied by chunks as a row's values lie together in the file."""
    vertex = document.header.vertex
    rest = sum(bool(REST.fullmatch(column)) for column in vertex.names)
    scene = _empty(vertex.count, 1 + rest // 3, FILTER_COLUMN in vertex.names)
    data = _table(document)
    for start in range(0, len(scene), CHUNK):
        rows = slice(start, start + CHUNK)
        chunk = np.array(data[rows])
        for column, values in columns(scene).items():
            values[rows] = torch.from_numpy(np.ascontiguousarray(chunk[column]))
    return scene


def _empty(n: int, k: int, filtered: bool) -> Gaussians:
    return Gaussians(
        means=torch.empty(n, 3),
        quats=torch.empty(n, 4),
        log_scales=torch.empty(n, 3),
        logit_opacities=torch.empty(n),
        sh=torch.empty(n, k, 3),
        filter_3d=torch.empty(n) if filtered else None,
    )


def _table(document: Document) -> np.ndarray:
    return next(e.data for e in document.elements if e.name == "vertex")


def _without_faults(scene: Gaussians, path: Path, drop_bad: bool) -> Gaussians:
    faults = _faults(scene)
    if not faults:
        return scene
    if not drop_bad:
        what = listing([str(fault) for fault in faults])
        raise FormatError(path, f"{what}; pass --drop-bad to leave such rows out")
    bad = torch.stack([fault.rows for fault in faults]).any(dim=0)
    counts = listing([f"{fault.text}: {int(fault.rows.sum()):,}" for fault in faults])
    log.warning("%s: left out %d of %d Gaussians (%s)", path, int(bad.sum()), len(scene), counts)
    return scene[~bad]


def _faults(scene: Gaussians) -> list[Fault]:
    named = columns(scene)
    faults = [Fault(f"NaN in {column}", values.isnan()) for column, values in named.items()]
    faults += [Fault(f"Inf in {column}", values.isinf()) for column, values in named.items()]
    length = torch.linalg.vector_norm(scene.quats, dim=-1)
    finite = scene.quats.isfinite().all(dim=-1)
    faults.append(Fault("a quaternion of length zero", length <= SHORTEST_QUATERNION))
    faults.append(Fault("a quaternion too long for float32", length.isinf() & finite))
    if scene.filter_3d is not None:
        faults.append(Fault(f"a negative {FILTER_COLUMN}", scene.filter_3d < 0))
    return [fault for fault in faults if fault.rows.any()]


def _plain_header(scene: Gaussians) -> Header:
    """3DGS's own header, in its order of columns."""
    rest = [f"f_rest_{i}" for i in range(3 * (scene.sh.shape[1] - 1))]
    order = [*REQUIRED[:3], *NORMALS, *REQUIRED[3:6], *rest, *REQUIRED[6:]]
    properties = [f"property float {column}" for column in order]
    start = ["ply", "format binary_little_endian 1.0", f"element vertex {len(scene)}"]
    return parse("scene", [*start, *properties, "end_header"], "\n")


def _updated(old: Header, scene: Gaussians, new: bool) -> Header:
    """The header for this scene: number, columns, and what it says of convention and fusions."""
    wanted = columns(scene)
    known = old.vertex.names
    dropped = [column for column in known if _is_parameter(column) and column not in wanted]
    added = [column for column in wanted if column not in known]
    header = old.with_vertex(len(scene), dropped, added)
    return stating(header, None if new else old, scene.convention, scene.fused)


def _records(
    header: Header, scene: Gaussians, document: Document, origin: Origin | None
) -> np.ndarray:
    """The Gaussians' table: parameters from the scene, other columns from the document."""
    values = columns(scene)
    dtype = np.dtype([(p.name, "<" + p.code) for p in header.vertex.properties])
    records = np.zeros(len(scene), dtype)
    for column in header.vertex.names:
        if column in values:
            assert values[column].isfinite().all(), f"{column} is NaN or infinite"
            records[column] = values[column].detach().cpu().numpy()
        elif origin:
            records[column] = _table(document)[column][origin.rows.cpu().numpy()]
    return records

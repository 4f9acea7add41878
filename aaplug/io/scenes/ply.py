"""The .ply scenes of INRIA's 3DGS and its dialects, read and written so that nothing in them is lost.

A Gaussian is a row of the element "vertex": x y z, f_dc_0..2, f_rest_*, opacity (a logit), scale_0..2 (natural
logarithms), rot_0..3 (wxyz, any length), in any order and among any other columns, in any of PLY's three codings.
Dialects: float64 columns (converted), red green blue in place of f_dc_* (nerfstudio's rgb mode), scale_0..1 alone
(2DGS), filter_3D (Mip-Splatting).  Everything that is not a Gaussian's parameter stays in the document and is written
back unchanged.  Output is little-endian binary.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.gaussians import LEARNED_COLUMN, Gaussians
from aaplug.io.atomic import replacing
from aaplug.io.ply_header import LITTLE, Header, check_size, is_packed, parse, read_header
from aaplug.io.scenes.columns import DEGREES, FILTER_COLUMN, columns_of, scene_of
from aaplug.io.scenes.packed import sh_of_colour
from aaplug.io.scenes.ply_document import Document, document_of, stamp_of
from aaplug.io.scenes.ply_tags import meaning_in_run, stating
from aaplug.io.scenes.rows import SceneFileOptions, check_count, library_errors
from aaplug.io.scenes.scene import PART, Scene
from aaplug.system.errors import FormatError, OutputError, counted, listing

REST = re.compile(r"f_rest_\d+")
COLOURS = ("f_dc_0", "f_dc_1", "f_dc_2")
BYTE_COLOURS = ("red", "green", "blue")  # uchar
SCALES = ("scale_0", "scale_1", "scale_2")
REQUIRED = (*("x", "y", "z", *COLOURS, "opacity", *SCALES), *("rot_0", "rot_1", "rot_2", "rot_3"))
NORMALS = ("nx", "ny", "nz")  # unused; 3DGS writes them, and some readers expect them
EXTRAS = ("min_pixel_sizes", "max_pixel_sizes", "base_mask")  # of Multi-Scale 3DGS, of any type
UP_AXIS = re.compile(r"vertical axis\s*:\s*[xyz+-]+", re.IGNORECASE)  # a comment of nerfstudio and Brush, for viewers
MOST_NAMED = 24  # columns in a message
ROWS_PER_WRITE = 1 << 13  # 2 MB, so that a column's stride stays within the cache

name = "ply"
keeps = ("harmonics", "record", "extras")


def sniff(path: Path, head: bytes) -> bool:
    """True for a .ply file that is not packed, even if it holds no scene."""
    return head.startswith((b"ply\n", b"ply\r")) and not is_packed(path)


def open_scene(path: Path, options: SceneFileOptions) -> Scene:
    """See `SceneFormat`."""
    with library_errors(path):
        header = read_header(path)
        stamp = stamp_of(path)
        check_size(header, stamp[0])
        notes = _check_columns(header)
        check_count(path, header.vertex.count)
        said, note = meaning_in_run(header)
        document = document_of(path, header, stamp)
    degree = DEGREES[len(_rest(header))]
    load, notes = partial(_rows, document, degree, said.flat), (*notes, *([note] if note else ()))
    return Scene(path, name, header.vertex.count, degree, load, *said, document=document, notes=notes)


def write(path: Path, parts: Iterable[Gaussians], count: int, overwrite: bool, options: SceneFileOptions) -> None:
    """Write a scene part by part, with the columns, tables and comments of its source file."""
    parts = iter(parts)
    first = next(parts)
    document, names = _document_of(first), [*columns_of(first[:0]), *first.extras]
    if document is None:  # a header as 3DGS writes it, with its order of columns
        lines = [f"property float {c}" for c in (*names[:3], *NORMALS, *names[3:])]
        start = ["ply", f"format {LITTLE} 1.0", f"element vertex {len(first)}"]
        document = Document(parse("scene", [*start, *lines, "end_header"], "\n"))
    old = document.header
    spare = SCALES[2] if first.flat else None
    dropped = [c for c in old.vertex.codes if _is_parameter(c) and c not in names and c != spare]
    added = [column for column in names if column not in old.vertex.codes]
    read = None if document.table is None else old
    header = stating(old.rewritten(count, dropped, added), read, first.convention, first.fused)
    with replacing(path, overwrite) as stream:
        stream.write(header.content)
        stream.write(document.before())
        start, written = stream.tell(), 0
        for part in chain([first], parts):
            for at in range(0, len(part), ROWS_PER_WRITE):
                stream.write(_records(header, part[at : at + ROWS_PER_WRITE]).tobytes())
            written += len(part)
        size = start + written * header.vertex.dtype.itemsize
        if stream.tell() != size:
            raise OutputError(path, f"{stream.tell():,} bytes were written instead of {size:,}")
        stream.write(document.after())
        if written != count:  # rows were left out: spaces replace digits that the number lost
            assert written < count
            stream.seek(0)
            stream.write(header.rewritten(f"{written:>{len(str(count))}}").content)


def beside(scene: Gaussians) -> str:
    """The columns beside its parameters that only a .ply keeps, in words; "" for none.

    Left out are normals, which nothing uses, colours in bytes, which say no more than f_dc, and comments, but for the
    one that says which way is up.
    """
    columns, tables, comments = [*scene.extras], list[str](), list[str]()
    if document := _document_of(scene):
        header, usual = document.header, {*scene.extras, *NORMALS, *BYTE_COLOURS}
        columns += [c for c in header.vertex.codes if c not in usual and not _is_parameter(c)]
        tables = [element.name for element in header.elements if element is not header.vertex]
        comments = [comment for comment in header.comments if UP_AXIS.fullmatch(comment)]
    named = {"columns": columns, "tables": tables, "comments": comments}
    return " and the ".join(f"{kind} {listing(names, MOST_NAMED)}" for kind, names in named.items() if names)


def _rest(header: Header) -> list[str]:
    return [column for column in header.vertex.codes if REST.fullmatch(column)]


def _check_columns(header: Header) -> list[str]:
    """Check the columns; notes on unusual ones that are understood."""
    vertex = header.vertex
    columns = vertex.codes
    if vertex.lists:
        raise FormatError(header.path, f"vertex property {listing(vertex.lists)} is a list; a scene has numbers only")
    coloured = all(c in columns and columns[c] == "u1" for c in BYTE_COLOURS) and not columns.keys() & {*COLOURS}
    optional = {*(COLOURS if coloured else ()), SCALES[2]}
    if missing := [c for c in REQUIRED if c not in columns and c not in optional]:
        lacks = f"vertex lacks {', '.join(missing)}, which a 3DGS .ply has"
        raise FormatError(header.path, f"{lacks}; is it a point cloud or a mesh?")
    used = {c: code for c, code in columns.items() if _is_parameter(c)}
    if wrong := [c for c, code in used.items() if code not in ("f4", "f8")]:
        raise FormatError(header.path, f"{listing(wrong)} must be float; convert the file to float32")
    rest = _rest(header)
    if len(rest) not in DEGREES:
        raise FormatError(header.path, f"has {len(rest)} f_rest columns; degrees 0 to 4 have 0, 9, 24, 45 or 72")
    if gaps := [f"f_rest_{i}" for i in range(len(rest)) if f"f_rest_{i}" not in rest]:
        raise FormatError(header.path, f"has {len(rest)} f_rest columns, but not {listing(gaps)}")
    double = [*used.values()].count("f8")
    notes = {
        f"coding: {header.coding}": header.coding != LITTLE,
        f"{counted(double, 'column')} of float64, used as float32": double > 0,
        "pixel sizes of Multi-Scale 3DGS, for the recipe multi-scale": all(c in columns for c in EXTRAS),
        "learned filters, for the recipe learned": any(map(LEARNED_COLUMN.fullmatch, columns)),
        "colours from the columns red, green, blue; no harmonics": coloured,
    }
    return [note for note, applies in notes.items() if applies]


def _is_parameter(column: str) -> bool:
    return column in REQUIRED or column == FILTER_COLUMN or bool(REST.fullmatch(column))


def _rows(document: Document, degree: int, flat: bool, start: int, stop: int) -> Gaussians:
    """The parameters as tensors, converted part by part, so that memory holds all of them once."""
    part = _part(document, degree, flat, start, start)  # none, which has the columns
    whole = {name: x.new_empty(stop - start, *x.shape[1:]) for name, x in {**part.columns, **part.extras}.items()}
    for begin in range(start, stop, PART):
        part = _part(document, degree, flat, begin, min(begin + PART, stop))
        for name, column in {**part.columns, **part.extras}.items():
            whole[name][begin - start :][: len(part)] = column
    columns = {name: whole[name] for name in part.columns}
    return replace(part, **columns, extras={name: whole[name] for name in part.extras})


def _part(document: Document, degree: int, flat: bool, start: int, stop: int) -> Gaussians:
    assert document.table is not None
    rows = document.table.read(start, stop)
    columns = rows.dtype.names or ()
    names = [c for c in columns if rows.dtype[c].kind == "f"]
    values = _matrix(rows, names)
    if COLOURS[0] not in names:
        harmonics = sh_of_colour(_matrix(rows, BYTE_COLOURS) / np.iinfo(np.uint8).max)
        names, values = (*names, *COLOURS), torch.cat([values, harmonics], dim=1)
    kept = [c for c in columns if c in EXTRAS or LEARNED_COLUMN.fullmatch(c)]
    extras = {c: torch.from_numpy(rows[c].astype(np.float32)) for c in kept}
    return replace(scene_of(names, values, degree, flat), extras=extras)


def _matrix(rows: np.ndarray, names: Sequence[str]) -> Float[Tensor, "n c"]:
    """Columns as float32, without a copy if they are that and follow each other."""
    from numpy.lib.recfunctions import structured_to_unstructured  # 15 ms that every verb would start later

    matrix = structured_to_unstructured(rows[[*names]], np.float32)
    return torch.from_numpy(matrix.ravel().reshape(matrix.shape))  # of one row or none, ravel takes the odd stride away


def _document_of(scene: Gaussians) -> Document | None:
    return scene.origin.document if scene.origin and scene.origin.format == name else None


def _records(header: Header, scene: Gaussians) -> np.ndarray:
    """Rows of the Gaussians' table: parameters from the scene, other columns from the document.

    In a column that is not float32, a value that is still what was read keeps the file's digits.
    """
    records = np.zeros(len(scene), header.vertex.dtype)
    columns = columns_of(scene)
    assert not any(column.isnan().any() for column in columns.values()), "a parameter is NaN"
    values = {name: column.detach().cpu().numpy() for name, column in (columns | {**scene.extras}).items()}
    old, document = {}, _document_of(scene)
    unchanged = any(c not in values or code != "f4" for c, code in header.vertex.codes.items())
    if unchanged and document and document.table and scene.origin:
        rows = document.table.take(scene.origin.rows.cpu())
        old = {name: rows[name] for name in rows.dtype.names or ()}
    for column, code in header.vertex.codes.items():
        new, was = values.get(column), old.get(column)
        if new is None:
            new = was
        elif was is not None and code != "f4":
            new = np.where(was.astype(np.float32) == new, was, new)
        if new is not None:
            records[column] = new
    return records

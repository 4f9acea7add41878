"""XGRIDS' .lcc, read (github.com/xgrids/LCCWhitepaper, version 5): the finest level of detail and the environment.

A JSON file, and beside it index.bin, data.bin, and for degree 3 shcoef.bin; environment.bin holds far splats.  Each
part of space has an entry in index.bin: its number, then for each level a count and the place of its records in
data.bin.  A record is position (float32), colour and opacity (bytes), linear scales (16 bits between the ends of
`attributes`), a quaternion xyzw without its largest component (10 bits each) and a normal.  Harmonics have 11, 10 and
11 bits between their ends, and lie at twice the record's place.  z is up.  The format does not tell of training.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.gaussians import Gaussians
from aaplug.core.placing import placed
from aaplug.io.limits import whole_limit
from aaplug.io.scenes.packed import Piece, byte_opacities, floats, fractions, in_a_row, sh_of_colour, word_quats
from aaplug.io.scenes.rows import SceneFileOptions, by_name, library_errors, read_rows
from aaplug.io.scenes.scene import Scene
from aaplug.io.scenes.splat import EVIDENCE
from aaplug.io.values import Entry, entries, natural, object_of, read_bounded, read_json, text
from aaplug.system.errors import FormatError

FIELDS = [("means", "<f4", 3), ("rgba", "u1", 4), ("scales", "<u2", 3), ("quats", "<u4"), ("normals", "<u2", 3)]
WORDS = ("sh", "<u4", 16)  # of harmonics; the last one is unused
RECORD, HARMONICS = np.dtype(FIELDS), np.dtype([WORDS])
FAR_RECORD = np.dtype([*FIELDS, WORDS])  # of the environment, with its harmonics
LEVEL = [("count", "<u4"), ("start", "<u8"), ("size", "<u4")]
KINDS = {"Portable": 0, "Quality": 3}  # degree of harmonics by fileType
COEFFICIENTS = 15  # of harmonics, beside that of degree 0
CHANNELS, COMPONENTS = ((0, 11), (11, 10), (21, 11)), ((0, 10), (10, 10), (20, 10))  # of words: place, number of bits
MOST_SCALE = 65535
MAX_LEVELS = 64
Z_UP = torch.tensor([[1, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)  # to y down and z forward
CREDIT = "Data Organization Format originated from XGRIDS"  # its license asks to show it

Read = Callable[[int, int], np.ndarray]  # of the rows of a table from start up to stop

name = "lcc"
sniff = by_name(".lcc", start=b"{")


def open_scene(path: Path, options: SceneFileOptions) -> Scene:
    """The finest level, and the environment if there is one; see `SceneFormat`."""
    with library_errors(path):
        root = object_of(read_json(path), path, name, "totalLevel and attributes", "attributes")
        kind, levels = root.get("fileType", text), root.get("totalLevel", partial(natural, most=MAX_LEVELS, least=1))
        root.place.expect(kind in KINDS, "fileType", " or ".join(KINDS), kind)
        degree, attributes = KINDS[kind], entries(path, "attribute", root.value("attributes"))
        beside = {file.name.lower(): file for file in path.parent.iterdir()}
        names = ("index.bin", "data.bin", *(["shcoef.bin"] if degree else []))
        for lacking in set(names) - set(beside):
            raise FormatError(path, f"needs {lacking} beside it")
        index, data, *harmonics = (beside[each] for each in names)
        ends = partial(_ends, path, {each.get("name", text): each for each in attributes})
        kinds = ("scale", "shcoef") if degree else ("scale",)
        pieces = _pieces(index, data, harmonics[0] if degree else data, levels, degree, ends(kinds))
        far = FAR_RECORD if degree else RECORD
        if (sky := beside.get("environment.bin")) and sky.stat().st_size:
            count, rest = divmod(sky.stat().st_size, far.itemsize)
            if rest:
                raise FormatError(sky, f"has {sky.stat().st_size:,} bytes, not a multiple of {far.itemsize}")
            read = partial(read_rows, sky, far)
            pieces.append(Piece(count, degree, partial(_load, read, read, ends([f"env{kind}" for kind in kinds]))))
    used = tuple(beside[each] for each in (*names, "environment.bin") if each in beside)
    notes = (f"the finest of {levels} levels", CREDIT)
    return Scene(path, name, *in_a_row(pieces), EVIDENCE, notes=notes, others=used)


def turned_from_z_up(scene: Gaussians) -> Gaussians:
    """A scene whose z axis points up, in OpenCV's axes: (x, y, z) becomes (x, -z, y), as splat-transform does it."""
    return placed(scene, Z_UP, 1.0, (0.0, 0.0, 0.0))


def _load(read: Read, read_harmonics: Read, ends: Sequence[Float[Tensor, "2 3"]], start: int, stop: int) -> Gaussians:
    """The rows from start up to stop.  ends: of scales, and of harmonics if there are any."""
    rows = read(start, stop)
    quats = word_quats(rows["quats"], *COMPONENTS).roll(1, dims=1)
    scales = torch.lerp(ends[0][0], ends[0][1], floats(rows["scales"]) / MOST_SCALE)
    sh = sh_of_colour(floats(rows["rgba"][:, :3]) / 255)[:, None]
    if len(ends) > 1:
        values = fractions(read_harmonics(start, stop)["sh"][:, :COEFFICIENTS], *CHANNELS)
        sh = torch.cat([sh, torch.lerp(ends[1][0], ends[1][1], values)], dim=1)
    opacities = byte_opacities(rows["rgba"][:, 3])
    return turned_from_z_up(Gaussians(floats(rows["means"]), quats, scales.log(), opacities, sh))


def _ends(path: Path, attributes: dict[str, Entry], wanted: Sequence[str]) -> list[Float[Tensor, "2 3"]]:
    if lacking := set(wanted) - set(attributes):
        raise FormatError(path, f"attributes: {min(lacking)} is missing")
    found = [attributes[key] for key in wanted]
    return [torch.stack([each.vector("min", 3), each.vector("max", 3)]).float() for each in found]


def _pieces(index: Path, data: Path, harmonics: Path, levels: int, degree: int, ends: list[Tensor]) -> list[Piece]:
    """Records of the finest level, part of space by part."""
    entry = np.dtype([("part", "<u4"), ("levels", LEVEL, (levels,))])
    held = read_bounded(index, whole_limit("JSON"))
    if len(held) % entry.itemsize:
        raise FormatError(index, f"has {len(held):,} bytes, not a multiple of {entry.itemsize} for {levels} levels")
    finest = np.frombuffer(held, entry)["levels"][:, 0]
    size = data.stat().st_size
    whole = min(size, harmonics.stat().st_size // 2) if degree else size
    counts, starts, sizes = (finest[key].astype(np.uint64) for key in ("count", "start", "size"))
    wrong = (sizes != counts * RECORD.itemsize) | (starts > size) | (sizes > whole - np.minimum(starts, whole))
    if wrong.any() or sizes.sum() > size:
        raise FormatError(index, f"part {int(wrong.argmax())} should lie in {data.name}, of {whole:,} bytes")
    found = list[Piece]()
    for start, count in zip(starts.tolist(), counts.tolist(), strict=True):
        read = partial(read_rows, data, RECORD, offset=start)
        read_harmonics = partial(read_rows, harmonics, HARMONICS, offset=2 * start)
        found.append(Piece(count, degree, partial(_load, read, read_harmonics, ends)))
    return found

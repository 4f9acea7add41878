"""PlayCanvas' .compressed.ply (SuperSplat, splat-transform, gsplat): four 32-bit words per Gaussian.

Element "chunk": for every 256 Gaussians the smallest and largest position, log-scale and, in newer files, colour.
Element "vertex": packed_position and packed_scale (11, 10, 11 bits between those), packed_rotation (2 bits for the
largest component, 3 × 10 for the others), packed_color (4 bytes).  Element "sh", if any: a byte for each f_rest.
The header's comments say how the scene was trained, as in a plain .ply.  It is written in Morton order, so that the
Gaussians of a chunk are neighbours and the steps between its bounds are small.
"""

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.gaussians import Gaussians
from aaplug.io.atomic import replacing
from aaplug.io.ply_header import LITTLE, Element, Header, check_size, is_packed, parse, read_header
from aaplug.io.scenes.columns import DEGREES
from aaplug.io.scenes.packed import byte_opacities, bytes_of, fractions, sh_of_colour, without_largest, word_quats
from aaplug.io.scenes.ply_document import Table, stamp_of
from aaplug.io.scenes.ply_tags import meaning, stating
from aaplug.io.scenes.record import along_curve, warn_of_moves, warn_of_sizes, whole
from aaplug.io.scenes.rows import SceneFileOptions, library_errors
from aaplug.io.scenes.scene import PART, Scene
from aaplug.system.errors import FormatError

WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
BOUNDS = [f"{end}_{axis}" for end in ("min", "max") for axis in ("x", "y", "z")]
SCALE_BOUNDS = [f"{end}_scale_{axis}" for end in ("min", "max") for axis in ("x", "y", "z")]
COLOUR_BOUNDS = [f"{end}_{c}" for end in ("min", "max") for c in ("r", "g", "b")]
ELEVEN_TEN_ELEVEN, COMPONENTS = ((21, 11), (11, 10), (0, 11)), ((20, 10), (10, 10), (0, 10))
CHUNK_LENGTH = 256  # Gaussians
SH_SPAN = 8.0  # harmonics lie between -4 and 4
# by byte: the centres of 256 steps, but of the first and the last byte the ends
HARMONICS = (np.concatenate([[0.0], (np.arange(1, 255) + 0.5) / 256, [1.0]]) - 0.5).astype(np.float32) * SH_SPAN
MOST_DEGREE = 3
LARGEST_LOG_SCALE = 20.0  # absolute: a wider chunk of log-scales would leave its steps too coarse

name = "compressed.ply"
keeps = ("harmonics", "record")


def sniff(path: Path, head: bytes) -> bool:
    """True for a .ply with packed words."""
    return head.startswith((b"ply\n", b"ply\r")) and is_packed(path)


def open_scene(path: Path, options: SceneFileOptions) -> Scene:
    """See `SceneFormat`."""
    with library_errors(path):
        header = read_header(path)
        check_size(header, path.stat().st_size)
        _check(path, header)
        stamp = stamp_of(path)
        tables = {e.name: Table(path, header.start_of(e), e.count, e.dtype, stamp) for e in header.elements}
        said = meaning(header, compressed=True)
        bounds = tables["chunk"].read(0, tables["chunk"].count)
    sh = tables.get("sh")
    degree = DEGREES[len(sh.dtype.names or ())] if sh else 0
    load, count = partial(_rows, tables, bounds, degree), header.vertex.count
    return Scene(path, name, count, degree, load, said.evidence, said.convention, said.fused)


def _check(path: Path, header: Header) -> None:
    if header.coding != LITTLE or any(e.lists for e in header.elements):
        raise FormatError(path, f"is a packed .ply, which should be {LITTLE} without lists")
    elements = {e.name: e for e in header.elements}
    count, chunk = header.vertex.count, elements.get("chunk")
    _need(path, header.vertex, WORDS, "u4")
    if chunk is None or chunk.count * CHUNK_LENGTH < count:
        raise FormatError(path, f"has {chunk.count if chunk else 0:,} chunks, too few for {count:,} Gaussians")
    coloured = COLOUR_BOUNDS if COLOUR_BOUNDS[0] in chunk.codes else []
    _need(path, chunk, [*BOUNDS, *SCALE_BOUNDS, *coloured], "f4")
    if sh := elements.get("sh"):
        rest = len(sh.codes)
        if sh.count != count or rest not in DEGREES:
            raise FormatError(path, f"has {sh.count:,} rows of {rest} harmonics for {count:,} Gaussians")
        _need(path, sh, [f"f_rest_{i}" for i in range(rest)], "u1")


def _need(path: Path, element: Element, columns: Sequence[str], code: str) -> None:
    if missing := [c for c in columns if element.codes.get(c) != code]:
        raise FormatError(path, f"element {element.name!r} needs {missing[0]} as {code}")


def _rows(tables: dict[str, Table], bounds: np.ndarray, degree: int, start: int, stop: int) -> Gaussians:
    def between(names: list[str], share: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        ends = torch.from_numpy(np.stack([bounds[c][of_row] for c in names], axis=1))
        return torch.lerp(ends[:, :3], ends[:, 3:], share)

    words = tables["vertex"].read(start, stop)
    rest = tables["sh"].read(start, stop) if degree else None
    of_row = np.arange(start, stop) // CHUNK_LENGTH
    colour = words["packed_color"]
    rgb = fractions(colour, (24, 8), (16, 8), (8, 8))
    if COLOUR_BOUNDS[0] in (bounds.dtype.names or ()):
        rgb = between(COLOUR_BOUNDS, rgb)
    sh = torch.zeros(len(words), (degree + 1) ** 2, 3)
    sh[:, 0] = sh_of_colour(rgb)
    if rest is not None:
        k = sh.shape[1] - 1
        for i in range(3 * k):
            sh[:, 1 + i % k, i // k] = torch.from_numpy(HARMONICS[rest[f"f_rest_{i}"]])
    means = between(BOUNDS, fractions(words["packed_position"], *ELEVEN_TEN_ELEVEN))
    scales = between(SCALE_BOUNDS, fractions(words["packed_scale"], *ELEVEN_TEN_ELEVEN))
    quats = word_quats(words["packed_rotation"], *COMPONENTS)
    return Gaussians(means, quats, scales, byte_opacities(colour & 255), sh)


# Writing


def write(path: Path, parts: Iterable[Gaussians], count: int, overwrite: bool, options: SceneFileOptions) -> None:
    """Write a scene, with values rounded to the format's steps."""
    scene = along_curve(whole(path, parts, name, MOST_DEGREE))
    chunk = torch.arange(len(scene)) // CHUNK_LENGTH
    colours = scene.base_colours
    log_scales = scene.log_scales.clamp(-LARGEST_LOG_SCALE, LARGEST_LOG_SCALE)
    bounds, shares = zip(*(_bounded(values, chunk) for values in (scene.means, log_scales, colours)), strict=True)
    steps = torch.tensor([(1 << bits) - 1 for _, bits in ELEVEN_TEN_ELEVEN])
    span = (bounds[0][:, 3:] - bounds[0][:, :3])[chunk]
    warn_of_moves(path, name, scene, ((shares[0] * steps).round() / steps - shares[0]) * span)
    warn_of_sizes(path, name, scene, -LARGEST_LOG_SCALE, LARGEST_LOG_SCALE)
    rest, largest = without_largest(scene.unit_quats)
    turns = _word(rest / 2**0.5 + 0.5, *COMPONENTS) | largest << 30
    rgba = torch.cat([shares[2], scene.opacities[:, None]], dim=1)
    words = [_word(shares[0], *ELEVEN_TEN_ELEVEN), turns, _word(shares[1], *ELEVEN_TEN_ELEVEN)]
    words.append(_word(rgba, (24, 8), (16, 8), (8, 8), (0, 8)))
    columns = {"chunk": [*BOUNDS, *SCALE_BOUNDS, *COLOUR_BOUNDS], "vertex": list(WORDS)}
    tables = [torch.cat(bounds, dim=1).numpy().astype("<f4"), torch.stack(words, dim=1).numpy().astype("<u4")]
    if scene.sh_degree:
        rests = (rest.transpose(1, 2).flatten(1) / SH_SPAN + 0.5 for rest in scene.sh[:, 1:].split(PART))
        tables.append(np.concatenate([bytes_of((rest * 256).floor()) for rest in rests]))
        columns["sh"] = [f"f_rest_{i}" for i in range(tables[-1].shape[1])]
    kinds = {"chunk": "float", "vertex": "uint", "sh": "uchar"}
    lines = ["ply", f"format {LITTLE} 1.0"]
    for (element, names), table in zip(columns.items(), tables, strict=True):
        lines += [f"element {element} {len(table)}", *(f"property {kinds[element]} {each}" for each in names)]
    header = stating(parse("scene", [*lines, "end_header"], "\n"), None, scene.convention, scene.fused)
    with replacing(path, overwrite) as stream:
        stream.write(header.content)
        for table in tables:
            stream.write(table.tobytes())


def _bounded(
    values: Float[Tensor, "n 3"], chunk: Int[Tensor, " n"]
) -> tuple[Float[Tensor, "c 6"], Float[Tensor, "n 3"]]:
    """The smallest and largest values of each chunk, and each value as a fraction between them."""
    index, empty = chunk[:, None].expand(-1, 3), values.new_zeros(-(-len(values) // CHUNK_LENGTH), 3)
    low, high = (empty.scatter_reduce(0, index, values, how, include_self=False) for how in ("amin", "amax"))
    span = high - low
    return torch.cat([low, high], dim=1), (values - low[chunk]) / torch.where(span > 0, span, 1.0)[chunk]


def _word(shares: Float[Tensor, "n c"], *fields: tuple[int, int]) -> Int[Tensor, " n"]:
    """Fractions as fields of a word; the inverse of `fractions`."""
    parts = [(share * ((1 << bits) - 1)).round().long() << shift for share, (shift, bits) in zip(
        shares.clamp(0, 1).unbind(dim=1), fields, strict=True)]  # fmt: skip
    return torch.stack(parts).sum(dim=0)

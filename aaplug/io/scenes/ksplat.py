"""mkkellogg's .ksplat, compression levels 0 to 2 (github.com/mkkellogg/GaussianSplats3D).

A header of 4096 bytes, then one of 1024 for each section, then the sections.  A section holds the sizes of its partly
filled buckets, the buckets' centres, and a record per Gaussian: position (float32, or 16 bits around its bucket's
centre), scales (linear; float32 or float16), quaternion wxyz, colour and opacity (bytes), harmonics (float32, float16
or bytes), ordered by degree, then channel.
"""

import struct
from collections import namedtuple
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from aaplug.core.gaussians import Gaussians
from aaplug.io.scenes.packed import Piece, byte_opacities, floats, sh_of_colour
from aaplug.io.scenes.rows import SceneFileOptions, by_name, check_count, library_errors
from aaplug.io.scenes.scene import Scene
from aaplug.io.scenes.splat import EVIDENCE
from aaplug.system.errors import FormatError

# version, sections, Gaussians, level, smallest and largest harmonic
MAIN = struct.Struct("<BBxxI8xIH14xff")
MAIN_SIZE, SECTION_SIZE = 4096, 1024
SECTION = struct.Struct("<IIIIfH2xI4xIIH")  # see Section
SHAPE_TYPES = ("<f4", "<f2", "<f2")  # of scales and quaternions, by level
POSITION_TYPES = ("<f4", "<u2", "<u2")
HARMONIC_TYPES = ("<f4", "<f2", "u1")
POSITION_RANGES = (1, 32767, 32767)  # if the section does not say
HARMONIC_RANGE = (-1.5, 1.5)  # of harmonics in bytes, if the file does not say
MAX_DEGREE = 3

name = "ksplat"
sniff = by_name(".ksplat")  # the format has no magic number


# A section's header.  count, room: Gaussians, and records reserved.  capacity: Gaussians per bucket.  block: side of a
# bucket's cube.  full, partial: numbers of full and partly filled buckets.
Section = namedtuple("Section", "count room capacity buckets block bucket_size range full partial degree")


def open_scene(path: Path, options: SceneFileOptions) -> Scene:
    """See `SceneFormat`."""
    with library_errors(path):
        data, none = path.read_bytes(), torch.zeros(0, 3)
        parts = list[Gaussians]()
        if len(data) < MAIN_SIZE:
            raise FormatError(path, f"is cut short: a header has {MAIN_SIZE:,} bytes, the file {len(data):,}")
        major, minor, number, count, level, *ends = MAIN.unpack_from(data)
        if (major, level) not in ((0, 0), (0, 1), (0, 2)) or minor < 1:
            raise FormatError(path, f"has version {major}.{minor}, level {level}; known are 0.1 and levels 0 to 2")
        check_count(path, count)
        at = MAIN_SIZE + number * SECTION_SIZE
        if at > len(data):
            raise FormatError(path, f"promises {number:,} sections, more than it can hold")
        for index in range(number):
            section = Section(*SECTION.unpack_from(data, MAIN_SIZE + index * SECTION_SIZE))
            part, at = _decoded(path, data, at, section, level, ends)
            parts += [part] if len(part) else []
    rows = Piece.of(parts or [Gaussians(none, torch.zeros(0, 4), none, torch.zeros(0), none[:, None])])
    if rows.length != count:
        raise FormatError(path, f"promises {count:,} Gaussians, and its sections hold another number")
    return Scene(path, name, *rows, EVIDENCE, notes=(f"compression level {level}",))


def _decoded(
    path: Path, data: bytes, at: int, section: Section, level: int, ends: Sequence[float]
) -> tuple[Gaussians, int]:
    """The Gaussians of the section that begins at a byte, and where it ends.  ends: of harmonics; 0 if unsaid."""
    rest = 3 * ((section.degree + 1) ** 2 - 1)
    shape, position, harmonic = SHAPE_TYPES[level], POSITION_TYPES[level], HARMONIC_TYPES[level]
    fields = [("means", position, 3), ("scales", shape, 3), ("quats", shape, 4), ("rgba", "u1", 4)]
    record = np.dtype([*fields, ("sh", harmonic, rest)]) if section.degree <= MAX_DEGREE else None
    sizes = 4 * section.partial
    start = at + sizes + section.bucket_size * section.buckets
    end = start + (record.itemsize * section.room if record else 0)
    held = section.full + section.partial
    wrong = record is None or section.count > section.room or end > len(data)
    if level:
        wrong = wrong or held > section.buckets or (section.buckets and section.bucket_size != 12)
    if wrong:
        raise FormatError(path, f"has a damaged section at byte {at:,}: {section}")
    rows = np.frombuffer(data, record, section.count, start)
    means = rows["means"].astype(np.float64)
    if level:
        full = np.full(section.full, section.capacity, np.int64)
        partial = np.frombuffer(data, "<u4", section.partial, at).astype(np.int64)
        fill = np.minimum(np.concatenate([full, partial]), section.count)
        if fill.sum() < section.count:
            raise FormatError(path, f"has buckets for {fill.sum():,} of {section.count:,} Gaussians")
        bucket = np.searchsorted(np.cumsum(fill), np.arange(section.count), side="right")
        centres = np.frombuffer(data, "<f4", 3 * section.buckets, at + sizes).reshape(-1, 3)
        steps = section.range or POSITION_RANGES[level]
        means = (means - steps) * (section.block / 2 / steps) + centres[bucket]
    sh = torch.zeros(len(rows), (section.degree + 1) ** 2, 3)
    sh[:, 0] = sh_of_colour(floats(rows["rgba"][:, :3]) / 255)
    values = floats(rows["sh"])
    if level == len(HARMONIC_TYPES) - 1:
        least, most = (end or usual for end, usual in zip(ends, HARMONIC_RANGE, strict=True))
        values = least + values / 255 * (most - least)
    for d in range(1, section.degree + 1):
        band = values[:, 3 * (d * d - 1) : 3 * ((d + 1) ** 2 - 1)]
        sh[:, d * d : (d + 1) ** 2] = band.reshape(len(rows), 3, 2 * d + 1).transpose(1, 2)
    opacities = byte_opacities(rows["rgba"][:, 3])
    return Gaussians(floats(means), floats(rows["quats"]), floats(rows["scales"]).log(), opacities, sh), end

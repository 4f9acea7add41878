"""Niantic's .spz, versions 1 to 4 (github.com/nianticlabs/spz, README), read through zlib and zstandard.

Header: magic "NGSP", version, count (uint32 each), SH degree, bits of a position's fraction, flags, reserved (bytes).
Then sections, each for all Gaussians: positions (3 × 24-bit fixed point; float16 in version 1), opacities, colours,
log-scales, quaternions, harmonics, mostly a byte per number.  Versions 1 to 3 are one gzip stream; version 4 has a
longer header, a table of sizes, and a zstd stream per section.  Axes are x right, y up, z back; a scene here has y down
and z forward.  Flag 1: trained with antialiasing; the file does not say with which kernel.
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.errors import FormatError
from aaplug.core.gaussians import ANTIALIASED, CLASSIC, Gaussians
from aaplug.io.scenes.options import Options
from aaplug.io.scenes.packed import byte_opacities, check_growth, floats, gunzip, gunzip_start, largest_last, unzstd
from aaplug.io.scenes.scene_file import SceneFile, check_count, library_errors
from aaplug.io.scenes.spz_writer import ANTIALIASED_FLAG, TURNS
from aaplug.io.scenes.spz_writer import write as write

MAGIC = b"NGSP"
GZIP = b"\x1f\x8b"
HEADER = struct.Struct("<4sIIBBBB")  # magic, version, count, degree, fraction bits, flags, reserved
HEADER_4 = struct.Struct("<4sIIBBBBI12x")  # the reserved byte counts streams; then the table's place
STREAM = struct.Struct("<QQ")  # compressed and decompressed size
HALVES, FIXED, THREES, STREAMS = 1, 2, 3, 4  # versions, by what each introduced
MAX_DEGREE = 4
MAX_FRACTION = 24  # bits of a position
COLOUR_GAIN = 0.15  # stored colour over the harmonic of degree 0
SCALE_STEPS, SCALE_LEAST = 16.0, -10.0  # log-scales: steps per unit, and the smallest
MAGNITUDE = 511  # 9 bits of a quaternion's component; the tenth is its sign
AXES_NOTES = {
    "opengl": "axes turned from OpenGL's to OpenCV's, by the specification "
    "(`spz_axes` opencv if the writer did not turn them, as splat-transform and gsply)",
    "opencv": "axes as stored (`spz_axes` opencv)",
}

name = "spz"
needs = "gsply"


@dataclass(frozen=True)
class Header:
    """The header's numbers."""

    version: int
    count: int
    degree: int
    fraction: int
    flags: int

    @property
    def widths(self) -> tuple[int, ...]:
        """Bytes per Gaussian in each section: positions, opacities, colours, scales, quaternions, harmonics."""
        position = 6 if self.version == HALVES else 9
        quaternion = 4 if self.version >= THREES else 3
        return position, 1, 3, 3, quaternion, 3 * ((self.degree + 1) ** 2 - 1)


def sniff(path: Path, head: bytes) -> bool:
    """Whether the file begins with the magic, or is a gzip stream with the suffix .spz."""
    return head.startswith(MAGIC) or (head.startswith(GZIP) and path.suffix.lower() == ".spz")


def open_scene(path: Path, options: Options) -> SceneFile:
    """Decompress a scene; see `SceneFormat`."""
    with library_errors(path):
        header, sections = _sections(path)
    turn = TURNS[options.spz_axes]
    antialiased = bool(header.flags & ANTIALIASED_FLAG)
    evidence = "the flag antialiased is not set: assumed classic"
    if antialiased:
        evidence = "the flag antialiased is set; its kernel is not recorded, 0.3 px² assumed"
    return SceneFile(
        path,
        name,
        header.count,
        header.degree,
        lambda start, stop: turn(_rows(header, [s[start:stop] for s in sections])),
        evidence,
        ANTIALIASED if antialiased else CLASSIC,
        notes=(f"version {header.version}; {AXES_NOTES[options.spz_axes]}",),
    )


def _sections(path: Path) -> tuple[Header, list[np.ndarray]]:
    data = path.read_bytes()
    zipped = data.startswith(GZIP)
    start = gunzip_start(data, HEADER.size) if zipped else data[: HEADER.size]
    header = _header(path, start)
    sizes = [width * header.count for width in header.widths]
    if header.version >= STREAMS:
        if zipped:
            raise FormatError(path, f"version {header.version} should not be one gzip stream")
        parts: Iterable[bytes] = _streams(path, data, sizes)
    else:
        parts = _split(_payload(path, data, sum(sizes), zipped), sizes)
    arrays = [np.frombuffer(part, np.uint8) for part in parts]
    shaped = zip(arrays, header.widths, strict=True)
    return header, [array.reshape(header.count, width) for array, width in shaped]


def _header(path: Path, data: bytes) -> Header:
    if len(data) < HEADER.size or not data.startswith(MAGIC):
        raise FormatError(path, "is not an .spz: its header is missing")
    _, version, count, degree, fraction, flags, _ = HEADER.unpack(data)
    if not HALVES <= version <= STREAMS:
        raise FormatError(path, f"is .spz of version {version}; known are 1 to {STREAMS}")
    if degree > MAX_DEGREE or fraction > MAX_FRACTION:
        raise FormatError(path, f"has the impossible SH degree {degree} or {fraction} bits of fraction")
    check_count(path, count)
    return Header(version, count, degree, fraction, flags)


def _payload(path: Path, data: bytes, size: int, zipped: bool) -> bytes:
    whole = HEADER.size + size
    if zipped:
        check_growth(path, whole, len(data))
        return gunzip(data, whole, path)[HEADER.size :]
    if len(data) < whole:
        raise FormatError(path, f"is cut short: {whole:,} bytes promised, {len(data):,} there")
    return data[HEADER.size :]


def _split(payload: bytes, sizes: list[int]) -> Iterable[bytes]:
    at = 0
    for size in sizes:
        yield payload[at : at + size]
        at += size


def _streams(path: Path, data: bytes, sizes: list[int]) -> Iterable[bytes]:
    """The sections of version 4; an empty section has no stream."""
    if len(data) < HEADER_4.size:
        raise FormatError(path, "is cut short in its header")
    *_, number, table = HEADER_4.unpack_from(data)
    wanted = sum(size > 0 for size in sizes)
    at = table + number * STREAM.size
    if number != wanted or table < HEADER_4.size or at > len(data):
        raise FormatError(
            path, f"has {number} streams listed at byte {table:,}; {wanted} and a place within the file expected"
        )
    check_growth(path, sum(sizes), len(data))
    listed = iter(STREAM.unpack_from(data, table + i * STREAM.size) for i in range(number))
    for size in sizes:
        if not size:
            yield b""
            continue
        compressed, inflated = next(listed)
        if inflated != size or at + compressed > len(data):
            raise FormatError(
                path,
                f"lists a stream of {compressed:,} bytes for {inflated:,}; {size:,} expected, "
                f"and {len(data) - at:,} bytes are left",
            )
        yield unzstd(data[at : at + compressed], size, path)
        at += compressed


def _rows(header: Header, sections: list[np.ndarray]) -> Gaussians:
    positions, alphas, colours, scales, quats, harmonics = sections
    n, k = len(positions), (header.degree + 1) ** 2
    sh = torch.zeros(n, k, 3)
    sh[:, 0] = (floats(colours) / 255 - 0.5) / COLOUR_GAIN
    sh[:, 1:] = (floats(harmonics.reshape(n, k - 1, 3)) - 128) / 128
    return Gaussians(
        _positions(header, positions),
        _threes(quats) if header.version >= THREES else _first_three(quats),
        floats(scales) / SCALE_STEPS + SCALE_LEAST,
        byte_opacities(alphas[:, 0]),
        sh,
    )


def _positions(header: Header, data: np.ndarray) -> Float[Tensor, "n 3"]:
    if header.version == HALVES:
        return floats(np.ascontiguousarray(data).view("<f2"))
    low, middle, high = (data[:, i::3].astype(np.int32) for i in range(3))
    fixed = low | middle << 8 | high.astype(np.uint8).view(np.int8).astype(np.int32) << 16
    return torch.from_numpy(fixed.astype(np.float64) / 2**header.fraction).float()


def _first_three(data: np.ndarray) -> Float[Tensor, "n 4"]:
    """Versions 1 and 2: components x, y, z; w follows and is not negative."""
    xyz = floats(data) / 127.5 - 1
    return largest_last(xyz, torch.zeros(len(xyz)))


def _threes(data: np.ndarray) -> Float[Tensor, "n 4"]:
    """2 bits for the index of the largest component (xyzw), then 10 bits for each of the others."""
    words = np.ascontiguousarray(data).view("<u4")[:, 0].astype(np.int64)
    fields = [(words >> shift) & 1023 for shift in (20, 10, 0)]
    parts = [(f & MAGNITUDE) * np.where(f > MAGNITUDE, -1, 1) for f in fields]
    rest = floats(np.stack(parts, axis=1)) / MAGNITUDE / 2**0.5
    xyzw = largest_last(rest, torch.from_numpy(words >> 30))
    return xyzw[:, [3, 0, 1, 2]]

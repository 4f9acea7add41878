"""Niantic's .spz, versions 1 to 4 (github.com/nianticlabs/spz, README), read through zlib and zstandard.

Header: magic "NGSP", version, count (uint32 each), SH degree, bits of a position's fraction, flags, reserved (bytes).
Then sections, each for all Gaussians: positions (3 × 24-bit fixed point; float16 in version 1), opacities, colours,
log-scales, quaternions, harmonics, mostly a byte per number.  Versions 1 to 3 are one gzip stream; version 4 has a
longer header, a table of sizes, and a zstd stream per section.  Axes are x right, y up, z back; a scene here has y down
and z forward.  Flag 1: trained with antialiasing; the file does not say with which kernel.

gsply (the extra `spz`) writes version 3, which every reader of the format knows.  It packs the numbers; this module
adds the axes, the flag, and as many bits of a position's fraction as the scene allows.
"""

import gzip
import io
import math
import struct
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
import zstandard
from jaxtyping import Float
from torch import Tensor

from aaplug.core.conventions import CLASSIC, SpzAxes
from aaplug.core.gaussians import Gaussians
from aaplug.io.atomic import replacing
from aaplug.io.limits import whole_limit
from aaplug.io.scenes.options import SceneFileOptions
from aaplug.io.scenes.packed import byte_opacities, check_growth, floats, half_turn_about_x, largest_last
from aaplug.io.scenes.scene import COMPENSATED, KERNEL_LOST, Scene, check_count, library_errors
from aaplug.system.errors import FormatError, OutputError
from aaplug.system.locks import scratch

MAGIC = b"NGSP"
GZIP_SIGNATURE = b"\x1f\x8b"
GZIP_WINDOW = 31  # zlib's code for a gzip stream with the largest window
MAX_WINDOW = 1 << 27  # bytes: zstd's own maximum
HEADER = struct.Struct("<4sIIBBBB")  # magic, version, count, degree, fraction bits, flags, reserved
HEADER_4 = struct.Struct("<4sIIBBBBI12x")  # the reserved byte counts streams; then the table's place
STREAM = struct.Struct("<QQ")  # compressed and decompressed size
FIRST_VERSION = 1  # positions are float16
WORD_QUATERNIONS_VERSION = 3  # quaternions are words: the smallest three components, 10 bits each
STREAMS_VERSION = 4  # a zstd stream per section; the last version
MAX_DEGREE = 4
MAX_FRACTION = 24  # bits of a position
COLOUR_GAIN = 0.15  # stored colour over the harmonic of degree 0
SCALE_STEPS, MIN_LOG_SCALE = 16.0, -10.0  # log-scales: steps per unit, and the smallest
MAGNITUDE_MASK = 511  # 9 bits of a quaternion's component; the tenth is its sign
WRITTEN_VERSION = 3
MAX_WRITTEN_GAUSSIANS = 10_000_000  # accepted by readers of versions before 4 (nianticlabs/spz)
MAX_WRITTEN_DEGREE = 3  # of harmonics that gsply writes
MAX_WRITTEN_FRACTION = 20  # bits: a millionth of a unit
POSITION_BITS = 23  # of a position's fixed-point number, beside its sign
FLAGS_BYTE = 14  # place in the header
ANTIALIASED_FLAG = 1
MAX_LOGIT = 30.0  # in float32 its opacity is 1
# TURNS lead from the axes of the file to OpenCV's, and back.
TURNS: Mapping[str, Callable[[Gaussians], Gaussians]] = {"opengl": half_turn_about_x, "opencv": lambda scene: scene}
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
        position = 6 if self.version == FIRST_VERSION else 9
        quaternion = 4 if self.version >= WORD_QUATERNIONS_VERSION else 3
        return position, 1, 3, 3, quaternion, 3 * ((self.degree + 1) ** 2 - 1)


def sniff(path: Path, head: bytes) -> bool:
    """True for a file that begins with the magic, and for a gzip stream with the suffix .spz."""
    return head.startswith(MAGIC) or (head.startswith(GZIP_SIGNATURE) and path.suffix.lower() == ".spz")


def open_scene(path: Path, options: SceneFileOptions) -> Scene:
    """Decompress a scene; see `SceneFormat`."""
    with library_errors(path):
        header, sections = _sections(path)
    convention, evidence = CLASSIC, "the flag antialiased is not set: assumed classic"
    if header.flags & ANTIALIASED_FLAG:
        convention, evidence = COMPENSATED, f"the flag antialiased is set; {KERNEL_LOST}"

    def reading(axes: SpzAxes, other: Scene | None = None) -> Scene:
        load, notes = partial(_rows, header, sections, TURNS[axes]), (f"version {header.version}", AXES_NOTES[axes])
        return Scene(path, name, header.count, header.degree, load, evidence, convention, notes=notes, other=other)

    if options.spz_axes == "auto":  # the header does not name its writer
        return reading("opengl", reading("opencv"))
    return reading(options.spz_axes)


def _sections(path: Path) -> tuple[Header, list[np.ndarray]]:
    data = path.read_bytes()
    zipped = data.startswith(GZIP_SIGNATURE)
    header = _header(
        path, zlib.decompressobj(GZIP_WINDOW).decompress(data, HEADER.size) if zipped else data[: HEADER.size]
    )
    sizes = [width * header.count for width in header.widths]
    if header.version >= STREAMS_VERSION:
        if zipped:
            raise FormatError(path, f"version {header.version} should not be one gzip stream")
        parts: Iterable[bytes] = _streams(path, data, sizes)
    else:
        payload, ends = _payload(path, data, sum(sizes), zipped), np.cumsum(sizes).tolist()
        parts = (payload[end - size : end] for size, end in zip(sizes, ends, strict=True))
    shaped = zip(parts, header.widths, strict=True)
    return header, [np.frombuffer(part, np.uint8).reshape(header.count, width) for part, width in shaped]


def _header(path: Path, data: bytes) -> Header:
    if len(data) < HEADER.size or not data.startswith(MAGIC):
        raise FormatError(path, "is not an .spz: its header is missing")
    _, version, count, degree, fraction, flags, _ = HEADER.unpack(data)
    if not FIRST_VERSION <= version <= STREAMS_VERSION:
        raise FormatError(path, f"is .spz of version {version}; known are 1 to {STREAMS_VERSION}")
    if degree > MAX_DEGREE or fraction > MAX_FRACTION:
        raise FormatError(path, f"has the impossible SH degree {degree} or {fraction} bits of fraction")
    check_count(path, count)
    return Header(version, count, degree, fraction, flags)


def _payload(path: Path, data: bytes, size: int, zipped: bool) -> bytes:
    whole = HEADER.size + size
    if zipped:
        check_growth(path, whole, len(data))
        slack = whole_limit("SLACK")
        inflated = zlib.decompressobj(GZIP_WINDOW).decompress(data, whole + slack + 1)
        if not whole <= len(inflated) <= whole + slack:  # a few bytes more are accepted
            many = "more than " * (len(inflated) > whole + slack)
            raise FormatError(path, f"inflates to {many}{len(inflated):,} bytes where its header promises {whole:,}")
        return inflated[HEADER.size :]
    if len(data) < whole:
        raise FormatError(path, f"is cut short: {whole:,} bytes promised, {len(data):,} there")
    return data[HEADER.size :]


def _streams(path: Path, data: bytes, sizes: list[int]) -> Iterable[bytes]:
    """The sections of version 4; an empty section has no stream."""
    if len(data) < HEADER_4.size:
        raise FormatError(path, "is cut short in its header")
    *_, number, table = HEADER_4.unpack_from(data)
    wanted = sum(size > 0 for size in sizes)
    at = table + number * STREAM.size
    if number != wanted or table < HEADER_4.size or at > len(data):
        what = f"has {number} streams listed at byte {table:,}"
        raise FormatError(path, f"{what}; {wanted} and a place within the file expected")
    check_growth(path, sum(sizes), len(data))
    listed = iter(STREAM.unpack_from(data, table + i * STREAM.size) for i in range(number))
    for size in sizes:
        if not size:
            yield b""
            continue
        compressed, inflated = next(listed)
        if inflated != size or at + compressed > len(data):
            what = f"lists a stream of {compressed:,} bytes for {inflated:,}"
            raise FormatError(path, f"{what}; {size:,} expected, and {len(data) - at:,} bytes are left")
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
        with decompressor.stream_reader(io.BytesIO(data[at : at + compressed])) as stream:
            section = stream.read(size + 1)
        if len(section) != size:
            raise FormatError(path, f"a stream inflates to {len(section):,} bytes where {size:,} are promised")
        yield section
        at += compressed


def _rows(
    header: Header, sections: list[np.ndarray], turn: Callable[[Gaussians], Gaussians], start: int, stop: int
) -> Gaussians:
    positions, alphas, colours, scales, quats, harmonics = (section[start:stop] for section in sections)
    n, k = len(positions), (header.degree + 1) ** 2
    sh = torch.zeros(n, k, 3)
    sh[:, 0] = (floats(colours) / 255 - 0.5) / COLOUR_GAIN
    sh[:, 1:] = (floats(harmonics.reshape(n, k - 1, 3)) - 128) / 128
    if header.version >= WORD_QUATERNIONS_VERSION:
        unit = _threes(quats)
    else:  # x, y, z; w follows and is not negative
        unit = largest_last(floats(quats) / 127.5 - 1, torch.zeros(n))
    if header.version == FIRST_VERSION:
        means = floats(np.ascontiguousarray(positions).view("<f2"))
    else:  # fixed point in three bytes, the last with the sign
        low, middle, high = (positions[:, i::3].astype(np.int32) for i in range(3))
        fixed = low | middle << 8 | high.astype(np.uint8).view(np.int8).astype(np.int32) << 16
        means = torch.from_numpy(fixed.astype(np.float64) / 2**header.fraction).float()
    log_scales = floats(scales) / SCALE_STEPS + MIN_LOG_SCALE
    return turn(Gaussians(means, unit, log_scales, byte_opacities(alphas[:, 0]), sh))


def _threes(data: np.ndarray) -> Float[Tensor, "n 4"]:
    """2 bits for the index of the largest component (xyzw), then 10 bits for each of the others."""
    words = np.ascontiguousarray(data).view("<u4")[:, 0].astype(np.int64)
    fields = [(words >> shift) & 1023 for shift in (20, 10, 0)]
    parts = [(f & MAGNITUDE_MASK) * np.where(f > MAGNITUDE_MASK, -1, 1) for f in fields]
    rest = floats(np.stack(parts, axis=1)) / MAGNITUDE_MASK / 2**0.5
    xyzw = largest_last(rest, torch.from_numpy(words >> 30))
    return xyzw[:, [3, 0, 1, 2]]


def write(path: Path, parts: Iterable[Gaussians], count: int, overwrite: bool, options: SceneFileOptions) -> None:
    """Write a scene, with values rounded to the format's steps."""
    turn = TURNS["opengl" if options.spz_axes == "auto" else options.spz_axes]
    content = _packed(path, [turn(_checked(path, part)) for part in parts])
    with replacing(path, overwrite) as stream:
        stream.write(content)


def _checked(path: Path, part: Gaussians) -> Gaussians:
    """The part; refuses what the format cannot hold."""
    if part.flat:
        raise OutputError(path, "cannot hold 2D Gaussians; write a .ply")
    if part.filter_3d is not None:
        raise OutputError(path, "cannot hold a filter_3D; aaplug convert fuses it")
    if part.sh_degree > MAX_WRITTEN_DEGREE:
        degrees = f"up to degree {MAX_WRITTEN_DEGREE}, not {part.sh_degree}"
        raise OutputError(path, f"gsply writes harmonics {degrees}; write a .ply")
    return part


def _packed(path: Path, scenes: list[Gaussians]) -> bytes:
    count = sum(map(len, scenes))
    if count > MAX_WRITTEN_GAUSSIANS:
        raise OutputError(path, f"readers take {MAX_WRITTEN_GAUSSIANS:,} Gaussians, not {count:,}; write a .ply")
    from gsply.gsdata import GSData  # an optional package, and slow to import
    from gsply.spz import write_spz

    def column(values: Callable[[Gaussians], torch.Tensor]) -> np.ndarray:
        return torch.cat([values(scene) for scene in scenes]).contiguous().numpy()

    means = column(lambda s: s.means)
    farthest = float(np.abs(means).max(initial=0.0))
    fraction = POSITION_BITS - math.frexp(farthest)[1] if farthest else MAX_WRITTEN_FRACTION  # the farthest still fits
    if fraction < 1:
        raise OutputError(path, f"cannot hold positions as far as {farthest:g} from the origin; write a .ply")
    with library_errors(path), scratch() as folder:
        file = folder / "scene.spz"
        data = GSData.from_arrays(
            means=means,
            scales=column(lambda s: s.log_scales),
            quats=column(lambda s: s.unit_quats),
            opacities=column(lambda s: s.logit_opacities.clamp(-MAX_LOGIT, MAX_LOGIT)),
            sh0=column(lambda s: s.sh[:, 0]),
            shN=column(lambda s: s.sh[:, 1:]),
            format="ply",
        )
        write_spz(file, data, version=WRITTEN_VERSION, fractional_bits=min(fraction, MAX_WRITTEN_FRACTION))
        content = bytearray(gzip.decompress(file.read_bytes()))
    content[FLAGS_BYTE] = ANTIALIASED_FLAG * scenes[0].convention.compensated
    return gzip.compress(content, mtime=0)

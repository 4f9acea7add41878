"""Niantic's .spz, versions 1 to 4 (github.com/nianticlabs/spz, README), read through zlib and zstandard.

Header: magic "NGSP", version, count (uint32 each), SH degree, bits of a position's fraction, flags, reserved (bytes).
Then sections, each for all Gaussians: positions (3 × 24-bit fixed point; float16 in version 1), opacities, colours,
log-scales, quaternions, harmonics, mostly a byte per number.  Versions 1 to 3 are one gzip stream; version 4 has a
longer header, a table of sizes, and a zstd stream per section.  Axes are x right, y up, z back; a scene here has y down
and z forward.  Flag 1: trained with antialiasing; the file does not say with which kernel.  Flag 2: records follow the
header (version 4) or the sections; Adobe's coordinate system among them names other axes.

Version 4 is written with that record, version 3 for older readers without it, version 2 for glTF.
"""

import gzip
import io
import math
import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from itertools import accumulate, pairwise
from pathlib import Path

import numpy as np
import torch
import zstandard
from jaxtyping import Float
from torch import Tensor

from aaplug.core.conventions import CLASSIC
from aaplug.core.gaussians import Gaussians, joined
from aaplug.core.placing import mirrored
from aaplug.io.atomic import write_file
from aaplug.io.limits import whole_limit
from aaplug.io.scenes.packed import byte_opacities, bytes_of, floats, largest_last, without_largest
from aaplug.io.scenes.record import holdable, warn_of_moves, warn_of_sizes
from aaplug.io.scenes.rows import SceneFileOptions, check_count, check_growth, library_errors
from aaplug.io.scenes.scene import COMPENSATED, KERNEL_LOST, Scene
from aaplug.system.errors import FormatError, OutputError

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
MAX_OLD_GAUSSIANS, MAX_OLD_DEGREE = 10_000_000, 3  # accepted by readers of versions before 4 (nianticlabs/spz)
MAX_WRITTEN_FRACTION = 20  # bits: a millionth of a unit
POSITION_BITS = 23  # of a position's fixed-point number, beside its sign
REACH = 2.0 ** (POSITION_BITS - 1)  # world units, below which positions lie, for at least one bit of fraction
# a quaternion times 1, i, j or k, by the component that is then w: the same Gaussian, turned by halves about its axes
HALF_TURNED = torch.tensor([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
HALF_TURN_SIGNS = torch.tensor([[1.0, 1, 1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1], [-1, 1, -1, 1]])
ANTIALIASED_FLAG, EXTENSIONS_FLAG = 1, 2
RECORD = struct.Struct("<II")  # an extension's type and length
COORDINATES = 0xADBE0003  # the type SPZ_ADOBE_coordinate_system: one of these numbers
AXES = ("", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF")  # where x, y and z point, by number
ZSTD_LEVEL = 9
NAMED_AXES = {  # axes, and a note, by `spz_axes`
    "opengl": (
        "RUB",
        "axes turned from OpenGL's to OpenCV's, by the specification "
        "(`spz_axes` opencv if the writer did not turn them, as splat-transform and gsply)",
    ),
    "opencv": ("RDF", "axes as stored (`spz_axes` opencv)"),
}

name = "spz"
keeps = ("harmonics", "compensation")


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
        header, sections, axes = parsed(path, path.read_bytes())
    convention, evidence = CLASSIC, "the flag antialiased is not set: assumed classic"
    if header.flags & ANTIALIASED_FLAG:
        convention, evidence = COMPENSATED, f"the flag antialiased is set; {KERNEL_LOST}"

    def reading(axes: str, note: str, other: Scene | None = None) -> Scene:
        load, notes = partial(rows, header, sections, axes), (f"version {header.version}", note)
        return Scene(path, name, header.count, header.degree, load, evidence, convention, notes=notes, other=other)

    if options.spz_axes != "auto":
        return reading(*NAMED_AXES[options.spz_axes])
    if axes is not None:
        return reading(axes, f"axes turned from {axes}, which the file states, to RDF")
    return reading(*NAMED_AXES["opengl"], reading(*NAMED_AXES["opencv"]))


def parsed(path: Path, data: bytes) -> tuple[Header, list[np.ndarray], str | None]:
    """A file's header, its sections with a row per Gaussian, and the axes that it states; or those of a part of it."""
    zipped = data.startswith(GZIP_SIGNATURE)
    head = zlib.decompressobj(GZIP_WINDOW).decompress(data, HEADER.size) if zipped else data[: HEADER.size]
    if len(head) < HEADER.size or not head.startswith(MAGIC):
        raise FormatError(path, "is not an .spz: its header is missing")
    header = Header(*HEADER.unpack(head)[1:6])
    if not FIRST_VERSION <= header.version <= STREAMS_VERSION:
        raise FormatError(path, f"is .spz of version {header.version}; known are 1 to {STREAMS_VERSION}")
    if header.degree > MAX_DEGREE or header.fraction > MAX_FRACTION:
        raise FormatError(path, f"has the impossible SH degree {header.degree} or {header.fraction} bits of fraction")
    check_count(path, header.count)
    sizes = [width * header.count for width in header.widths]
    if header.version >= STREAMS_VERSION:
        if zipped:
            raise FormatError(path, f"version {header.version} should not be one gzip stream")
        parts, records = _streams(path, data, sizes)
    else:
        whole, payload = HEADER.size + sum(sizes), data
        if zipped:
            check_growth(path, whole, len(data))
            slack = whole_limit("SLACK")
            payload = zlib.decompressobj(GZIP_WINDOW).decompress(data, whole + slack + 1)
            if len(payload) > whole + slack:  # a few bytes more are accepted
                raise FormatError(path, f"inflates to more than {whole + slack:,} bytes, its header promises {whole:,}")
        if len(payload) < whole:
            raise FormatError(path, f"is cut short: {whole:,} bytes promised, {len(payload):,} there")
        payload = payload[HEADER.size :]
        parts = (payload[start:end] for start, end in pairwise(accumulate(sizes, initial=0)))
        records = payload[sum(sizes) :]
    shaped = zip(parts, header.widths, strict=True)
    sections = [np.frombuffer(part, np.uint8).reshape(header.count, width) for part, width in shaped]
    return header, sections, _axes(path, records) if header.flags & EXTENSIONS_FLAG else None


def _axes(path: Path, records: bytes) -> str | None:
    """The axes that a file's records state, the last one that counts."""
    found, at = None, 0
    while at + RECORD.size <= len(records):
        kind, length = RECORD.unpack_from(records, at)
        at += RECORD.size
        if kind == COORDINATES and length >= 4 and at + 4 <= len(records):
            number = int.from_bytes(records[at : at + 4], "little")
            if number >= len(AXES):
                known = ", ".join(f"{i} ({axes})" for i, axes in enumerate(AXES) if axes)
                raise FormatError(path, f"states the coordinate system {number}; known are {known}")
            found = AXES[number] or None
        at += length
    return found


def _streams(path: Path, data: bytes, sizes: list[int]) -> tuple[list[bytes], bytes]:
    """The sections of version 4, and the records before them; an empty section has no stream."""
    if len(data) < HEADER_4.size:
        raise FormatError(path, "is cut short in its header")
    *_, number, table = HEADER_4.unpack_from(data)
    wanted = sum(size > 0 for size in sizes)
    at = table + number * STREAM.size
    if number != wanted or table < HEADER_4.size or at > len(data):
        what = f"has {number} streams listed at byte {table:,}"
        raise FormatError(path, f"{what}; {wanted} and a place within the file expected")
    check_growth(path, sum(sizes), len(data))
    sections, listed = list[bytes](), STREAM.iter_unpack(data[table:at])
    for size in sizes:
        if not size:
            sections.append(b"")
            continue
        compressed, inflated = next(listed)
        if inflated != size:
            raise FormatError(path, f"lists a stream that inflates to {inflated:,} bytes, {size:,} expected")
        if at + compressed > len(data):
            raise FormatError(path, f"is cut short: {at + compressed:,} bytes promised, {len(data):,} there")
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
        with decompressor.stream_reader(io.BytesIO(data[at : at + compressed])) as stream:
            section = stream.read(size + 1)
        if len(section) != size:
            raise FormatError(path, f"a stream inflates to {len(section):,} bytes where {size:,} are promised")
        sections.append(section)
        at += compressed
    return sections, data[HEADER_4.size : table]


def rows(header: Header, sections: list[np.ndarray], axes: str, start: int, stop: int) -> Gaussians:
    """The rows from start up to stop, of a file in these axes."""
    positions, alphas, colours, scales, quats, harmonics = (section[start:stop] for section in sections)
    n, k = len(positions), (header.degree + 1) ** 2
    sh = torch.zeros(n, k, 3)
    sh[:, 0] = (floats(colours) / 255 - 0.5) / COLOUR_GAIN
    sh[:, 1:] = (floats(harmonics.reshape(n, k - 1, 3)) - 128) / 128
    if header.version >= WORD_QUATERNIONS_VERSION:
        words = np.ascontiguousarray(quats).view("<u4")[:, 0].astype(np.int64)  # 2 bits for the largest, 10 for others
        fields = np.stack([(words >> shift) & 1023 for shift in (20, 10, 0)], axis=1)
        signed = (fields & MAGNITUDE_MASK) * np.where(fields > MAGNITUDE_MASK, -1, 1)
        xyzw = largest_last(floats(signed) / MAGNITUDE_MASK / 2**0.5, torch.from_numpy(words >> 30))
        unit = xyzw.roll(1, dims=1)
    else:  # x, y, z; w follows and is not negative
        unit = largest_last(floats(quats) / 127.5 - 1, torch.zeros(n))
    if header.version == FIRST_VERSION:
        means = floats(np.ascontiguousarray(positions).view("<f2"))
    else:  # fixed point in three bytes, the last with the sign
        low, middle, high = (positions[:, i::3].astype(np.int32) for i in range(3))
        fixed = low | middle << 8 | high.astype(np.uint8).view(np.int8).astype(np.int32) << 16
        means = torch.from_numpy(fixed.astype(np.float64) / 2**header.fraction).float()
    log_scales = floats(scales) / SCALE_STEPS + MIN_LOG_SCALE
    return _turned(Gaussians(means, unit, log_scales, byte_opacities(alphas[:, 0]), sh), axes)


def _turned(scene: Gaussians, axes: str) -> Gaussians:
    """The scene from these axes to OpenCV's, RDF, or back."""
    return scene if axes == "RDF" else mirrored(scene, [1.0 if axis in "RDF" else -1.0 for axis in axes])


def write(path: Path, parts: Iterable[Gaussians], count: int, overwrite: bool, options: SceneFileOptions) -> None:
    """Write a scene, with values rounded to the format's steps."""
    axes, _ = NAMED_AXES["opengl" if options.spz_axes == "auto" else options.spz_axes]
    write_file(path, packed(path, _turned(joined([*parts]), axes), options.spz_version, axes), overwrite)


def packed(path: Path, scene: Gaussians, version: int, axes: str) -> bytes:
    """The content of a .spz of version 2, 3 or 4, which alone states these axes, the scene's own.

    Raises OutputError for a scene that it cannot hold.
    """
    old, count = version < STREAMS_VERSION, len(scene)
    holdable(path, scene, name, MAX_OLD_DEGREE if old else MAX_DEGREE)
    if old and count > MAX_OLD_GAUSSIANS:
        raise OutputError(path, f"readers take {MAX_OLD_GAUSSIANS:,} Gaussians, not {count:,}; write a .ply")
    farthest = float(scene.means.abs().max()) if count else 0.0
    if farthest >= REACH:
        where = f"positions as far as {farthest:g} from the origin"
        raise OutputError(path, f"cannot hold {where}; move the scene by aaplug merge, or write a .ply")
    fraction = min(POSITION_BITS - math.frexp(farthest)[1], MAX_WRITTEN_FRACTION)  # the farthest still fits
    warn_of_moves(path, name, scene, (scene.means * 2**fraction).round() / 2**fraction - scene.means)
    warn_of_sizes(path, name, scene, MIN_LOG_SCALE, MIN_LOG_SCALE + 255 / SCALE_STEPS)
    sections = _columns(scene, version, fraction)
    flags = ANTIALIASED_FLAG * scene.convention.compensated
    facts = version, count, scene.sh_degree, fraction
    if old:
        return gzip.compress(HEADER.pack(MAGIC, *facts, flags, 0) + b"".join(sections), mtime=0)
    record = RECORD.pack(COORDINATES, 4) + AXES.index(axes).to_bytes(4, "little")
    compressor = zstandard.ZstdCompressor(ZSTD_LEVEL, write_checksum=True)
    streams = [(compressor.compress(data), len(data)) for data in sections if data]
    start = HEADER_4.pack(MAGIC, *facts, flags | EXTENSIONS_FLAG, len(streams), HEADER_4.size + len(record))
    table = b"".join(STREAM.pack(len(data), size) for data, size in streams)
    return start + record + table + b"".join(data for data, _ in streams)


def _columns(scene: Gaussians, version: int, fraction: int) -> list[bytes]:
    """The sections of a scene; the inverse of `rows`."""
    fixed = (scene.means.double() * 2**fraction).round().clamp(max=(1 << POSITION_BITS) - 1).to(torch.int32)
    positions = fixed.numpy().astype("<i4").view(np.uint8).reshape(len(scene), 3, 4)[..., :3]
    if version >= WORD_QUATERNIONS_VERSION:
        rest, largest = without_largest(scene.unit_quats.roll(-1, dims=1).double())
        parts = (rest * (2**0.5 * MAGNITUDE_MASK)).round().long()
        fields = parts.abs().clamp(max=MAGNITUDE_MASK) + (MAGNITUDE_MASK + 1) * (parts < 0)
        words = largest << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
        quats = words.numpy().astype("<u4")
    else:
        quats = _three_bytes(scene.unit_quats)
    columns = [
        positions,
        bytes_of(scene.opacities * 255),
        bytes_of((scene.sh[:, 0] * COLOUR_GAIN + 0.5) * 255),
        bytes_of((scene.log_scales - MIN_LOG_SCALE) * SCALE_STEPS),
        quats,
        bytes_of(scene.sh[:, 1:] * 128 + 128),
    ]
    return [column.tobytes() for column in columns]


def _three_bytes(quats: Float[Tensor, "n 4"]) -> np.ndarray:
    """Bytes of x, y and z of unit quaternions, wxyz, or of the half turn that these bytes hold best.

    Readers take w from the other three.  Where it is small, it would put the Gaussian up to 9 degrees off.
    """
    turned = quats.double()[:, HALF_TURNED] * HALF_TURN_SIGNS  # n, four, wxyz
    turned = turned * torch.where(turned[..., :1] < 0, -1.0, 1.0)
    steps = ((turned[..., 1:] + 1) * 127.5).round()
    read = largest_last((steps / 127.5 - 1).flatten(0, 1), torch.zeros(4 * len(quats)))
    best = (torch.nn.functional.normalize(read).view_as(turned) * turned).sum(dim=2).argmax(dim=1)
    return bytes_of(steps[torch.arange(len(quats)), best])

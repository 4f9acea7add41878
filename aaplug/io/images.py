"""Image files as float tensors, and tensors as PNG and WebP.

Tensors are RGB, float32, [height, width, 3], row 0 at the top, values in [0, 1] as stored (gamma-encoded).  Bit depths
are 8 or 16.  Orientation tags are ignored, those of a TIFF refused: cameras were calibrated on the pixels as they stand
in the file.  An animation is its still picture or first frame, a file of several pictures its first.

Readers raise FormatError for a file that is missing, not an image of `FORMATS`, damaged, or above the limits IMAGE and
IMAGE_EXTRA.  Memory is bounded by the limits before anything is decoded: by the size in the header that Pillow reads,
which OpenCV's pixels must have.
"""

import logging
import os
import re
import struct
import tempfile
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageColor
from torch import Tensor
from torch.nn import functional

from aaplug.core.colours import Colour
from aaplug.core.imaging import levels
from aaplug.io.atomic import AnyPath, write_file
from aaplug.io.limits import whole_limit
from aaplug.system.contracts import contract
from aaplug.system.errors import MAX_VALUE_CHARACTERS, FormatError, OutputError, UsageError, listing, not_one_of, reason
from aaplug.system.executors import torch_threads

LOSSLESS_WEBP = 101  # OpenCV's quality for it
SAMPLE_TYPES = {8: np.uint8, 16: np.uint16}  # by bit depth
ROWS_PER_BAND = 64  # of an image converted to samples at once
ALPHA_CHANNELS = 4  # RGB and alpha
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP")  # of Pillow; OpenCV tells them by the same first bytes
MAX_PIXEL_SIZE = 8  # bytes: four channels of 16 bits
MISREAD = ("CMYK", "LAB")  # modes of Pillow that OpenCV makes other RGB of
TIFF_ORIENTATION = 274  # tag Orientation; 1 turns nothing
TIFF_ALPHA = 338  # tag ExtraSamples
PREMULTIPLIED, STRAIGHT = 1, 2  # its values
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_CHUNK = struct.Struct(">I4s")  # length of the data and kind, before them
PNG_CHECKSUM = 4  # bytes, after them
PNG_PIXELS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")  # chunks that make a still picture
LOSS_MESSAGES = ("Corrupt JPEG data: premature end", "Premature end of JPEG file")  # libjpeg's messages for lost pixels
DAMAGE_MESSAGE = "Corrupt JPEG data"  # libjpeg's for what may be harmless too: bytes between the markers
STDERR = 2  # file descriptor, which the codecs write to directly

log = logging.getLogger("aaplug")


def image_size(path: AnyPath) -> tuple[int, int]:
    """Width and height in px as stored, from the header alone."""
    return _look(Path(path))[0]


def is_transparent(path: Path) -> bool:
    """True for an image whose header tells of transparency; False for what cannot be read."""
    try:
        return _look(path)[1]
    except FormatError:
        return False


@contract
def read_image(path: AnyPath, background: tuple[float, float, float] | None = None) -> Float[Tensor, "h w 3"]:
    """Read an 8- or 16-bit image; a transparent one is composited over `background` in float, and refused if None."""
    return _read(Path(path), 3, background)


def read_rgba(path: AnyPath) -> Float[Tensor, "h w 4"]:
    """Read an 8- or 16-bit image with straight (not premultiplied) alpha; 1 where the file has none."""
    return _read(Path(path), ALPHA_CHANNELS, None)


@contract
def write_png(path: AnyPath, rgb: Float[Tensor, "h w 3"], bit_depth: int = 8, overwrite: bool = False) -> None:
    """Write colours, clamped to [0, 1], as a PNG of 8 or 16 bits.

    Raises:
        OutputError: see `replacing`; also, the file's name does not end in .png.
        UsageError: it is no image of finite floats [height, width, 3], or there is no such bit depth.
    """
    if Path(path).suffix.lower() != ".png":
        raise OutputError(path, "is no name of a PNG, which ends in .png; `aaplug.render` writes other formats")
    write_file(path, encoded(".png", rgb, bit_depth=bit_depth), overwrite)


def checked_image(image: Any, channels: Sequence[int] = (3,)) -> Float[Tensor, "h w c"]:
    """An image that can be stored, without gradients; raises UsageError for anything but finite floats [h, w, c]."""
    got = f"{image.dtype} {list(image.shape)}" if isinstance(image, Tensor) else type(image).__name__
    right = isinstance(image, Tensor) and image.is_floating_point() and image.ndim == 3 and image.numel() > 0
    if not right or image.shape[2] not in channels:
        raise UsageError("image", f"should be a tensor of floats from 0 to 1, [height, width, 3], not {got}")
    if not image.isfinite().all():
        raise UsageError("image", "has colours that are NaN or infinite")
    return image.detach()


@torch_threads(1)
def encoded(suffix: str, image: Float[Tensor, "h w c"], quality: int | None = None, bit_depth: int = 8) -> bytes:
    """The file of an image with 1, 3 or 4 channels, of which the fourth is straight alpha, clamped to [0, 1].

    Bands of rows are converted to OpenCV's BGR order one by one, which keeps the float copies small.

    quality: of a .jpg, whose colour has full resolution, or a .webp, 1 to 100; None is 95, or lossless.  A .png is
        made quickly rather than small if it is 1.
    """
    if bit_depth not in SAMPLE_TYPES:
        raise UsageError("bit_depth", not_one_of(bit_depth, map(str, SAMPLE_TYPES)))
    image = checked_image(image, (1, 3, ALPHA_CHANNELS))
    order = [2, 1, 0, 3][: image.shape[2]] if image.shape[2] > 1 else [0]
    bands = (levels(rows, bit_depth)[..., order].cpu().numpy() for rows in image.split(ROWS_PER_BAND))
    samples = np.concatenate([band.astype(SAMPLE_TYPES[bit_depth]) for band in bands])
    full = cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
    settings = {
        ".jpg": (cv2.IMWRITE_JPEG_QUALITY, 95 if quality is None else quality, *full),
        ".webp": (cv2.IMWRITE_WEBP_QUALITY, LOSSLESS_WEBP if quality is None else quality),
        ".png": () if quality is None else (cv2.IMWRITE_PNG_COMPRESSION, quality),
    }
    success, file = cv2.imencode(suffix, samples, settings[suffix])
    assert success
    return file.tobytes()


def _look(path: Path) -> tuple[tuple[int, int], bool, int]:
    """Width and height in px, whether it is transparent, and a TIFF's kind of alpha, by the header; checks limits."""
    pillow_limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None  # it is lower than ours and only warns
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path, formats=FORMATS) as header:
            size, transparent, mode = header.size, header.has_transparency_data, header.mode
            tags = getattr(header, "tag_v2", {})
            alpha, orientation = tags.get(TIFF_ALPHA, (0,))[-1], tags.get(TIFF_ORIENTATION, 1)
            stored = path.stat().st_size
    except FileNotFoundError as error:
        raise FormatError(path, "does not exist") from error
    except Exception as error:  # Pillow's parsers raise all kinds
        if isinstance(error, OSError) and error.strerror:  # the system's
            raise FormatError(path, f"cannot be read: {reason(error)}") from error
        raise FormatError(path, f"is not an image that can be read ({listing(FORMATS)})") from error
    finally:
        Image.MAX_IMAGE_PIXELS = pillow_limit
    if mode in MISREAD:
        raise FormatError(path, f"has {mode} colours, which OpenCV converts in its own way; save it as RGB PNG")
    if orientation != 1:
        raise FormatError(path, f"has the tag Orientation {orientation}, by which OpenCV turns a TIFF; save it without")
    pixels, most = size[0] * size[1], whole_limit("IMAGE")  # an image above it counts as a decompression bomb
    if pixels > most:
        raise FormatError(path, f"has {size[0]}x{size[1]} px, more than the {most:,} allowed")
    if stored > MAX_PIXEL_SIZE * pixels + whole_limit("IMAGE_EXTRA"):
        raise FormatError(path, f"has {stored:,} bytes, which {size[0]}x{size[1]} px do not need")
    return size, transparent, alpha


@torch_threads(1)
def _read(path: Path, channels: int, background: tuple[float, float, float] | None) -> Float[Tensor, "h w c"]:
    """Values in [0, 1], RGBA or RGB over a background, in bands of rows: memory holds the samples and the result."""
    size, transparent, alpha = _look(path)
    try:
        data = _still(path, path.read_bytes())
        with captured_stderr() as words:
            # UNCHANGED keeps 16 bits and alpha, and ignores the orientation tag
            samples = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
            words.seek(0)
            lines = words.read().decode("ascii", "replace").splitlines()
    except (OSError, MemoryError, cv2.error) as error:
        raise FormatError(path, "cannot be read or is damaged") from error
    if samples is None or any(line.startswith(LOSS_MESSAGES) for line in lines):
        raise FormatError(path, "is damaged or cut short")
    if damage := next((line for line in lines if line.startswith(DAMAGE_MESSAGE)), ""):
        log.warning("%s: is damaged (%s)", path, damage)
    height, width, *stored = samples.shape
    if (width, height) != size:
        raise FormatError(path, f"has {width}x{height} px where its header says {size[0]}x{size[1]}")
    if samples.dtype not in SAMPLE_TYPES.values():
        raise FormatError(path, f"holds {samples.dtype} samples; save it with 8 or 16 bits")
    multiplied = alpha == PREMULTIPLIED or (alpha == STRAIGHT and samples.dtype == np.uint8)  # OpenCV does so itself
    if transparent != (stored == [ALPHA_CHANNELS]) or multiplied:
        raise FormatError(path, "has colours or transparency that OpenCV cannot read; save it as RGB(A) PNG")
    samples = samples.reshape(height, width, -1)
    order = [0, 0, 0] if samples.shape[2] == 1 else [2, 1, 0, 3][: samples.shape[2]]  # from BGR(A) or gray
    composited = len(order) > channels
    if composited and background is None:
        raise FormatError(path, "is transparent; pass `background`, the colour behind it")
    highest, image = np.iinfo(str(samples.dtype)).max, torch.empty(height, width, channels)
    for start in range(0, height, ROWS_PER_BAND):
        rows = torch.from_numpy(samples[start : start + ROWS_PER_BAND, :, order].astype(np.float32) / highest)
        if composited:
            rgb, alpha = rows[..., :3], rows[..., 3:]
            rows = rgb * alpha + torch.tensor(background, dtype=torch.float32) * (1 - alpha)
        image[start : start + ROWS_PER_BAND] = functional.pad(rows, (0, channels - rows.shape[2]), value=1.0)
    return image


def _still(path: Path, data: bytes) -> bytes:
    """A PNG without the chunks of an animation, with which OpenCV also takes pixels that are missing for black."""
    if not data.startswith(PNG_SIGNATURE):
        return data
    parts, at = [PNG_SIGNATURE], len(PNG_SIGNATURE)
    while at + PNG_CHUNK.size <= len(data):
        length, kind = PNG_CHUNK.unpack_from(data, at)
        end = at + PNG_CHUNK.size + length + PNG_CHECKSUM
        if end > len(data):  # OpenCV would make room for what is not there
            raise FormatError(path, "is damaged or cut short")
        if kind in PNG_PIXELS:
            parts.append(data[at:end])
        if kind == PNG_PIXELS[-1]:
            break
        at = end
    return b"".join(parts)


_capturing = threading.Lock()
if hasattr(os, "register_at_fork"):  # no process begins as a copy of one whose stderr is captured
    os.register_at_fork(
        before=_capturing.acquire, after_in_parent=_capturing.release, after_in_child=_capturing.release
    )


@contextmanager
def captured_stderr() -> Iterator[IO[bytes]]:
    """Capture what libpng and libjpeg print: it names no file and would break a progress bar.

    stderr is the whole process's, so one thread captures at a time.  Where the system has files in memory, no folder of
    temporary files is needed.
    """
    in_memory = hasattr(os, "memfd_create")
    with _capturing, open(os.memfd_create("stderr"), "w+b") if in_memory else tempfile.TemporaryFile() as words:
        saved = os.dup(STDERR)
        os.dup2(words.fileno(), STDERR)
        try:
            yield words
        finally:
            os.dup2(saved, STDERR)
            os.close(saved)


def colour_of(text: str, where: str = "background") -> Colour:
    """The opaque colour that CSS writes so, by name, #rrggbb, rgb(...) or hsl(...); raises UsageError at `where`."""
    # Pillow knows CSS's commas, not its spaces
    listed = text if "," in text else re.sub(r"(?<=[\d%])\s+(?=\d)", ",", text)
    try:
        red, green, blue = (min(max(level, 0), 255) / 255 for level in ImageColor.getrgb(listed))
    except ValueError as error:
        takes = 'auto or an opaque colour as CSS writes it, such as white, "#ff8000" or "rgb(255, 128, 0)"'
        raise UsageError(where, f"takes {takes}; got '{text[:MAX_VALUE_CHARACTERS]}'") from error
    return red, green, blue

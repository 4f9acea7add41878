"""Image files as float tensors, and tensors as PNG and WebP.

Tensors are RGB, float32, [height, width, 3], row 0 at the top, values in [0, 1] as stored (gamma-encoded).  Bit depths
are 8 or 16.  Orientation tags are ignored: cameras were calibrated on the pixels as they stand in the file.

Readers raise FormatError for a file that is missing, not an image, damaged, or above the limit IMAGE.
"""

import logging
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import IO

import cv2
import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from aaplug.core.errors import FormatError
from aaplug.core.imaging import levels
from aaplug.io.atomic import replacing
from aaplug.io.limits import whole_limit

LOSSLESS_WEBP = 101  # OpenCV's quality for it
SAMPLE_TYPES = {8: np.uint8, 16: np.uint16}  # by bit depth
ROWS = 256  # of an image converted to samples at once
ALPHA_CHANNELS = 4  # RGB and alpha
DAMAGE = ("Corrupt JPEG data", "Premature end of JPEG file")  # libjpeg's messages for lost pixels
STDERR = 2  # file descriptor, which the codecs write to directly

log = logging.getLogger("aaplug")


def image_size(path: str | PathLike[str]) -> tuple[int, int]:
    """Width and height in px as stored, from the header alone."""
    return _look(Path(path))[0]


def read_image(
    path: str | PathLike[str], background: tuple[float, float, float] | None = None
) -> Float[Tensor, "h w 3"]:
    """Read an 8- or 16-bit image; a transparent one is composited over `background` in float, and refused if None."""
    pixels = torch.from_numpy(_read(Path(path)))
    if pixels.shape[2] < ALPHA_CHANNELS:
        return pixels
    if background is None:
        raise FormatError(path, "is transparent; pass `background`, the colour behind it")
    rgb, alpha = pixels[..., :3], pixels[..., 3:]
    return rgb * alpha + torch.tensor(background, dtype=torch.float32) * (1 - alpha)


def read_rgba(path: str | PathLike[str]) -> Float[Tensor, "h w 4"]:
    """Read an 8- or 16-bit image with straight (not premultiplied) alpha; 1 where the file has none."""
    pixels = torch.from_numpy(_read(Path(path)))
    opaque = torch.ones_like(pixels[..., :1])
    return pixels if pixels.shape[2] == ALPHA_CHANNELS else torch.cat([pixels, opaque], dim=2)


def write_png(
    path: str | PathLike[str], rgb: Float[Tensor, "h w 3"], bit_depth: int = 8, overwrite: bool = False
) -> None:
    """Write colours, clamped to [0, 1], as a PNG; see `replacing`."""
    png = _encoded(".png", _stored(rgb, bit_depth))
    with replacing(path, overwrite) as stream:
        stream.write(png)


def encode_webp(rgb: Float[Tensor, "h w 3"], quality: int | None) -> bytes:
    """A WebP file of colours clamped to [0, 1], in 8 bits.  quality: 1 to 100; None is lossless."""
    setting = LOSSLESS_WEBP if quality is None else quality
    return _encoded(".webp", _stored(rgb, 8), cv2.IMWRITE_WEBP_QUALITY, setting)


def _encoded(suffix: str, samples: np.ndarray, *settings: int) -> bytes:
    done, file = cv2.imencode(suffix, samples, settings)
    assert done
    return file.tobytes()


def _stored(rgb: Float[Tensor, "h w 3"], bit_depth: int) -> np.ndarray:
    """Samples in OpenCV's BGR order, converted in bands of rows to keep the float copies small."""
    parts = (levels(rows, bit_depth).flip(2).cpu().numpy() for rows in rgb.split(ROWS))
    return np.concatenate([part.astype(SAMPLE_TYPES[bit_depth]) for part in parts])


def _look(path: Path) -> tuple[tuple[int, int], bool]:
    """Width and height, and whether the header declares transparency."""
    try:
        with _no_pillow_limit(), Image.open(path) as header:
            size, transparent = header.size, header.has_transparency_data
    except FileNotFoundError as error:
        raise FormatError(path, "does not exist") from error
    except Exception as error:  # Pillow's parsers raise all kinds
        raise FormatError(path, "is not an image that can be read") from error
    most = whole_limit("IMAGE")  # an image above it counts as a decompression bomb
    if size[0] * size[1] > most:
        raise FormatError(path, f"has {size[0]}x{size[1]} px, more than the {most:,} allowed")
    return size, transparent


@contextmanager
def _no_pillow_limit() -> Iterator[None]:
    """Disable Pillow's own limit, which is lower than ours and only warns."""
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def _read(path: Path) -> np.ndarray:
    """Float32 in [0, 1], RGB or RGBA."""
    _, transparent = _look(path)
    pixels = _decode(path)
    if pixels.dtype not in SAMPLE_TYPES.values():
        raise FormatError(path, f"holds {pixels.dtype} samples; save it with 8 or 16 bits")
    if transparent != (pixels.shape[2] == ALPHA_CHANNELS):
        raise FormatError(path, "has colours or transparency that OpenCV cannot read; save it as RGB(A) PNG")
    image = pixels.astype(np.float32) / np.iinfo(pixels.dtype).max
    order = [0, 0, 0] if image.shape[2] == 1 else [2, 1, 0, 3][: image.shape[2]]
    return np.ascontiguousarray(image[..., order])


def _decode(path: Path) -> np.ndarray:
    """Samples as stored, [h, w, channels], BGR(A) or gray."""
    try:
        with captured_stderr() as words:
            # UNCHANGED keeps 16 bits and alpha, and ignores the orientation tag
            pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
            words.seek(0)
            lines = words.read().decode("ascii", "replace").splitlines()
    except (OSError, MemoryError, cv2.error) as error:
        raise FormatError(path, "cannot be read or is damaged") from error
    if pixels is None:
        raise FormatError(path, "is damaged or cut short")
    if damage := next((line for line in lines if line.startswith(DAMAGE)), ""):
        log.warning("%s: is damaged (%s)", path, damage)
    return pixels[..., None] if pixels.ndim == 2 else pixels


@contextmanager
def captured_stderr() -> Iterator[IO[bytes]]:
    """Capture what libpng, libjpeg and FFmpeg print: it names no file and would break a progress bar."""
    with tempfile.TemporaryFile() as words:
        saved = os.dup(STDERR)
        os.dup2(words.fileno(), STDERR)
        try:
            yield words
        finally:
            os.dup2(saved, STDERR)
            os.close(saved)

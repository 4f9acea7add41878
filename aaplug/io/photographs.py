"""Photographs at the sizes that renders are judged at, by the downscaling that a protocol names.

A photograph is read once; `at(hw, factor)` then gives it `factor` times as dense in pixels, of that height and width,
for a factor up to 1.  Which of the field's ways is taken moves PSNR by 0.5 dB and more, so each has a name.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from aaplug.core.cameras import Lens
from aaplug.core.errors import UsageError
from aaplug.core.imaging import box_average, quantised, resampled
from aaplug.io.images import read_image, read_rgba
from aaplug.io.lenses import straight

At = Callable[[tuple[int, int], float], Float[Tensor, "h w 3"]]
Background = tuple[float, float, float]
LEVELS = 255  # of 8 bits
WHOLE = 1e-6  # slack when a factor is taken for a power of 1/2
HALVING = 2  # px a side: multi-scale Blender data is halved again and again


@dataclass(frozen=True)
class Photograph:
    """One photograph, in memory.  hw: its own height and width in px."""

    hw: tuple[int, int]
    at: At


@dataclass(frozen=True)
class Downscale:
    """One way to make photographs smaller; `protocol` says it in words."""

    name: str
    protocol: str
    read: Callable[[Path, Background, Lens | None], Photograph]


def read_photo(
    path: Path, background: Background, lens: Lens | None = None
) -> Float[Tensor, "h w 3"]:
    """A photograph over a colour, as its camera's pinhole sees it, rounded to 8 bits.

    Raises:
        FormatError: see `read_image`.
    """
    return quantised(straight(read_image(path, background), lens))


def _box(path: Path, background: Background, lens: Lens | None = None) -> Photograph:
    photo = read_photo(path, background, lens)
    return Photograph(
        (photo.shape[0], photo.shape[1]), lambda hw, factor: resampled(photo, factor, hw)
    )


def _rgba_box(path: Path, background: Background, lens: Lens | None = None) -> Photograph:
    """Mip-NeRF's multi-scale Blender data: RGBA halved in float, cut to 8 bits when saved and again when composited."""
    halves = [straight(read_rgba(path), lens)]
    behind = torch.tensor(background)

    def at(hw: tuple[int, int], factor: float) -> Float[Tensor, "h w 3"]:
        depth = round(math.log2(1 / factor))
        if abs(factor * 2**depth - 1) > WHOLE:
            raise UsageError(
                "--scale", f"multi-scale Blender data is halved; {factor:g} is no power of 1/2"
            )
        while len(halves) <= depth:
            halves.append(box_average(halves[-1], HALVING))
        saved = _cut(halves[depth])[: hw[0], : hw[1]]
        return _cut(saved[..., :3] * saved[..., 3:] + behind * (1 - saved[..., 3:]))

    height, width, _ = halves[0].shape
    return Photograph((height, width), at)


def _cut(values: Tensor) -> Tensor:
    """8 bits by truncation; what float32 makes of a whole level stays that level."""
    return (values * LEVELS + 1e-3).floor() / LEVELS


def _pil_bicubic(path: Path, background: Background, lens: Lens | None = None) -> Photograph:
    """3DGS's -r: the 8-bit photograph through Pillow's antialiased bicubic, in 8 bits again."""
    photo = read_photo(path, background, lens)
    picture = Image.fromarray((photo * LEVELS).round().byte().numpy())

    def at(hw: tuple[int, int], factor: float) -> Float[Tensor, "h w 3"]:
        small = picture.resize((hw[1], hw[0]), Image.Resampling.BICUBIC)
        return torch.from_numpy(np.array(small, dtype=np.float32) / LEVELS)

    return Photograph((photo.shape[0], photo.shape[1]), at)


DOWNSCALES = {
    way.name: way
    for way in (
        Downscale(
            "box",
            "box average (area-weighted where the factor is not whole), after compositing and 8-bit rounding",
            _box,
        ),
        Downscale(
            "rgba-box",
            "RGBA halved by 2×2 box means in float, cut to 8 bits, composited, cut again (multi-scale Blender data)",
            _rgba_box,
        ),
        Downscale(
            "pil-bicubic",
            "Pillow's antialiased bicubic on the 8-bit photograph, in 8 bits (3DGS's -r)",
            _pil_bicubic,
        ),
    )
}

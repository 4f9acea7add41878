"""Photographs at the sizes of the renders that they are compared with, by the downscaling that a protocol names.

The choice of downscaling moves PSNR by 0.5 dB and more, so each method of the field has a name in `DOWNSCALES`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from aaplug.core.cameras import Lens
from aaplug.core.errors import UsageError
from aaplug.core.imaging import WHOLE, box_average, levels, quantised, resampled
from aaplug.io.images import read_image, read_rgba
from aaplug.io.lenses import undistorted

At = Callable[[tuple[int, int], float], Float[Tensor, "h w 3"]]
Background = tuple[float, float, float]
LEVELS = 255  # highest level of 8 bits


@dataclass(frozen=True)
class Photograph:
    """One photograph in memory.

    hw: its height and width, in px.
    at: called with a height and width and a factor up to 1, the photograph of that size, `factor` times as dense.
    """

    hw: tuple[int, int]
    at: At


@dataclass(frozen=True)
class Downscale:
    """A downscaling method; `protocol` describes it for reports."""

    name: str
    protocol: str
    read: Callable[[Path, Background, Lens | None], Photograph]


def read_photo(path: str | PathLike[str], background: Background, lens: Lens | None = None) -> Float[Tensor, "h w 3"]:
    """Read a photograph: composite it over `background`, undistort it by its lens, round it to 8 bits."""
    return quantised(undistorted(read_image(path, background), lens))


def _box(path: Path, background: Background, lens: Lens | None = None) -> Photograph:
    photo = read_photo(path, background, lens)
    return Photograph((photo.shape[0], photo.shape[1]), lambda hw, factor: resampled(photo, factor, hw))


def _rgba_box(path: Path, background: Background, lens: Lens | None = None) -> Photograph:
    """Mip-NeRF's multi-scale Blender data: RGBA halved in float, truncated to 8 bits when saved and when composited."""
    halves = [undistorted(read_rgba(path), lens)]
    behind = torch.tensor(background)

    def at(hw: tuple[int, int], factor: float) -> Float[Tensor, "h w 3"]:
        depth = round(math.log2(1 / factor))
        if abs(factor * 2**depth - 1) > WHOLE:
            raise UsageError("scale", f"{factor:g} is not a power of 1/2, as multi-scale Blender data needs")
        while len(halves) <= depth:
            halves.append(box_average(halves[-1], 2))
        saved = _truncated(halves[depth])[: hw[0], : hw[1]]
        return _truncated(saved[..., :3] * saved[..., 3:] + behind * (1 - saved[..., 3:]))

    height, width, _ = halves[0].shape
    return Photograph((height, width), at)


def _truncated(values: Tensor) -> Tensor:
    """Truncate to 8 bits; the slack keeps a whole level that float32 rounded down."""
    return (values * LEVELS + 1e-3).floor() / LEVELS


def _pil_bicubic(path: Path, background: Background, lens: Lens | None = None) -> Photograph:
    """3DGS's -r: Pillow's antialiased bicubic on the 8-bit photograph, rounded to 8 bits again."""
    photo = read_photo(path, background, lens)
    picture = Image.fromarray(levels(photo, 8).byte().numpy())

    def at(hw: tuple[int, int], factor: float) -> Float[Tensor, "h w 3"]:
        small = picture.resize((hw[1], hw[0]), Image.Resampling.BICUBIC)
        return torch.from_numpy(np.array(small, dtype=np.float32) / LEVELS)

    return Photograph((photo.shape[0], photo.shape[1]), at)


BOX = "box average (area-weighted where the factor is not whole), after compositing and 8-bit rounding"
RGBA_BOX = "RGBA halved by 2×2 box means in float, cut to 8 bits, composited, cut again (multi-scale Blender data)"
PIL_BICUBIC = "Pillow's antialiased bicubic on the 8-bit photograph, in 8 bits (3DGS's -r)"
DOWNSCALES = {
    "box": Downscale("box", BOX, _box),
    "rgba-box": Downscale("rgba-box", RGBA_BOX, _rgba_box),
    "pil-bicubic": Downscale("pil-bicubic", PIL_BICUBIC, _pil_bicubic),
}

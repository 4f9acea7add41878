"""Photographs at the sizes of the renders that they are compared with, by the downscaling that a protocol names.

The choice of downscaling moves PSNR by 0.5 dB and more, so each method of the field has a name in `DOWNSCALES`.
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

from aaplug.core.cameras import WHOLE_SLACK, Camera, Undistortion
from aaplug.core.imaging import Factors, box_average, levels, quantised, resampled
from aaplug.io.atomic import AnyPath
from aaplug.io.images import read_image, read_rgba
from aaplug.io.lenses import undistorted
from aaplug.system.errors import FormatError, UsageError

Background = tuple[float, float, float]
MAX_LEVEL = 255  # of 8 bits


@dataclass(frozen=True)
class Photograph:
    """One photograph in memory.

    hw: its height and width, in px.
    at: called with a height and width and factors up to 1, the photograph of that size, with so much denser rows and
        columns.
    """

    hw: tuple[int, int]
    at: Callable[[tuple[int, int], Factors], Float[Tensor, "h w 3"]]

    def factors(self, view: Camera, scale: float) -> Factors:
        """The density, relative to the photograph's own, of pixels `scale` times as dense as those of its view.

        A photograph may be larger or smaller than the size at which its view was trained, and both were rounded.
        Raises FormatError if it is not of the camera's shape.
        """
        (height, width), rounding = self.hw, 1 + max(view.hw) / min(view.hw)  # px of the smaller of the two
        if abs(height - width * view.height / view.width) > rounding * max(1, width / view.width):
            cameras = f"the cameras say {view.width}x{view.height}"
            raise FormatError(view.photo or view.name, f"is {width}x{height} px, of another shape than {cameras}")
        return scale * view.height / height, scale * view.width / width


@dataclass(frozen=True)
class Downscale:
    """A downscaling method; `protocol` describes it for reports.

    check: raises UsageError for a factor, up to 1, that the method does not take; None if it takes all.
    """

    protocol: str
    read: Callable[[Path, Background, Undistortion | None], Photograph]
    check: Callable[[float], object] | None = None


def read_photo(
    path: AnyPath, background: Background, undistortion: Undistortion | None = None
) -> Float[Tensor, "h w 3"]:
    """Read a photograph: composite it over `background`, undistort it by its lens, round it to 8 bits."""
    return quantised(undistorted(read_image(path, background), undistortion))


def photo_of(view: Camera, background: Background) -> Callable[[Camera], Float[Tensor, "h w 3"]]:
    """Read the photograph of a view; call it with the same view, with pixels denser or sparser, for its size.

    Below the photograph's own size its pixels are averaged; above it they are interpolated (bicubic, which overshoots).
    """
    assert view.photo is not None
    photograph = _box(view.photo, background, view.undistortion)
    return lambda resized: photograph.at(resized.hw, photograph.factors(view, resized.fx / view.fx))


def _box(path: Path, background: Background, undistortion: Undistortion | None = None) -> Photograph:
    photo = read_photo(path, background, undistortion)
    return Photograph((photo.shape[0], photo.shape[1]), lambda hw, factors: resampled(photo, factors, hw))


def _halvings(factor: float) -> int:
    count = round(math.log2(1 / factor))
    if abs(factor * 2**count - 1) > WHOLE_SLACK:
        raise UsageError("scale", f"{factor:g} is not a power of 1/2, as multi-scale Blender data needs")
    return count


def _rgba_box(path: Path, background: Background, undistortion: Undistortion | None = None) -> Photograph:
    """Mip-NeRF's multi-scale Blender data: RGBA halved in float, truncated to 8 bits when saved and when composited."""
    halves = [undistorted(read_rgba(path), undistortion)]
    behind = torch.tensor(background)

    def at(hw: tuple[int, int], factors: Factors) -> Float[Tensor, "h w 3"]:
        depth = _halvings(factors[1])
        while len(halves) <= depth:
            halves.append(box_average(halves[-1], 2))
        saved = truncated(halves[depth])[: hw[0], : hw[1]]
        return truncated(saved[..., :3] * saved[..., 3:] + behind * (1 - saved[..., 3:]))

    def truncated(values: Tensor) -> Tensor:
        """Truncate to 8 bits; the slack keeps a whole level that float32 rounded down."""
        return (values * MAX_LEVEL + 1e-3).floor() / MAX_LEVEL

    height, width, _ = halves[0].shape
    return Photograph((height, width), at)


def _pil_bicubic(path: Path, background: Background, undistortion: Undistortion | None = None) -> Photograph:
    """3DGS's -r: Pillow's antialiased bicubic on the 8-bit photograph, rounded to 8 bits again."""
    photo = read_photo(path, background, undistortion)
    picture = Image.fromarray(levels(photo, 8).byte().numpy())

    def at(hw: tuple[int, int], factors: Factors) -> Float[Tensor, "h w 3"]:
        small = picture.resize((hw[1], hw[0]), Image.Resampling.BICUBIC)
        return torch.from_numpy(np.array(small, dtype=np.float32) / MAX_LEVEL)

    return Photograph((photo.shape[0], photo.shape[1]), at)


BOX = "box average (area-weighted where the factor is not whole), after compositing and 8-bit rounding"
RGBA_BOX = "RGBA halved by 2×2 box means in float, cut to 8 bits, composited, cut again (multi-scale Blender data)"
PIL_BICUBIC = "Pillow's antialiased bicubic on the 8-bit photograph, in 8 bits (3DGS's -r)"
DOWNSCALES = {
    "box": Downscale(BOX, _box),
    "rgba-box": Downscale(RGBA_BOX, _rgba_box, _halvings),
    "pil-bicubic": Downscale(PIL_BICUBIC, _pil_bicubic),
}

"""Lenses of photographs, and photographs as an undistorted pinhole sees them.

The pinhole keeps the lens's focal length and principal point, so sampling rates are those at the photograph's centre.
Its view is cropped to what the photograph covers.  The centre of the first pixel is (0.5, 0.5) here, (0, 0) in OpenCV.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from aaplug.core.cameras import Camera, Undistortion
from aaplug.core.lenses import EQUIRECT, PINHOLE, Lens
from aaplug.system.errors import UsageError, counted

HALF_PIXEL = 0.5  # px: the centre of OpenCV's first pixel is 0
MIN_SHARE = 0.5  # of a side: a photograph that covers less of its pinhole's view is not used
CACHED_LENSES = 8  # since most photographs share one
PANORAMA = "EQUIRECTANGULAR"  # by COLMAP's and nerfstudio's name
PANORAMIC, BENT = "renders are panoramas, too", "renders are bent as their photos are; `undistort` straightens both"
STRAIGHTENED = "renders are of the pinhole at its centre; photos are undistorted and cropped to what they cover"
UNUSED = "drawn as pinholes, without photos (colmap image_undistorter converts them)"


@dataclass(frozen=True)
class Distortion:
    """A lens model that is no pinhole, by its name in the file.  lens: None for one that `Lens` lacks."""

    name: str
    lens: Lens | None = None


def panorama(width: int, height: int) -> tuple[float, float, float, float]:
    """fx, fy, cx and cy, in px, of an image of 360° × 180°."""
    return width / (2 * math.pi), height / math.pi, width / 2, height / 2


def with_lenses(
    cameras: Sequence[Camera], distortions: Sequence[Distortion | None], undistort: bool
) -> tuple[list[Camera], list[str]]:
    """The cameras with their lenses, without photographs that cannot be used; and notes on the lenses, if any.

    undistort: as pinholes instead, cropped to what their photographs cover; raises UsageError for a panorama.
    """
    drawn, names = list[Camera](), dict[str, list[str]]()  # the names of lens models by what becomes of their cameras
    for camera, distortion in zip(cameras, distortions, strict=True):
        if distortion is not None:
            lens, what = distortion.lens, PANORAMIC if distortion.lens == EQUIRECT else BENT
            if undistort and lens == EQUIRECT:
                problem = f"its photograph is a panorama ({distortion.name}), which no pinhole shows"
                raise UsageError(f"camera {camera.name}", f"{problem}; leave out `undistort`")
            if undistort:
                camera, what = straightened(camera, lens), STRAIGHTENED
            else:
                camera = replace(camera, **({"lens": lens} if lens else {"photo": None}))
            unused = lens is None or (undistort and camera.photo is None)
            names.setdefault(UNUSED if unused else what, []).append(distortion.name)
        drawn.append(camera)
    return drawn, [
        f"{counted(len(each), 'camera')} with another lens than a pinhole ({', '.join(sorted({*each}))}): {what}"
        for what, each in names.items()
    ]


def straightened(camera: Camera, lens: Lens | None) -> Camera:
    """The pinhole of a camera whose photograph was taken by a lens, without the photograph if it cannot be used."""
    if camera.photo is not None and lens is not None:
        size, pinhole = (camera.width, camera.height), (camera.fx, camera.fy, camera.cx, camera.cy)
        whole = Undistortion(lens, size, pinhole, (0, 0, *size))
        if window := _window(whole):
            left, top, width, height = window
            placed = {"width": width, "height": height, "cx": camera.cx - left, "cy": camera.cy - top}
            return replace(camera, **placed, lens=PINHOLE, undistortion=replace(whole, window=window))
    return replace(camera, lens=PINHOLE, photo=None)


def undistorted(image: Float[Tensor, "h w c"], undistortion: Undistortion | None) -> Float[Tensor, "H W c"]:
    """A photograph as its camera's pinhole sees it; unchanged without an undistortion.

    Interpolation is bilinear, as in COLMAP, nerfstudio and gsplat, which train on such images.
    """
    if undistortion is None:
        return image
    height, width = image.shape[:2]
    x, y = _maps(undistortion, width, height)
    return torch.from_numpy(cv2.remap(image.numpy(), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


@lru_cache(CACHED_LENSES)
def _window(whole: Undistortion) -> tuple[int, int, int, int] | None:
    """Left, top, width and height of the pinhole's view that the photograph covers; None if less than MIN_SHARE."""
    width, height = whole.size
    x, y = _maps(whole, width, height)
    outside = ~((x >= -HALF_PIXEL) & (x <= width - HALF_PIXEL) & (y >= -HALF_PIXEL) & (y <= height - HALF_PIXEL))
    x0, y0, x1, y1 = 0, 0, width, height
    while x1 - x0 >= MIN_SHARE * width and y1 - y0 >= MIN_SHARE * height:
        inner = outside[y0:y1, x0:x1]
        sides = [side.mean() for side in (inner[:, 0], inner[0], inner[:, -1], inner[-1])]
        worst = int(np.argmax(sides))
        if sides[worst] == 0:
            return x0, y0, x1 - x0, y1 - y0
        x0, y0 = x0 + (worst == 0), y0 + (worst == 1)
        x1, y1 = x1 - (worst == 2), y1 - (worst == 3)
    return None


@lru_cache(CACHED_LENSES)
def _maps(undistortion: Undistortion, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """For each pixel of the pinhole's window, x and y in a photograph of width × height px, in OpenCV's pixels."""
    scale = torch.tensor([width / undistortion.size[0], height / undistortion.size[1]], dtype=torch.float64)
    left, top, *window = undistortion.window
    rows, columns = (torch.arange(max(1, round(window[i] * float(scale[i]))), dtype=torch.float64) for i in (1, 0))
    y, x = torch.meshgrid((rows + HALF_PIXEL) / len(rows), (columns + HALF_PIXEL) / len(columns), indexing="ij")
    pixels = torch.stack([left + x * window[0], top + y * window[1]], dim=-1)  # of the whole pinhole
    fx, fy, cx, cy = undistortion.pinhole
    focal, centre = pixels.new_tensor([fx, fy]), pixels.new_tensor([cx, cy])
    rays = functional.pad((pixels - centre) / focal, (0, 1), value=1.0)
    places = (undistortion.lens.places(rays) * focal + centre) * scale - HALF_PIXEL
    across, down = places.float().unbind(dim=-1)
    return across.contiguous().numpy(), down.contiguous().numpy()

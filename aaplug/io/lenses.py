"""Lens distortion: cameras and photographs as an undistorted pinhole sees them, by OpenCV.

The pinhole keeps the lens's focal length and principal point, so sampling rates are those at the photograph's centre.
Its view is cropped to what the photograph covers.  The centre of the first pixel is (0.5, 0.5) here, (0, 0) in OpenCV.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera, Lens

HALF_PIXEL = 0.5  # px: the centre of OpenCV's first pixel is 0
MIN_SHARE = 0.5  # of a side: a photograph that covers less of its pinhole's view is not used
CACHED_LENSES = 8  # since most photographs share one


@dataclass(frozen=True)
class Distortion:
    """A lens model.

    coefficients: OpenCV's, k1, k2, p1, p2 and more, or k1 to k4 of a fisheye; None for a model that OpenCV lacks.
    """

    name: str
    coefficients: tuple[float, ...] | None = None
    fisheye: bool = False


def undistorted_cameras(cameras: Sequence[Camera], distortions: Sequence[Distortion | None]) -> list[Camera]:
    """The cameras as pinholes, cropped to what their photographs cover; without photographs that cannot be used."""
    pinholes = []
    for camera, lens in zip(cameras, distortions, strict=True):
        if lens is None:
            pinholes.append(camera)
            continue
        whole = window = None
        if camera.photo is not None and lens.coefficients is not None:
            size, pinhole = (camera.width, camera.height), (camera.fx, camera.fy, camera.cx, camera.cy)
            whole = Lens(lens.coefficients, lens.fisheye, size, pinhole, (0, 0, *size))
            window = _window(whole)
        if whole is None or window is None:
            pinholes.append(replace(camera, photo=None))
            continue
        left, top, width, height = window
        centre = {"cx": camera.cx - left, "cy": camera.cy - top}
        pinholes.append(replace(camera, width=width, height=height, **centre, lens=replace(whole, window=window)))
    return pinholes


def undistorted(image: Float[Tensor, "h w c"], lens: Lens | None) -> Float[Tensor, "H W c"]:
    """A photograph as the pinhole of its lens sees it; unchanged without a lens.

    Interpolation is bilinear, as in COLMAP, nerfstudio and gsplat, which train on such images.
    """
    if lens is None:
        return image
    height, width = image.shape[:2]
    x, y = _maps(lens, width, height)
    return torch.from_numpy(cv2.remap(image.numpy(), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def lens_notes(distortions: Sequence[Distortion | None], cameras: Sequence[Camera]) -> list[str]:
    """A note on the lenses that distort, with the names of their models, if there are any."""
    pairs = [(lens, camera) for lens, camera in zip(distortions, cameras, strict=True) if lens]
    if not pairs:
        return []
    models = ", ".join(sorted({lens.name for lens, _ in pairs}))
    straight = sum(camera.photo is not None for _, camera in pairs)
    what = "their photos are undistorted (OpenCV) and cropped to what they cover"
    if straight < len(pairs):
        lost = "photos whose distortion OpenCV lacks are not used; colmap image_undistorter converts them"
        what = f"{straight} photos are undistorted; other {lost}" if straight else lost
    distort = f"{len(pairs)} cameras have a lens that distorts ({models})"
    return [f"{distort}: renders are of the pinhole at its centre; {what}"]


@lru_cache(CACHED_LENSES)
def _window(whole: Lens) -> tuple[int, int, int, int] | None:
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
def _maps(lens: Lens, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """For each pixel of the pinhole's window, x and y in a photograph of width × height px, in OpenCV's pixels."""
    scale = width / lens.size[0], height / lens.size[1]
    left, top, *window = lens.window
    size = tuple(max(1, round(side * s)) for side, s in zip(window, scale, strict=True))
    zoom = tuple(a / b for a, b in zip(size, window, strict=True))
    photo, pinhole = (_matrix(lens.pinhole, *each) for each in (((0, 0), scale), ((left, top), zoom)))
    maps = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    x, y = maps(photo, np.array(lens.coefficients), np.eye(3), pinhole, size, cv2.CV_32FC1)
    return x, y


def _matrix(
    pinhole: tuple[float, float, float, float], corner: tuple[int, int], scale: tuple[float, ...]
) -> np.ndarray:
    """Intrinsics in OpenCV's pixels of an image that begins at `corner` and is `scale` times as dense."""
    fx, fy, cx, cy = pinhole
    x, y = (cx - corner[0]) * scale[0] - HALF_PIXEL, (cy - corner[1]) * scale[1] - HALF_PIXEL
    return np.array([[fx * scale[0], 0, x], [0, fy * scale[1], y], [0, 0, 1]])

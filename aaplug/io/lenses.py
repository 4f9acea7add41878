"""Photographs through lenses that distort, straightened to what a pinhole at their centre sees, by OpenCV.

A pinhole keeps the lens's focal length and centre, so that rates are those of the photograph's middle; it is cut to
what the photograph shows of it.  Here the centre of the first pixel is (0.5, 0.5), in OpenCV (0, 0).
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

HALF = 0.5  # px: OpenCV's first pixel has its centre at 0
LEAST_SHARE = 0.5  # of a side: where a photograph shows less of its pinhole, it is of no use
MAPS = 8  # of lenses, kept for the photographs that share one


@dataclass(frozen=True)
class Distortion:
    """A lens's model by its name, and OpenCV's coefficients, None for one that OpenCV has not.

    coefficients: k1, k2, p1, p2 and more; of a fisheye k1 to k4.
    """

    name: str
    coefficients: tuple[float, ...] | None = None
    fisheye: bool = False


def straightened(cameras: Sequence[Camera], bent: Sequence[Distortion | None]) -> list[Camera]:
    """The cameras; those that distort as the pinholes that their photographs show, or without them."""
    return [
        camera if lens is None else _straightened(camera, lens)
        for camera, lens in zip(cameras, bent, strict=True)
    ]


def straight(image: Float[Tensor, "h w c"], lens: Lens | None) -> Float[Tensor, "H W c"]:
    """A photograph as the pinhole of its lens sees it; the photograph itself without a lens.

    Interpolation is bilinear, as in COLMAP, nerfstudio and gsplat, whose scenes were trained on such images.
    """
    if lens is None:
        return image
    height, width = image.shape[:2]
    maps = _maps(lens, width, height)
    pixels = cv2.remap(image.numpy(), *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return torch.from_numpy(pixels)


def lens_notes(bent: Sequence[Distortion | None], cameras: Sequence[Camera]) -> list[str]:
    """Lines on lenses that distort, by the names of their models, if there are any."""
    pairs = [(lens, camera) for lens, camera in zip(bent, cameras, strict=True) if lens]
    if not pairs:
        return []
    models = ", ".join(sorted({lens.name for lens, _ in pairs}))
    photographed = [camera for _, camera in pairs if camera.photo]
    what = "their photos are straightened to that (OpenCV) and cut to what they show"
    if len(photographed) < len(pairs):
        what = (
            "photos without OpenCV's distortion are not used; colmap image_undistorter makes some"
        )
        if photographed:
            what = f"{len(photographed)} photos are straightened to that; other {what}"
    return [
        f"{len(pairs)} cameras have a lens that distorts ({models}): renders show the pinhole at its centre; {what}"
    ]


def _straightened(camera: Camera, lens: Distortion) -> Camera:
    if camera.photo is None or lens.coefficients is None:
        return replace(camera, photo=None)
    whole = Lens(
        lens.coefficients,
        lens.fisheye,
        (camera.width, camera.height),
        (camera.fx, camera.fy, camera.cx, camera.cy),
        (0, 0, camera.width, camera.height),
    )
    window = _window(whole)
    if window is None:
        return replace(camera, photo=None)
    left, top, width, height = window
    return replace(
        camera,
        width=width,
        height=height,
        cx=camera.cx - left,
        cy=camera.cy - top,
        lens=replace(whole, window=window),
    )


@lru_cache(MAPS)
def _window(whole: Lens) -> tuple[int, int, int, int] | None:
    """Left, top, width and height of what the photograph shows of its pinhole, None if that is little."""
    width, height = whole.size
    x, y = _maps(whole, width, height)
    outside = ~((x >= -HALF) & (x <= width - HALF) & (y >= -HALF) & (y <= height - HALF))
    x0, y0, x1, y1 = 0, 0, width, height
    while x1 - x0 >= LEAST_SHARE * width and y1 - y0 >= LEAST_SHARE * height:
        sides = (
            outside[y0:y1, x0].mean(),
            outside[y0, x0:x1].mean(),
            outside[y0:y1, x1 - 1].mean(),
            outside[y1 - 1, x0:x1].mean(),
        )
        worst = int(np.argmax(sides))
        if sides[worst] == 0:
            return x0, y0, x1 - x0, y1 - y0
        x0, y0 = x0 + (worst == 0), y0 + (worst == 1)
        x1, y1 = x1 - (worst == 2), y1 - (worst == 3)
    return None


@lru_cache(MAPS)
def _maps(lens: Lens, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Where in a photograph of width × height px each pixel of the pinhole's window lies, in OpenCV's pixels."""
    scale = width / lens.size[0], height / lens.size[1]
    left, top, *window = lens.window
    size = tuple(max(1, round(side * s)) for side, s in zip(window, scale, strict=True))
    own = _matrix(lens.pinhole, (0, 0), scale)
    seen = _matrix(
        lens.pinhole, (left, top), tuple(a / b for a, b in zip(size, window, strict=True))
    )
    coefficients = np.array(lens.coefficients)
    find = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    x, y = find(own, coefficients, np.eye(3), seen, size, cv2.CV_32FC1)
    return x, y


def _matrix(
    pinhole: tuple[float, float, float, float], corner: tuple[int, int], scale: tuple[float, ...]
) -> np.ndarray:
    fx, fy, cx, cy = pinhole
    return np.array(
        [
            [fx * scale[0], 0, (cx - corner[0]) * scale[0] - HALF],
            [0, fy * scale[1], (cy - corner[1]) * scale[1] - HALF],
            [0, 0, 1],
        ]
    )

"""Photographs undistorted, against images of a known plane through lens models written out here."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from aaplug.core.cameras import Camera
from aaplug.io.lenses import Distortion, undistorted, undistorted_cameras
from aaplug.io.photographs import read_photo

SIZE = 160, 120
PINHOLE = 130.0, 125.0, 83.0, 57.0  # fx, fy, cx, cy
LENSES = {
    "barrel": Distortion("OPENCV", (-0.2, 0.05, 0.0, 0.0)),
    "pincushion": Distortion("OPENCV", (0.15, 0.0, 0.002, -0.004)),
    "full": Distortion("FULL_OPENCV", (-0.2, 0.03, 0.001, 0.002, 0.01, 0.02, 0.01, 0.0)),
    "fisheye": Distortion("OPENCV_FISHEYE", (0.03, -0.01, 0.002, 0.0), fisheye=True),
}


def bend(xy: np.ndarray, lens: Distortion) -> np.ndarray:
    """Where a ray (x, y, 1) meets the sensor at focal length 1 (docs.opencv.org, calib3d)."""
    assert lens.coefficients is not None
    x, y = xy.T
    r2 = x * x + y * y
    if lens.fisheye:
        r, angle = np.sqrt(r2), np.arctan(np.sqrt(r2))
        bent = angle * (1 + sum(k * angle ** (2 * i + 2) for i, k in enumerate(lens.coefficients)))
        return xy * np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0)[:, None]
    k1, k2, p1, p2, k3, k4, k5, k6 = (*lens.coefficients, 0, 0, 0, 0)[:8]
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y],
        axis=1,
    )


def plane(xy: np.ndarray) -> np.ndarray:
    """A smooth picture on the plane at depth 1, in three colours."""
    x, y = xy.T
    waves = [np.sin(9 * x + 2 * y), np.sin(7 * y - x), np.cos(5 * x + 5 * y)]
    return 0.5 + 0.4 * np.stack(waves, axis=1)


def centres(width: int, height: int) -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def taken_through(lens: Distortion, times: int = 1) -> np.ndarray:
    """The plane's photograph, `times` as fine as the camera: each pixel's ray by fixed-point iteration."""
    width, height = (times * side for side in SIZE)
    fx, fy, cx, cy = (times * value for value in PINHOLE)
    target = (centres(width, height) - (cx, cy)) / (fx, fy)
    rays = target.copy()
    for _ in range(200):
        rays += 0.7 * (target - bend(rays, lens))
    assert np.abs(bend(rays, lens) - target).max() < 1e-9
    return plane(rays).reshape(height, width, 3)


def camera_of(tmp_path, lens: Distortion, times: int = 1) -> Camera:
    pixels = (taken_through(lens, times) * 65535).round().astype(np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), pixels[..., ::-1])
    fx, fy, cx, cy = PINHOLE
    pose = torch.eye(4, dtype=torch.float64)
    camera = Camera("a", *SIZE, fx, fy, cx, cy, pose, photo=tmp_path / "a.png")
    return undistorted_cameras([camera], [lens])[0]


def seen_by(camera: Camera, times: int = 1) -> np.ndarray:
    """What the camera's own pinhole shows of the plane."""
    width, height = times * camera.width, times * camera.height
    pixels = centres(width, height) / times
    rays = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return plane(rays).reshape(height, width, 3)


@pytest.mark.parametrize(("name", "times"), [("barrel", 1), ("pincushion", 2), ("full", 1), ("fisheye", 1)])
def test_a_straightened_photograph_is_what_the_pinhole_sees(tmp_path, name, times):
    camera = camera_of(tmp_path, LENSES[name], times)
    view = seen_by(camera, times)
    photo, as_taken = (read_photo(camera.photo, (0.0, 0.0, 0.0), lens) for lens in (camera.lens, None))
    assert photo.shape == view.shape
    error = np.abs(photo.double().numpy() - view)
    assert error.max() < 0.012  # at the edges, where half a pixel is repeated
    assert error.mean() < 0.0015  # bilinear interpolation of these waves, and 8 bits
    left, top, width, height = (times * side for side in camera.lens.window)
    assert np.abs(as_taken.numpy()[top : top + height, left : left + width] - view).max() > 0.1


def test_a_barrel_shows_all_of_its_pinhole_and_a_pincushion_most(tmp_path):
    assert camera_of(tmp_path, LENSES["barrel"]).lens.window == (0, 0, *SIZE)
    camera = camera_of(tmp_path, LENSES["pincushion"])
    left, top, width, height = camera.lens.window
    assert (camera.width, camera.height) == (width, height)
    assert (camera.fx, camera.fy, camera.cx + left, camera.cy + top) == PINHOLE
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], float)
    bent = bend((corners - (camera.cx, camera.cy)) / PINHOLE[:2], LENSES["pincushion"])
    sides = bent * PINHOLE[:2] + PINHOLE[2:]
    assert ((sides > -1) & (sides < np.array(SIZE) + 1)).all()
    assert width * height > 0.7 * SIZE[0] * SIZE[1]


def test_a_lens_that_shows_little_of_its_pinhole_has_no_photograph(tmp_path):
    camera = replace(camera_of(tmp_path, LENSES["barrel"]), lens=None)
    strong = Distortion("OPENCV", (30.0, 0.0, 0.0, 0.0))
    (bare,) = undistorted_cameras([camera], [strong])
    assert (bare.photo, bare.lens, bare.width) == (None, None, SIZE[0])
    image = torch.rand(4, 5, 3)
    assert undistorted(image, None) is image


@pytest.mark.parametrize("name", LENSES)
def test_the_lenses_are_colmaps(name):
    pycolmap = pytest.importorskip("pycolmap")
    lens = LENSES[name]
    theirs = pycolmap.Camera(model=lens.name, width=SIZE[0], height=SIZE[1], params=[*PINHOLE, *lens.coefficients])
    rays = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2))
    points = theirs.img_from_cam(np.concatenate([rays, np.ones((50, 1))], axis=1))
    np.testing.assert_allclose(points, bend(rays, lens) * PINHOLE[:2] + PINHOLE[2:], atol=1e-9)

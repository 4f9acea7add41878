"""Golden images: 3DGS's conventions worked out in plain float64 loops, independently of aaplug's code.

Clip space from fields of view, integer pixels at ((ndc + 1) S - 1) / 2, the Jacobian clamped at 1.3 tan(fov/2), a near
plane at 0.2; alpha = min(0.99, o exp(-sigma)), skipped below 1/255; a pixel stops where the next transmittance would be
below 1e-4; with antialiasing, opacity times the root of the ratio of determinants.  Colours of spherical harmonics plus
1/2 are clamped below at 0.  Its limit to tiles within three standard deviations is not part of this.
test_gsplat.py compares with gsplat's own code.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from aaplug import Camera, Gaussians, Renderer, TrainingViews
from aaplug.core.conventions import ANTIALIASED, CLASSIC
from aaplug.rasterizers.reference import Reference
from aaplug.rasterizers.tiled import Tiled
from tests.conftest import ALL_RASTERIZERS, make_camera, make_scene

SKY = (0.25, 0.5, 1.0)


@dataclass
class Flat:
    """A Gaussian on the screen: (x, y) with pixel centres at +0.5, inverse covariance, and what is composited."""

    x: float
    y: float
    conic: tuple[float, float, float]
    depth: float
    opacity: float
    rgb: np.ndarray


def stored(scene: Gaussians) -> Iterable[tuple[np.ndarray, np.ndarray, float, np.ndarray]]:
    """Mean, covariance, opacity and harmonics (coefficients x 3) of each Gaussian, activated."""
    means, quats, log_scales, logits, sh = (column.double().numpy() for column in scene.columns.values())
    axes = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix() * np.exp(log_scales)[:, None]
    return zip(means, axes @ axes.transpose(0, 2, 1), 1 / (1 + np.exp(-logits)), sh, strict=True)


def sh_colour(sh: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """The published constants and order, degree 0 to 3."""
    x, y, z = direction / np.linalg.norm(direction)
    basis = [0.28209479177387814]
    basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    basis += [
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    return np.maximum(np.array(basis[: len(sh)]) @ sh + 0.5, 0.0)


def projected(
    mean: np.ndarray, covariance: np.ndarray, opacity: float, sh: np.ndarray, camera: Camera, compensated: bool
) -> Flat | None:
    """The principal point is the middle of the image: 3DGS knows fields of view only."""
    view = camera.cam_from_world.numpy()
    width, height = camera.width, camera.height
    tan_x, tan_y = 0.5 * width / camera.fx, 0.5 * height / camera.fy
    x, y, z = view[:3, :3] @ mean + view[:3, 3]
    if z <= 0.2:
        return None
    pixel_x = ((x / (z * tan_x) + 1) * width - 1) / 2
    pixel_y = ((y / (z * tan_y) + 1) * height - 1) / 2
    focal_x, focal_y = width / (2 * tan_x), height / (2 * tan_y)
    tx = min(1.3 * tan_x, max(-1.3 * tan_x, x / z)) * z
    ty = min(1.3 * tan_y, max(-1.3 * tan_y, y / z)) * z
    jacobian = np.array([[focal_x / z, 0, -focal_x * tx / z**2], [0, focal_y / z, -focal_y * ty / z**2]])
    to_screen = jacobian @ view[:3, :3]
    before = to_screen @ covariance @ to_screen.T
    a, b, c = before[0, 0] + 0.3, before[0, 1], before[1, 1] + 0.3
    det = a * c - b * b
    factor = math.sqrt(max(0.005**2, np.linalg.det(before) / det)) if compensated else 1.0
    rgb = sh_colour(sh, mean - np.linalg.inv(view)[:3, 3])
    return Flat(pixel_x + 0.5, pixel_y + 0.5, (c / det, -b / det, a / det), z, opacity * factor, rgb)


def composited(splats: list[Flat], camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colour over SKY, alpha, and whether a pixel is near a cut-off, where rounding may decide."""
    splats = sorted(splats, key=lambda splat: splat.depth)
    image = np.zeros((camera.height, camera.width, 3))
    alphas, close = np.zeros(image.shape[:2]), np.zeros(image.shape[:2], dtype=bool)
    for row in range(camera.height):
        for column in range(camera.width):
            left, colour = 1.0, np.zeros(3)
            for splat in splats:
                dx, dy = column + 0.5 - splat.x, row + 0.5 - splat.y
                a, b, c = splat.conic
                sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
                alpha = min(0.99, splat.opacity * math.exp(-sigma))
                close[row, column] |= abs(alpha * 255 - 1) < 1e-3
                if sigma < 0 or alpha < 1 / 255:
                    continue
                after = left * (1 - alpha)
                close[row, column] |= abs(after * 1e4 - 1) < 1e-3
                if after < 1e-4:
                    break
                colour += splat.rgb * alpha * left
                left = after
            image[row, column] = colour + left * np.array(SKY)
            alphas[row, column] = 1 - left
    return image, alphas, close


def scene_of(seed: int, degree: int) -> Gaussians:
    """Some Gaussians in front of, beside and behind the camera, many of them opaque."""
    scene = make_scene(70, seed, degree=degree)
    return replace(
        scene, means=1.3 * scene.means, log_scales=scene.log_scales + 1, logit_opacities=3 * scene.logit_opacities + 4
    )


@pytest.mark.parametrize(("degree", "compensated"), [(0, True), (1, False), (2, True), (3, False)])
def test_images_are_those_of_3dgs(degree, compensated):
    """Of every rasterizer: in float64 to rounding, in float32 away from cut-offs."""
    camera = make_camera((0.4, -1.1, 0.2), size=(36, 27), fov=1.0)
    camera = replace(camera, fy=1.3 * camera.fy).as_trained()
    scene = replace(scene_of(degree, degree), convention=ANTIALIASED if compensated else CLASSIC)
    drawn = [flat for each in stored(scene) if (flat := projected(*each, camera, compensated)) is not None]
    assert 20 < len(drawn) < 70
    expected, alpha, close = (torch.from_numpy(x) for x in composited(drawn, camera))
    assert alpha.max() > 0.9998, "some pixels should stop"
    assert close.double().mean() < 0.03
    for name, rasterizer in {**ALL_RASTERIZERS, "float64": Tiled(), "exact": Reference()}.items():
        exact = name in ("float64", "exact")
        given = scene.to(torch.float64) if exact else scene
        training = TrainingViews.of(given, [camera])  # without the check that it sees most of the scene
        recipe = "ewa" if compensated else "classic"
        image = Renderer.of(given, training, recipe, background=SKY, rasterizer=rasterizer)(camera)
        for found, wanted in ((image.rgb, expected), (image.alpha, alpha)):
            difference = (found.double() - wanted).abs()[~close].max()
            assert difference < (2e-7 if exact else 1e-4), f"{name}: {difference:.1e}"

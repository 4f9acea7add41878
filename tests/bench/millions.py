"""Scenes of a million Gaussians, with cameras: one of noise, and one split from a trained scene."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import torch

from aaplug.core.camera_paths import orbit
from aaplug.core.cameras import BLACK, Camera, CameraSet
from aaplug.core.gaussians import Gaussians
from aaplug.core.projection import rotation_matrices
from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import read_scene
from aaplug.levels.covariances import area, blurred, covariances
from aaplug.levels.rates import rates_of
from aaplug.rendering.benchmark import SEED, synthetic_camera, synthetic_scene
from tests.bench.away import SCENES, Scene
from tests.conftest import SHARED_DATA

COUNT = 1_000_000
TRAINED = 800  # px: side of the synthetic scene's training images
POSES, TESTS = 24, 5  # training poses on a ring around the synthetic scene, and test poses between them
BETWEEN = 0.31  # of the step from one test pose to the next: none is a training pose
PARTS = 20  # Gaussians that each of a trained scene is split into
PART = 0.25  # of a Gaussian's covariance that each part has; the spread of their means has the rest
UP = (0.0, 0.0, 1.0)

Opened = tuple[Gaussians, CameraSet, Scene]


def split(scene: Gaussians, cameras: CameraSet, parts: int = PARTS, seed: int = SEED) -> Gaussians:
    """The scene with every Gaussian split into `parts` smaller ones.

    Means are drawn from the Gaussian and then moved so that mean and covariance of all parts together are exactly the
    Gaussian's, also after training's dilation, which adds the same to both.  Opacities sum to its energy: opacity times
    projected area, as training saw it.
    """
    draw = torch.Generator().manual_seed(seed)
    places = torch.randn(len(scene), parts, 3, generator=draw)
    places -= places.mean(dim=1, keepdim=True)
    root = torch.linalg.cholesky(places.mT @ places / parts)
    places = torch.linalg.solve_triangular(root, places.mT, upper=False).mT  # of covariance 1
    factors = rotation_matrices(scene.unit_quats) * scene.scales[:, None, :]
    means = scene.means[:, None] + math.sqrt(1 - PART) * places @ factors.mT
    dilation = scene.convention.kernel / rates_of(scene, cameras.train).square()
    whole, part = (area(blurred(share * covariances(scene), dilation)) for share in (1.0, PART))
    each = replace(
        scene,
        log_scales=scene.log_scales + 0.5 * math.log(PART),
        logit_opacities=(scene.opacities * whole / part / parts).logit(eps=1e-4),
        origin=None,
        pixel_sizes=None,
    )
    return replace(each[torch.arange(len(scene)).repeat_interleave(parts)], means=means.flatten(0, 1))


def trained(name: str) -> Opened:
    """A trained scene, its cameras, and how it was trained."""
    path = SHARED_DATA / SCENES[name].file
    return read_scene(path), read_cameras(path.parent, train_scale=SCENES[name].scale), SCENES[name]


def finely(name: str) -> Opened:
    """A trained scene, split."""
    scene, cameras, how = trained(name)
    return split(scene, cameras), cameras, how


def noise() -> Opened:
    """The synthetic scene, whose neighbours have colours at random, and cameras around it."""
    camera = synthetic_camera(TRAINED, TRAINED)
    return (
        synthetic_scene(COUNT),
        CameraSet(_ring(camera, POSES), _ring(camera, TESTS, BETWEEN)),
        Scene("", background=BLACK),
    )


def _ring(camera: Camera, count: int, start: float = 0.0) -> tuple[Camera, ...]:
    """Poses of a data set around the vertical axis through the scene's middle."""
    depth, up = float(camera.centre.norm()), torch.tensor(UP, dtype=torch.float64)
    turned = (orbit(camera, (start + i) / count, depth, up) for i in range(count))
    return tuple(replace(view, name=f"{start:g} {i}").as_trained() for i, view in enumerate(turned))


MILLIONS: Mapping[str, Callable[[], Opened]] = {
    "million": noise,
    "chair_million": lambda: finely("chair"),
    "snowmiku_million": lambda: finely("snowmiku"),
}

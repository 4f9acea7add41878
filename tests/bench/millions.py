"""Scenes of a million Gaussians, with cameras: one of noise, and one split from a trained scene."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import torch

from aaplug.core.cameras import Camera, CameraSet, look_at
from aaplug.core.colours import BLACK
from aaplug.core.gaussians import Gaussians
from aaplug.core.projection import rotation_matrices
from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import read_scene
from aaplug.levels.clusters import rates_of
from aaplug.levels.covariances import area, blur, covariances
from aaplug.rendering.benchmark import SEED, synthetic_camera, synthetic_scene
from tests.bench.away import SCENES, Scene
from tests.conftest import SHARED_DATA

COUNT = 1_000_000
TRAINED = 800  # px: side of the synthetic scene's training images
RINGS, POSES = (8.0, 16.0, 26.0, 40.0), 25  # degrees above the horizon, and training poses at each
TEST_RING, TESTS = 20.0, 5
BETWEEN = 0.31  # of the step from one test pose to the next
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
    whole, part = (area(blur(share * covariances(scene), dilation)) for share in (1.0, PART))
    each = replace(
        scene,
        log_scales=scene.log_scales + 0.5 * math.log(PART),
        logit_opacities=(scene.opacities * whole / part / parts).logit(eps=1e-4),
        origin=None,
        extras={},
    )
    return replace(each[torch.arange(len(scene)).repeat_interleave(parts)], means=means.flatten(0, 1))


def trained(name: str) -> Opened:
    """A trained scene, its cameras, and how it was trained."""
    path = SHARED_DATA / SCENES[name].file
    return read_scene(path).gaussians(), read_cameras(path.parent, train_scale=SCENES[name].scale), SCENES[name]


def finely(name: str) -> Opened:
    """A trained scene, split."""
    scene, cameras, how = trained(name)
    return split(scene, cameras), cameras, how


def noise(count: int = COUNT) -> Opened:
    """The synthetic scene, whose neighbours have colours at random, and cameras around it."""
    camera = synthetic_camera(TRAINED, TRAINED)
    train = [view for ring, degrees in enumerate(RINGS) for view in _ring(camera, degrees, POSES, ring / len(RINGS))]
    test = _ring(camera, TEST_RING, TESTS, BETWEEN)
    return synthetic_scene(count), CameraSet(tuple(train), tuple(test)), Scene("", background=BLACK)


def _ring(camera: Camera, degrees: float, count: int, start: float) -> Iterator[Camera]:
    """Poses of a data set around the scene's middle, as far from it as the camera.

    degrees: above the horizon.  start: of the step from one to the next.
    """
    elevation, up = math.radians(degrees), torch.tensor(UP)
    for i in range(count):
        turn = math.tau * (start + i) / count
        flat = math.cos(elevation) * math.cos(turn), math.cos(elevation) * math.sin(turn)
        eye = float(camera.centre.norm()) * torch.tensor([*flat, math.sin(elevation)])
        pose = look_at(*(place.double() for place in (eye, torch.zeros(3), up)))
        yield replace(camera, name=f"{degrees:g} degrees {i}", cam_from_world=pose).as_trained()


MILLIONS: Mapping[str, Callable[[], Opened]] = {
    "million": noise,
    "chair_million": lambda: finely("chair"),
    "snowmiku_million": lambda: finely("snowmiku"),
}

"""Trained scenes beside the repository with their cameras, and scenes of a million Gaussians."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera, CameraSet, look_at
from aaplug.core.colours import BLACK, WHITE
from aaplug.core.gaussians import Gaussians
from aaplug.core.imaging import quantised
from aaplug.core.projection import rotation_matrices
from aaplug.core.training import TrainingViews
from aaplug.evaluation.metrics import psnr
from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import read_scene
from aaplug.levels.clusters import rates_of
from aaplug.levels.covariances import area, blur, covariances
from aaplug.methods.recipe import Recipe
from aaplug.rendering.benchmark import SEED, synthetic_camera, synthetic_scene
from aaplug.rendering.renderer import Renderer
from tests.conftest import SHARED_DATA

TEST_VIEWS = 4
MILLION = 1_000_000
SYNTHETIC_SIDE = 800  # px: side of the synthetic scene's training images
RING_ELEVATIONS, RING_POSES = (8.0, 16.0, 26.0, 40.0), 25  # degrees above the horizon, training poses at each
TEST_ELEVATION, TEST_POSES = 20.0, 5
TEST_START = 0.31  # of the step from one test pose to the next
PARTS = 20  # Gaussians that each of a trained scene is split into
PART_COVARIANCE = 0.25  # of a Gaussian's covariance that each part has; the spread of their means has the rest
UP = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Checkpoint:
    """A scene's file, and how it was trained.

    finer: the checkpoint that was trained at a finer scale.  scale: of training's images against the files'.
    cameras: the file or folder with them; None for the scene's folder.
    """

    file: str
    finer: str | None = None
    scale: float = 1.0
    cull_margin: float = math.inf
    background: tuple[float, float, float] = WHITE
    cameras: str | None = None


CHECKPOINTS = {
    "chair": Checkpoint("chair/chair.ply"),
    "chair_eighth": Checkpoint("chair/chair_eighth.ply", "chair", 1 / 8),
    "snowmiku": Checkpoint("snowmiku/snowmiku.ply", cull_margin=0.3, background=BLACK),
    "snowmiku_quarter": Checkpoint("snowmiku/snowmiku_quarter.ply", "snowmiku", 1 / 4, 0.3, BLACK),
    "1000 Gaussians of train": Checkpoint(
        "formats/splats/train-1000.ply", background=BLACK, cameras="formats/splats/train.cameras.json"
    ),
}
TRAINED = tuple(CHECKPOINTS)[:4]  # those with photographs


@dataclass(frozen=True, eq=False)
class Trained:
    """A scene with its cameras, and how it was trained."""

    scene: Gaussians
    cameras: CameraSet
    checkpoint: Checkpoint

    @cached_property
    def training(self) -> TrainingViews:
        """The training views, computed once."""
        return TrainingViews.of(self.scene, self.cameras, self.checkpoint.cull_margin)

    def views(self, count: int = TEST_VIEWS, first: int = 0) -> Sequence[Camera]:
        """Test views, spread over all."""
        return self.cameras.test[first :: -(-len(self.cameras.test) // count)]

    def renderer(self, recipe: str | Recipe = "auto", **options: Any) -> Renderer:
        """A renderer of the scene over its training's background."""
        return Renderer.of(self.scene, self.training, recipe, background=self.checkpoint.background, **options)


def trained(name: str) -> Trained:
    """Read one of `CHECKPOINTS`."""
    checkpoint = CHECKPOINTS[name]
    path = SHARED_DATA / checkpoint.file
    cameras = path.parent if checkpoint.cameras is None else SHARED_DATA / checkpoint.cameras
    return Trained(read_scene(path).gaussians(), read_cameras(cameras, train_scale=checkpoint.scale), checkpoint)


def decibels(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    """PSNR of an image as it is stored; infinite where it is the truth."""
    ratio = psnr(quantised(image), truth)
    return math.inf if ratio is None else ratio


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
    means = scene.means[:, None] + math.sqrt(1 - PART_COVARIANCE) * places @ factors.mT
    dilation = scene.convention.kernel / rates_of(scene, cameras.train).square()
    whole, part = (area(blur(share * covariances(scene), dilation)) for share in (1.0, PART_COVARIANCE))
    each = replace(
        scene,
        log_scales=scene.log_scales + 0.5 * math.log(PART_COVARIANCE),
        logit_opacities=(scene.opacities * whole / part / parts).logit(eps=1e-4),
        origin=None,
        extras={},
    )
    return replace(each[torch.arange(len(scene)).repeat_interleave(parts)], means=means.flatten(0, 1))


def split_finely(name: str) -> Trained:
    """A trained scene, split."""
    whole = trained(name)
    return replace(whole, scene=split(whole.scene, whole.cameras))


def noise(count: int = MILLION) -> Trained:
    """The synthetic scene, whose neighbours have colours at random, and cameras around it."""
    camera = synthetic_camera(SYNTHETIC_SIDE, SYNTHETIC_SIDE)
    starts = {degrees: number / len(RING_ELEVATIONS) for number, degrees in enumerate(RING_ELEVATIONS)}
    train = [view for degrees, start in starts.items() for view in _ring(camera, degrees, RING_POSES, start)]
    test = _ring(camera, TEST_ELEVATION, TEST_POSES, TEST_START)
    return Trained(synthetic_scene(count), CameraSet(tuple(train), tuple(test)), Checkpoint("", background=BLACK))


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


MILLIONS: Mapping[str, Callable[[], Trained]] = {
    "million": noise,
    "chair_million": lambda: split_finely("chair"),
    "snowmiku_million": lambda: split_finely("snowmiku"),
}

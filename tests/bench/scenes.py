"""Trained scenes beside the repository with their cameras."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug import Camera, CameraSet, Recipe, Renderer, TrainingViews, read_cameras, read_scene
from aaplug.core.colours import BLACK, WHITE
from aaplug.core.gaussians import MIN_OPACITY, Gaussians
from aaplug.core.imaging import quantised
from aaplug.core.projection import rotation_matrices
from aaplug.evaluation.metrics import psnr
from tests.conftest import SHARED_DATA

TEST_VIEWS = 4
PART_VARIANCE = 0.25  # of a split Gaussian's part, against its own


@dataclass(frozen=True)
class Checkpoint:
    """A scene's file, and how it was trained.

    scale: of training's images against the files'.  cameras: their file or folder; None for the scene's folder.
    """

    file: str
    scale: float = 1.0
    cull_margin: float = math.inf
    background: tuple[float, float, float] = WHITE
    cameras: str | None = None


CHECKPOINTS = {
    "chair": Checkpoint("chair/chair.ply"),
    "chair_eighth": Checkpoint("chair/chair_eighth.ply", 1 / 8),
    "snowmiku": Checkpoint("snowmiku/snowmiku.ply", cull_margin=0.3, background=BLACK),
    "snowmiku_quarter": Checkpoint("snowmiku/snowmiku_quarter.ply", 1 / 4, 0.3, BLACK),
    "1000 Gaussians of train": Checkpoint(
        "formats/splats/train-1000.ply", background=BLACK, cameras="formats/splats/train.cameras.json"
    ),
}


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

    def views(self, count: int = TEST_VIEWS) -> Sequence[Camera]:
        """Test views, spread over all."""
        return self.cameras.test[:: -(-len(self.cameras.test) // count)]

    def renderer(self, recipe: str | Recipe = "auto", **options: Any) -> Renderer:
        """A renderer of the scene over its training's background."""
        return Renderer.of(self.scene, self.training, recipe, background=self.checkpoint.background, **options)


def trained(name: str) -> Trained:
    """Read one of `CHECKPOINTS`."""
    checkpoint = CHECKPOINTS[name]
    path = SHARED_DATA / checkpoint.file
    cameras = path.parent if checkpoint.cameras is None else SHARED_DATA / checkpoint.cameras
    return Trained(read_scene(path).gaussians(), read_cameras(cameras, train_scale=checkpoint.scale), checkpoint)


def split(scene: Gaussians) -> Gaussians:
    """Each Gaussian as 20 smaller ones that together keep its mean, its covariance and, where it is faint, its light.

    They lie at the corners of a dodecahedron in the frame where the Gaussian is a unit ball.
    """
    golden = (1 + math.sqrt(5)) / 2
    sides = [(0.0, y / golden, z * golden) for y, z in product((1, -1), repeat=2)]
    turned = (side[i:] + side[:i] for side in sides for i in range(3))
    corners = torch.tensor([*product((1.0, -1.0), repeat=3), *turned])
    corners *= math.sqrt(1 - PART_VARIANCE)  # their mean square along each axis is 1
    parts = scene[torch.arange(len(scene)).repeat_interleave(len(corners))]
    offsets = parts.scales * corners.repeat(len(scene), 1)
    return replace(
        parts,
        means=parts.means + torch.einsum("nij,nj->ni", rotation_matrices(parts.unit_quats), offsets),
        log_scales=parts.log_scales + math.log(PART_VARIANCE) / 2,
        logit_opacities=torch.logit(parts.opacities / (len(corners) * PART_VARIANCE), eps=MIN_OPACITY),
    )


def decibels(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    """PSNR of an image as it is stored; infinite where it is the truth."""
    ratio = psnr(quantised(image), truth)
    return math.inf if ratio is None else ratio


def middle(view: Camera, side: int) -> Camera:
    """The middle of a view, of so many px a side at most."""
    width, height = min(view.width, side), min(view.height, side)
    left, top = (view.width - width) // 2, (view.height - height) // 2
    return replace(view, width=width, height=height, cx=view.cx - left, cy=view.cy - top)


def middle_of(image: Float[Tensor, "h w 3"], side: int) -> Float[Tensor, "H W 3"]:
    """What `middle` shows of an image."""
    top, left = (max(0, length - side) // 2 for length in image.shape[:2])
    return image[top : top + side, left : left + side]

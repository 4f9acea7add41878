"""What a run works on, and how far it has come."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians
from aaplug.core.sampling import SamplingBounds
from aaplug.evaluation.truth import Truth
from aaplug.finetuning.densification import ScreenGradients
from aaplug.finetuning.parameters import Leaves, extent, leaves_of, scene_of
from aaplug.finetuning.settings import Settings
from aaplug.rendering.renderer import Renderer

EPSILON = 1e-15  # of Adam (3DGS)


@dataclass(frozen=True)
class TuningJob:
    """What to tune, how it will be viewed, and what it should look like.

    start: draws the scene that the run starts from as the viewer will; its recipe has no world filter.
    views: training views, at the training size.
    truth: the images that renders are compared with.
    """

    start: Renderer
    views: Sequence[Camera]
    truth: Truth
    settings: Settings

    @property
    def extent(self) -> float:
        """The scene's size, in world units."""
        return extent(self.start.training.cameras)


@dataclass
class State:
    """How far a run has come; changed in place, step by step.

    first_log_scales: of each Gaussian when the run or densification made it.
    bounds: sampling bounds; they are computed anew every `loop.BOUNDS_EVERY` steps and after each densification.
    bad_steps: steps in a row without a finite gradient.
    rollbacks: how often the run returned to an earlier state.
    curve: number, view and loss by scale of each step.
    probes: PSNR measured on the way.
    """

    step: int
    leaves: Leaves
    adam: torch.optim.Adam
    first_log_scales: Float[Tensor, "n 3"]
    bounds: SamplingBounds
    gradients: ScreenGradients
    bad_steps: int = 0
    rollbacks: int = 0
    curve: list[dict[str, Any]] = field(default_factory=list)
    probes: list[dict[str, Any]] = field(default_factory=list)

    def scene(self, job: TuningJob) -> Gaussians:
        """The scene as it is now."""
        return scene_of({n: leaf.detach() for n, leaf in self.leaves.items()}, job.start.scene)

    def renderer(self, job: TuningJob) -> Renderer:
        """Draws the scene as it is now; differentiable in the leaves."""
        training = replace(job.start.training, bounds=self.bounds)
        return replace(job.start, scene=scene_of(self.leaves, job.start.scene), training=training)


def begin(job: TuningJob) -> State:
    """The state before the first step."""
    scene = job.start.scene
    leaves = leaves_of(scene)
    adam, gradients = optimizer(leaves, job.settings), ScreenGradients.none(len(scene))
    return State(0, leaves, adam, scene.log_scales, job.start.training.bounds, gradients)


def optimizer(leaves: Leaves, settings: Settings) -> torch.optim.Adam:
    """Adam over the leaves that move."""
    groups = [
        {"params": [leaves[name].requires_grad_()], "lr": 0.0, "name": name}
        for name in settings.rates
        if leaves[name].numel()
    ]
    return torch.optim.Adam(groups, eps=EPSILON)

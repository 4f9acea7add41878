"""What a run is about, and where it is."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.sampling import SamplingBounds
from aaplug.core.training import TrainingViews
from aaplug.finetuning.densification import Pulls
from aaplug.finetuning.parameters import Leaves, leaves_of, scene_of
from aaplug.finetuning.settings import Settings
from aaplug.finetuning.truth import Truth
from aaplug.methods.recipes import Recipe

EPSILON = 1e-15  # of Adam (3DGS)


@dataclass(frozen=True)
class Job:
    """What to tune, how it will be viewed, and what it should look like.

    start: the scene as the viewer gets it at first, its Gaussians where those are that training's bounds are of.
    recipe: the viewer's rule; it has no world filter.
    views: training views, at the training size.
    """

    start: Gaussians
    training: TrainingViews
    recipe: Recipe
    views: Sequence[Camera]
    truth: Truth
    settings: Settings
    rasterizer: Rasterizer
    background: tuple[float, float, float]


@dataclass
class State:
    """Where a run is; changed in place, step by step.

    born: ln of the standard deviations that the Gaussians started with.  bounds: from where they were not long ago.
    bad: steps in a row that gave no finite gradient.
    back_offs: times that the run went back.  curve: of each step its number, view, and loss by scale.
    probes: what was measured on the way, by whoever watches.
    """

    step: int
    leaves: Leaves
    adam: torch.optim.Adam
    born: Float[Tensor, "n 3"]
    bounds: SamplingBounds
    pulls: Pulls
    bad: int = 0
    back_offs: int = 0
    curve: list[dict[str, Any]] = field(default_factory=list)
    probes: list[dict[str, Any]] = field(default_factory=list)

    def scene(self, job: Job) -> Gaussians:
        """The scene as it is now."""
        return scene_of({name: leaf.detach() for name, leaf in self.leaves.items()}, job.start)


def begin(job: Job) -> State:
    """The state before the first step."""
    leaves = leaves_of(job.start)
    born, bounds = job.start.log_scales, job.training.bounds
    return State(0, leaves, optimizer(leaves, job.settings), born, bounds, Pulls.none(len(born)))


def optimizer(leaves: Leaves, settings: Settings) -> torch.optim.Adam:
    """Adam over the leaves that move."""
    groups = [
        {"params": [leaves[name].requires_grad_()], "lr": 0.0, "name": name}
        for name in settings.rates
        if leaves[name].numel()
    ]
    return torch.optim.Adam(groups, eps=EPSILON)

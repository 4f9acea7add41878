"""Densification: more Gaussians where the loss pulls hard, fewer where they are transparent (3DGS, section 5.2).

n: Gaussians before, m: after.  Where the gradient of the loss in a Gaussian's screen position exceeds a threshold, on
average over the views that drew it, a small Gaussian is cloned and a large one is split in two.  Nearly transparent
Gaussians are pruned.  As in 3DGS, gradients are per half the image's side.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from aaplug.core.gaussians import Gaussians
from aaplug.finetuning.parameters import WHOLE
from aaplug.rendering.renderer import Drawing

THRESHOLD = 2e-4  # gradient from which a Gaussian is densified (3DGS)
SMALL = 0.01  # share of the scene's extent; larger Gaussians are split (3DGS)
SHRINK = 1.6  # divides the standard deviations of the two halves of a split (3DGS)
MIN_OPACITY = 0.005  # less is pruned (3DGS)


@dataclass
class ScreenGradients:
    """Gradients of the loss in screen positions: the sum of their lengths, and in how many views each was drawn."""

    total: Float[Tensor, " n"]
    views: Float[Tensor, " n"]

    @classmethod
    def none_of(cls, count: int) -> "ScreenGradients":
        """Before the first view."""
        return cls(torch.zeros(count), torch.zeros(count))

    def add(self, drawing: Drawing) -> None:
        """Add a view after its backward pass; its splats' means must have retained their gradients."""
        splats, (height, width) = drawing.splats, drawing.hw
        assert splats.means.grad is not None
        length = (splats.means.grad * splats.means.new_tensor([width / 2, height / 2])).norm(dim=1)
        self.total.index_add_(0, splats.sources, length.to(self.total))
        self.views.index_add_(0, splats.sources, torch.ones_like(length).to(self.views))

    @property
    def mean(self) -> Float[Tensor, " n"]:
        """Mean over the views that drew the Gaussian, 0 if none did."""
        return self.total / self.views.clamp(min=1)


@dataclass(frozen=True)
class Densified:
    """The scene after densification.

    sources: the index, before, of the Gaussian that each one comes from.
    new: true for clones and halves: their Adam moments start at zero.
    """

    scene: Gaussians
    sources: Int[Tensor, " m"]
    new: Bool[Tensor, " m"]


def densify(scene: Gaussians, gradients: Float[Tensor, " n"], extent: float, generator: torch.Generator) -> Densified:
    """Clone, split and prune; Gaussians that stay come first, in their order."""
    dense = gradients >= THRESHOLD
    large = scene.scales.amax(dim=1) > SMALL * extent
    masks = ~(dense & large), dense & ~large, dense & large
    kept, cloned, split = (mask.nonzero()[:, 0] for mask in masks)
    sources = torch.cat([kept, cloned, split, split])
    parts = [scene[kept], scene[cloned], _halves(scene[split.repeat(2)], generator)]
    columns = {name: torch.cat([getattr(part, name) for part in parts]) for name in (*WHOLE, "sh")}
    grown = replace(parts[0], **columns, origin=None, pixel_sizes=None)
    new = torch.arange(len(sources)) >= len(kept)
    visible = (grown.opacities >= MIN_OPACITY).nonzero()[:, 0]
    if not len(visible):
        return Densified(scene, torch.arange(len(scene)), torch.zeros(len(scene), dtype=torch.bool))
    return Densified(grown[visible], sources[visible], new[visible])


def _halves(scene: Gaussians, generator: torch.Generator) -> Gaussians:
    """Smaller Gaussians at random places drawn from those that are split."""
    local = torch.randn(len(scene), 3, generator=generator).to(scene.means) * scene.scales
    w, x, y, z = scene.unit_quats.unbind(dim=1)
    axis = torch.stack([x, y, z], dim=1)
    turn = 2 * torch.linalg.cross(axis, local)  # v + w t + a × t with t = 2 a × v
    offset = local + w[:, None] * turn + torch.linalg.cross(axis, turn)
    smaller = scene.log_scales - torch.tensor(SHRINK).log()
    return replace(scene, means=scene.means + offset, log_scales=smaller)


def carried(moments: Mapping[str, Tensor], densified: Densified) -> dict[str, Tensor]:
    """An optimizer's moments after densification: kept for Gaussians that stay, 0 for new ones."""
    found = {name: column[densified.sources] if column.ndim else column for name, column in moments.items()}
    for column in (column for column in found.values() if column.ndim):
        column[densified.new] = 0
    return found

"""More Gaussians where the image pulls at them hard, fewer where they show nothing (3DGS, section 5.2).

n: Gaussians before, m: after.  A Gaussian whose screen position is pulled by more than a threshold, on average over
the views that drew it, is cloned where it is small and split in two where it is large; what is nearly transparent goes.
The pull is the loss's gradient in units of half the image's sides, as 3DGS has it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from aaplug.core.gaussians import Gaussians
from aaplug.core.splats import Splats2D

PULL = 2e-4  # at which a Gaussian is densified (3DGS)
SMALL = 0.01  # of the scene's extent: larger ones are split (3DGS)
SHRINK = 1.6  # of the standard deviations of the two that a split makes (3DGS)
MIN_SHOWN = 0.005  # opacity: less is pruned (3DGS)


@dataclass
class Pulls:
    """How hard the views drawn so far pulled at each Gaussian: sums, and in how many of them it was drawn."""

    total: Float[Tensor, " n"]
    views: Float[Tensor, " n"]

    @classmethod
    def none(cls, n: int) -> "Pulls":
        """Of n Gaussians that no view has drawn."""
        return cls(torch.zeros(n), torch.zeros(n))

    def add(self, splats: Splats2D, hw: tuple[int, int]) -> None:
        """Take in a view whose splats' means have gradients."""
        assert splats.means.grad is not None
        half = splats.means.new_tensor([hw[1] / 2, hw[0] / 2])
        pull = (splats.means.grad * half).norm(dim=1)
        self.total.index_add_(0, splats.sources, pull.to(self.total))
        self.views.index_add_(0, splats.sources, torch.ones_like(pull).to(self.views))

    @property
    def mean(self) -> Float[Tensor, " n"]:
        """Per view that drew it, 0 for what none drew."""
        return self.total / self.views.clamp(min=1)


@dataclass(frozen=True)
class Change:
    """What becomes of the Gaussians.

    sources: the Gaussian that each of the new scene's comes from.  new: whether it is another than that, so that an
    optimizer knows nothing of it.
    """

    scene: Gaussians
    sources: Int[Tensor, " m"]
    new: Bool[Tensor, " m"]


def densify(
    scene: Gaussians, pull: Float[Tensor, " n"], extent: float, generator: torch.Generator
) -> Change:
    """Clone, split and prune; those that stay come first, in their order."""
    pulled = pull >= PULL
    large = scene.scales.amax(dim=1) > SMALL * extent
    cloned, split = (pulled & ~large).nonzero()[:, 0], (pulled & large).nonzero()[:, 0]
    kept = (~(pulled & large)).nonzero()[:, 0]
    halves = split.repeat(2)
    grown = _joined([scene[kept], scene[cloned], _halves(scene[halves], generator)])
    sources = torch.cat([kept, cloned, halves])
    new = torch.arange(len(sources)) >= len(kept)
    shown = (grown.opacities >= MIN_SHOWN).nonzero()[:, 0]
    if len(shown) == 0:
        return Change(scene, torch.arange(len(scene)), torch.zeros(len(scene), dtype=torch.bool))
    return Change(grown[shown], sources[shown], new[shown])


def _halves(scene: Gaussians, generator: torch.Generator) -> Gaussians:
    """Smaller Gaussians at random places inside those that are split."""
    local = torch.randn(len(scene), 3, generator=generator).to(scene.means) * scene.scales
    w, x, y, z = scene.unit_quats.unbind(dim=1)
    axis = torch.stack([x, y, z], dim=1)
    turn = 2 * torch.linalg.cross(axis, local)  # v + w t + a × t with t = 2 a × v
    offset = local + w[:, None] * turn + torch.linalg.cross(axis, turn)
    smaller = scene.log_scales - torch.tensor(SHRINK).log()
    return replace(scene, means=scene.means + offset, log_scales=smaller)


def _joined(scenes: list[Gaussians]) -> Gaussians:
    names = ("means", "quats", "log_scales", "logit_opacities", "sh")
    columns = {name: torch.cat([getattr(scene, name) for scene in scenes]) for name in names}
    return replace(scenes[0], **columns, origin=None, pixel_sizes=None)


def carried(moments: Mapping[str, Tensor], change: Change) -> dict[str, Tensor]:
    """An optimizer's columns for the changed scene: kept with what stays, 0 for what is new."""
    found = {}
    for name, column in moments.items():
        if column.ndim == 0:
            found[name] = column
            continue
        moved = column[change.sources].clone()
        moved[change.new] = 0
        found[name] = moved
    return found

"""Mipmap-GS (Li et al. 2024): fine-tuning that makes one model for one scale, with 3DGS's densification (section 5.2).

n: Gaussians before, m: after densification.  Where the gradient of the loss in a Gaussian's screen position exceeds a
threshold, on average over the views that drew it, a small Gaussian is cloned and a large one is split in two.  Nearly
transparent Gaussians are pruned.  As in 3DGS, gradients are per half the image's side.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from aaplug.core.gaussians import Gaussians
from aaplug.core.projection import rotation_matrices
from aaplug.finetuning.loop import extent, update_bounds
from aaplug.finetuning.settings import RATES, SEED_STRIDE, Method, Settings
from aaplug.finetuning.state import WHOLE, State, TuningJob, leaves_of, optimizer
from aaplug.methods.viewers import CLASSIC_VIEWER
from aaplug.rendering.renderer import Drawing
from aaplug.system.errors import UsageError

STEPS = 100  # between densifications (3DGS)
MIN_GRADIENT = 2e-4  # from which a Gaussian is densified (3DGS)
MAX_CLONED_SCALE = 0.01  # share of the scene's extent; larger Gaussians are split (3DGS)
SPLIT_SHRINKAGE = 1.6  # divides the standard deviations of the two halves of a split (3DGS)
MIN_OPACITY = 0.005  # of a Gaussian that is not pruned (3DGS)
SPLIT_SEED = 6_000_000  # added to the seed for the places of the halves


@contextmanager
def with_densification(job: TuningJob, state: State) -> Iterator[list[Drawing]]:
    """After a step, add its gradients, and every `STEPS` steps change the number of Gaussians.

    Those that stay keep their Adam moments.
    """
    drawings: list[Drawing] = []
    yield drawings
    settings, sums = job.settings, state.gradients
    if state.bad_steps:
        return
    if not sums:
        sums.update({name: torch.zeros(len(state.first_log_scales)) for name in ("total", "views")})
    for drawing in drawings:
        splats, (height, width) = drawing.splats, drawing.hw
        assert splats.means.grad is not None
        length = (splats.means.grad * splats.means.new_tensor([width / 2, height / 2])).norm(dim=1)
        sums["total"].index_add_(0, splats.sources, length.to(sums["total"]))
        sums["views"].index_add_(0, splats.sources, torch.ones_like(length).to(sums["views"]))
    if state.step % STEPS or state.step >= settings.steps:
        return
    generator = torch.Generator().manual_seed(settings.seed * SEED_STRIDE + SPLIT_SEED + state.step)
    means = sums["total"] / sums["views"].clamp(min=1)
    with torch.no_grad():
        change = densify(state.scene(job), means, extent(job.start.training.cameras), generator)
        moments = {g["name"]: moments_after(state.adam.state[g["params"][0]], change) for g in state.adam.param_groups}
    state.leaves = leaves_of(change.scene)
    state.adam = optimizer(state.leaves, settings)
    for group in state.adam.param_groups:
        state.adam.state[group["params"][0]] = moments[group["name"]]
    first = state.first_log_scales[change.sources]
    state.first_log_scales = torch.where(change.new[:, None], change.scene.log_scales, first)
    state.gradients = {}
    update_bounds(job, state)


@dataclass(frozen=True, eq=False)
class Densification:
    """The scene after densification.

    sources: the index, before, of the Gaussian that each one comes from.
    new: true for clones and halves: their Adam moments start at zero.
    """

    scene: Gaussians
    sources: Int[Tensor, " m"]
    new: Bool[Tensor, " m"]


def densify(
    scene: Gaussians, gradients: Float[Tensor, " n"], extent: float, generator: torch.Generator
) -> Densification:
    """Clone, split and prune; Gaussians that stay come first, in their order."""
    dense = gradients >= MIN_GRADIENT
    large = scene.scales.amax(dim=1) > MAX_CLONED_SCALE * extent
    masks = ~(dense & large), dense & ~large, dense & large
    unsplit, cloned, split = (mask.nonzero()[:, 0] for mask in masks)
    sources = torch.cat([unsplit, cloned, split, split])
    parts = [scene[unsplit], scene[cloned], _halves(scene[split.repeat(2)], generator)]
    columns = {name: torch.cat([getattr(part, name) for part in parts]) for name in (*WHOLE, "sh")}
    denser = replace(parts[0], **columns, origin=None, extras={})
    new = torch.arange(len(sources)) >= len(unsplit)
    visible = denser.opacities >= MIN_OPACITY
    if not visible.any():
        return Densification(scene, torch.arange(len(scene)), torch.zeros(len(scene), dtype=torch.bool))
    return Densification(denser[visible], sources[visible], new[visible])


def _halves(scene: Gaussians, generator: torch.Generator) -> Gaussians:
    """Smaller Gaussians at random places drawn from those that are split."""
    local = torch.randn(len(scene), 3, generator=generator).to(scene.means) * scene.scales
    offset = (rotation_matrices(scene.unit_quats) @ local[:, :, None]).squeeze(2)
    smaller = scene.log_scales - torch.tensor(SPLIT_SHRINKAGE).log()
    return replace(scene, means=scene.means + offset, log_scales=smaller)


def moments_after(moments: Mapping[str, Tensor], change: Densification) -> dict[str, Tensor]:
    """An optimizer's moments after densification: 0 for new Gaussians, unchanged for those that stay."""
    columns = {name: column[change.sources] if column.ndim else column for name, column in moments.items()}
    for column in (column for column in columns.values() if column.ndim):
        column[change.new] = 0
    return columns


def mipmap_gs(scales: Sequence[float], move: Sequence[str] = (), anchor: float = 0.0) -> Settings:
    """Mipmap-GS (Li et al. 2024), one model for one scale: all parameters at 3DGS's rates, 1000 steps of L2.

    Its truth is a bilinear resize at the test poses; here it is the box average at the training poses.  It moves every
    parameter and has no anchor.  More than one scale raises UsageError.
    """
    if len(scales) != 1:
        raise UsageError("scale", "mipmap-gs makes one model for one scale; give one")
    return Settings("mipmap-gs", 1000, {scales[0]: 1.0}, RATES)


MIPMAP_GS = Method(mipmap_gs, CLASSIC_VIEWER, with_densification)

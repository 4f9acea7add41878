"""Ellipses of screen-space Gaussians: whitening, the cut-off, growing by a radius, and culling.

m: splats.  d: offset (dx, dy) from a splat's centre, in px.  C: its covariance, packed (xx, xy, yy), in px².
"""

import math
from dataclasses import replace
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.kernels import EAGER, EXAMPLE_SIZE, Kernel, Kernels
from aaplug.core.rules import RULES_3DGS, Rules
from aaplug.core.splats import Splats2D
from aaplug.system.contracts import Range, contract
from aaplug.system.errors import UsageError

Columns = tuple[Tensor, Tensor, Tensor, Tensor]


@contract
def whitening(splats: Splats2D) -> Float[Tensor, "m 2 2"]:
    """W of each splat with |W d|² = dᵀ C⁻¹ d."""
    return torch.stack(whitening_columns(splats.covs, splats.dets), dim=1).unflatten(1, (2, 2))


def whitening_columns(covs: Float[Tensor, "m 3"], dets: Float[Tensor, " m"]) -> Columns:
    """ux, uy, vx, vy: the rows of a matrix W with |W d|² = dᵀ C⁻¹ d, so that u = ux·dx + uy·dy, and v likewise.

    W is upper triangular: vx is 0, and v depends on dy alone.  With the given determinant a needle keeps its precision;
    expanding dᵀ C⁻¹ d cancels.
    """
    _, xy, yy = covs.unbind(dim=1)
    yy = yy.clamp(min=torch.finfo(yy.dtype).tiny)  # of a disc on edge
    across = yy.sqrt() / dets.sqrt()  # their quotient may be too large
    return across, -xy / yy * across, torch.zeros_like(across), yy.rsqrt()


def squared_cutoff(
    opacities: Float[Tensor, " m"], min_alpha: float | Tensor = RULES_3DGS.min_alpha
) -> Float[Tensor, " m"]:
    """Squared Mahalanobis distance at which alpha falls to `min_alpha`; negative where it never reaches it."""
    return 2 * torch.log(opacities / min_alpha)


def positive_cutoff(splats: Splats2D, min_alpha: float) -> Float[Tensor, " m"]:
    """The squared cut-off, at least a tiny positive number, so that it can be a divisor."""
    return squared_cutoff(splats.opacities, min_alpha).clamp(min=torch.finfo(splats.means.dtype).tiny)


@contract
def grown(splats: Splats2D, radius: Float[Tensor, " m"], min_alpha: Annotated[float, Range(above=0)]) -> Splats2D:
    """Splats whose cut-off ellipses contain every point within `radius` px of the given ones; for bounding only.

    For any e > 0, the covariance (1 + e) C + (1 + 1/e) (r²/R) I bounds the Minkowski sum of an ellipse (C, squared
    cut-off R) and a disc of radius r.  e = r / √(R tr C / 2) makes the bound's trace smallest.
    """
    if radius.shape != splats.dets.shape:
        raise UsageError("radius", f"expected [{len(splats)}] numbers, got {[*radius.shape]}")
    cutoff = positive_cutoff(splats, min_alpha)
    radius = radius.clamp(min=torch.finfo(splats.means.dtype).eps)  # it is divided by
    trace = splats.covs[:, 0] + splats.covs[:, 2]
    share = radius / (0.5 * cutoff * trace).sqrt()
    added = (1 + 1 / share) * radius**2 / cutoff
    diagonal = splats.covs.new_tensor([1.0, 0.0, 1.0])
    scale = 1 + share
    dets = scale * scale * splats.dets + scale * added * trace + added * added
    return replace(splats, covs=scale[:, None] * splats.covs + added[:, None] * diagonal, dets=dets)


def cull(
    splats: Splats2D,
    hw: tuple[int, int],
    margin: float = math.inf,
    kernels: Kernels = EAGER,
    ellipses: Splats2D | None = None,
    rules: Rules = RULES_3DGS,
) -> Splats2D:
    """The splats that can change an image of height and width `hw` px; a splat without area cannot.

    margin: cull splats whose centre lies farther outside the image than this share of its longer side.
    ellipses: the same splats' bounding ellipses, where a pixel kernel shows more than the splats' own.
    """
    size = splats.means.new_tensor([hw[1], hw[0], margin * max(hw), rules.min_alpha])
    bounds = splats if ellipses is None else ellipses
    columns = bounds.means, bounds.covs, bounds.dets, bounds.opacities
    (inside,) = kernels.run(CULL, *columns, size)
    return splats.selected(inside.bool().nonzero().squeeze(1))


def _inside(
    means: Float[Tensor, "m 2"],
    covs: Float[Tensor, "m 3"],
    dets: Float[Tensor, " m"],
    opacities: Float[Tensor, " m"],
    size: Float[Tensor, " 4"],
) -> tuple[Tensor]:
    """1 for splats that can be seen, else 0; a compiled loop takes three times as long to write truth values.

    size: the image's width and height, `margin` in px, and the least alpha.
    """
    *sides, band, min_alpha = size.unbind()
    inside = (opacities >= min_alpha) & (dets > 0)
    cutoff = squared_cutoff(opacities, min_alpha).clamp(min=0.0)
    for mean, variance, side in zip(means.unbind(dim=1), (covs[:, 0], covs[:, 2]), sides, strict=True):
        half = (cutoff * variance).sqrt()
        inside = inside & (mean + half > 0) & (mean - half < side)
        inside = inside & (mean >= -band) & (mean <= side + band)
    return (torch.where(inside, 1.0, 0.0),)


def _example() -> tuple[Tensor, ...]:
    m = EXAMPLE_SIZE
    means = torch.linspace(-9.0, 9.0, 2 * m).view(m, 2)
    return means, torch.ones(m, 3), torch.ones(m), torch.ones(m), torch.tensor([4.0, 4.0, 2.0, RULES_3DGS.min_alpha])


CULL = Kernel("cull", _inside, _example, ("m", "m", "m", "m", None), gathers=True)

"""Culling of the splats that cannot change an image."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.ellipses import squared_cutoff
from aaplug.core.kernels import EAGER, EXAMPLE_SIZE, Kernel, Kernels
from aaplug.core.rules import RULES_3DGS, Rules
from aaplug.core.splats import Splats2D


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

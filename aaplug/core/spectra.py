"""Spectra of splats: how much of each lies above the Nyquist rate of the samples that draw it.

A splat's alpha o exp(-dᵀ C⁻¹ d / 2) has the Fourier transform H(ω) = 2π o √|C| exp(-ωᵀ C ω / 2) about its centre, where
ω is in radians per sample.  Samples carry |ω| < π along each axis; what lies above appears as other frequencies.

m: splats, after projection and screen filter, in px of the samples; w: frequencies.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.splats import Splats2D
from aaplug.system.contracts import contract


@contract
def frequency_response(splats: Splats2D, omega: Float[Tensor, "w 2"]) -> Float[Tensor, "m w"]:
    """H of each splat about its own centre, in px²; at 0 it is the splat's light.

    Args:
        splats: of a view, by any recipe: `renderer.splats(*renderer.sampled(view))`.
        omega: frequencies along x and y, in radians per px.
    """
    xx, xy, yy = splats.covs[:, :, None].unbind(dim=1)
    x, y = omega.to(splats.covs).unbind(dim=1)
    light = 2 * math.pi * splats.opacities * splats.dets.sqrt()
    return light[:, None] * (-0.5 * (xx * x * x + 2 * xy * x * y + yy * y * y)).exp()


def energies(splats: Splats2D) -> tuple[Float[Tensor, " m"], Float[Tensor, " m"]]:
    """Integral of the squared alpha, in px², and its share outside the samples' band |ω| < π, along the splat's axes.

    By Parseval it is that of |H|² / 4π², which is π o² √|C|.  |H|² is a Gaussian of standard deviations 1 / √(2λ) along
    the axes of C, whose variances are λ.
    """
    xx, xy, yy = splats.covs.unbind(dim=1)
    longer = 0.5 * (xx + yy) + torch.hypot(0.5 * (xx - yy), xy)
    inside = (math.pi * longer.sqrt()).erf() * (math.pi * (splats.dets / longer).sqrt()).erf()
    return math.pi * splats.opacities.square() * splats.dets.sqrt(), 1 - inside

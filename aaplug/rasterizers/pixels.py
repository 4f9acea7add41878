"""Pixel kernels: what a splat's alpha is at a pixel, its value at the centre or its mean over the pixel.

The mean is Analytic-Splatting's (Liang et al. 2024, eqs. 8 to 11): over a square, `Splats2D.window` wide, turned to
the splat's own axes, where the Gaussian factors; an approximation of theirs, for pixels are not turned.  `integral`
has the exact normal distribution, `logistic` the paper's approximation of it, for parity with its published figures.

`square` is over the pixel's own square, which is not turned: it is cut across the axis that the splat is longer in into
CELLS strips, each with the exact share of the splat there, times the exact mean of what the splat is across, given the
strip's middle.  Samples along an ellipse's long side and weights from its shape are MipSLAM's idea (arXiv 2603.06989),
whose constants are not published: this form is aaplug's own.

u: position along an axis, h: half the window, both in standard deviations.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.splats import Splats2D, reach

# h below which a difference of two distributions loses digits, and its series does not
SMALL = {torch.float32: 0.1, torch.float64: 1e-3}
SMALL_LOGISTIC = {torch.float32: 0.01, torch.float64: 1e-4}
THINNEST = 0.1  # px: of a window, in what `grown` allows for
HALF_DIAGONAL = math.sqrt(0.5)  # of a square: none of its points is farther from its centre
CELLS = 3  # strips of a square
LOGISTIC = (1.6, 0.07)  # S(x) = 1/(1 + exp(−1.6 x − 0.07 x³))


def mean_gaussian(u: Tensor, h: Tensor) -> Tensor:
    """Mean of exp(−x²/2) over u ± h.

    Where h is small, its series e^(−u²/2) (1 + h²(u² − 1)/6 + h⁴(u⁴ − 6u² + 3)/120).
    """
    small = SMALL[u.dtype]
    wide = h.clamp(min=small)
    ends = [((u + side * wide) * math.sqrt(0.5)).erf() for side in (1, -1)]
    mean = (ends[0] - ends[1]) * math.sqrt(math.pi / 8) / wide
    uu, hh = u * u, h * h
    series = 1 + hh * (uu - 1) / 6 + hh * hh * (uu * uu - 6 * uu + 3) / 120
    return torch.where(h < small, series * (-0.5 * uu).exp(), mean)


def mean_logistic(u: Tensor, h: Tensor) -> Tensor:
    """The same by Analytic-Splatting's S in the normal distribution's place; its derivative where h is small."""
    small = SMALL_LOGISTIC[u.dtype]
    wide = h.clamp(min=small)
    mean = (logistic(u + wide) - logistic(u - wide)) * math.sqrt(math.pi / 2) / wide
    s = logistic(u)
    slope = (LOGISTIC[0] + 3 * LOGISTIC[1] * u * u) * s * (1 - s)
    return torch.where(h < small, slope * math.sqrt(2 * math.pi), mean)


def logistic(x: Tensor) -> Tensor:
    """Analytic-Splatting's approximation of the normal distribution (its eq. 9); at most 4e-4 from it."""
    return (LOGISTIC[0] * x + LOGISTIC[1] * x**3).sigmoid()


def grown(splats: Splats2D) -> Splats2D:
    """Splats whose alpha ≥ 1/255 ellipses hold every pixel centre whose pixel touches the given ones'."""
    radius = HALF_DIAGONAL * max(splats.window, THINNEST)
    return widened(splats, torch.full_like(splats.dets, radius))


def widened(splats: Splats2D, radius: Float[Tensor, " m"]) -> Splats2D:
    """Splats whose alpha ≥ 1/255 ellipses hold what is within `radius` px of the given ones'.

    (1 + e) C + (1 + 1/e) (r²/R) I holds the sum of an ellipse, C at squared reach R, and a disc of radius r for any e.
    """
    reached = reach(splats.opacities).clamp(min=torch.finfo(splats.means.dtype).tiny)
    trace = splats.covs[:, 0] + splats.covs[:, 2]
    share = radius / (0.5 * reached * trace).sqrt()
    added = (1 + 1 / share) * radius**2 / reached
    diagonal = splats.covs.new_tensor([1.0, 0.0, 1.0])
    scale = 1 + share
    return Splats2D(
        means=splats.means,
        covs=scale[:, None] * splats.covs + added[:, None] * diagonal,
        dets=scale * scale * splats.dets + scale * added * trace + added * added,
        depths=splats.depths,
        opacities=splats.opacities,
        sources=splats.sources,
        rgb=splats.rgb,
    )

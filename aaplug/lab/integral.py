"""Alpha averaged over the pixel: Analytic-Splatting (Liang et al. 2024, eqs. 8 to 11).

Along the splat's principal axes the Gaussian is a product, and its mean over an aligned square is the product of two
one-dimensional means.  The paper therefore rotates the pixel's square, of side `Splats2D.window`, to these axes: an
approximation, because the real pixel is not rotated.  The normal distribution function is exact; the paper approximates
it by a logistic one.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.special import ndtr

from aaplug.core.ellipses import Columns, grown
from aaplug.core.interfaces import Limits, Pixels
from aaplug.core.kernels import Kernels
from aaplug.core.rules import Rules
from aaplug.core.splats import Splats2D
from aaplug.methods.pixel_kernels.raster_rows import COLUMNS, OPACITY, forms_at, rows_of

HALF_U, HALF_V = COLUMNS, COLUMNS + 1  # half windows, in standard deviations
MIN_WINDOW = 1e-5  # px: at this width the mean equals the value at the centre to ten digits
MIN_BOUNDING_WINDOW = 0.1  # px: bounding ellipses are grown as for a window at least this wide
HALF_DIAGONAL = math.sqrt(0.5)  # of a unit square
# standard deviations: half windows below which a difference of two distributions loses digits, and a series does not
MAX_SERIES_HALF = {torch.float32: 0.1, torch.float64: 1e-3}


@dataclass(frozen=True)
class Integral:
    """Alpha is opacity times the product of two one-dimensional means."""

    name: str = "integral"
    columns: int = COLUMNS + 3
    needs_depth_slopes: bool = False
    splats_per_pass: int = 8

    def bounding_ellipses(self, splats: Splats2D, rules: Rules) -> Splats2D | None:
        """Ellipses that contain every pixel centre whose window, at any rotation, touches the cut-off ellipse."""
        radius = HALF_DIAGONAL * max(splats.window, MIN_BOUNDING_WINDOW)
        return grown(splats, torch.full_like(splats.dets, radius), rules.min_alpha)

    def raster_rows(self, splats: Splats2D, kernels: Kernels) -> Float[Tensor, "m c"]:
        """Principal axes, and the half windows along them."""
        ux, uy, vx, vy = principal_columns(splats.covs, splats.dets)
        halves = [0.5 * splats.window * torch.hypot(x, y) for x, y in ((ux, uy), (vx, vy))]
        return rows_of(splats, [ux, uy, vx, vy], [*halves, torch.zeros_like(ux)])

    def alpha(self, rows: Float[Tensor, "*n t c"], pixels: Pixels, limits: Limits) -> Float[Tensor, "*n t P"]:
        """Opacity times the means over the window along both axes."""
        alpha = rows[..., OPACITY, None]
        for form, half in zip(forms_at(rows, pixels), (HALF_U, HALF_V), strict=True):
            alpha = alpha * mean_gaussian(form, rows[..., half, None])
        return limits.cut(alpha)

    def exact(self, splats: Splats2D, offsets: Float[Tensor, "p c 2"]) -> Float[Tensor, "p c"]:
        """2π σ₁ σ₂ P₁ P₂ / window²: Pᵢ is the normal distribution's probability of the window along axis i."""
        values = torch.ones_like(offsets[..., 0])
        rows = principal_columns(splats.covs, splats.dets)
        for x, y in (rows[:2], rows[2:]):
            width = max(splats.window, MIN_WINDOW) * torch.hypot(x, y)  # in standard deviations
            u = x * offsets[..., 0] + y * offsets[..., 1]
            probability = ndtr(u + width / 2) - ndtr(u - width / 2)
            values = values * probability * math.sqrt(2 * math.pi) / width
        return values


def principal_columns(covs: Float[Tensor, "m 3"], dets: Float[Tensor, " m"]) -> Columns:
    """ux, uy, vx, vy of a whitening whose rows are the principal axes over their standard deviations, longer first.

    What is so small that its determinant underflows is taken for as small a splat that has one.
    """
    xx, xy, yy = covs.unbind(dim=1)
    across, along = 2 * xy, xx - yy
    circle = (across == 0) & (along == 0)  # any axes do, but the angle has no gradient
    angle = 0.5 * torch.atan2(across.where(~circle, 0.0), along.where(~circle, 1.0))
    half = 0.5 * (xx + yy)
    root = torch.hypot(0.5 * along.where(~circle, 1.0), xy)
    least = torch.finfo(dets.dtype).tiny
    longer = (half + torch.where(circle, 0.0, root)).clamp(min=least)
    wide, thin = longer.rsqrt(), (longer / dets.clamp(min=least)).sqrt()
    cos, sin = angle.cos(), angle.sin()
    return cos * wide, sin * wide, -sin * thin, cos * thin


def mean_gaussian(u: Tensor, h: Tensor) -> Tensor:
    """Mean of exp(-x²/2) over u ± h, all in standard deviations.

    For small h its series is e^(-u²/2) (1 + h²(u² - 1)/6 + h⁴(u⁴ - 6u² + 3)/120).
    """
    small = MAX_SERIES_HALF[u.dtype]
    wide = h.clamp(min=small)
    ends = [((u + side * wide) * math.sqrt(0.5)).erf() for side in (1, -1)]
    mean = (ends[0] - ends[1]) * math.sqrt(math.pi / 8) / wide
    uu, hh = u * u, h * h
    series = 1 + hh * (uu - 1) / 6 + hh * hh * (uu * uu - 6 * uu + 3) / 120
    return torch.where(h < small, series * (-0.5 * uu).exp(), mean)


INTEGRAL = Integral()

"""AA-2DGS's object-space Mip filter on discs (Younes et al., NeurIPS 2025); letters as in `pixel_kernels.surfel`.

With J = ds/dd = (B + s nᵀ)/w and V = I + 0.1 J Jᵀ a disc's value is det V^-½ exp(-sᵀ V⁻¹ s / 2).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.ellipses import grown, positive_cutoff
from aaplug.core.interfaces import Limits, Pixels
from aaplug.core.rules import Rules
from aaplug.core.splats import Splats2D
from aaplug.methods.pixel_kernels.point import HALF_LOG2_E, exp2_of
from aaplug.methods.pixel_kernels.raster_rows import OPACITY, UX, UY, VX, VY
from aaplug.methods.pixel_kernels.surfel import SLOPE_X, SLOPE_Y, Surfel, intersection, plane_coordinates

DISC_VARIANCE = 0.1  # px²: variance of AA-2DGS's object-space Mip filter
MOST = 1e8  # of s, t, and their change per px: beyond it a disc on edge is below every cut-off, and squares overflow
LEAST_FACTOR = 1e-8  # AA-2DGS adds this to 1/det V before the square root, as published


@dataclass(frozen=True)
class SurfelMip(Surfel):
    """`Surfel` with the object-space Mip filter in place of 2DGS's low-pass filter."""

    name: str = "surfel-mip"

    def with_filter(self, discs: Splats2D, shift: Float[Tensor, " m"], rules: Rules) -> Splats2D:
        """Ellipses of discs that are convolved with the filter."""
        return grown(discs, (DISC_VARIANCE * positive_cutoff(discs, rules.min_alpha)).sqrt(), rules.min_alpha)

    def alpha(self, rows: Float[Tensor, "*n t c"], pixels: Pixels, limits: Limits) -> Float[Tensor, "*n t P"]:
        """Opacity times the filtered disc; s, t, J and V are scaled as the forms of the raster rows are."""
        s, t, inverse = plane_coordinates(rows, pixels)
        ux, uy, vx, vy, nx, ny = (rows[..., i, None] for i in (UX, UY, VX, VY, SLOPE_X, SLOPE_Y))
        j00, j01 = (ux + s * nx) * inverse, (uy + s * ny) * inverse
        j10, j11 = (vx + t * nx) * inverse, (vy + t * ny) * inverse
        s, t, j00, j01, j10, j11 = (x.clamp(-MOST, MOST) for x in (s, t, j00, j01, j10, j11))
        area = j00 * j11 - j01 * j10
        size = j00 * j00 + j01 * j01 + j10 * j10 + j11 * j11
        k = DISC_VARIANCE / HALF_LOG2_E
        per_det = 1 / (1 + k * size + k * k * area * area)
        across = (j10 * s - j00 * t) ** 2 + (j11 * s - j01 * t) ** 2
        value = exp2_of(rows[..., OPACITY, None] - (s * s + t * t + k * across) * per_det, limits)
        return limits.cut((per_det + LEAST_FACTOR).sqrt() * value)

    def exact(self, splats: Splats2D, offsets: Float[Tensor, "p c 2"]) -> Float[Tensor, "p c"]:
        """The filter as the paper expands it, with the Jacobian of the intersection of planes."""
        p, in_front, s, t, by_row, by_column, t_w = intersection(splats, offsets)
        depth = torch.where(in_front, p[..., 2], 1.0)
        by_x = torch.linalg.cross(t_w.expand_as(by_column), by_column)
        by_y = torch.linalg.cross(by_row, t_w.expand_as(by_row))
        a, b, c, d = (
            (change[..., i] * depth - p[..., i] * change[..., 2]) / depth**2 for change in (by_x, by_y) for i in (0, 1)
        )
        kappa = DISC_VARIANCE
        area, size = a * d - b * c, a * a + b * b + c * c + d * d
        det = kappa**2 * area**2 + kappa * size + 1
        rho = (s * s + t * t + kappa * ((d * s - c * t) ** 2 + (a * t - b * s) ** 2)) / det
        return torch.where(in_front, (1 / det + LEAST_FACTOR).sqrt() * torch.exp(-0.5 * rho), 0.0)


SURFEL_MIP = SurfelMip()

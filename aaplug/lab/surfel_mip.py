"""AA-2DGS's object-space Mip filter on discs (Younes et al., NeurIPS 2025); letters as in `pixel_kernels.surfel`.

With J = ds/dd = (B + s nᵀ)/w and V = I + 0.1 J Jᵀ a disc's value is det V^-½ exp(-sᵀ V⁻¹ s / 2).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.splats import Splats2D
from aaplug.methods.pixel_kernels.raster_rows import UX, UY, VX, VY
from aaplug.methods.pixel_kernels.surfel import Surfel, intersection

DISC_VARIANCE = 0.1  # px²: variance of AA-2DGS's object-space Mip filter
LEAST_FACTOR = 1e-8  # AA-2DGS adds this to 1/det V before the square root, as published


@dataclass(frozen=True)
class SurfelMip(Surfel):
    """`Surfel` with the object-space Mip filter in place of 2DGS's low-pass filter."""

    name: str = "surfel-mip"

    def filter_variance(self, window: float) -> float:
        """Variance of the filter, in px²."""
        return DISC_VARIANCE

    def value(
        self, rows: Tensor, e: tuple[Tensor, Tensor], ahead: Tensor, slopes: tuple[Tensor, Tensor], squared: Tensor
    ) -> Tensor:
        """The filtered disc; see `Surfel.value`."""
        s, t = e[0] / ahead, e[1] / ahead
        ux, uy, vx, vy = (rows[..., i, None] for i in (UX, UY, VX, VY))
        j00, j01 = (ux + s * slopes[0]) / ahead, (uy + s * slopes[1]) / ahead
        j10, j11 = (vx + t * slopes[0]) / ahead, (vy + t * slopes[1]) / ahead
        area = j00 * j11 - j01 * j10
        size = j00 * j00 + j01 * j01 + j10 * j10 + j11 * j11
        k = DISC_VARIANCE
        det = 1 + k * size + k * k * area * area
        across = (j10 * s - j00 * t) ** 2 + (j11 * s - j01 * t) ** 2
        return (1 / det + LEAST_FACTOR).sqrt() * (-0.5 * (s * s + t * t + k * across) / det).exp()

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

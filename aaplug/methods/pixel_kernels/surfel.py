"""Discs where rays meet them: 2DGS (Huang et al. 2024).

d: offset of a pixel from the disc's projected centre, in px.  C: covariance of the disc's linearised projection, in
px².  B: a whitening of C, Bᵀ B = C⁻¹.  n: depth slopes, in 1/px.  Inverse depth on the disc's plane is linear in the
pixel: w = 1 - n·d times that of the centre.  The ray meets the plane at s = B d / w, in standard deviations of the
disc: 2DGS's intersection (eq. 10), by the Sherman-Morrison formula.  Beyond a 2D Gaussian it needs only n.

"surfel" is 2DGS: exp(-ρ/2) with ρ = min(|s|², 2 |d|²/r²).  The second term is a screen-space low-pass filter with a
standard deviation of √½ r px, where r = `Splats2D.window`: 1 in `2dgs`, training's pixel in `2dgs-matched`.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.ellipses import positive_cutoff, whitening_columns
from aaplug.core.interfaces import Limits, Pixels
from aaplug.core.kernels import Kernels
from aaplug.core.rules import Rules
from aaplug.core.splats import Splats2D
from aaplug.methods.pixel_kernels.point import HALF_LOG2_E, LOG2_PADDING, exp2_of
from aaplug.methods.pixel_kernels.raster_rows import COLUMNS, OPACITY, forms_at, offsets_at, rows_of

SLOPE_X, SLOPE_Y, FILTER = COLUMNS, COLUMNS + 1, COLUMNS + 2
LOW_PASS = 2.0  # 1/px²: inverse variance of 2DGS's low-pass filter, whose σ is √½ px
MIN_FILTER_WIDTH = 1e-3  # px: lower bound of the low-pass filter's width, which is a divisor
IN_FRONT = 1e-3  # lower bound of w, and of 1 - R q for a disc near the camera plane
HORIZON = 1e-12  # lower bound of w in `exact`


@dataclass(frozen=True)
class Surfel:
    """Alpha is opacity times the disc's Gaussian where the pixel's ray meets its plane."""

    name: str = "surfel"
    columns: int = COLUMNS + 3
    needs_depth_slopes: bool = True
    splats_per_pass: int = 8

    def bounding_ellipses(self, splats: Splats2D, rules: Rules) -> Splats2D | None:
        """Ellipses that contain the discs and their filters.

        A disc that reaches the camera plane within its cut-off gets opacity 0 and is culled: its image is unbounded.
        With e = B d and R the squared cut-off, a disc in front of it covers |e|² <= R w².  With q = nᵀ C n < 1/R this
        is an ellipse around -R C n / (1 - R q) with the covariance (C + R C n nᵀ C / (1 - R q)) / (1 - R q).
        """
        assert splats.depth_slopes is not None
        cutoff = positive_cutoff(splats, rules.min_alpha)
        xx, xy, yy = splats.covs.unbind(dim=1)
        nx, ny = splats.depth_slopes.unbind(dim=1)
        cx, cy = xx * nx + xy * ny, xy * nx + yy * ny
        left = 1 - cutoff * (nx * cx + ny * cy)
        near = left > IN_FRONT
        left = left.clamp(min=IN_FRONT)
        stretch = cutoff / left
        shift = -stretch[:, None] * torch.stack([cx, cy], dim=1)
        covs = torch.stack([xx + stretch * cx * cx, xy + stretch * cx * cy, yy + stretch * cy * cy], dim=1)
        discs = replace(splats, means=splats.means + shift, covs=covs / left[:, None], dets=splats.dets / left**3)
        ellipses = self.with_filter(discs, torch.hypot(*shift.unbind(dim=1)), rules)
        return replace(ellipses, opacities=torch.where(near, splats.opacities, 0.0))

    def with_filter(self, discs: Splats2D, shift: Float[Tensor, " m"], rules: Rules) -> Splats2D:
        """Ellipses that also contain the low-pass filter, a circle `shift` px from their centres.

        A covariance contains a concentric circle of radius r if its least eigenvalue times the cut-off is at least r².
        """
        cutoff = positive_cutoff(discs, rules.min_alpha)
        radius = (self.filter_variance(discs.window) * cutoff).sqrt() + shift
        half = 0.5 * (discs.covs[:, 0] + discs.covs[:, 2])
        least = discs.dets / (half + (half * half - discs.dets).clamp(min=0).sqrt())
        return discs.blurred((radius * radius / cutoff - least).clamp(min=0), compensate=False)

    def filter_variance(self, window: float) -> float:
        """Variance of the filter beside the disc, in px²."""
        return max(window, MIN_FILTER_WIDTH) ** 2 / LOW_PASS

    def raster_rows(self, splats: Splats2D, kernels: Kernels) -> Float[Tensor, "m c"]:
        """Scaled forms, opacity as its log2 (see `point`), depth slopes, and the scaled form of the low-pass filter."""
        assert splats.depth_slopes is not None
        dets = splats.dets.clamp(min=torch.finfo(splats.dets.dtype).tiny)  # of discs that are points or stand on edge
        forms = [HALF_LOG2_E**0.5 * form for form in whitening_columns(splats.covs, dets)]
        opacities = splats.opacities.clamp(min=torch.finfo(splats.opacities.dtype).tiny).log2() - LOG2_PADDING
        low_pass = torch.full_like(opacities, HALF_LOG2_E / self.filter_variance(splats.window))
        columns = [*splats.depth_slopes.unbind(dim=1), low_pass]
        return rows_of(replace(splats, opacities=opacities), forms, columns)

    def alpha(self, rows: Float[Tensor, "*n t c"], pixels: Pixels, limits: Limits) -> Float[Tensor, "*n t P"]:
        """2^(log2 o - ρ log2(e)/2), 0 below the cut-off."""
        s, t, _ = plane_coordinates(rows, pixels)
        dx, dy = offsets_at(rows, pixels)
        on_disc, low_pass = s * s + t * t, rows[..., FILTER, None] * (dx * dx + dy * dy)
        return exp2_of(rows[..., OPACITY, None] - torch.minimum(on_disc, low_pass), limits)

    def exact(self, splats: Splats2D, offsets: Float[Tensor, "p c 2"]) -> Float[Tensor, "p c"]:
        """2DGS's intersection of homogeneous planes (its eqs. 8 to 10), beside its low-pass filter."""
        _, in_front, s, t = intersection(splats, offsets)[:4]
        squared = offsets.square().sum(dim=2)
        low_pass = LOW_PASS * squared / max(splats.window, MIN_FILTER_WIDTH) ** 2
        values = torch.exp(-0.5 * torch.minimum(s * s + t * t, low_pass))
        return torch.where(in_front, values, torch.exp(-0.5 * low_pass))


def plane_coordinates(rows: Float[Tensor, "*n t c"], pixels: Pixels) -> tuple[Tensor, Tensor, Tensor]:
    """Where pixels' rays meet the discs, s and t, by the forms of the raster rows; and 1/w."""
    u, v = forms_at(rows, pixels, triangular=True)
    dx, dy = offsets_at(rows, pixels)
    inverse = 1 / (1 - rows[..., SLOPE_X, None] * dx - rows[..., SLOPE_Y, None] * dy).clamp(min=IN_FRONT)
    return u * inverse, v * inverse, inverse


def intersection(splats: Splats2D, offsets: Float[Tensor, "p c 2"]) -> tuple[Tensor, ...]:
    """p = by_row × by_column, where it lies in front, the disc's coordinates s and t, by_row, by_column and T_w.

    T_u, T_v, T_w map the disc's coordinates to the screen, from any root of its covariance and its depth slopes.
    """
    t_u, t_v, t_w = _planes(splats)
    x, y = offsets[..., :1], offsets[..., 1:]
    by_row, by_column = x * t_w - t_u, y * t_w - t_v
    p = torch.linalg.cross(by_row, by_column)
    in_front = p[..., 2] > HORIZON
    depth = torch.where(in_front, p[..., 2], 1.0)
    return p, in_front, p[..., 0] / depth, p[..., 1] / depth, by_row, by_column, t_w


def _planes(splats: Splats2D) -> tuple[Tensor, Tensor, Tensor]:
    """T_u, T_v, T_w of each disc."""
    assert splats.depth_slopes is not None
    xx, xy, _ = splats.covs.unbind(dim=1)
    a = xx.sqrt()
    zero, one = torch.zeros_like(a), torch.ones_like(a)
    root = torch.stack([a, zero, xy / a, (splats.dets / xx).sqrt()], dim=1).unflatten(1, (2, 2))
    tilt = torch.einsum("cij,ci->cj", root, splats.depth_slopes)
    t_u, t_v = (torch.cat([root[:, i], zero[:, None]], dim=1) for i in (0, 1))
    return t_u, t_v, torch.cat([tilt, one[:, None]], dim=1)


SURFEL = Surfel()

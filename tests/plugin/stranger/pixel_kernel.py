"""A pixel kernel: alpha is the mean of the Gaussian over four points of the pixel."""

import math
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from aaplug import Kernels, Limits, Pixels, Rules, Splats2D, grown, raster_rows, whitening, whitening_columns

QUARTER = raster_rows.COLUMNS  # our own column: a quarter of the pixel's side, in px
COLUMNS = (raster_rows.UX, raster_rows.UY, raster_rows.VX, raster_rows.VY, raster_rows.OPACITY, QUARTER)
POINTS = tuple(product((-1, 1), repeat=2))  # in quarters of the pixel, from its centre


@dataclass(frozen=True)
class FourPoints:
    """Alpha is opacity times the mean of the Gaussian's value at four points."""

    name: str = "four-points"
    columns: int = QUARTER + 1
    needs_depth_slopes: bool = False
    splats_per_pass: int = 8

    def bounding_ellipses(self, splats: Splats2D, rules: Rules) -> Splats2D:
        """Ellipses that contain the centre of every pixel with one of its points in the splat."""
        radius = math.sqrt(2) * splats.window / 4
        return grown(splats, torch.full_like(splats.dets, radius), rules.min_alpha)

    def raster_rows(self, splats: Splats2D, kernels: Kernels) -> Tensor:
        """Two forms u, v with exp(-(u² + v²) / 2) as the Gaussian's value, our own column, and the padding row.

        Of m splats, [m + 1, columns].
        """
        quarter = torch.full_like(splats.dets, splats.window / 4)
        return raster_rows.rows_of(splats, whitening_columns(splats.covs, splats.dets), [quarter])

    def alpha(self, rows: Tensor, pixels: Pixels, limits: Limits) -> Tensor:
        """Opacity times the mean, 0 below the cut-off: [..., t, P] of rows [..., t, columns] at P pixels of t tiles."""
        u, v = raster_rows.forms_at(rows, pixels)
        ux, uy, vx, vy, opacity, quarter = (rows[..., i, None] for i in COLUMNS)
        total = torch.zeros_like(u)
        for right, down in POINTS:
            du, dv = quarter * (right * ux + down * uy), quarter * (right * vx + down * vy)
            total = total + torch.exp(-0.5 * ((u + du).square() + (v + dv).square()))
        return limits.cut(opacity * total / len(POINTS))

    def exact(self, splats: Splats2D, offsets: Tensor) -> Tensor:
        """The same mean in float64, from the definition; at offsets [p, c, 2] of p pixels from c splats, [p, c]."""
        points = offsets.new_tensor(POINTS) * splats.window / 4
        at = offsets[:, :, None] + points  # [p, c, 4, 2]
        white = torch.einsum("cij,pckj->pcki", whitening(splats), at)
        return torch.exp(-0.5 * white.square().sum(dim=-1)).mean(dim=-1)


FOUR_POINTS = FourPoints()

"""A pixel kernel: alpha is the mean of the Gaussian over four points of the pixel."""

import math
from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.ellipses import grown, whitening, whitening_columns
from aaplug.core.interfaces import Pixels
from aaplug.core.kernels import Kernels
from aaplug.core.rules import Rules
from aaplug.core.splats import Splats2D
from aaplug.methods.pixel_kernels.raster_rows import COLUMNS, OPACITY, UX, UY, VX, VY, forms_at, rows_of

QUARTER = COLUMNS  # our own column: a quarter of the pixel's side, in px
POINTS = tuple(product((-1, 1), repeat=2))  # in quarters of the pixel, from its centre


@dataclass(frozen=True)
class FourPoints:
    """Alpha is opacity times the mean of the Gaussian's value at four points."""

    name: str = "four-points"
    columns: int = COLUMNS + 1
    needs_depth_slopes: bool = False
    splats_per_pass: int = 8

    def bounding_ellipses(self, splats: Splats2D, rules: Rules) -> Splats2D:
        """Ellipses that contain the centre of every pixel with one of its points in the splat."""
        radius = math.sqrt(2) * splats.window / 4
        return grown(splats, torch.full_like(splats.dets, radius), rules.min_alpha)

    def raster_rows(self, splats: Splats2D, kernels: Kernels) -> Float[Tensor, "m_and_1 c"]:
        """Two forms u, v with exp(-(u² + v²) / 2) as the Gaussian's value, our own column, and the padding row."""
        quarter = torch.full_like(splats.dets, splats.window / 4)
        return rows_of(splats, whitening_columns(splats.covs, splats.dets), [quarter])

    def alpha(self, rows: Float[Tensor, "*n t c"], pixels: Pixels, rules: Rules) -> Float[Tensor, "*n t P"]:
        """Opacity times the mean, 0 below the cut-off."""
        u, v = forms_at(rows, pixels)
        ux, uy, vx, vy, opacity, quarter = (rows[..., i, None] for i in (UX, UY, VX, VY, OPACITY, QUARTER))
        total = torch.zeros_like(u)
        for right, down in POINTS:
            du, dv = quarter * (right * ux + down * uy), quarter * (right * vx + down * vy)
            total = total + torch.exp(-0.5 * ((u + du).square() + (v + dv).square()))
        return torch.threshold(opacity * total / len(POINTS), rules.below_min_alpha, 0.0)

    def exact(self, splats: Splats2D, offsets: Float[Tensor, "p c 2"]) -> Float[Tensor, "p c"]:
        """The same mean in float64, from the definition."""
        points = offsets.new_tensor(POINTS) * splats.window / 4
        at = offsets[:, :, None] + points  # [p, c, 4, 2]
        white = torch.einsum("cij,pckj->pcki", whitening(splats), at)
        return torch.exp(-0.5 * white.square().sum(dim=-1)).mean(dim=-1)


FOUR_POINTS = FourPoints()

"""Alpha averaged over the pixel's own, unturned square.

The square is cut into STRIPS strips across the axis along which the splat is longer.  Each strip has the exact share of
the splat along that axis, times the exact mean across it, given the strip's middle.  Samples along an ellipse's long
side with weights from its shape are MipSLAM's idea (arXiv 2603.06989), whose constants are not published: this form is
aaplug's own.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.special import ndtr

from aaplug.core.ellipses import whitening_columns
from aaplug.core.interfaces import Pixels
from aaplug.core.kernels import Kernels
from aaplug.core.rules import Rules
from aaplug.core.splats import Splats2D
from aaplug.methods.pixel_kernels.averages import mean_gaussian
from aaplug.methods.pixel_kernels.integral import NARROWEST, pixel_margin
from aaplug.methods.pixel_kernels.raster_rows import COLUMNS, OPACITY, forms_at, rows_of

HALF_ACROSS, HALF_ALONG, SLOPE = COLUMNS, COLUMNS + 1, COLUMNS + 2  # in standard deviations
STRIPS = 3


@dataclass(frozen=True)
class Square:
    """Alpha is opacity times the mean over the pixel's square."""

    name: str = "square"
    columns: int = COLUMNS + 3
    needs_depth_slopes: bool = False
    splats_per_pass: int = 8

    def bounding_ellipses(self, splats: Splats2D, rules: Rules) -> Splats2D | None:
        """Ellipses that contain the centre of every pixel that touches the splat."""
        return pixel_margin(splats, rules)

    def raster_rows(self, splats: Splats2D, kernels: Kernels) -> Float[Tensor, "m c"]:
        """The second form follows x or y, where the splat is longer; the first is across it.

        SLOPE: how much the first form changes over the window along the second.
        """
        window = splats.window
        ux, uy, vx, vy = whitening_columns(splats.covs, splats.dets)
        along_x = vx > 0
        across, slope = torch.where(along_x, uy, ux), torch.where(along_x, ux, uy)
        own = [0.5 * window * across, 0.5 * window * (vx + vy), window * slope]
        return rows_of(splats, [ux, uy, vx, vy], own)

    def alpha(self, rows: Float[Tensor, "*n t c"], pixels: Pixels, rules: Rules) -> Float[Tensor, "*n t P"]:
        """Opacity times the mean of the strips."""
        across, along = forms_at(rows, pixels)
        half_across, half_along, slope = (rows[..., i, None] for i in (HALF_ACROSS, HALF_ALONG, SLOPE))
        total = torch.zeros_like(along)
        for strip in range(STRIPS):
            from_middle = (strip - (STRIPS - 1) / 2) / STRIPS
            share = mean_gaussian(along + 2 * from_middle * half_along, half_along / STRIPS)
            total = total + share * mean_gaussian(across + from_middle * slope, half_across)
        alpha = rows[..., OPACITY, None] * total / STRIPS
        return torch.threshold(alpha, rules.below_min_alpha, 0.0)

    def exact(self, splats: Splats2D, offsets: Float[Tensor, "p c 2"]) -> Float[Tensor, "p c"]:
        """A marginal of the Gaussian per strip, times the conditional across it at the strip's middle."""
        side = max(splats.window, NARROWEST)
        xx, xy, yy = splats.covs.unbind(dim=1)
        wide = xx >= yy
        long = torch.where(wide, xx, yy)
        along, across = (torch.where(wide, offsets[..., i], offsets[..., 1 - i]) for i in (0, 1))
        values = torch.zeros_like(along)
        for strip in range(STRIPS):
            middle = along + side * ((strip + 0.5) / STRIPS - 0.5)
            given = across - xy / long * middle
            values = values + _mean(middle, long.sqrt(), side / STRIPS) * _mean(
                given, (splats.dets / long).sqrt(), side
            )
        return values / STRIPS


def _mean(at: Float[Tensor, "p c"], sigma: Float[Tensor, " c"], side: float) -> Float[Tensor, "p c"]:
    """Mean of exp(-x²/2σ²) over at ± side/2."""
    probability = ndtr((at + side / 2) / sigma) - ndtr((at - side / 2) / sigma)
    return probability * sigma * math.sqrt(2 * math.pi) / side


SQUARE = Square()

"""Where along a ray discs lie: the distortion loss and the median depth of 2DGS (Huang et al. 2024, arXiv 2403.17888).

m: discs; t: tiles; K: discs of a tile in turn; P: pixels per tile; p: pixels; h, w: px.
w_i = alpha_i T_i: weight of the i-th disc of a pixel, in front of which the transmittance is T_i.  m_i: its depth.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from aaplug.core.colours import BLACK
from aaplug.core.interfaces import Limits, Pixels, Rasterizer
from aaplug.core.kernels import EAGER, Kernels
from aaplug.core.rules import RULES_GSPLAT, Rules
from aaplug.core.splats import Splats2D
from aaplug.gsplat.arguments import Options
from aaplug.methods.pixel_kernels.raster_rows import BLUE, RED, next_rows, tile_centres
from aaplug.methods.pixel_kernels.surfel import SURFEL, Surfel
from aaplug.rasterizers.reference import alphas

BELOW_1 = 1 - 2.0**-24  # the float32 below it
HALF = 0.5  # transmittance at the median
SPLATS = 16  # whose alphas are computed at once
DIGIT = 4096  # a disc's number is drawn as two colours, which float32 holds exactly


def distortion(splats: Splats2D, options: Options, rasterizer: Rasterizer) -> Float[Tensor, "h w 1"]:
    """Σ_i Σ_(j<i) 2 w_i w_j (m_i - m_j): 2DGS, eq. 13, with the depth of centres, as gsplat has it.

    With T the transmittance behind everything, D = Σ w_i m_i, and w_i (T_i + T_(i+1)) = T_i² - T_(i+1)², the sum is
    2 (D (1 + T) - Σ (T_i² - T_(i+1)²) m_i).  The last sum is the depth of discs that are all drawn twice, one copy
    behind the other.  The difference is small, so both are drawn in float64.
    """
    exact = splats.to(torch.float64)
    exact = replace(exact, rgb=exact.depths[:, None].expand(-1, 3))
    rules = options.convention.rules
    once = rasterizer(exact, options.hw, BLACK, SURFEL, None, rules)
    squared = replace(rules, max_alpha=BELOW_1, min_transmittance=rules.min_transmittance**2)
    twice = rasterizer(exact, options.hw, BLACK, Twice(once=rules), None, squared)
    return (2 * (once.rgb[..., :1] * (2 - once.alpha[..., None]) - twice.rgb[..., :1])).to(splats.means)


@dataclass(frozen=True)
class Twice(Surfel):
    """Two discs of the same place, one behind the other, by the rules `once` of each."""

    name: str = "surfel-twice"
    once: Rules = RULES_GSPLAT

    def alpha(self, rows: Float[Tensor, "*n t c"], pixels: Pixels, limits: Limits) -> Float[Tensor, "*n t P"]:
        """1 - (1 - alpha)² = alpha (2 - alpha)."""
        alpha = super().alpha(rows, pixels, Limits.by(self.once)).clamp(max=self.once.max_alpha)
        return alpha * (2 - alpha)

    def exact(self, splats: Splats2D, offsets: Float[Tensor, "p c 2"]) -> Float[Tensor, "p c"]:
        """The same, over the opacity."""
        alpha = (splats.opacities * super().exact(splats, offsets)).clamp(max=self.once.max_alpha)
        alpha = torch.where(alpha >= self.once.min_alpha, alpha, 0.0)
        return alpha * (2 - alpha) / splats.opacities.clamp(min=self.once.min_alpha)


def median_depth(splats: Splats2D, options: Options, rasterizer: Rasterizer) -> Float[Tensor, "h w 1"]:
    """Depth of the last disc in front of which the transmittance is above a half; 0 where there is none."""
    number = torch.arange(len(splats))
    digits = torch.stack([number // DIGIT, number % DIGIT, 0 * number], dim=1).to(splats.means)
    with torch.no_grad():
        numbered, rules = replace(splats, rgb=digits), options.convention.rules
        found = rasterizer(numbered, options.hw, BLACK, SURFEL, MEDIAN, rules)
        high, low, _ = found.rgb.double().unbind(dim=2)
        number = torch.where(found.alpha > 0, DIGIT * high + low, len(splats)).long()
    depths = torch.cat([splats.depths, splats.depths.new_zeros(1)])
    return depths.index_select(0, number.flatten()).view(*number.shape, 1)


@dataclass(frozen=True)
class Median:
    """A compositor: the colour of the last disc in front of which the transmittance is above a half, and alpha 1."""

    name: str = "median"

    def rows(self, splats: Splats2D) -> Float[Tensor, "m c"]:
        """The discs' raster rows."""
        return SURFEL.raster_rows(splats, EAGER)

    def tiles(
        self,
        rows: Float[Tensor, "m c"],
        window: float,
        order: Int[Tensor, " p"],
        first: Int[Tensor, " t"],
        counts: Int[Tensor, " t"],
        centres: tuple[Float[Tensor, "t P"], Float[Tensor, "t P"]],
        kernels: Kernels,
        rules: Rules,
    ) -> Float[Tensor, "4 t P"]:
        """Colour and alpha; a tile ends where all its pixels are past the median."""
        (x, y), local = centres, tile_centres(rows)
        corners = torch.stack([x[:, 0] - local[0][0], y[:, 0] - local[1][0]], dim=1)
        pixels, left, image = Pixels(corners, *local), torch.ones_like(x), rows.new_zeros(*x.shape, 4)
        for start in range(0, int(counts.max()), SPLATS):
            nearest = next_rows(rows, order, first + start, first + counts, SPLATS)
            alpha = SURFEL.alpha(nearest.transpose(0, 1), pixels, Limits.by(rules))
            last, left = _last_above_half(alpha, left, rules)
            colour = nearest[torch.arange(len(counts))[:, None], last.clamp(min=0), RED : BLUE + 1]
            image = torch.where(last[..., None] >= 0, functional.pad(colour, (0, 1), value=1.0), image)
            if (left <= HALF).all():
                break
        return image.permute(2, 0, 1)

    def exact(
        self, splats: Splats2D, centres: Float[Tensor, "p 2"], rules: Rules
    ) -> tuple[Float[Tensor, "p 3"], Float[Tensor, " p"]]:
        """The same of all splats at once."""
        alpha = alphas(splats, centres, SURFEL, rules).T
        last, _ = _last_above_half(alpha, torch.ones_like(centres[:, 0]), rules)
        assert splats.rgb is not None
        hit = last >= 0
        return splats.rgb[last.clamp(min=0)] * hit[:, None], 1.0 - hit.to(centres)


def _last_above_half(
    alpha: Float[Tensor, "K *p"], left: Float[Tensor, "*p"], rules: Rules
) -> tuple[Int[Tensor, "*p"], Float[Tensor, "*p"]]:
    """The last disc that is drawn with more than half of the light left, -1 if none is, and the light behind all.

    No pixel has stopped there: what one disc leaves of a half is above every bound.
    """
    behind = left * (1 - alpha.clamp(max=rules.max_alpha)).cumprod(dim=0)
    before = torch.cat([left[None], behind[:-1]])
    turns = torch.arange(len(alpha)).view(-1, *([1] * left.dim()))
    return torch.where((alpha > 0) & (before > HALF), turns, -1).amax(dim=0), behind[-1]


MEDIAN = Median()

"""Where along a ray discs lie: the distortion loss and the median depth of 2DGS (Huang et al. 2024, arXiv 2403.17888).

m: discs; t: tiles; P: pixels per tile; p: pixels; h, w: px.
w_i = alpha_i T_i: weight of the i-th disc of a pixel, in front of which the transmittance is T_i.  m_i: its depth.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.colours import BLACK
from aaplug.core.interfaces import Limits, Pixels, Rasterizer
from aaplug.core.rules import RULES_GSPLAT, Rules
from aaplug.core.splats import Splats2D
from aaplug.gsplat.arguments import Options
from aaplug.methods.order import Order
from aaplug.methods.pixel_kernels.surfel import SURFEL, Surfel
from aaplug.rendering.passes import MAX_NUMBER

BELOW_1 = 1 - 2.0**-24  # the float32 below it


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
    with torch.no_grad():
        numbered = splats if len(splats) <= MAX_NUMBER else splats.to(torch.float64)
        numbers = torch.arange(len(splats), device=splats.means.device).to(numbered.depths)
        numbered = replace(numbered, rgb=torch.stack([numbered.depths, numbers, 0 * numbers], dim=1))
        last = Order(SURFEL, ("last", "last", "last", "last"))
        found = rasterizer(numbered, options.hw, BLACK, SURFEL, last, options.convention.rules).rgb[..., :1]
    return torch.cat([splats.depths, splats.depths.new_zeros(1)])[found.long()]  # -1, the last: no disc

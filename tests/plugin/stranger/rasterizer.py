"""A rasterizer: one row of pixels at a time, all splats at once, in float64."""

from dataclasses import dataclass

import torch
from torch import Tensor

from aaplug import RULES_3DGS, Colour, Compositor, PixelKernel, Render, Rules, Splats2D, over


@dataclass(frozen=True)
class RowByRow:
    """Draws by each pixel kernel's exact form."""

    name: str = "row-by-row"

    def __call__(
        self,
        splats: Splats2D,
        hw: tuple[int, int],
        background: Colour,
        pixel: PixelKernel,
        compositor: Compositor | None = None,
        rules: Rules = RULES_3DGS,
    ) -> Render:
        """Draw the splats, nearest first."""
        splats = splats.to(torch.float64)
        splats = splats[torch.sort(splats.depths, stable=True).indices]
        x = torch.arange(hw[1], dtype=torch.float64) + 0.5
        lines = [torch.stack([x, torch.full_like(x, y + 0.5)], dim=1) for y in range(hw[0])]
        drawn = [
            _row(splats, line, pixel, rules) if compositor is None else compositor.exact(splats, line, rules)
            for line in lines
        ]
        rgb, transmittance = (torch.stack(parts) for parts in zip(*drawn, strict=True))
        return over(rgb, 1 - transmittance, background)


def _row(splats: Splats2D, centres: Tensor, pixel: PixelKernel, rules: Rules) -> tuple[Tensor, Tensor]:
    """Premultiplied colour [w, 3] and the visible share [w] of the background, at pixel centres [w, 2]."""
    values = pixel.exact(splats, centres[:, None] - splats.means)
    alpha = (splats.opacities * values).clamp(max=rules.max_alpha)
    alpha = torch.where(alpha >= rules.min_alpha, alpha, 0.0)
    one = centres.new_ones(len(centres), 1)
    light = torch.cat([one, one * (1 - alpha).cumprod(dim=1)], dim=1)  # before each splat, and after
    kept = light[:, 1:] >= rules.min_transmittance  # a pixel stops before it becomes opaque
    assert splats.rgb is not None
    rgb = torch.where(kept, alpha * light[:, :-1], 0.0) @ splats.rgb
    return rgb, torch.where(torch.cat([one > 0, kept], dim=1), light, 1.0).amin(dim=1)


ROW_BY_ROW = RowByRow()

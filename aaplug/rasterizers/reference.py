"""The reference rasterizer: every splat at every pixel, in float64, in the order and by the stopping rule of 3DGS.

p: pixels of a strip; c: splats of a chunk.  It has no tiles and no bounding ellipses; strips and chunks bound its
memory.  Differentiable through autograd.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.colours import Colour
from aaplug.core.imaging import over
from aaplug.core.interfaces import Compositor, PixelKernel
from aaplug.core.rules import RULES_3DGS, Rules
from aaplug.core.splats import Render, Splats2D
from aaplug.methods.pixel_kernels.point import POINT

STRIP_PIXELS = 4096
CHUNK_SPLATS = 512


@dataclass(frozen=True)
class Reference:
    """Draws by each pixel kernel's exact twin; the image is float64."""

    name: str = "reference"

    def __call__(
        self,
        splats: Splats2D,
        hw: tuple[int, int],
        background: Colour,
        pixel: PixelKernel = POINT,
        compositor: Compositor | None = None,
        rules: Rules = RULES_3DGS,
    ) -> Render:
        """Draw the splats in float64."""
        splats = splats.to(torch.float64)
        splats = splats[torch.sort(splats.depths, stable=True).indices]
        y, x = (torch.arange(side, dtype=torch.float64, device=splats.means.device) + 0.5 for side in hw)
        strips = [
            composited(splats, strip, pixel, rules) if compositor is None else compositor.exact(splats, strip, rules)
            for strip in torch.cartesian_prod(y, x).flip(1).split(STRIP_PIXELS)
        ]
        rgb = torch.cat([rgb for rgb, _ in strips]).reshape(*hw, -1)
        transmittance = torch.cat([t for _, t in strips]).reshape(hw)
        return over(rgb, 1 - transmittance, background)


def composited(
    splats: Splats2D, centres: Float[Tensor, "p 2"], pixel: PixelKernel, rules: Rules
) -> tuple[Float[Tensor, "p d"], Float[Tensor, " p"]]:
    """Premultiplied colour and transmittance of splats in their order, front to back (3DGS, eq. 3)."""
    assert splats.rgb is not None
    rgb = centres.new_zeros(len(centres), splats.rgb.shape[1])
    transmittance = centres.new_ones(len(centres))
    going = torch.ones_like(transmittance, dtype=torch.bool)
    for start in range(0, len(splats), CHUNK_SPLATS):
        chunk = splats[start : start + CHUNK_SPLATS]
        alpha = alphas(chunk, centres, pixel, rules)
        after = transmittance[:, None] * (1 - alpha).cumprod(dim=1)
        before = torch.cat([transmittance[:, None], after[:, :-1]], dim=1)
        # `after` only falls, so the first splat that misses the bound ends the pixel
        counts = (after >= rules.min_transmittance) & going[:, None]
        rgb = rgb + torch.where(counts, alpha * before, 0.0) @ splats.rgb[start : start + CHUNK_SPLATS]
        transmittance = torch.minimum(transmittance, torch.where(counts, after, 1.0).amin(dim=1))
        going = going & counts[:, -1]
    return rgb, transmittance


def alphas(
    splats: Splats2D, centres: Float[Tensor, "p 2"], pixel: PixelKernel = POINT, rules: Rules = RULES_3DGS
) -> Float[Tensor, "p c"]:
    """Alpha of each splat at each pixel, capped, and 0 below the cut-off (3DGS, eq. 4)."""
    values = pixel.exact(splats, centres[:, None] - splats.means)
    alpha = (splats.opacities * values).clamp(max=rules.max_alpha)
    return torch.where(alpha >= rules.min_alpha, alpha, 0.0)


REFERENCE = Reference()

"""The reference rasterizer: every splat at every pixel, in float64, in the order and by the stopping rule of 3DGS.

p: pixels of a strip; c: splats of a chunk.  It has no bounding ellipses, and tiles only where splats have ray
slopes; strips and chunks bound its memory.  Differentiable through autograd.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.colours import Colour
from aaplug.core.imaging import over
from aaplug.core.interfaces import Compositor, PixelKernel
from aaplug.core.rules import RULES_3DGS, Rules
from aaplug.core.splats import Render, Splats2D, ordering_depths
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.methods.pixel_kernels.raster_rows import TILE

STRIP_PIXELS = 4096
CHUNK_SPLATS = 512


@dataclass(frozen=True)
class Reference:
    """Draws by each pixel kernel's exact twin; the image is float64."""

    name: str = "reference"
    tile: ClassVar[int] = TILE  # px, side of the tiles in which it sorts

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
        centres = torch.cartesian_prod(y, x).flip(1)
        painted = [
            (at, *composited(drawn, centres[at], pixel, rules))
            if compositor is None
            else (at, *compositor.exact(drawn, centres[at], rules))
            for at, drawn in _strips(splats, centres)
        ]
        places, rgb, transmittance = (torch.cat(parts) for parts in zip(*painted, strict=True))
        back = places.argsort()
        rgb, transmittance = rgb[back], transmittance[back]
        return over(rgb.reshape(*hw, -1), 1 - transmittance.reshape(hw), background)


def _strips(splats: Splats2D, centres: Float[Tensor, "n 2"]) -> Iterator[tuple[Int[Tensor, " p"], Splats2D]]:
    """Places of some pixels and their splats, nearest first: of a tile each if splats have ray slopes."""
    if splats.ray_slopes is None:
        everywhere = torch.arange(len(centres), device=centres.device)
        yield from ((places, splats) for places in everywhere.split(STRIP_PIXELS))
        return
    tiles, numbers = torch.unique((centres / TILE).floor(), dim=0, return_inverse=True)
    for number, tile in enumerate(tiles):
        places = (numbers == number).nonzero().squeeze(1)
        ahead = ((TILE * (tile + 0.5) - splats.means) * splats.ray_slopes).sum(dim=1)
        nearest = torch.sort(ordering_depths(splats.depths, ahead), stable=True).indices
        yield places, splats[nearest]


def composited(
    splats: Splats2D, centres: Float[Tensor, "p 2"], pixel: PixelKernel, rules: Rules
) -> tuple[Float[Tensor, "p d"], Float[Tensor, " p"]]:
    """Premultiplied colour and transmittance of splats in their order, front to back (3DGS, eq. 3)."""
    assert splats.rgb is not None
    nothing = alphas(splats[:0], centres, pixel, rules)  # so that an image without splats has gradients, too
    rgb, transmittance = nothing @ splats.rgb[:0], 1 - nothing.sum(dim=1)
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

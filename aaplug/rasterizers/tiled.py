"""The fast rasterizer: tiles, one depth sort, and compositing as elementwise array code that compiles to one loop.

t: tiles of TILE × TILE px; P: pixels a tile.

1. `drawing` has a row for each splat: what its alpha at a pixel is found from.
2. `binning` finds which splats each tile draws, nearest first.
3. `compositing` draws them.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import chain

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.interfaces import PixelKernel
from aaplug.kernels import EAGER, Kernels
from aaplug.rasterizers.binning import MEMORY, TILE, Bins, bands
from aaplug.rasterizers.blending import blended, table_of
from aaplug.rasterizers.compositing import composite
from aaplug.rasterizers.drawing import drawing_of, pixel_centres
from aaplug.rasterizers.extents import extents_of
from aaplug.rasterizers.rules import over
from aaplug.splats import Render, Splats2D

BLENDED_TILES = 64  # of about equally many splats, blended together


@dataclass(frozen=True)
class Tiled:
    """Draws in tiles, in the splats' precision; differentiable.

    kernels: how the elementwise stages run.  memory: bytes that binning may take beside the scene and the image.
    """

    kernels: Kernels = EAGER
    memory: float = MEMORY

    def __call__(
        self,
        splats: Splats2D,
        hw: tuple[int, int],
        background: tuple[float, float, float],
        pixel: PixelKernel = "point",
    ) -> Render:
        """Draw the splats."""
        grid = (-(-hw[0] // TILE), -(-hw[1] // TILE))
        extents = extents_of(splats, pixel) or splats
        paint = self._painter(splats, pixel)

        def painted() -> Iterator[Render]:
            for bins in bands(extents, grid, self.kernels, self.memory):
                colours, alphas = paint(bins)
                rgb, alpha = (_untiled(x, grid[1]) for x in (colours, alphas[None]))
                yield over(rgb, alpha[..., 0], background)

        whole = _assembled(painted(), grid[0] * TILE)
        return Render(whole.rgb[: hw[0], : hw[1]], whole.alpha[: hw[0], : hw[1]])

    def _painter(
        self, splats: Splats2D, pixel: PixelKernel
    ) -> Callable[[Bins], tuple[Tensor, Tensor]]:
        """What paints the tiles of a band."""
        if pixel == "blending":
            return partial(_blend, table_of(splats), splats, kernels=self.kernels)
        return partial(
            composite, drawing_of(splats, self.kernels, pixel), kernels=self.kernels, pixel=pixel
        )


def _untiled(tiles: Float[Tensor, "k t P"], columns: int) -> Float[Tensor, "h w k"]:
    """Tiles of whole rows put in their places."""
    image = tiles.view(len(tiles), -1, columns, TILE, TILE).permute(1, 3, 2, 4, 0)
    return image.reshape(-1, columns * TILE, len(tiles))


def _assembled(bands: Iterator[Render], height: int) -> Render:
    """Bands from the top in one image; each is let go when it is in its place, as a large image has but one copy."""
    first = next(bands)
    if len(first.rgb) == height:
        return first
    whole = Render(*(x.new_empty(height, *x.shape[1:]) for x in first))
    top = 0
    for band in chain([first], bands):
        bottom = top + len(band.rgb)
        whole.rgb[top:bottom], whole.alpha[top:bottom] = band
        top = bottom
    return whole


def _blend(
    table: Float[Tensor, "m 12"], splats: Splats2D, bins: Bins, kernels: Kernels
) -> tuple[Float[Tensor, "3 t P"], Float[Tensor, "t P"]]:
    """The same by the rule of `blending`, in array code alone."""
    local = pixel_centres(table)
    order = torch.sort(bins.counts, descending=True, stable=True).indices
    parts = []
    for tiles in order.split(BLENDED_TILES):
        x, y = (bins.origins[tiles, i, None] + local[i] for i in (0, 1))
        lists = (bins.splats, bins.first[tiles], bins.counts[tiles])
        parts.append(blended(table, splats.window, *lists, x, y, kernels))
    image = torch.cat(parts, dim=1)[:, order.argsort()].to(splats.means)
    return image[:3], image[3]

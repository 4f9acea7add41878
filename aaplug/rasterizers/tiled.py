"""The fast rasterizer: tiles, one depth sort, and compositing as elementwise array code that compiles to one loop.

m: splats; t: tiles of TILE × TILE px; P: pixels a tile; c: columns of a drawing row.

1. A splat becomes a drawing row: two linear forms u, v of the pixel's position with u² + v² = log2(e)/2 · dᵀ C⁻¹ d, so
   that alpha is 2^(log2 o − u² − v²).  Forms lose no digits where the expanded quadratic of a needle would.
2. `binning` finds which splats each tile draws, nearest first.
3. `compositing` draws them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import log2

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.interfaces import PixelKernel
from aaplug.kernels import EAGER, Kernel, Kernels
from aaplug.rasterizers.binning import MEMORY, TILE, Bins, bands, splat_example
from aaplug.rasterizers.blending import blended, table_of
from aaplug.rasterizers.compositing import LOG2_SILENT, OPACITY, composite, pixel_centres
from aaplug.rasterizers.extents import SURFELS, extents_of
from aaplug.rasterizers.rules import over
from aaplug.rasterizers.surfels import NARROWEST
from aaplug.splats import Render, Splats2D, principal_columns, whitening_columns

BLENDED_TILES = 64  # of about equally many splats, blended together
HALF_LOG2_E = 0.5 * log2(torch.e)


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
        rgb, alpha = [], []
        for bins in bands(extents, grid, self.kernels, self.memory):
            colours, alphas = paint(bins)
            rgb.append(_untiled(colours, grid[1]))
            alpha.append(_untiled(alphas[None], grid[1]))
        return over(_image(rgb, hw), _image(alpha, hw)[..., 0], background)

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


def _image(bands: list[Tensor], hw: tuple[int, int]) -> Float[Tensor, "h w k"]:
    """Bands from the top put together, and cut to size."""
    image = bands[0] if len(bands) == 1 else torch.cat(bands)
    return image[: hw[0], : hw[1]]


def drawing_of(
    splats: Splats2D, kernels: Kernels, pixel: PixelKernel = "point"
) -> Float[Tensor, "m c"]:
    """Linear forms, centre, opacity and colour of each splat, and a last row that draws nothing."""
    assert splats.rgb is not None
    if pixel == "point":
        columns = (splats.means, splats.covs, splats.dets, splats.opacities, splats.rgb)
        (rows,) = kernels.run(DRAWING, *columns)
    elif pixel in SURFELS:
        rows = _disc_rows(splats, splats.rgb)
    else:
        rows = _mean_rows(splats, splats.rgb, square=pixel == "square")
    nothing = rows.new_zeros(1, rows.shape[1])
    nothing[:, OPACITY] = LOG2_SILENT if pixel == "point" else 0.0
    return torch.cat([rows, nothing])


def _drawing_rows(
    means: Float[Tensor, "m 2"],
    covs: Float[Tensor, "m 3"],
    dets: Float[Tensor, " m"],
    opacities: Float[Tensor, " m"],
    rgb: Float[Tensor, "m 3"],
) -> tuple[Float[Tensor, "m 10"]]:
    """Rows for values at points, the opacity as its log2."""
    forms = [HALF_LOG2_E**0.5 * form for form in whitening_columns(covs, dets)]
    columns = [*forms, *means.unbind(dim=1), opacities.log2(), *rgb.unbind(dim=1)]
    return (torch.stack(columns, dim=1),)


def _mean_rows(splats: Splats2D, rgb: Float[Tensor, "m 3"], square: bool) -> Float[Tensor, "m 13"]:
    """Rows for means over pixels: two forms, and the half windows along them, in standard deviations.

    The forms run along the splat's own axes; over a square the second along x or y, whichever the splat is longer in,
    and the first across it, with what it changes over the window along the second.
    """
    window = splats.window
    if square:
        ux, uy, vx, vy = whitening_columns(splats.covs, splats.dets)
        along_x = vx > 0
        across, slope = torch.where(along_x, uy, ux), torch.where(along_x, ux, uy)
        halves = [0.5 * window * across, 0.5 * window * (vx + vy), window * slope]
    else:
        ux, uy, vx, vy = principal_columns(splats.covs, splats.dets)
        halves = [0.5 * window * torch.hypot(x, y) for x, y in ((ux, uy), (vx, vy))]
        halves.append(torch.zeros_like(ux))
    return _rows_of(splats, rgb, [ux, uy, vx, vy], halves)


def _disc_rows(splats: Splats2D, rgb: Float[Tensor, "m 3"]) -> Float[Tensor, "m 13"]:
    """Rows for discs: a whitening, the tilt, and the low-pass filter's width."""
    assert splats.tilts is not None
    width = torch.full_like(splats.opacities, max(splats.window, NARROWEST))
    forms = whitening_columns(splats.covs, splats.dets)
    return _rows_of(splats, rgb, forms, [*splats.tilts.unbind(dim=1), width])


def _rows_of(
    splats: Splats2D, rgb: Float[Tensor, "m 3"], forms: Sequence[Tensor], rest: Sequence[Tensor]
) -> Float[Tensor, "m 13"]:
    columns = [*forms, *splats.means.unbind(dim=1), splats.opacities, *rgb.unbind(dim=1), *rest]
    return torch.stack(columns, dim=1)


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


DRAWING = Kernel(
    "drawing", _drawing_rows, lambda: (*splat_example(), torch.ones(100_000, 3)), ("m",) * 5
)

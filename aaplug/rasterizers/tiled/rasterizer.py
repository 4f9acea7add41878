"""The tiled rasterizer: one depth sort, tiles, and compositing as elementwise array code that is compiled.

t: tiles of TILE × TILE px; P: pixels per tile.

1. A pixel kernel makes one raster row per splat.
2. `binning` finds which splats each tile draws, nearest first.
3. `forward` composites them; `backward` differentiates that.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import ClassVar

import torch
from torch.nn import functional

from aaplug.core.colours import Colour
from aaplug.core.imaging import over
from aaplug.core.interfaces import Compositor, PixelKernel, ReadsRays
from aaplug.core.kernels import EAGER, Kernels
from aaplug.core.rules import RULES_3DGS, Rules
from aaplug.core.splats import Render, Splats2D
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.methods.pixel_kernels.raster_rows import TILE, tile_centres
from aaplug.rasterizers.tiled.backward import composite
from aaplug.rasterizers.tiled.binning import MEMORY_BYTES, Bins, bands
from aaplug.rasterizers.tiled.forward import MIN_TILES, Compositing
from aaplug.rasterizers.tiled.layout import placed
from aaplug.rasterizers.tiled.packages import CountingKernels
from aaplug.system.errors import UsageError

Painter = Callable[[Bins], Render]  # of a band
MAX_BLENDED_TILES = 512  # composited together by a compositor, so that what it keeps per pixel fits the cache


@dataclass(frozen=True)
class Tiled:
    """Draws in tiles, in the splats' precision; differentiable.

    kernels: run the elementwise stages.  memory: bytes that binning may take beside the scene and the image.
    """

    kernels: Kernels = EAGER
    memory: float = MEMORY_BYTES
    tile: ClassVar[int] = TILE  # px, side of the tiles in which it sorts

    @property
    def name(self) -> str:
        """The name of its kernels: eager or compiled."""
        return self.kernels.name

    def within(self, memory: float) -> "Tiled":
        """The same rasterizer with another memory budget, in bytes."""
        return replace(self, memory=memory)

    def counting(self, add: Callable[[int], None]) -> "Tiled":
        """The same rasterizer, which adds up the splat-pixel evaluations of compositing."""
        return replace(self, kernels=CountingKernels(self.kernels, lambda count, _: add(count) if count else None))

    def __call__(
        self,
        splats: Splats2D,
        hw: tuple[int, int],
        background: Colour,
        pixel: PixelKernel = POINT,
        compositor: Compositor | None = None,
        rules: Rules = RULES_3DGS,
    ) -> Render:
        """Draw the splats."""
        grid = (-(-hw[0] // TILE), -(-hw[1] // TILE))
        if grid == (1, 1):
            grid = (1, MIN_TILES)  # a lone tile would be drawn eagerly
        ellipses = splats.bounds(pixel, rules) or pixel.bounding_ellipses(splats, rules) or splats
        if compositor is None:
            assert splats.rgb is not None
            channels = splats.rgb.shape[1]
            behind = functional.pad(splats.rgb.new_tensor(background), (0, channels - len(background)))
            coloured = splats.with_columns({"rgb": splats.rgb - behind}) if any(background) else splats
            rows = pixel.raster_rows(coloured, self.kernels)
            columns = pixel.columns + channels - 3
            if rows.shape != (len(splats) + 1, columns):
                expected = f"{len(splats) + 1} rows (one per splat and a padding row) of {columns} columns"
                problem = f"raster_rows should return {expected}, got {tuple(rows.shape)}"
                raise UsageError(f"pixel kernel {pixel.name}", problem)
            rays = partial(pixel.rays, splats) if isinstance(pixel, ReadsRays) else None
            how = Compositing(pixel, rules, self.kernels, channels, rays, background)
            paint = partial(composite, rows, how=how)
            gradients = rows.requires_grad and torch.is_grad_enabled()
        else:
            paint, gradients = self._blender(splats, compositor, rules, background), False

        parts = map(paint, bands(ellipses, grid, self.kernels, self.memory, rules, gradients))
        whole = _assembled(parts, grid[0] * TILE)
        return Render(whole.rgb[: hw[0], : hw[1]], whole.alpha[: hw[0], : hw[1]])

    def _blender(self, splats: Splats2D, compositor: Compositor, rules: Rules, background: Colour) -> Painter:
        """Paints the tiles of a band by a compositor, tiles with about equally many splats together."""
        rows = compositor.rows(splats)
        local = tile_centres(rows)

        def paint(bins: Bins) -> Render:
            order = bins.by_length()
            parts = []
            for tiles in order.split(MAX_BLENDED_TILES):
                x, y = (bins.origins[tiles, i, None] + local[i] for i in (0, 1))
                lists = (bins.splats, bins.first[tiles], bins.counts[tiles])
                parts.append(compositor.tiles(rows, splats.window, *lists, (x, y), self.kernels, rules))
            image = placed(torch.cat(parts, dim=1).to(splats.means), order, bins.columns, self.kernels)
            return over(image[:3].permute(1, 2, 0), image[3], background)

        return paint


def _assembled(bands: Iterator[Render], height: int) -> Render:
    """Join bands from the top; each is freed once it is in place, so that a large image exists only once."""
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


EAGER_TILED = Tiled()

"""gsplat's `meta`: the splats of all images in one table, and the tiles that they overlap.

c: cameras; n: Gaussians; m: splats of one image; s: splats of all images; p: pairs of a splat and a tile.  Images are
the cameras of each batch in turn.  Packed, the table has a row for each splat, [s, ...]; else it has one for each
Gaussian of each image, [..., c, n, ...], which is zero where the image does not show the Gaussian.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.splats import Splats2D
from aaplug.gsplat.arguments import Options
from aaplug.gsplat.views import Seen

DEPTH_BITS = 32  # lowest bits of an intersection's id


@dataclass(frozen=True)
class Layout:
    """Where splats stand in the table.

    shape: batch dimensions, then cameras.  counts: splats of each image.
    images, sources: image and Gaussian of each splat, image after image.
    """

    shape: torch.Size
    gaussians: int
    packed: bool
    counts: list[int]
    images: Int[Tensor, " s"]
    sources: Int[Tensor, " s"]

    @classmethod
    def of(cls, splats: Sequence[Splats2D], shape: torch.Size, gaussians: int, packed: bool) -> "Layout":
        """The layout of the splats of all images."""
        counts = [len(part) for part in splats]
        images = torch.repeat_interleave(torch.tensor(counts))
        return cls(shape, gaussians, packed, counts, images, torch.cat([part.sources for part in splats]))

    @property
    def rows(self) -> Int[Tensor, " s"]:
        """Row of each splat."""
        return torch.arange(len(self.sources)) if self.packed else self.images * self.gaussians + self.sources

    def laid(self, column: Tensor) -> Tensor:
        """A column of all splats as the table has it."""
        if self.packed:
            return column
        rest = column.shape[1:]
        whole = column.new_zeros(self.shape.numel() * self.gaussians, *rest)
        return whole.index_copy(0, self.rows, column).view(*self.shape, self.gaussians, *rest)

    def taken(self, table: Tensor) -> Sequence[Tensor]:
        """Each image's part of a column of the table."""
        if not self.packed:
            table = table.flatten(0, len(self.shape)).index_select(0, self.rows)
        return table.split(self.counts)

    def told(self, means2d: Tensor) -> list[Callable[[Tensor], object]]:
        """For each image, what adds its absolute gradients to `means2d.absgrad`, which gsplat's users read."""
        total = torch.zeros_like(means2d)
        means2d.absgrad = total  # pyright: ignore[reportAttributeAccessIssue]
        rows = total.view(-1, 2)
        adders: list[Callable[[Tensor], object]] = [
            partial(rows.index_add_, 0, part) for part in self.rows.split(self.counts)
        ]
        return adders


def tabulated(found: Sequence[Seen], layout: Layout, options: Options) -> tuple[dict[str, Any], list[Splats2D]]:
    """The table, and the splats of each image read from it, so that gradients of images pass through it."""
    splats = [part.splats for part in found]
    columns = {
        "radii": [part.radii for part in found],
        "means2d": [part.means for part in splats],
        "depths": [part.depths for part in splats],
        "conics": [_conics(part) for part in splats],
        "opacities": [part.opacities for part in splats],
    }
    flat = {name: torch.cat(parts) for name, parts in columns.items()}
    cameras = layout.shape[-1]
    ids = (layout.images // cameras, layout.images % cameras, layout.sources)
    meta: dict[str, Any] = dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))
    meta |= zip(meta, ids, strict=True) if layout.packed else {}
    meta |= {name: layout.laid(column) for name, column in flat.items()}
    meta |= _tiles(flat, layout, options)
    meta |= {"width": options.width, "height": options.height, "tile_size": options.tile_size}
    meta |= {"n_batches": layout.shape[:-1].numel(), "n_cameras": cameras}
    read = zip(splats, *(layout.taken(meta[name]) for name in ("means2d", "depths", "opacities")), strict=True)
    return meta, [replace(part, means=means, depths=z, opacities=opacities) for part, means, z, opacities in read]


def _conics(splats: Splats2D) -> Float[Tensor, "m 3"]:
    """Inverses of the covariances: xx, xy, yy in 1/px²."""
    xx, xy, yy = splats.covs.unbind(dim=1)
    return torch.stack([yy, -xy, xx], dim=1) / splats.dets[:, None]


@torch.no_grad()
def _tiles(flat: dict[str, Tensor], layout: Layout, options: Options) -> dict[str, Any]:
    """The pairs of a splat and a tile that its bounding box overlaps, sorted by image, tile and depth."""
    grid = torch.tensor([-(-options.width // options.tile_size), -(-options.height // options.tile_size)])
    ends = flat["means2d"] - flat["radii"], flat["means2d"] + flat["radii"]
    low, high = (torch.minimum((x / options.tile_size).clamp(min=0.0), grid.to(x)) for x in ends)
    first = low.floor().long()
    sides = high.ceil().long() - first
    counts = sides.prod(dim=1)
    owners = torch.repeat_interleave(counts)
    place = torch.arange(len(owners)) - (counts.cumsum(0) - counts)[owners]
    wide = sides[owners, 0]
    columns, rows = first[owners].unbind(dim=1)
    tiles = (rows + place // wide) * grid[0] + columns + place % wide
    bits = int(grid.prod()).bit_length()
    depths = flat["depths"].float().view(torch.int32)[owners].long()
    where = layout.images[owners] << bits | tiles
    ids, order = torch.sort(where << DEPTH_BITS | depths, stable=True)
    images = torch.arange(layout.shape.numel())[:, None] << bits
    starts = torch.searchsorted(ids >> DEPTH_BITS, images | torch.arange(int(grid.prod())))
    return {
        "tile_width": int(grid[0]),
        "tile_height": int(grid[1]),
        "tiles_per_gauss": layout.laid(counts.int()),
        "isect_ids": ids,
        "flatten_ids": layout.rows[owners[order]].int(),
        "isect_offsets": starts.int().view(*layout.shape, int(grid[1]), int(grid[0])),
    }

"""gsplat's `meta`: the splats of all images in one table.

c: cameras; n: Gaussians; m: splats of one image; s: splats of all images.  Images are the cameras of each batch in
turn.  Packed, the table has a row for each splat, [s, ...]; else it has one for each Gaussian of each image,
[..., c, n, ...], which is zero where the image does not show the Gaussian.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.splats import Splats2D
from aaplug.gsplat.arguments import Options


@dataclass(frozen=True, eq=False)
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
    def of(cls, sources: Sequence[Tensor], shape: torch.Size, gaussians: int, packed: bool) -> "Layout":
        """The layout of the splats of all images, from each image's `sources`."""
        counts = [len(part) for part in sources]
        images = torch.repeat_interleave(torch.tensor(counts, device=sources[0].device))
        return cls(shape, gaussians, packed, counts, images, torch.cat(list(sources)))

    @property
    def rows(self) -> Int[Tensor, " s"]:
        """Row of each splat."""
        if self.packed:
            return torch.arange(len(self.sources), device=self.sources.device)
        return self.images * self.gaussians + self.sources

    def column(self, values: Sequence[Tensor]) -> Tensor:
        """A column of the table, from the values of each image's splats."""
        flat = torch.cat(list(values))
        if self.packed:
            return flat
        rest = flat.shape[1:]
        table = flat.new_zeros(self.shape.numel() * self.gaussians, *rest)
        return table.index_copy(0, self.rows, flat).view(*self.shape, self.gaussians, *rest)

    def split(self, column: Tensor) -> Sequence[Tensor]:
        """The values of each image's splats, from a column of the table."""
        if not self.packed:
            column = column.flatten(0, len(self.shape)).index_select(0, self.rows)
        return column.split(self.counts)

    def facts(self, options: Options) -> dict[str, Any]:
        """The facts of the table beside its columns of numbers."""
        cameras = self.shape[-1]
        ids = (self.images // cameras, self.images % cameras, self.sources) if self.packed else (None, None, None)
        return {
            **dict(zip(("batch_ids", "camera_ids", "gaussian_ids"), ids, strict=True)),
            "width": options.width,
            "height": options.height,
            "tile_size": options.tile_size,
            "n_batches": self.shape[:-1].numel(),
            "n_cameras": cameras,
        }

    def gradient_adders(self, means2d: Tensor) -> list[Callable[[Tensor], object]]:
        """Functions that add each image's absolute gradients to `means2d.absgrad`, which gsplat's users read."""
        total = torch.zeros_like(means2d)
        means2d.absgrad = total  # pyright: ignore[reportAttributeAccessIssue]
        return [partial(total.view(-1, 2).index_add_, 0, rows) for rows in self.rows.split(self.counts)]


def conics(splats: Splats2D) -> Float[Tensor, "m 3"]:
    """Inverses of the covariances: xx, xy, yy in 1/px²."""
    xx, xy, yy = splats.covs.unbind(dim=1)
    return torch.stack([yy, -xy, xx], dim=1) / splats.dets[:, None]

"""Planes of pixels: tile by tile, or as an image.

k: planes; l, a: lines of TILE pixels; t: tiles of TILE × TILE px; P: pixels per tile.
"""

from collections.abc import Sequence
from functools import cache, partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.kernels import Kernel, Kernels
from aaplug.methods.pixel_kernels.raster_rows import PIXELS, TILE


def placed(
    planes: Float[Tensor, "k _ P"], order: Int[Tensor, " t"], columns: int, kernels: Kernels
) -> Float[Tensor, "k h w"]:
    """Planes of an image of `columns` tiles a row.

    order: which of the image's tiles each is; those beyond the planes' equal their last tile.
    """
    places = torch.arange(len(order), device=order.device).clamp_(max=planes.shape[1] - 1)
    ranks = torch.empty_like(order).index_copy_(0, order, places)
    lines = ranks.view(-1, 1, columns) * TILE + torch.arange(TILE, device=order.device)[:, None]
    return _gathered(planes.unbind(), lines, kernels).view(len(planes), -1, columns * TILE)


def tiles_of(
    planes: Sequence[Float[Tensor, "h w"]], tiles: Int[Tensor, " t"], columns: int, kernels: Kernels
) -> Float[Tensor, "k t P"]:
    """Planes of some tiles of an image with `columns` tiles a row."""
    down = torch.arange(TILE, device=tiles.device) * columns
    lines = (tiles // columns * TILE * columns + tiles % columns)[:, None] + down
    return _gathered(planes, lines, kernels).view(len(planes), -1, PIXELS)


def _gathered(
    planes: Sequence[Float[Tensor, "*any"]], lines: Int[Tensor, "*order"], kernels: Kernels
) -> Float[Tensor, "k l s"]:
    """Lines of TILE pixels in another order."""
    return kernels.run(lines_kernel(len(planes)), lines.flatten(), *(plane.reshape(-1, TILE) for plane in planes))[0]


def _lines(order: Int[Tensor, " l"], *planes: Float[Tensor, "a side"]) -> tuple[Float[Tensor, "k l side"]]:
    return (torch.stack([plane.index_select(0, order) for plane in planes]),)


def _lines_example(planes: int) -> tuple[Tensor, ...]:
    lines = 10_000 * TILE
    plane = torch.linspace(0.0, 1.0, lines * TILE).view(-1, TILE)
    return torch.arange(lines).flip(0), *(plane.clone() for _ in range(planes))


@cache
def lines_kernel(planes: int = 4) -> Kernel:
    """The gathering of lines of colour and alpha."""
    name = "lines" if planes == 4 else f"lines-{planes}"
    return Kernel(name, _lines, partial(_lines_example, planes), ("l", *planes * ("a",)))

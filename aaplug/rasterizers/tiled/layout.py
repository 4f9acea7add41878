"""Planes of pixels: tile by tile, or as an image.

k: planes; l: lines of tiles; t: tiles of TILE × TILE px; P: pixels per tile.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.kernels import Kernel, Kernels
from aaplug.methods.pixel_kernels.raster_rows import PIXELS, TILE


def placed(
    planes: Float[Tensor, "4 t P"], order: Int[Tensor, " t"], columns: int, kernels: Kernels
) -> Float[Tensor, "4 h w"]:
    """Planes of an image of `columns` tiles a row.  order: which of the image's tiles each is."""
    ranks = torch.empty_like(order).index_copy_(0, order, torch.arange(len(order), device=order.device))
    down = torch.arange(TILE, device=order.device)[:, None]
    lines = (ranks.view(-1, 1, columns) * TILE + down).flatten()
    (image,) = kernels.run(PLACED, lines, *(plane.reshape(-1, TILE) for plane in planes))
    return image.view(len(planes), -1, columns * TILE)


def _placed(lines: Int[Tensor, " l"], *planes: Float[Tensor, "l side"]) -> tuple[Float[Tensor, "k l side"]]:
    """Bring the lines of all tiles, TILE pixels each, in the image's order."""
    return (torch.stack([plane.index_select(0, lines) for plane in planes]),)


def tiles_of(image: Float[Tensor, "k h w"]) -> Float[Tensor, "k t P"]:
    """Planes of its tiles, row by row; h and w are multiples of TILE."""
    planes, height, width = image.shape
    tiles = image.view(planes, height // TILE, TILE, width // TILE, TILE).transpose(2, 3)
    return tiles.reshape(planes, -1, PIXELS)


def _placed_example() -> tuple[Tensor, ...]:
    lines = torch.arange(10_000 * TILE).flip(0)
    return lines, *(torch.linspace(0.0, 1.0, len(lines) * TILE).view(-1, TILE) for _ in range(4))


PLACED = Kernel("placed", _placed, _placed_example, ("l",) * 5)

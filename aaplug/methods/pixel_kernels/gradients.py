"""Sums of a pixel kernel's gradient over the pixels of a tile.

t: tiles; K: splats of a step; P: pixels per tile; c: columns of a raster row; s: sums.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.interfaces import Limits, PixelKernel, Pixels
from aaplug.core.kernels import Kernels
from aaplug.methods.pixel_kernels.raster_rows import BLUE, RED


class Move(NamedTuple):
    """One splat per tile: its raster row, the pixels, its weight at each, and the gradient of log alpha there."""

    row: Float[Tensor, "t c"]
    pixels: Pixels
    weight: Float[Tensor, "t P"]
    gradient: Float[Tensor, "t P"]


@runtime_checkable
class SumsGradients(Protocol):
    """A pixel kernel that sums its own gradient in closed form; without it, autograd differentiates `alpha`.

    gradient_sums: number of sums per splat, beside one of each channel.
    """

    @property
    def gradient_sums(self) -> int: ...  # noqa: D102

    def sums(self, moves: list[Move], colours: Sequence[Float[Tensor, "t P"]], T: Tensor) -> Float[Tensor, "t s_K"]:
        """Sums over each tile's pixels of each splat.

        colours: gradient of each channel of the image.  T: transmittance before the first of the splats.
        """
        ...

    def from_sums(
        self, rows: Float[Tensor, "m c"], sums: Float[Tensor, "m s"], kernels: Kernels
    ) -> Float[Tensor, "m c"]:
        """Gradient of the raster rows from the sums over all tiles."""
        ...


def sums_per_splat(pixel: PixelKernel, channels: int) -> int:
    """The number of sums that a splat's gradient is made of."""
    return pixel.gradient_sums + channels if isinstance(pixel, SumsGradients) else pixel.columns


def stacked(moves: list[Move]) -> tuple[Float[Tensor, "t K c"], Float[Tensor, "t K P"], Float[Tensor, "t K P"]]:
    """Raster rows, weights and gradients of the splats of a step."""
    rows, _, weights, gradients = zip(*moves, strict=True)
    return torch.stack(rows, dim=1), torch.stack(weights, dim=1), torch.stack(gradients, dim=1)


def sums_by_autograd(
    pixel: PixelKernel, limits: Limits, moves: list[Move], colours: Sequence[Float[Tensor, "t P"]]
) -> Float[Tensor, "t c_K"]:
    """Gradient of the raster rows for any pixel kernel: autograd of alpha, from the gradient of log alpha."""
    rows, weights, gradients = stacked(moves)
    with torch.enable_grad():
        rows = rows.detach().requires_grad_()
        alpha = pixel.alpha(rows.transpose(0, 1), moves[0].pixels, limits).transpose(0, 1)
        grads = torch.where(alpha > 0, gradients / alpha, 0.0).detach()
        (added,) = torch.autograd.grad(alpha, rows, grads)
    added[..., RED : BLUE + 1] = torch.bmm(weights, torch.stack([*colours], dim=2))
    return added.flatten(1)

"""The value at the pixel's centre, with another gradient: of a splat's centre, the sum of absolute values over pixels.

AbsGS (Ye et al., arXiv 2404.10484, eq. 6) splits splats by it: gradients of a splat that blurs much detail cancel in
the sum.  Everything but the centre has gradient 0.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.interfaces import Pixels
from aaplug.core.kernels import Kernels
from aaplug.methods.pixel_kernels.gradients import Move
from aaplug.methods.pixel_kernels.point import LN_2, Point
from aaplug.methods.pixel_kernels.raster_rows import UX, UY, VX, VY, X, Y, forms_at


@dataclass(frozen=True)
class AbsolutePoint(Point):
    """`Point`, with absolute gradients of the centres."""

    name: str = "point-absolute"
    gradient_sums: int = 2

    def sums(
        self, moves: list[Move], colours: tuple[Tensor, Tensor, Tensor], T: Tensor, pixels: Pixels
    ) -> Float[Tensor, "t s_K"]:
        """Per splat, the sums of the absolute gradients of its centre's x and y."""
        sums = []
        for row, _, gradient in moves:
            u, v = forms_at(row, pixels)
            for i, j in ((UX, VX), (UY, VY)):
                slope = 2 * LN_2 * (row[:, i, None] * u + row[:, j, None] * v)
                sums.append((gradient * slope).abs().sum(dim=1))
        return torch.stack(sums, dim=1)

    def from_sums(
        self, rows: Float[Tensor, "m c"], sums: Float[Tensor, "m s"], kernels: Kernels
    ) -> Float[Tensor, "m c"]:
        """The sums, as the gradient of the centre."""
        gradient = torch.zeros_like(rows)
        gradient[:, X], gradient[:, Y] = sums.unbind(dim=1)
        return gradient


ABSOLUTE_POINT = AbsolutePoint()

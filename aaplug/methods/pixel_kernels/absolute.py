"""The value at the pixel's centre, with one more gradient: of a splat's centre, the sum of absolute values over pixels.

AbsGS (Ye et al., arXiv 2404.10484, eq. 6) splits splats by it: gradients of a splat that blurs much detail cancel in
the sum.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor

from aaplug.core.kernels import Kernels
from aaplug.methods.pixel_kernels.point import ALPHA_SUMS, LN_2, Point
from aaplug.methods.pixel_kernels.raster_rows import UX, UY, VX, VY


@dataclass(frozen=True)
class AbsolutePoint(Point):
    """`Point`, whose backward pass also tells the absolute gradients of the centres.

    absolute_gradients_to: takes them, [m, 2] for all m splats; several times where an image is drawn in bands.
    """

    name: str = "point-absolute"
    gradient_sums: int = ALPHA_SUMS + 2
    absolute_gradients_to: Callable[[Tensor], object] | None = field(default=None, compare=False, repr=False)

    def further_terms(
        self, row: Float[Tensor, "t c"], gradient: Float[Tensor, "t P"], forms: tuple[Tensor, Tensor]
    ) -> list[Float[Tensor, "t P"]]:
        """Absolute gradients of the centre's x and y at each pixel."""
        u, v = forms
        slopes = (2 * LN_2 * (row[:, i, None] * u + row[:, j, None] * v) for i, j in ((UX, VX), (UY, VY)))
        return [(gradient * slope).abs() for slope in slopes]

    def from_sums(
        self, rows: Float[Tensor, "m c"], sums: Float[Tensor, "m s"], kernels: Kernels
    ) -> Float[Tensor, "m c"]:
        """Gradient of the raster rows, as of `Point`; the last two sums are those of absolute gradients."""
        if self.absolute_gradients_to is not None:
            self.absolute_gradients_to(sums[:-1, -2:])
        return super().from_sums(rows, sums[:, :-2], kernels)


ABSOLUTE_POINT = AbsolutePoint()

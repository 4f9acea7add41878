"""How far a splat shows, by pixel kernel."""

from aaplug.interfaces import PixelKernel
from aaplug.rasterizers.pixels import grown
from aaplug.rasterizers.surfels import discs_reach
from aaplug.splats import Splats2D

SURFELS: tuple[PixelKernel, ...] = ("surfel", "surfel-mip")  # kernels that need tilts


def extents_of(splats: Splats2D, pixel: PixelKernel) -> Splats2D | None:
    """Splats whose ellipses hold all that a kernel shows of the given ones; None where they do so themselves."""
    if pixel == "point":
        return None
    return discs_reach(splats, pixel == "surfel-mip") if pixel in SURFELS else grown(splats)

"""Pixel kernels: what a splat's alpha is at a pixel.  A new one is a file here and a line below."""

from aaplug.core.interfaces import PixelKernel
from aaplug.core.registry import Registry, named
from aaplug.methods.pixel_kernels.integral import INTEGRAL
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.methods.pixel_kernels.surfel import SURFEL, SURFEL_MIP

PIXEL_KERNELS: Registry[PixelKernel] = Registry(
    "pixel kernel", named((POINT, INTEGRAL, SURFEL, SURFEL_MIP)), PixelKernel
)

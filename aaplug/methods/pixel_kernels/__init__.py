"""Pixel kernels: what a splat's alpha is at a pixel.  A new one is a file here and a line below."""

from aaplug.core.interfaces import PixelKernel
from aaplug.core.registry import Registry
from aaplug.methods.pixel_kernels.integral import INTEGRAL, LOGISTIC_INTEGRAL
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.methods.pixel_kernels.square import SQUARE
from aaplug.methods.pixel_kernels.surfel import SURFEL, SURFEL_MIP

PIXEL_KERNELS: Registry[PixelKernel] = Registry(
    "pixel kernel", {kernel.name: kernel for kernel in (POINT, INTEGRAL, LOGISTIC_INTEGRAL, SQUARE, SURFEL, SURFEL_MIP)}
)

__all__ = ["INTEGRAL", "LOGISTIC_INTEGRAL", "PIXEL_KERNELS", "POINT", "SQUARE", "SURFEL", "SURFEL_MIP"]

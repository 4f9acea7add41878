"""Counting the splat-pixel evaluations of compositing: the work of a frame, on any machine."""

from collections.abc import Callable

from torch import Tensor

from aaplug.core.kernels import Kernel, Kernels
from aaplug.methods.pixel_kernels.raster_rows import PIXELS


class CountingKernels(Kernels):
    """Runs kernels as the given ones do, and tells how many evaluations each compositing pass makes."""

    def __init__(self, kernels: Kernels, add: Callable[[int], None]):
        """add: called with the number of splat-pixel evaluations of each pass."""
        self._kernels, self._add = kernels, add
        self.name, self.tiles = kernels.name, kernels.tiles

    def run(self, kernel: Kernel, *args: Tensor) -> tuple[Tensor, ...]:
        """Run a kernel."""
        if kernel.evaluations:
            self._add(len(args[2]) * kernel.evaluations * PIXELS)
        return self._kernels.run(kernel, *args)

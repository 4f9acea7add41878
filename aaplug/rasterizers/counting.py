"""Counting the pairs of a splat and a pixel that compositing evaluates: the work of a frame, whatever the machine."""

from torch import Tensor

from aaplug.kernels import Kernel, Kernels
from aaplug.rasterizers.binning import PASS, TILE
from aaplug.rasterizers.compositing import COMPOSITE


class Counting(Kernels):
    """Kernels that run as the given ones do and add up `pairs`."""

    def __init__(self, kernels: Kernels):
        self._kernels, self.name, self.tiles, self.pairs = kernels, kernels.name, kernels.tiles, 0

    def run(self, kernel: Kernel, *args: Tensor) -> tuple[Tensor, ...]:
        """Run a kernel."""
        if kernel in COMPOSITE.values():
            self.pairs += len(args[2]) * PASS * TILE**2
        return self._kernels.run(kernel, *args)

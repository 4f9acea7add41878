"""Counting the pairs of a splat and a pixel that compositing evaluates: the work of a frame, whatever the machine."""

from torch import Tensor

from aaplug.kernels import Kernel, Kernels
from aaplug.rasterizers.blending import TURN
from aaplug.rasterizers.compositing import PASSES
from aaplug.rasterizers.drawing import PIXELS

SPLATS = {TURN.name: 1} | {one.kernel.name: one.splats for one in PASSES.values()}


class Counting(Kernels):
    """Kernels that run as the given ones do and add up `pairs`."""

    def __init__(self, kernels: Kernels):
        self._kernels, self.name, self.tiles, self.pairs = kernels, kernels.name, kernels.tiles, 0

    def run(self, kernel: Kernel, *args: Tensor) -> tuple[Tensor, ...]:
        """Run a kernel."""
        if kernel.name in SPLATS:
            self.pairs += len(args[2]) * SPLATS[kernel.name] * PIXELS
        return self._kernels.run(kernel, *args)

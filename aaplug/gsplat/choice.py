"""The rasterizer that a call asks for."""

import logging
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from aaplug.core.interfaces import Rasterizer
from aaplug.core.kernels import Kernel, Kernels, Runner
from aaplug.rasterizers import RASTERIZERS
from aaplug.rasterizers.choice import find_rasterizer
from aaplug.rasterizers.tiled import Tiled
from aaplug.rasterizers.tiled.on_demand import BUILT_BY_NAME
from aaplug.system.contracts import described
from aaplug.system.errors import UsageError

log = logging.getLogger("aaplug")


@cache
def rasterizer_of(name: str, precision: torch.dtype, device: str) -> Rasterizer:
    """A rasterizer by name for what a program draws; kernels are loaded and checked once, not for every image.

    precision, device: of the Gaussians; only float32 on the CPU has compiled kernels.
    """
    if name == "auto" and (precision, device) != (torch.float32, "cpu"):
        on_cpu = "float64 is drawn eagerly; kernels are compiled for float32, which is several times as fast"
        elsewhere = f"tensors on {device} are drawn eagerly; gsplat's own kernels are far faster there"
        log.warning(on_cpu if device == "cpu" else elsewhere)
        return RASTERIZERS["eager"]
    found = find_rasterizer(name, None, gradients=True)
    if name != "compiled":
        return found
    assert isinstance(found, Tiled)
    return replace(found, kernels=OnlyCompiled(found.kernels))


class OnlyCompiled(Kernels):
    """Runs kernels as the given ones do, and refuses to composite eagerly."""

    def __init__(self, kernels: Kernels):
        self.kernels, self.name, self.tiles, self.ready = kernels, kernels.name, kernels.tiles, kernels.ready

    def runner(self, kernel: Kernel, args: tuple[Tensor, ...]) -> Runner:
        """The function of a stage; a leading size of 1 is always run eagerly."""
        run = self.kernels.runner(kernel, args)
        whole = all(len(arg) > 1 for arg in args if arg.dim())
        if run is kernel.function and kernel.name.startswith("composite-") and whole:
            problem = f"no kernel '{kernel.name}' is compiled for {described(args[0])}"
            later = ", and compiles it meanwhile" * (kernel.name in BUILT_BY_NAME and args[0].dtype is torch.float32)
            raise UsageError("rasterizer", f'{problem}; "auto" draws it eagerly{later}')
        return run

"""Kernels: the elementwise stages of a frame, one source with two ways to run.

A kernel is a function of tensors.  Run eagerly it is plain array code that any device, precision and gradient can
use; `aaplug.compiled` turns the same source into one fused loop ahead of time.  A stage asks its `Kernels` to run it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Kernel:
    """One stage.

    function: tensors in, a tuple of tensors out; what it updates in place must be contiguous.
    example: arguments to compile for.
    sizes: of each argument the name of its leading size, None where that is fixed; sizes of one name are equal.
    """

    name: str
    function: Callable[..., tuple[Tensor, ...]]
    example: Callable[[], tuple[Tensor, ...]]
    sizes: tuple[str | None, ...]


class Kernels:
    """Runs kernels eagerly.

    name: as the output says.  tiles: how many tiles a compositing call takes, so that its buffers stay in the cache.
    """

    name = "eager"
    tiles = 1024

    def run(self, kernel: Kernel, *args: Tensor) -> tuple[Tensor, ...]:
        """Run one stage."""
        return kernel.function(*args)


@dataclass(frozen=True)
class Package:
    """A kernel compiled for arguments of these types on a CPU."""

    run: Callable[[list[Tensor]], list[Tensor]]
    dtypes: tuple[torch.dtype, ...]

    def takes(self, args: tuple[Tensor, ...]) -> bool:
        """Whether it can run these: no gradients, and no sizes of one, which are a case of their own to compilers."""
        tracked = torch.is_grad_enabled() and any(arg.requires_grad for arg in args)
        return not tracked and all(
            arg.dtype == dtype and arg.device.type == "cpu" and len(arg) > 1
            for arg, dtype in zip(args, self.dtypes, strict=True)
        )


class CompiledKernels(Kernels):
    """Runs what was compiled where it can, and everything else eagerly: gradients, precisions, devices."""

    name = "compiled"
    tiles = 4096

    def __init__(self, packages: dict[str, Package]):
        self._packages = packages

    def run(self, kernel: Kernel, *args: Tensor) -> tuple[Tensor, ...]:
        """Run one stage."""
        package = self._packages.get(kernel.name)
        if package is None or not package.takes(args):
            return super().run(kernel, *args)
        return tuple(package.run([arg.contiguous() for arg in args]))


EAGER = Kernels()

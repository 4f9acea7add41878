"""Kernels: the elementwise stages of a frame, one source with two ways to run.

A kernel is a pure function of tensors.  Run eagerly it is plain array code that any device, precision and gradient can
use; `aaplug.compiled` turns the same source into one fused loop ahead of time.  A stage asks its `Kernels` to run it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class Kernel:
    """One stage.

    function: tensors in, a tuple of tensors out, without side effects.  example: arguments to compile for.
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


class CompiledKernels(Kernels):
    """Runs what was compiled for float32 on a CPU, and everything else eagerly: gradients, precisions, devices."""

    name = "compiled"
    tiles = 2048

    def __init__(self, packages: dict[str, Any]):
        self._packages = packages

    def run(self, kernel: Kernel, *args: Tensor) -> tuple[Tensor, ...]:
        """Run one stage."""
        package = self._packages.get(kernel.name)
        if package is None or not all(_fits(arg) for arg in args):
            return super().run(kernel, *args)
        return tuple(package(*(arg.detach().contiguous() for arg in args)))


def _fits(arg: Tensor) -> bool:
    """Whether compiled code takes it: one element is a size of its own to the compiler."""
    tracked = arg.requires_grad and torch.is_grad_enabled()
    plain = arg.device.type == "cpu" and arg.dtype not in (torch.float16, torch.bfloat16)
    return plain and not tracked and len(arg) > 1


EAGER = Kernels()

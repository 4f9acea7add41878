"""Kernels that do more than run eagerly: compiled packages where they fit, and counting the work of compositing."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import torch
from torch import Tensor

from aaplug.core.kernels import BACKWARD, Kernel, Kernels, Runner, once_differentiable
from aaplug.methods.pixel_kernels.raster_rows import PIXELS

MAX_GRADIENT_ROWS = 1 << 15  # whose gradients are computed at once, so that what lies between fits the cache


@dataclass(frozen=True)
class Package:
    """A kernel compiled for CPU arguments of these types and shapes; sizes: see `Kernel`.

    shapes: of an argument with a leading size only what follows that.
    """

    run: Callable[[list[Tensor]], list[Tensor]]
    types: list[torch.dtype]
    shapes: list[torch.Size]
    sizes: tuple[str | None, ...]

    @staticmethod
    def of(run: Callable[[list[Tensor]], list[Tensor]], kernel: Kernel) -> "Package":
        """The package that a kernel was compiled to."""
        return Package(run, *_taken_by(kernel), kernel.sizes)

    def takes(self, args: tuple[Tensor, ...]) -> bool:
        """True if it can run these arguments; a leading size of one is a separate case to the compiler."""
        for arg, dtype, expected, size in zip(args, self.types, self.shapes, self.sizes, strict=True):
            shape = arg.shape if size is None else arg.shape[1:]
            if arg.dtype is not dtype or shape != expected or not arg.is_cpu or (size is not None and len(arg) < 2):
                return False
        return True


@cache
def _taken_by(kernel: Kernel) -> tuple[list[torch.dtype], list[torch.Size]]:
    """The types and shapes of a package's arguments; to make an example of them takes long."""
    example = list(zip(kernel.example(), kernel.sizes, strict=True))
    return [arg.dtype for arg, _ in example], [arg.shape if size is None else arg.shape[1:] for arg, size in example]


class CompiledKernels(Kernels):
    """Runs compiled packages where they fit, and everything else eagerly: other precisions and devices.

    Pickled, it is only a request: whoever unpickles it loads the packages of its own machine, or runs eagerly.
    """

    name = "compiled"
    tiles = 2048

    def __init__(
        self,
        package_of: Callable[[Kernel], Package | None],
        gradients: Sequence[Kernel] = (),
        reload: Callable[[], Kernels] = Kernels,
    ):
        """package_of: loads a kernel's package when it is first needed.  gradients: kernels that differentiate others.

        reload: for unpickling.
        """
        self._package_of, self._reload = package_of, reload
        self._gradients = {kernel.name: kernel for kernel in gradients}
        self._packages: dict[str, Package | None] = {}  # by their kernels' names

    def __reduce__(self) -> tuple[Callable[[], Kernels], tuple[()]]:
        return self._reload, ()

    def runner(self, kernel: Kernel, args: tuple[Tensor, ...]) -> Runner:
        """The function that runs one stage for such arguments."""
        package = self._package(kernel)
        if package is None or not package.takes(args):
            return kernel.function
        if not (torch.is_grad_enabled() and any(arg.requires_grad for arg in args)):
            if all(arg.is_contiguous() for arg in args):
                return lambda *args: package.run([*args])
            assert all(args[i].is_contiguous() for i in kernel.updates), f"{kernel.name} would update copies"
            return lambda *args: package.run([arg.contiguous() for arg in args])
        gradient = self._gradients.get(kernel.name + BACKWARD)
        backward = None if gradient is None else self._package(gradient)
        return kernel.function if backward is None else partial(_Tracked.apply, package, backward)

    def ready(self, kernel: Kernel) -> bool:
        """True if the kernel is compiled."""
        return self._package(kernel) is not None

    def _package(self, kernel: Kernel) -> Package | None:
        if kernel.name not in self._packages:
            self._packages[kernel.name] = self._package_of(kernel)
        return self._packages[kernel.name]


class _Tracked(torch.autograd.Function):
    """A compiled kernel with a compiled backward pass, which recomputes the forward pass."""

    @staticmethod
    def forward(ctx: Any, package: Package, backward: Package, *args: Tensor) -> tuple[Tensor, ...]:
        args = tuple(arg.contiguous() for arg in args)
        ctx.save_for_backward(*args)
        ctx.package = backward
        return tuple(package.run(list(args)))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        args = ctx.saved_tensors
        results = iter(_pulled_back(ctx.package, args, [grad.contiguous() for grad in grads]))
        return None, None, *(next(results) if arg.is_floating_point() else None for arg in args)


def _pulled_back(package: Package, args: Sequence[Tensor], grads: list[Tensor]) -> list[Tensor]:
    """Gradients of the floating point arguments; a part of the rows at a time, where all have one leading size."""
    sized = list(zip([*args, *grads], package.sizes, strict=True))
    rows = {size: len(arg) for arg, size in sized if size is not None}
    longest = max(rows.values())
    if len(rows) > 1 or longest <= MAX_GRADIENT_ROWS:
        return package.run([arg for arg, _ in sized])
    parts = -(-longest // MAX_GRADIENT_ROWS)
    split = [[arg] * parts if size is None else arg.tensor_split(parts) for arg, size in sized]
    results = zip(*(package.run([*part]) for part in zip(*split, strict=True)), strict=True)
    sizes = [size for arg, size in sized[: len(args)] if arg.is_floating_point()]
    return [torch.stack(x).sum(0) if size is None else torch.cat(x) for x, size in zip(results, sizes, strict=True)]


class CountingKernels(Kernels):
    """Runs kernels as the given ones do, and tells of each run."""

    def __init__(self, kernels: Kernels, add: Callable[[int, bool], None]):
        """add: called with a run's splat-pixel evaluations, 0 if it does not composite, and whether it is compiled."""
        self._kernels, self._add = kernels, add
        self.name, self.tiles, self.ready = kernels.name, kernels.tiles, kernels.ready

    def runner(self, kernel: Kernel, args: tuple[Tensor, ...]) -> Runner:
        """The function that runs a kernel, and counts."""
        run = self._kernels.runner(kernel, args)

        def counting(*args: Tensor) -> Sequence[Tensor]:
            evaluations = kernel.size("t", args) * kernel.evaluations * PIXELS if kernel.evaluations else 0
            self._add(evaluations, run is not kernel.function)
            return run(*args)

        return counting

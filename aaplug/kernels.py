"""Kernels: the elementwise stages of a frame, one source with two ways to run.

A kernel is a function of tensors.  Run eagerly it is plain array code that any device, precision and gradient can
use; `aaplug.compiled` turns the same source into one fused loop ahead of time.  A stage asks its `Kernels` to run it.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

BACKWARD = "-backward"  # after the name of a kernel, the name of the one for its gradients


@dataclass(frozen=True)
class Kernel:
    """One stage.

    function: tensors in, a tuple of tensors out; what it updates in place must be contiguous.
    example: arguments to compile for.
    sizes: of each argument the name of its leading size, None where that is fixed; sizes of one name are equal.
    gathers: whether vectors pay even where their numbers lie apart, which compilers doubt: where work is much.
    pulls_back: whether the function takes gradients itself, so that it must be traced before it is compiled.
    """

    name: str
    function: Callable[..., tuple[Tensor, ...]]
    example: Callable[[], tuple[Tensor, ...]]
    sizes: tuple[str | None, ...]
    gathers: bool = False
    pulls_back: bool = False


def backward_of(kernel: Kernel, answers: tuple[str, ...]) -> Kernel:
    """The kernel that gives the gradient of each floating point argument of a kernel without side effects.

    It takes the arguments and the gradients of the answers, whose leading sizes have the names `answers`.
    """
    count = len(kernel.sizes)

    def function(*args: Tensor) -> tuple[Tensor, ...]:
        inputs, grads = args[:count], args[count:]
        moving = [i for i, arg in enumerate(inputs) if arg.is_floating_point()]

        def of(*values: Tensor) -> tuple[Tensor, ...]:
            filled = list(inputs)
            for i, value in zip(moving, values, strict=True):
                filled[i] = value
            return kernel.function(*filled)

        pull = torch.func.vjp(of, *(inputs[i] for i in moving))[1]
        return tuple(pull(grads))

    def example() -> tuple[Tensor, ...]:
        args = kernel.example()
        found = kernel.function(*args)
        return *args, *(torch.linspace(-1.0, 1.0, x.numel()).to(x).view_as(x) for x in found)

    sizes = (*kernel.sizes, *answers)
    name = kernel.name + BACKWARD
    return Kernel(name, function, example, sizes, kernel.gathers, pulls_back=True)


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
    """A kernel compiled for arguments on a CPU of these types, and shapes after the leading size."""

    run: Callable[[list[Tensor]], list[Tensor]]
    types: list[tuple[torch.dtype, list[int]]]

    @staticmethod
    def of(run: Callable[[list[Tensor]], list[Tensor]], example: tuple[Tensor, ...]) -> "Package":
        """What was compiled for an example."""
        return Package(run, [(arg.dtype, list(arg.shape[1:])) for arg in example])

    def takes(self, args: tuple[Tensor, ...]) -> bool:
        """Whether it can run these; sizes of one are a case of their own to compilers."""
        for arg, (dtype, rest) in zip(args, self.types, strict=True):
            leading, *found = arg.shape
            if arg.dtype is not dtype or found != rest or leading < 2 or not arg.is_cpu:
                return False
        return True


class CompiledKernels(Kernels):
    """Runs what was compiled where it can, and everything else eagerly: gradients, precisions, devices."""

    name = "compiled"
    tiles = 2048

    def __init__(
        self,
        packages: Mapping[str, Package],
        later: Callable[[str], Package | None] = lambda name: None,
    ):
        """packages: by the names of their kernels.  later: gives those that are loaded when they are first needed."""
        self._packages: dict[str, Package | None] = dict(packages)
        self._later = later

    def run(self, kernel: Kernel, *args: Tensor) -> tuple[Tensor, ...]:
        """Run one stage."""
        package = self._packages.get(kernel.name)
        if package is None or not package.takes(args):
            return super().run(kernel, *args)
        if not (torch.is_grad_enabled() and any(arg.requires_grad for arg in args)):
            return tuple(package.run([arg.contiguous() for arg in args]))
        name = kernel.name + BACKWARD
        if name not in self._packages:
            self._packages[name] = self._later(name)
        backward = self._packages[name]
        if backward is None:
            return super().run(kernel, *args)
        return _Tracked.apply(package, backward, *args)  # pyright: ignore[reportReturnType]


class _Tracked(torch.autograd.Function):
    """A compiled kernel with a compiled backward pass, which computes what it needs anew."""

    @staticmethod
    def forward(ctx: Any, package: Package, backward: Package, *args: Tensor) -> tuple[Tensor, ...]:
        args = tuple(arg.contiguous() for arg in args)
        ctx.save_for_backward(*args)
        ctx.package = backward
        return tuple(package.run(list(args)))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        args = ctx.saved_tensors
        found = iter(ctx.package.run([*args, *(grad.contiguous() for grad in grads)]))
        return None, None, *(next(found) if arg.is_floating_point() else None for arg in args)


EAGER = Kernels()


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch work with one thread, and with as many as before after that."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)

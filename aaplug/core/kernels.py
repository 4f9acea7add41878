"""Kernels: the elementwise stages of a frame, one source that runs in two ways.

A kernel is a function of tensors.  Run eagerly it is plain array code, for any device, precision and gradient;
`rasterizers.tiled.ahead_of_time` compiles the same source into few fused loops.  A stage asks its `Kernels` to run it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from typing import Any

import torch
from torch import Tensor

from aaplug.system.errors import UsageError

BACKWARD = "-backward"  # suffix of the name of a kernel's gradient kernel
ONE_MORE = "+1"  # suffix of the name of a size
SIGN_BIT = 31  # of a float32
# From 2.13 on torch tells g++ the width of vectors.  Before, g++ may move numbers through memory to read their bits.
READS_BITS = torch.__version__ >= "2.13"
EXAMPLE_SIZE = 100_000  # rows, as many as in real work: inductor chooses by them which loops use threads


@dataclass(frozen=True)
class Kernel:
    """One stage of a frame.

    function: tensors in, a tuple of tensors out.
    example: makes the arguments to compile for, `EXAMPLE_SIZE` rows of them.
    sizes: per argument the name of its leading size, None where that is fixed; sizes of one name are equal, and "n+1"
        is one more than "n".
    gathers: the kernel gathers scattered rows.  Inductor would leave the loop scalar; set this where arithmetic
        outweighs the gathers.
    chained: each value is made of many before it, and several read it.  Inductor would write it out again for each.
    keeps_sums: it keeps many sums, so where g++ schedules instructions it has to count the registers.
    pulls_back: the function computes gradients itself, so it is traced before it is compiled.
    updates: positions of the arguments that it updates in place; they must be contiguous.
    evaluations: splat-pixel evaluations of one call, per pixel of a tile; 0 for kernels that do not composite.
    """

    name: str
    function: Callable[..., tuple[Tensor, ...]]
    example: Callable[[], tuple[Tensor, ...]]
    sizes: tuple[str | None, ...]
    gathers: bool = False
    chained: bool = False
    keeps_sums: bool = False
    pulls_back: bool = False
    updates: tuple[int, ...] = ()
    evaluations: int = 0

    def size(self, name: str, args: tuple[Tensor, ...]) -> int:
        """A leading size of these arguments."""
        return len(args[self.sizes.index(name)])


def backward_of(kernel: Kernel, results: tuple[str, ...], chained: bool = False) -> Kernel:
    """The kernel for the gradient of each floating point argument of a kernel without side effects.

    It takes the arguments, then the gradients of the results, whose leading sizes are named in `results`.
    chained: see `Kernel`.
    """
    count = len(kernel.sizes)

    def function(*args: Tensor) -> tuple[Tensor, ...]:
        inputs, grads = args[:count], args[count:]
        places = [i for i, arg in enumerate(inputs) if arg.is_floating_point()]

        def of_floats(*values: Tensor) -> tuple[Tensor, ...]:
            arguments = list(inputs)
            for i, value in zip(places, values, strict=True):
                arguments[i] = value
            return kernel.function(*arguments)

        pull = torch.func.vjp(of_floats, *(inputs[i] for i in places))[1]
        return tuple(pull(grads))

    def example() -> tuple[Tensor, ...]:
        args = kernel.example()  # gradients of one sign: sums in which they cancel have few digits in float32
        return *args, *(torch.linspace(0.25, 1.0, x.numel()).to(x).view_as(x) for x in kernel.function(*args))

    sizes = (*kernel.sizes, *results)
    return Kernel(kernel.name + BACKWARD, function, example, sizes, kernel.gathers, chained, pulls_back=True)


Runner = Callable[..., Sequence[Tensor]]


class Kernels:
    """Runs kernels eagerly.

    name: as shown to the user.  tiles: how many tiles one compositing call takes, so that its buffers fit the cache.
    """

    name = "eager"
    tiles = 1024

    def run(self, kernel: Kernel, *args: Tensor) -> tuple[Tensor, ...]:
        """Run one stage."""
        return tuple(self.runner(kernel, args)(*args))

    def ready(self, kernel: Kernel) -> bool:
        """True unless the kernel runs eagerly where others are compiled."""
        return True

    def runner(self, kernel: Kernel, args: tuple[Tensor, ...]) -> Runner:
        """The function of a stage, for many small calls.

        It takes these arguments, and others that differ in their values and in leading sizes of at least 2.
        """
        return kernel.function


def materialized(x: Tensor) -> Tensor:
    """x itself.  A compiled kernel then computes it once, in a loop of its own, and not again at each use."""
    return x.as_strided(x.shape, x.stride()) if torch.compiler.is_compiling() else x


def where_signed(sign: Tensor, value: Tensor, negative: bool) -> Tensor:
    """`value` where `sign` is negative, or where it is not, else 0, for compiled kernels.

    sign: finite, of the shape of `value`, and +0 where it is zero.  float32 is chosen by its bits, without gradients.
    Inductor makes a vector of a comparison and a mask of that vector again, which costs more than reading signs.
    """
    if READS_BITS and value.dtype == torch.float32:
        signs = sign.view(torch.int32) >> SIGN_BIT  # all bits, or none
        return (value.view(torch.int32) & (signs if negative else ~signs)).view(torch.float32)
    return torch.where(sign < 0 if negative else sign >= 0, value, 0.0)


EAGER = Kernels()


def once_differentiable(backward: Callable[..., tuple[Tensor | None, ...]]) -> Callable[..., tuple[Tensor | None, ...]]:
    """The backward of a `Function`, whose gradients raise UsageError if they are differentiated themselves.

    torch's decorator of this name raises in `backward()` alone; `torch.autograd.grad` leaves them out without a word.
    """

    @wraps(backward)
    def tied(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        with torch.no_grad():
            results = backward(ctx, *grads)
        if not torch.is_grad_enabled():
            return results
        tensors = [x for x in results if x is not None]
        kept = iter(_Underived.apply(len(tensors), *tensors, *ctx.saved_tensors, *grads))
        return tuple(x if x is None else next(kept) for x in results)

    return tied


class _Underived(torch.autograd.Function):
    """The first `count` of some tensors, as a function of all of them whose derivative is not known."""

    @staticmethod
    def forward(ctx: Any, count: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        return tensors[:count]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        raise UsageError("gradient", "of a gradient of a render is not known: kernels are differentiated once")

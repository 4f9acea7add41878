"""Finding the rasterizer that a user means."""

import os
from collections.abc import Callable

import torch

from aaplug.core.interfaces import PixelKernel, Rasterizer, RunsKernels
from aaplug.core.kernels import EAGER, Kernels
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.rasterizers import RASTERIZERS
from aaplug.rasterizers.tiled import Tiled
from aaplug.rasterizers.tiled.ahead_of_time import BUNDLE_VARIABLE, KERNELS, build, has_compiler, is_built, load
from aaplug.rasterizers.tiled.backward import step_kernel
from aaplug.rasterizers.tiled.forward import pass_kernel
from aaplug.rasterizers.tiled.on_demand import OnDemandKernels
from aaplug.system.errors import UsageError, not_one_of

# Compiled, an 800 x 800 frame is 0.3 s faster and a step with gradients 1.5 s; compiling takes three minutes.
FRAMES_THAT_PAY, STEPS_THAT_PAY = 400, 100
CHANNELS = 3  # of a colour


def kernels_of(rasterizer: Rasterizer) -> Kernels:
    """The kernels that run the stages before a rasterizer, as it runs its own."""
    return rasterizer.kernels if isinstance(rasterizer, RunsKernels) else EAGER


def channels_at_once(rasterizer: Rasterizer, pixel: PixelKernel, gradients: bool = False) -> list[int]:
    """The numbers of channels that it may composite at a time: three or, where no kernel for them is missing, four."""
    if pixel != POINT:
        return [CHANNELS]
    kernels, more = kernels_of(rasterizer), CHANNELS + 1
    needed = [pass_kernel(pixel, more, gradients), *[step_kernel(pixel, more)] * gradients]
    ready = [kernels.ready(kernel) for kernel in needed]
    return [CHANNELS, more] if all(ready) else [CHANNELS]


def find_rasterizer(
    name: str = "auto",
    frames: int | None = 1,
    say: Callable[[str], None] = lambda text: None,
    *,
    gradients: bool = False,
) -> Rasterizer:
    """A rasterizer by name; "auto" is compiled where kernels are built, and builds them where `frames` repay it.

    frames: None if nobody knows: "auto" then builds what is missing while it draws.
    say: called with the choice, in words.  gradients: each frame is a step of an optimization.

    Raises UsageError if the name is not known, or "compiled" was asked for and cannot be built.
    """
    if name in RASTERIZERS:
        return RASTERIZERS[name]
    if name not in ("auto", "compiled"):
        raise UsageError("rasterizer", not_one_of(name, ["auto", "compiled", *RASTERIZERS]))
    if name == "auto" and frames is None:
        return Tiled(OnDemandKernels())
    kernels, problem = load(), ""
    pays = frames is not None and frames >= (STEPS_THAT_PAY if gradients else FRAMES_THAT_PAY) and has_compiler()
    lacks_gradients = gradients and not all(map(is_built, KERNELS))
    if (name == "compiled" or pays) and (kernels is None or lacks_gradients):
        say("rasterizer: compiling the kernels, once for this machine (about three minutes on two free cores)")
        try:
            kernels = build(gradients=gradients)
        except UsageError as error:
            kernels = load()
            if kernels is None and name == "compiled":
                raise
            problem = str(error)
    if kernels is not None:
        say(f"rasterizer: some kernels run eagerly, and slower ({problem})" if problem else "rasterizer: compiled")
        return Tiled(kernels)
    if not problem:
        problem = "`aaplug warmup` compiles it, several times as fast"
        problem = problem if has_compiler() else "no C++ compiler found to compile it"
        if bundle := os.environ.get(BUNDLE_VARIABLE):
            here = f"torch {torch.__version__} on this machine"
            problem = f"{BUNDLE_VARIABLE} names {bundle}, which has no kernels for {here}; {problem}"
    say(f"rasterizer: eager ({problem})")
    return RASTERIZERS["eager"]

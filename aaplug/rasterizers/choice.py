"""Finding the rasterizer that a user means."""

from collections.abc import Callable

from aaplug.core.interfaces import Rasterizer
from aaplug.rasterizers import RASTERIZERS
from aaplug.rasterizers.tiled import Tiled
from aaplug.rasterizers.tiled.ahead_of_time import build, has_compiler, load
from aaplug.system.errors import UsageError, not_one_of

FRAMES_THAT_PAY = 500  # compiling takes about 150 s and saves about 0.3 s per 800 x 800 frame


def find_rasterizer(name: str = "auto", frames: int = 1, say: Callable[[str], None] = lambda text: None) -> Rasterizer:
    """A rasterizer by name; "auto" is compiled where kernels are built, and builds them where `frames` repay it.

    say: called with the choice, in words.

    Raises:
        UsageError: the name is not known, or "compiled" was asked for and cannot be built.
    """
    if name in RASTERIZERS:
        return RASTERIZERS[name]
    if name not in ("auto", "compiled"):
        raise UsageError("rasterizer", not_one_of(name, ["auto", "compiled", *RASTERIZERS]))
    kernels = load()
    if kernels is None and (name == "compiled" or (frames >= FRAMES_THAT_PAY and has_compiler())):
        say("rasterizer: compiling the kernels, once for this machine (about a minute on two cores)")
        try:
            kernels = build()
        except UsageError as error:
            if name == "compiled":
                raise
            say(f"rasterizer: eager ({error})")
            return RASTERIZERS["eager"]
    if kernels is not None:
        say("rasterizer: compiled")
        return Tiled(kernels)
    hint = "`aaplug warmup` compiles it, several times as fast"
    say(f"rasterizer: eager ({hint if has_compiler() else 'no C++ compiler found to compile it'})")
    return RASTERIZERS["eager"]

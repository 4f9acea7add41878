"""aaplug warmup: compile the kernels once for this machine."""

from dataclasses import dataclass

from aaplug.rasterizers.tiled.ahead_of_time import KERNELS, build, cache_folder

from .console import print_json, progress, say


@dataclass(frozen=True)
class Warmup:
    """Compile the fast rasterizer once for this machine (about two minutes)."""

    json: bool = False
    """Print where the kernels are as one JSON object on stdout."""


def warmup(options: Warmup) -> int:
    """Compile what is missing and say where it is."""
    with progress("compiling", "kernels") as tell:
        build(tell)
    say(f"{len(KERNELS)} kernels in {cache_folder()}")
    if options.json:
        print_json({"folder": str(cache_folder()), "kernels": [kernel.name for kernel in KERNELS]})
    return 0

"""Compiling the rasterizer's kernels once for a machine."""

from pathlib import Path
from typing import NamedTuple

from aaplug.core.monitor import SILENT, Monitor
from aaplug.rasterizers.tiled.ahead_of_time import KERNELS, build, cache_folder


class Kernels(NamedTuple):
    """Compiled kernels: their folder and their names."""

    folder: Path
    names: list[str]


def warmup(*, monitor: Monitor = SILENT) -> Kernels:
    """Compile what is missing, in two to three minutes.

    Raises:
        UsageError: there is no compiler or it fails, or the cache folder cannot be written.
    """
    with monitor.progress("compiling", "kernels") as tell:
        build(tell)
    return Kernels(cache_folder(), [kernel.name for kernel in KERNELS])

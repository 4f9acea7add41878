"""Options of `bench`."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from aaplug.options.base import UNSET, OneOf, Options, choice, flag, number
from aaplug.options.shared import THREADS, size_of

CHOICES = ("all", "compiled", "eager")


@dataclass(frozen=True, kw_only=True)
class BenchOptions(Options):
    """What to time."""

    gaussians: Annotated[Sequence[int], number(1, 100_000_000, whole=True, several=True)] = (10_000, 100_000, 1_000_000)
    """Sizes of the synthetic scenes."""
    resolution: Annotated[Sequence[str] | None, flag("WxH ...")] = None
    """Sizes of the images: all scenes at the first, the middle one at each (default: 800x800 1600x1060)."""
    rasterizer: Annotated[str, choice(CHOICES), OneOf(CHOICES)] = "all"
    """Which to time; all: compiled, if `aaplug warmup` has run, and eager."""
    repeats: Annotated[int, number(1, 1000, whole=True)] = 5
    """Runs per median."""
    threads: Annotated[int | None, THREADS, UNSET] = None
    """Processor threads (default: all)."""
    forward_only: bool = False
    """Leave out the backward pass."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for size in self.resolution or ():
            size_of(size)

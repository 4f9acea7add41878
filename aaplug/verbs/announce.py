"""Telling what a long or large job will take before it starts, and refusing what this machine cannot hold."""

from collections.abc import Sequence

from aaplug.core.cameras import Camera
from aaplug.io.limits import lack_of_memory
from aaplug.rendering.cost import cost_of
from aaplug.rendering.renderer import Renderer
from aaplug.system.errors import UsageError, listing
from aaplug.system.executors import PAYS_AFTER_SECONDS
from aaplug.system.monitor import Monitor

LONG = 60.0  # seconds of work from which a job is announced
LARGE = 4e9  # bytes from which it is


def announce(
    renderers: Sequence[Renderer],
    views: Sequence[Camera],
    monitor: Monitor,
    *,
    work: str | None = None,
    seconds: float | None = None,
    processes: int = 1,
    fewer: str = "views",
) -> None:
    """Say how long rendering every view with every renderer will take, and how much memory, where that is much.

    work: in words, and its seconds, where it is more than these images.  processes: that share it.
    fewer: what takes less time, in words.

    Raises:
        UsageError: it would take more memory than the limit MEMORY_SHARE of the machine's allows.
    """
    cost = cost_of(renderers, views)
    seconds = cost.seconds if seconds is None else seconds
    needed = cost.scene + cost.image * (processes if seconds > PAYS_AFTER_SECONDS else 1)
    sizes = listing(sorted({f"{view.width}x{view.height}" for view in views}), most=3)
    images = len(views) * len(renderers)
    what = f"{work or f'{images} image' + 's' * (images != 1)} at {sizes}"
    if lacking := lack_of_memory(needed):
        raise UsageError(what, f"would take {lacking}; a smaller `scale` or fewer `threads` need less")
    if seconds >= LONG or needed >= LARGE:
        minutes = f"about {seconds / 60:.0f} minutes" if seconds >= LONG else "under a minute"
        memory = f", {needed / 1e9:.1f} GB" if needed >= LARGE else ""
        monitor.say(f"{what}: {minutes}{memory}; fewer {fewer} take less")

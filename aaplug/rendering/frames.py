"""Many frames: each to its own file, in processes side by side where there are enough of them.

Processes of one thread each were measured 1.6 times as fast on two cores as one process of two threads, whose stages
wait for each other; Python threads gained nothing.  An image does not depend on how many processes there are.
"""

import multiprocessing
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from aaplug.core.cameras import Camera
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.training import TrainingViews
from aaplug.io.images import write_png
from aaplug.methods.recipes import Recipe
from aaplug.rasterizers import Tiled
from aaplug.rasterizers.tiled import ahead_of_time as compiled
from aaplug.rendering.renderer import render

PAYS_AFTER = 20.0  # seconds of work left: two processes take five to start, and save two fifths


@dataclass(frozen=True)
class Frames:
    """Views of a smoothed scene, and a PNG for each."""

    scene: Gaussians
    training: TrainingViews
    recipe: Recipe
    background: tuple[float, float, float]
    views: Sequence[Camera]
    paths: Sequence[Path]
    bit_depth: int = 8
    overwrite: bool = False


def write_frames(
    frames: Frames,
    rasterizer: Rasterizer,
    threads: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
    pays_after: float = PAYS_AFTER,
) -> None:
    """Render every view to its file, in order, on `threads` threads in all.

    progress: told (views done, views in all).  pays_after: seconds of work left, by the
    first frame's time, for which processes are started.

    Raises:
        OutputError: an image cannot be written.
        UsageError: a process died, which is what too little memory does.
    """
    total = len(frames.views)
    progress(0, total)
    started = time.perf_counter()
    _write(frames, rasterizer, 0)
    progress(1, total)
    left = (time.perf_counter() - started) * (total - 1)
    processes = min(threads, total - 1) if left > pays_after else 1
    if processes < 2:
        for index in range(1, total):
            _write(frames, rasterizer, index)
            progress(index + 1, total)
        return
    with tempfile.TemporaryDirectory(prefix="aaplug-") as folder:
        file = Path(folder) / "frames.pt"
        torch.save(
            (replace(frames, scene=replace(frames.scene, origin=None)), *_plan(rasterizer)), file
        )
        pool = ProcessPoolExecutor(
            processes, multiprocessing.get_context("spawn"), _start, (str(file),)
        )
        try:
            for done, _ in enumerate(pool.map(_write_own, range(1, total)), start=2):
                progress(done, total)
        except BrokenProcessPool as error:
            raise UsageError("--threads", "a process died; fewer need less memory") from error
        finally:
            pool.shutdown(cancel_futures=True)


def _plan(rasterizer: Rasterizer) -> tuple[str, Rasterizer]:
    """A rasterizer in two parts that other processes can read: how its stages run, and the rest."""
    if isinstance(rasterizer, Tiled):
        return rasterizer.kernels.name, replace(rasterizer, kernels=Tiled().kernels)
    return rasterizer.kernels.name, rasterizer


def _write(frames: Frames, rasterizer: Rasterizer, index: int) -> None:
    with torch.no_grad():
        image = render(
            frames.scene,
            frames.views[index],
            frames.recipe,
            frames.training,
            rasterizer,
            frames.background,
        )
    write_png(frames.paths[index], image.rgb.float(), frames.bit_depth, frames.overwrite)


_own: tuple[Frames, Rasterizer] | None = None  # what this process renders


def _start(file: str) -> None:
    """Begin a process: one thread, and the scene mapped from the file that all of them share."""
    global _own
    torch.set_num_threads(1)
    frames, kernels, rasterizer = torch.load(file, mmap=True, weights_only=False)  # our own file
    loaded = compiled.load() if kernels == "compiled" else None
    if loaded is not None:
        rasterizer = replace(rasterizer, kernels=loaded)
    _own = frames, rasterizer


def _write_own(index: int) -> None:
    assert _own is not None
    _write(*_own, index)

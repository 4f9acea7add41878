"""How fast this machine renders, stage by stage."""

import re
from collections.abc import Sequence
from typing import NamedTuple

from aaplug.core.cameras import Camera
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.kernels import EAGER, Kernels
from aaplug.core.monitor import SILENT, Monitor
from aaplug.rasterizers.tiled.ahead_of_time import build, load
from aaplug.rendering.benchmark import Figures, exponent, measure, synthetic_camera, synthetic_scene
from aaplug.verbs.inputs import CamerasLike, SceneLike, cameras_of, processor, scene_of

GAUSSIANS = (10_000, 100_000, 1_000_000)
SIZES = ("800x800", "1600x1060")  # of images
CHOICES = ("all", "compiled", "eager")


class Bench(NamedTuple):
    """Measurements, and the exponents by which forward time grows with Gaussians and pixels."""

    runs: list[Figures]
    exponents: dict[str, float]


def bench(
    scene: SceneLike | None = None,
    cameras: CamerasLike = None,
    *,
    gaussians: Sequence[int] = GAUSSIANS,
    resolution: Sequence[str] | None = None,
    rasterizer: str = "all",
    repeats: int = 5,
    threads: int | None = None,
    forward_only: bool = False,
    monitor: Monitor = SILENT,
) -> Bench:
    """Time the rasterizer on synthetic scenes, or on the first training view of a scene.

    Args:
        scene: Gaussians, a scene's file or a model folder; None for synthetic scenes.
        cameras: of `scene`.
        gaussians: sizes of the synthetic scenes.
        resolution: sizes of their images, "WIDTHxHEIGHT": all scenes at the first, the middle one at each; None for
            800x800, and also 1600x1060 if there are several scenes.
        rasterizer: "compiled", "eager", or "all": compiled if it is built, and eager.
        repeats: runs per median.
        threads: processor threads; None for all.
        forward_only: leave out the backward pass.
        monitor: receives messages and progress.

    Raises:
        AaplugError: an input cannot be read, or an argument does not fit.
    """
    if repeats < 1:
        raise UsageError("repeats", f"must be 1 or more, got {repeats}")
    runs: list[Figures] = []
    with processor(threads):
        if scene is None:
            work = _synthetic(gaussians, resolution)
        else:
            work = [(scene_of(scene), cameras_of(cameras, scene).train[0])]
        kernels = _kernels(rasterizer, monitor)
        for shown, camera in work:
            for each in kernels:
                run = measure(shown, camera, each, repeats, not forward_only)
                size = f"{run.gaussians:,} Gaussians, {run.width}x{run.height}"
                monitor.say(f"{size}, {run.rasterizer}: {run.forward_ms:.0f} ms")
                runs.append(run)
    return Bench(runs, _exponents(runs))


def _kernels(rasterizer: str, monitor: Monitor) -> list[Kernels]:
    if rasterizer not in CHOICES:
        raise UsageError("rasterizer", f"'{rasterizer}' is not one of {', '.join(CHOICES)}")
    if rasterizer == "eager":
        return [EAGER]
    compiled = load()
    if rasterizer == "compiled":
        with monitor.progress("compiling", "kernels") as tell:
            return [compiled or build(tell)]
    if compiled is None:
        monitor.say("rasterizer: eager only; `aaplug warmup` compiles the fast one")
        return [EAGER]
    return [compiled, EAGER]


def _synthetic(gaussians: Sequence[int], resolution: Sequence[str] | None) -> list[tuple[Gaussians, Camera]]:
    """Every scene at the first size, and the middle one at the others."""
    given = resolution or (SIZES if len(gaussians) > 1 else SIZES[:1])
    sizes = [re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text) for text in given]
    if not all(sizes):
        raise UsageError("resolution", f"takes sizes such as 800x800, got {', '.join(given)}")
    if min(gaussians, default=0) < 1:
        raise UsageError("gaussians", "takes numbers above 0")
    first, *others = [synthetic_camera(int(size[1]), int(size[2])) for size in sizes if size]
    scenes = [synthetic_scene(n) for n in gaussians]
    middle = scenes[len(scenes) // 2]
    return [*((scene, first) for scene in scenes), *((middle, c) for c in others)]


def _exponents(runs: Sequence[Figures]) -> dict[str, float]:
    """How forward time grows with Gaussians at one size, and with pixels for one scene."""
    found: dict[str, float] = {}
    for name in dict.fromkeys(run.rasterizer for run in runs):
        own = [run for run in runs if run.rasterizer == name]
        first, last = own[0], own[-1]
        same_size = [r for r in own if (r.width, r.height) == (first.width, first.height)]
        same_scene = [r for r in own if r.gaussians == last.gaussians]
        if len(same_size) > 1:
            counts = [float(r.gaussians) for r in same_size]
            found[f"{name}: Gaussians"] = exponent(counts, [r.forward_ms for r in same_size])
        if len(same_scene) > 1:
            pixels = [float(r.width * r.height) for r in same_scene]
            found[f"{name}: pixels"] = exponent(pixels, [r.forward_ms for r in same_scene])
    return found

"""How fast this machine renders, stage by stage."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Annotated, Any, NamedTuple

import tyro

from aaplug.core.cameras import Camera
from aaplug.core.errors import UsageError, not_one_of
from aaplug.core.gaussians import Gaussians
from aaplug.core.kernels import EAGER, Kernels
from aaplug.core.monitor import SILENT, Monitor
from aaplug.rasterizers.tiled.ahead_of_time import build, load
from aaplug.rendering.benchmark import Figures, exponent, measure, synthetic_camera, synthetic_scene
from aaplug.verbs.inputs import CamerasLike, SceneLike, cameras_of, processor, scene_of
from aaplug.verbs.options import Options, choice, flag

SIZES = ("800x800", "1600x1060")  # of images
CHOICES = ("all", "compiled", "eager")


class Bench(NamedTuple):
    """Measurements, and the exponents by which forward time grows with Gaussians and pixels."""

    runs: list[Figures]
    exponents: dict[str, float]


@dataclass(frozen=True, kw_only=True)
class BenchOptions(Options):
    """What to time."""

    gaussians: Annotated[Sequence[int], tyro.conf.arg(metavar="N ...")] = (10_000, 100_000, 1_000_000)
    """Sizes of the synthetic scenes."""
    resolution: Annotated[Sequence[str] | None, flag("WxH ...")] = None
    """Sizes of the synthetic scenes' image: all scenes at the first, the middle one at each (default: 800x800, and
    1600x1060 if there are several scenes)."""
    rasterizer: Annotated[str, choice(CHOICES)] = "all"
    """Which to time; all: compiled, if `aaplug warmup` has run, and eager."""
    repeats: int = 5
    """Runs per median."""
    threads: Annotated[int | None, flag("N")] = None
    """Processor threads (default: all)."""
    forward_only: bool = False
    """Leave out the backward pass."""


@BenchOptions.shown
def bench(
    scene: SceneLike | None = None, cameras: CamerasLike = None, *, monitor: Monitor = SILENT, **options: Any
) -> Bench:
    """Time the rasterizer on synthetic scenes, or on the first training view of a scene.

    Args:
        scene, cameras, monitor: see `render`; without a scene, synthetic ones.
        options: fields of `BenchOptions`.
    """
    o = BenchOptions.of(options)
    if o.repeats < 1:
        raise UsageError("repeats", f"must be 1 or more, got {o.repeats}")
    runs: list[Figures] = []
    with processor(o.threads):
        work = _synthetic(o) if scene is None else [(scene_of(scene), cameras_of(cameras, scene).train[0])]
        kernels = _kernels(o.rasterizer, monitor)
        for (shown, camera), each in product(work, kernels):
            run = measure(shown, camera, each, o.repeats, not o.forward_only)
            shape = f"{run.gaussians:,} Gaussians, {run.width}x{run.height}"
            monitor.say(f"{shape}, {run.rasterizer}: {run.forward_ms:.0f} ms")
            runs.append(run)
    return Bench(runs, _exponents(runs))


def _kernels(rasterizer: str, monitor: Monitor) -> list[Kernels]:
    if rasterizer not in CHOICES:
        raise UsageError("rasterizer", not_one_of(rasterizer, CHOICES))
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


def _synthetic(o: BenchOptions) -> list[tuple[Gaussians, Camera]]:
    """Every scene at the first size, and the middle one at the others."""
    given = o.resolution or (SIZES if len(o.gaussians) > 1 else SIZES[:1])
    sizes = [re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text) for text in given]
    if not all(sizes):
        raise UsageError("resolution", f"takes sizes such as 800x800, got {', '.join(given)}")
    if min(o.gaussians, default=0) < 1:
        raise UsageError("gaussians", "takes numbers above 0")
    first, *others = [synthetic_camera(int(size[1]), int(size[2])) for size in sizes if size]
    scenes = [synthetic_scene(n) for n in o.gaussians]
    middle = scenes[len(scenes) // 2]
    return [*((scene, first) for scene in scenes), *((middle, c) for c in others)]


def _exponents(runs: Sequence[Figures]) -> dict[str, float]:
    """How forward time grows with Gaussians at one size, and with pixels for one scene."""
    found: dict[str, float] = {}
    for name in dict.fromkeys(run.rasterizer for run in runs):
        own = [run for run in runs if run.rasterizer == name]
        sized = [r for r in own if (r.width, r.height) == (own[0].width, own[0].height)]
        alike = [r for r in own if r.gaussians == own[-1].gaussians]
        counts, pixels = [float(r.gaussians) for r in sized], [float(r.width * r.height) for r in alike]
        for what, runs_of, sizes in (("Gaussians", sized, counts), ("pixels", alike, pixels)):
            if len(sizes) > 1:
                found[f"{name}: {what}"] = exponent(sizes, [r.forward_ms for r in runs_of])
    return found

"""How fast this machine renders, stage by stage."""

from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.kernels import EAGER, Kernels
from aaplug.core.monitor import SILENT, Monitor
from aaplug.io.limits import lack_of_memory
from aaplug.options.bench import BenchOptions
from aaplug.options.shared import size_of
from aaplug.rasterizers.tiled.ahead_of_time import build, load
from aaplug.rendering.benchmark import Figures, exponent, measure, synthetic_camera, synthetic_scene
from aaplug.verbs.inputs import CamerasLike, Held, SceneLike, inputs_of, processor, whole_of

SIZES = ("800x800", "1600x1060")  # of images
BYTES = 1200  # a Gaussian of degree 3 with its gradients and what autograd keeps, measured


class Bench(NamedTuple):
    """Measurements, and the exponents by which forward time grows with Gaussians and pixels."""

    runs: list[Figures]
    exponents: dict[str, float]


@BenchOptions.shown
def bench(
    scene: SceneLike | None = None, cameras: CamerasLike = None, *, monitor: Monitor = SILENT, **options: Any
) -> Bench:
    """Time the rasterizer on synthetic scenes, or on the first training view of a scene.

    Args:
        scene: see `render`; without one, synthetic ones.
        cameras: see `render`.
        monitor: see `render`.
        options: fields of `BenchOptions`.
    """
    o = BenchOptions.of(options)
    runs: list[Figures] = []
    with processor(o.threads):
        work = _synthetic(o) if scene is None else [_first_view(*inputs_of(scene, cameras, monitor))]
        kernels = _kernels(o.rasterizer, monitor)
        for (shown, camera), each in product(work, kernels):
            run = measure(shown, camera, each, o.repeats, not o.forward_only)
            shape = f"{run.gaussians:,} Gaussians, {run.width}x{run.height}"
            monitor.say(f"{shape}, {run.rasterizer}: {run.forward_ms:.0f} ms")
            runs.append(run)
    return Bench(runs, _exponents(runs))


def _first_view(scene: Held, cameras: CameraSet) -> tuple[Gaussians, Camera]:
    return whole_of(scene), cameras.train[0]


def _kernels(rasterizer: str, monitor: Monitor) -> list[Kernels]:
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
    first, *others = [synthetic_camera(*size_of(text)) for text in given]
    most = max(o.gaussians)
    if lacking := lack_of_memory(BYTES * most):
        raise UsageError("gaussians", f"{most:,} with gradients take {lacking}")
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

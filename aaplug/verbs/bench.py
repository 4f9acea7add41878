"""How fast this machine renders, stage by stage."""

from dataclasses import replace
from itertools import product
from typing import NamedTuple

from aaplug.core.kernels import EAGER
from aaplug.io.limits import lack_of_memory
from aaplug.methods.presets import find_recipe
from aaplug.methods.recipe import LevelChoice
from aaplug.options.verbs import BenchOptions, size_of
from aaplug.rasterizers.tiled.ahead_of_time import build, load
from aaplug.rendering.benchmark import Figures, exponent, measure, synthetic_camera, synthetic_scene
from aaplug.rendering.job import CamerasLike, Job, running
from aaplug.rendering.renderer import Renderer
from aaplug.system.errors import UsageError, counted
from aaplug.verbs.verb import SceneLike, looks

TIMED = replace(find_recipe("classic"), levels=LevelChoice())
DEFAULT_RESOLUTIONS = ("800x800", "1600x1060")
GAUSSIAN_BYTES = 1200  # one of degree 3 with its gradients and what autograd keeps, measured


class Bench(NamedTuple):
    """Measurements, and the exponents by which forward time grows with Gaussians and pixels."""

    runs: list[Figures]
    exponents: dict[str, float]


@looks(BenchOptions)
def bench(scene: SceneLike | None, cameras: CamerasLike, options: BenchOptions) -> Bench:
    """Time the rasterizer on synthetic scenes, or on the first training view of a scene, at one or several sizes.

    Args:
        scene: see `render`; without one, synthetic ones.
        cameras: see `render`.
    """
    if scene is not None and tuple(options.gaussians) != BenchOptions.gaussians:
        raise UsageError("gaussians", "are of synthetic scenes; leave them out, or the scene")
    runs, exponents = list[Figures](), dict[str, float]()
    with running(options):
        if scene is None:  # every scene at the first size, and the middle one at the others
            usual = DEFAULT_RESOLUTIONS if len(options.gaussians) > 1 else DEFAULT_RESOLUTIONS[:1]
            first, *others = [synthetic_camera(*size_of(text)).as_trained() for text in options.resolution or usual]
            most = max(options.gaussians)
            if lacking := lack_of_memory(GAUSSIAN_BYTES * most):
                raise UsageError("gaussians", f"{most:,} with gradients take {lacking}")
            scenes = [Renderer.of(synthetic_scene(n), [first], TIMED, rasterizer="eager") for n in options.gaussians]
            middle = scenes[len(scenes) // 2]
            work = [*((each, first) for each in scenes), *((middle, camera) for camera in others)]
        else:
            job = Job.of(scene, cameras, options)
            job.scene.gaussians()  # with harmonics, which the renderer else leaves in a large file
            renderer = Renderer.of(job.scene, job.cameras, TIMED, rasterizer="eager", min_seen=0.0)
            view = job.cameras.train[0]
            work = [(renderer, view.resized(*size_of(text))) for text in options.resolution or ()] or [(renderer, view)]
        kernels, compiled = [EAGER], None if options.rasterizer == "eager" else load()
        if options.rasterizer == "compiled":
            with options.monitor.progress("compiling", "kernels") as tell:
                kernels = [compiled or build(tell)]
        elif compiled is not None:
            kernels = [compiled, EAGER]
        elif options.rasterizer == "all":
            options.monitor.say("rasterizer: eager only; `aaplug warmup` compiles the fast one")
        for (renderer, camera), each in product(work, kernels):
            run = measure(renderer, camera, each, options.repeats)
            shape = f"{counted(run.gaussians, 'Gaussian')}, {run.width}x{run.height}"
            options.monitor.say(f"{shape}, {run.rasterizer}: {run.forward_ms:.0f} ms")
            runs.append(run)
    for name in dict.fromkeys(run.rasterizer for run in runs):
        own = [run for run in runs if run.rasterizer == name]
        sized = [
            (float(r.gaussians), r.forward_ms) for r in own if (r.width, r.height) == (own[0].width, own[0].height)
        ]
        alike = [(float(r.width * r.height), r.forward_ms) for r in own if r.gaussians == own[-1].gaussians]
        for what, points in (("Gaussians", sized), ("pixels", alike)):
            if len(points) > 1:
                exponents[f"{name}: {what}"] = exponent(*map(list, zip(*points, strict=True)))
    return Bench(runs, exponents)

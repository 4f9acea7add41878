"""Refining a level of detail: its Gaussians are tuned until the level, at its own size, looks like the scene.

The truth is the scene's own render, box-averaged, from training poses and from others between them.  So no photograph
is needed, and views away from training hold.  Most of the others are drawn like training poses, by the ratio of focal
lengths, and the rest as free ones: the two rules draw a Gaussian somewhat differently, and a level should fit both.
"""

import statistics
from collections.abc import Sequence
from dataclasses import replace
from itertools import cycle

import torch

from aaplug.core.camera_paths import free_views
from aaplug.core.cameras import Camera, spread
from aaplug.core.gaussians import Fusion, Gaussians, joined
from aaplug.evaluation.truth import MEMORY, Truth
from aaplug.finetuning.loop import run
from aaplug.finetuning.settings import CONSISTENCY_SETTINGS, TUNING_RATES
from aaplug.finetuning.state import TuningJob, begin
from aaplug.methods.conversion import TUNED
from aaplug.methods.presets import recipe_of
from aaplug.methods.viewers import Viewer
from aaplug.options.verbs import LEVEL_STEPS
from aaplug.rendering.renderer import Renderer
from aaplug.system.monitor import SILENT, Monitor

MAX_POSES = 100  # training poses
VIEWS_BETWEEN = 2  # views between two poses, which are drawn like training's
FREE_VIEW_EVERY = 4  # one view out of so many is free
PROBE_VIEWS = 6  # views that tell whether tuning helped; it does not use them
BYTES_PER_PIXEL = 6
# The tuned views take these sizes in turn, as multiples of the training size.  A level is drawn alone at 1 to 3/2 times
# its own rate and fades out below, so it learns these rates.  Its truth has the same sizes: whole boxes do not blur
VIEW_SIZES = (1.0, 1.5, 1.0, 1.22, 1.5, 1.0, 1.22, 0.84)
# Root mean square error, of colours in [0, 1].  A level that is closer has lower learning rates in proportion, because
# a step leaves noise in proportion to its length
USUAL_ERROR = 0.02
USUAL_STEPS_RATE = 1 / 4  # of the training rate: coarser levels take more steps, in inverse proportion
MAX_STEPS_FACTOR = 8.0
SMALLER_WEIGHT = 0.5  # of the loss at each of the smaller sizes, where errors are larger
CLOSE_ENOUGH = 3.5e-5  # mean square error, 44.5 dB: a level that is closer is not tuned


def refine(
    level: Gaussians,
    rate: float,
    look: Renderer,
    poses: Sequence[Camera],
    steps: int = LEVEL_STEPS,
    viewer: Viewer | None = None,
    monitor: Monitor = SILENT,
    smaller: Sequence[float] = (),
    beside: Gaussians | None = None,
) -> Gaussians:
    """The level after tuning, or as it is where that does not help.

    rate: the lowest sampling rate relative to training's that it is meant for.
    steps: for a rate of `USUAL_STEPS_RATE` and above; see `LEVEL_STEPS`.
    look: draws the scene as training showed it.
    poses: views to tune on, at the training size.
    viewer: what will draw the result; None for aaplug.
    smaller: sizes of images, against those at `rate`, that should be right too; steps take all sizes equally often.
    beside: Gaussians that are drawn with the level and stay as they are.

    Raises UsageError if no step has a finite gradient.
    """
    steps = round(steps * min(MAX_STEPS_FACTOR, max(1.0, USUAL_STEPS_RATE / rate)))
    scales = (rate, *(rate * size for size in smaller))
    views, probes = _views(poses, scales, steps)
    truth = Truth(look, memory=MEMORY)
    if viewer is not None:
        level = replace(viewer.shown(level), convention=viewer.convention_of(level))
        look = replace(look, recipe=recipe_of(viewer))
    start = look.showing(level if beside is None else joined([level, beside]))
    before = _error(start, truth, probes, rate)
    if before < CLOSE_ENOUGH:
        return level
    with torch.no_grad(), monitor.progress("rendering", "views") as tell:
        for number, view in enumerate(views):
            tell(number, len(views))
            for scale in scales:
                truth(view, scale)
    share = min(1.0, before**0.5 / USUAL_ERROR)
    rates = {name: share * (1 / rate if name == "means" else 1) * r for name, r in TUNING_RATES.items()}
    weights = {rate: 1.0} | dict.fromkeys(scales[1:], SMALLER_WEIGHT)
    settings = replace(CONSISTENCY_SETTINGS, name="levels", steps=steps, weights=weights, rates=rates, anchor=0.0)
    job = TuningJob(start, views, truth, settings, moving=len(level))
    state = begin(job)
    with monitor.progress("refining", "steps") as tell:

        def stop() -> bool:
            tell(state.step, steps)
            return False

        run(job, state, every=steps, stop=stop, say=monitor.say)
    scene = state.scene(job)
    if _error(replace(state.renderer(job), scene=scene), truth, probes, rate) >= before:
        return level
    record = Fusion(TUNED, {"steps": str(steps), "for": viewer.name if viewer else "levels"})
    return replace(scene[: len(level)], fused=(*level.fused, record))


def _views(poses: Sequence[Camera], scales: Sequence[float], steps: int) -> tuple[list[Camera], list[Camera]]:
    """Views to tune on, one a step and as many as fit into memory at all scales, and probes of the training size."""
    poses = spread(poses, MAX_POSES)
    sizes = [size for size in VIEW_SIZES if size * scales[0] <= 1] or [1.0]
    area = sum(scale**2 for scale in scales) * statistics.mean(size**2 for size in sizes)
    largest = max(camera.width * camera.height for camera in poses)
    count = max(1, min(steps, int(MEMORY / (BYTES_PER_PIXEL * area * largest))))
    between = [view.as_trained() for view in free_views(poses, VIEWS_BETWEEN)]
    as_trained = spread([*poses, *between], count - count // FREE_VIEW_EVERY)
    repeats = min(len(sizes), count - count // FREE_VIEW_EVERY) // len(as_trained)  # few views take several sizes each
    sized = [v.scaled(size) for v, size in zip([*as_trained] * max(1, repeats), cycle(sizes), strict=False)]
    free = spread(free_views(poses, 1, seed=1), count // FREE_VIEW_EVERY) if count >= FREE_VIEW_EVERY else ()
    return [*sized, *free], list(spread(free_views(poses, 1, seed=2), PROBE_VIEWS)) or list(poses[:1])


@torch.no_grad()
def _error(renderer: Renderer, truth: Truth, views: Sequence[Camera], rate: float) -> float:
    """Mean square error at the level's own rate."""
    errors = [renderer(view.scaled(rate)).rgb.clamp(0, 1) - truth(view, rate) for view in views]
    return sum(float(error.square().mean()) for error in errors) / len(errors)

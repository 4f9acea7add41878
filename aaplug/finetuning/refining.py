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

from aaplug.core.cameras import Camera, spread
from aaplug.core.choices import LEVEL_STEPS
from aaplug.core.free_views import free_views
from aaplug.core.gaussians import Fusion, Gaussians
from aaplug.core.monitor import SILENT, Monitor
from aaplug.evaluation.truth import Truth
from aaplug.finetuning.loop import run
from aaplug.finetuning.parameters import RATES
from aaplug.finetuning.settings import Settings
from aaplug.finetuning.state import TuningJob, begin
from aaplug.methods.recipes import RECIPES
from aaplug.methods.viewers import TUNED, Viewer
from aaplug.rendering.renderer import Renderer

POSES = 100  # training poses at most
BETWEEN = 2  # poses between them for each, drawn as training's
FREE = 4  # one view out of so many is free
PROBES = 6  # views that tell whether tuning helped, and are not tuned on
MEMORY = 1e9  # bytes of images to compare with
BYTES = 6  # a pixel
# of the views as trained, in turn, over the training size.  So a level learns the rates over its own at which it is
# drawn: alone from 3/2 to 1, and below it fades out.  The truth is of that size too: whole boxes of pixels do not blur
SIZES = (1.0, 1.5, 1.0, 1.22, 1.5, 1.0, 1.22, 0.84)
# over 3DGS's learning rates, where the level's error is `USUAL`; they follow the error, as the noise they leave does
FASTER = {"means": 1.0, "quats": 1.0, "log_scales": 3.0, "logit_opacities": 1.0, "dc": 2.0, "rest": 5.0}
SHARE = 0.3
USUAL = 0.02  # root mean square error, of colours in [0, 1]
DECAY = 0.03
LARGE = 1 / 4  # of the training rate
MOST_TIMES = 8.0  # as many at most
GOOD = 3.5e-5  # mean square error, 44.5 dB: a level that is so close is not tuned


def refined(
    level: Gaussians,
    rate: float,
    look: Renderer,
    poses: Sequence[Camera],
    steps: int = LEVEL_STEPS,
    viewer: Viewer | None = None,
    monitor: Monitor = SILENT,
) -> Gaussians:
    """The level after tuning, or as it is where that does not help.

    rate: the lowest sampling rate relative to training's that it is meant for.
    steps: for a rate of `LARGE` and above; see `LEVEL_STEPS`.
    look: draws the scene as training showed it.
    poses: views to tune on, at the training size.
    viewer: what will draw the result; None for aaplug.

    Raises:
        UsageError: no step has a finite gradient.
    """
    steps = round(steps * min(MOST_TIMES, max(1.0, LARGE / rate)))
    views, probes = _views(poses, rate, steps)
    truth = Truth(look, memory=MEMORY)
    if viewer is not None:
        level = replace(viewer.shown(level), convention=viewer.convention_of(level))
        look = replace(look, recipe=RECIPES[viewer.recipe])
    shown = look.showing(level)
    before = _error(shown, truth, probes, rate)
    if before < GOOD:
        return level
    _prepare(truth, views, rate, monitor)
    share = SHARE * before**0.5 / USUAL
    rates = {name: share * FASTER[name] * (1 / rate if name == "means" else 1) * own for name, own in RATES.items()}
    settings = Settings("levels", steps, {rate: 1.0}, rates, decay=DECAY)
    job = TuningJob(shown, views, truth, settings)
    state = begin(job)
    with monitor.progress("refining", "steps") as tell:

        def stop() -> bool:
            tell(state.step, steps)
            return False

        run(job, state, every=steps, stop=stop, say=monitor.say)
    found = state.scene(job)
    if _error(replace(state.renderer(job), scene=found), truth, probes, rate) >= before:
        return level
    return replace(
        found, fused=(*level.fused, Fusion(TUNED, {"steps": str(steps), "for": viewer.name if viewer else "levels"}))
    )


def _views(poses: Sequence[Camera], rate: float, steps: int) -> tuple[list[Camera], list[Camera]]:
    """Views to tune on, one a step and as many as fit into memory, and others, of the training size."""
    poses = spread(poses, POSES)
    sizes = [size for size in SIZES if size * rate <= 1] or [1.0]
    area = statistics.mean((size * rate) ** 2 for size in sizes)
    most = MEMORY / (BYTES * area * max(camera.width * camera.height for camera in poses))
    count = max(1, min(steps, int(most)))
    between = [view.as_trained() for view in free_views(poses, BETWEEN)]
    known = count - count // FREE
    trained = spread([*poses, *between], known)
    trained = [*trained] * max(1, min(len(sizes), known) // len(trained))  # few views at several sizes
    sized = [view.scaled(size) for view, size in zip(trained, cycle(sizes), strict=False)]
    free = spread(free_views(poses, 1, seed=1), count // FREE) if count >= FREE else ()
    return [*sized, *free], list(spread(free_views(poses, 1, seed=2), PROBES)) or list(poses[:1])


@torch.no_grad()
def _prepare(truth: Truth, views: Sequence[Camera], rate: float, monitor: Monitor) -> None:
    """Make all images to compare with."""
    with monitor.progress("rendering", "views") as tell:
        for number, view in enumerate(views):
            tell(number, len(views))
            truth(view, rate)


@torch.no_grad()
def _error(shown: Renderer, truth: Truth, views: Sequence[Camera], rate: float) -> float:
    """Mean square error at the level's own rate."""
    errors = [shown(view.scaled(rate)).rgb.clamp(0, 1) - truth(view, rate) for view in views]
    return sum(float(error.square().mean()) for error in errors) / len(errors)

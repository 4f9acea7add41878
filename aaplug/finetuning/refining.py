"""Refining a level of detail: its Gaussians are tuned until the level, at its own size, looks like the scene.

The truth is the scene's own render at the training size, box-averaged, from training poses and from free ones between
them.  So no photograph is needed, and views away from training hold.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch

from aaplug.core.cameras import Camera, spread
from aaplug.core.choices import LEVEL_STEPS
from aaplug.core.free_views import free_views
from aaplug.core.gaussians import Fusion, Gaussians
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.training import TrainingViews
from aaplug.evaluation.truth import Truth, ViewTruth
from aaplug.finetuning.loop import run
from aaplug.finetuning.parameters import RATES
from aaplug.finetuning.settings import Settings
from aaplug.finetuning.state import TuningJob, begin
from aaplug.methods.recipes import RECIPES
from aaplug.methods.viewers import TUNED, Viewer
from aaplug.rendering.renderer import Renderer

POSES = 100  # training poses at most
FREE = 3  # free poses for each
PROBES = 6  # views that tell whether tuning helped, and are not tuned on
MEMORY = 1e9  # bytes of images to compare with
BYTES = 6  # a pixel
# weight by scale, over the level's rate: it is drawn alone from 1.41 to 1 and fades out below
SCALES = {1.41: 0.4, 1.19: 0.6, 1.0: 1.0, 0.84: 0.6}
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
    scales = {rate * scale: weight for scale, weight in SCALES.items() if rate * scale < 1}
    steps = round(steps * min(MOST_TIMES, max(1.0, LARGE / rate)))
    views, probes = _views(poses, scales, steps)
    truth = Truth(look, memory=MEMORY)
    known = look.training
    if viewer is not None:
        level = replace(viewer.shown(level), convention=viewer.convention_of(level))
        look = replace(look, recipe=RECIPES[viewer.recipe])
    shown = replace(look, scene=level, training=TrainingViews.of(level, known.cameras, known.cull_margin))
    before = _error(shown, truth, probes, rate)
    if before < GOOD:
        return level
    _prepare(truth, views, scales, monitor)
    share = SHARE * before**0.5 / USUAL
    rates = {name: share * FASTER[name] * (1 / rate if name == "means" else 1) * own for name, own in RATES.items()}
    settings = Settings("levels", steps, scales, rates, decay=DECAY)
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


def _views(poses: Sequence[Camera], scales: dict[float, float], steps: int) -> tuple[list[Camera], list[Camera]]:
    """Views to tune on, one a step and as many as fit into memory, and others."""
    poses = spread(poses, POSES)
    pixels = max(camera.width * camera.height for camera in poses) * sum(scale**2 for scale in scales)
    views = spread([*poses, *free_views(poses, FREE)], max(1, min(steps, int(MEMORY / (BYTES * pixels)))))
    return list(views), list(spread(free_views(poses, 1, seed=1), PROBES)) or list(poses[:1])


@torch.no_grad()
def _prepare(truth: Truth, views: Sequence[Camera], scales: dict[float, float], monitor: Monitor) -> None:
    """Make all images to compare with, each view's from one render."""
    with monitor.progress("rendering", "views") as tell:
        for number, view in enumerate(views):
            tell(number, len(views))
            one = ViewTruth(truth, view)
            for scale in scales:
                one.image(scale)


@torch.no_grad()
def _error(shown: Renderer, truth: Truth, views: Sequence[Camera], rate: float) -> float:
    """Mean square error at the level's own rate."""
    errors = [shown(view.scaled(rate)).rgb.clamp(0, 1) - truth(view, rate) for view in views]
    return sum(float(error.square().mean()) for error in errors) / len(errors)

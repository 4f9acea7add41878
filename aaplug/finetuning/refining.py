"""Refining a level of detail: its Gaussians are tuned until the level, at its own size, looks like the scene.

The truth is the scene's own render, box-averaged, from training poses and from others between them.  So no photograph
is needed, and views away from training hold.  Most of the others are drawn like training poses, by the ratio of focal
lengths, and the rest as free ones: the two rules draw a Gaussian somewhat differently, and a level should fit both.
"""

import statistics
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import cycle

import torch
from jaxtyping import Int
from torch import Tensor

from aaplug.core.camera_paths import free_views
from aaplug.core.cameras import Camera, spread
from aaplug.core.gaussians import Gaussians
from aaplug.evaluation.truth import MEMORY, Truth
from aaplug.finetuning.loop import run, view_and_weights
from aaplug.finetuning.session import tuned_scene
from aaplug.finetuning.settings import CONSISTENCY, CONSISTENCY_SETTINGS, TUNING_RATES, balance, slowed
from aaplug.finetuning.state import State, TuningJob, begin, part_of
from aaplug.io.rad import node_sizes, shown_of
from aaplug.methods.presets import recipe_of
from aaplug.methods.viewers import Viewer
from aaplug.rendering.renderer import Renderer
from aaplug.system.monitor import Monitor

MAX_POSES = 100  # training poses
VIEWS_BETWEEN = 2  # views between two poses, which are drawn like training's
FREE_VIEW_EVERY = 4  # one view out of so many is free
PROBE_VIEWS = 6  # views that tell whether tuning helped; it does not use them
BYTES_PER_PIXEL = 6
# The tuned views take these sizes in turn, as multiples of the training size.  A level is drawn alone at 1 to 3/2 times
# its own rate and fades out below, so it learns these rates.  Its truth has the same sizes: whole boxes do not blur
VIEW_SIZES = (1.0, 1.5, 1.0, 1.22, 1.5, 1.0, 1.22, 0.84)
USUAL_ERROR = 0.02  # see `Settings`; at the level's own size, where errors are larger than at the training size
USUAL_STEPS_RATE = 1 / 4  # of the training rate: coarser levels take more steps, in inverse proportion
MAX_STEPS_FACTOR = 8.0
SMALLER_WEIGHT = 0.5  # of the loss at each of the smaller sizes, where errors are larger
CLOSE_ENOUGH = 3.5e-5  # mean square error, 44.5 dB: a level that is closer is not tuned

Shown = Callable[[Gaussians, Camera], Int[Tensor, " k"]]  # places of the Gaussians of a scene that a view shows


def refine(
    level: Gaussians,
    rate: float,
    look: Renderer,
    poses: Sequence[Camera],
    steps: int,
    viewer: Viewer | None,
    monitor: Monitor,
    smaller: Sequence[float],
) -> Gaussians:
    """The level after tuning, or as it is where that does not help.

    rate: the lowest sampling rate relative to training's that it is meant for.
    steps: for a rate of `USUAL_STEPS_RATE` and above.
    look: draws the scene as training showed it.
    poses: views to tune on, at the training size.
    viewer: what will draw the result; None for aaplug.
    smaller: sizes of images, against those at `rate`, that should be right too; steps take all sizes equally often.

    Raises UsageError if no step has a finite gradient.
    """
    steps = round(steps * min(MAX_STEPS_FACTOR, max(1.0, USUAL_STEPS_RATE / rate)))
    scales = (rate, *(rate * size for size in smaller))
    views, probes = _views(poses, scales, steps)
    truth = Truth(look, memory=MEMORY)
    if viewer is not None:
        level = replace(viewer.shown(level), convention=viewer.convention_of(level))
        look = replace(look, recipe=recipe_of(viewer))
    start = look.showing(level)
    before = _error(start, truth, probes, rate)
    if before < CLOSE_ENOUGH:
        return level
    rates = TUNING_RATES | {"means": TUNING_RATES["means"] / rate}
    weights = {rate: 1.0} | dict.fromkeys(scales[1:], SMALLER_WEIGHT)
    settings = replace(CONSISTENCY_SETTINGS, name="levels", steps=steps, weights=weights, rates=rates, anchor=0.0)
    settings = slowed(replace(settings, usual_error=USUAL_ERROR), dict.fromkeys((1.0, *weights), before))
    scene = _tuned(TuningJob(start, views, truth, settings), viewer.name if viewer else "levels", monitor)
    return level if _error(look.showing(scene), truth, probes, rate) >= before else scene


def refine_tree(
    tree: Gaussians,
    parents: Int[Tensor, " n"],
    rates: Sequence[float],
    look: Renderer,
    poses: Sequence[Camera],
    steps: int,
    viewer: Viewer,
    monitor: Monitor,
) -> Gaussians:
    """A tree after tuning: each step draws what Spark draws of it at one of the rates; as it is where that is no help.

    A Gaussian is drawn at several rates, beside finer and coarser ones, so all are tuned together.

    parents: place of each one's parent; -1 for none.
    rates: see `refine`; one is 1.  The others: as there.
    """
    views, probes = _views(poses, rates, steps)
    truth, start = Truth(look, memory=MEMORY), replace(look, recipe=recipe_of(viewer)).showing(tree)

    def shown(scene: Gaussians, view: Camera) -> Int[Tensor, " k"]:
        distances = (scene.means - view.centre.to(scene.means)).norm(dim=1)
        return shown_of(node_sizes(scene) * view.focal / distances, parents)

    def errors(renderer: Renderer) -> dict[float, float]:
        return {r: _error(renderer, truth, probes, r, shown) for r in rates}

    @contextmanager
    def around(job: TuningJob, state: State) -> Iterator[None]:
        view, (rate,) = view_and_weights(job.settings, job.views, state.step)
        state.group = shown(state.scene(job), view.scaled(rate))
        yield

    before = errors(start)
    settings = replace(CONSISTENCY_SETTINGS, name="tree", steps=steps, weights=dict.fromkeys(rates, 1.0), anchor=0.0)
    settings = balance(settings, before)
    job = TuningJob(start, views, truth, settings, method=replace(CONSISTENCY, around=around))
    scene = _tuned(job, viewer.name, monitor)
    after = errors(start.showing(scene))
    change = sum(weight * (after[rate] - before[rate]) for rate, weight in settings.weights.items())
    return tree if change >= 0 else scene


def _tuned(job: TuningJob, shown_by: str, monitor: Monitor) -> Gaussians:
    """The scene of a job after all of its steps, with a record that names what shows it."""
    state = begin(job)
    with monitor.progress("refining", "steps") as tell:
        run(job, state, every=job.settings.steps, tell=tell)
    return tuned_scene(state, job, job.start.scene.convention, {"for": shown_by})


def _views(poses: Sequence[Camera], scales: Sequence[float], steps: int) -> tuple[list[Camera], list[Camera]]:
    """Views to tune on, one a step and as many as fit into memory at all scales, and probes of the training size.

    Those of cameras that distort are straight: viewers draw no others, and gradients through a lens are not compiled.
    """
    poses = [pose.straight() for pose in spread(poses, MAX_POSES)]
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
def _error(renderer: Renderer, truth: Truth, views: Sequence[Camera], rate: float, shown: Shown | None = None) -> float:
    """Mean square error at a rate.  shown: the Gaussians that a view shows; None for all."""
    errors = []
    for view in views:
        small = view.scaled(rate)
        drawing = renderer if shown is None else part_of(renderer, shown(renderer.scene, small))
        errors.append(float((drawing(small).rgb.clamp(0, 1) - truth(view, rate)).square().mean()))
    return statistics.mean(errors)

"""Multi-scale evaluation: every recipe at every scale against one truth.

A scale is a size against training's.  Truth "photographs": the photograph, alpha composited on the background in
float, rounded to 8 bits and box-averaged to the size being judged.  Truth "self": the scene's own look, its
training-size render box-averaged below that size and `matched` above it.  Renders are clamped and rounded to 8 bits
before they are compared.  Views stream: nothing grows with their number but the numbers.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from jaxtyping import Float
from torch import Tensor

from aaplug.cameras import Camera
from aaplug.errors import UsageError
from aaplug.gaussians import Gaussians
from aaplug.interfaces import Rasterizer, Training
from aaplug.io.images import quantise, read_image, resampled
from aaplug.metrics import METRICS
from aaplug.pipeline import render, smooth
from aaplug.rasterizers import RASTERIZERS
from aaplug.recipes import Recipe, find_recipe
from aaplug.report import CEILING, Measurement, Report

NO_PHOTOGRAPH = "no photograph is this large: metrics above the photographs' own size are undefined"
EQUAL_IMAGES = "equal images: PSNR is infinite and left out of the mean"
TOO_SMALL = "image smaller than the SSIM window"


@dataclass(frozen=True)
class Task:
    """What to evaluate and against which truth."""

    recipes: Sequence[Recipe]
    scales: Sequence[float]
    views: Sequence[Camera]
    background: tuple[float, float, float]
    truth: Literal["photographs", "self"]
    rasterizer: Rasterizer = RASTERIZERS["eager"]


def evaluate(
    scene: Gaussians,
    training: Training,
    task: Task,
    facts: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Report:
    """Measure every recipe at every scale on every view.

    facts: JSON-ready entries for the protocol (versions, hashes).  progress: told (views done, views in all).

    Raises:
        UsageError: nothing to measure, or the truth is photographs and a view has none.
        FormatError: a photograph cannot be read.
    """
    _check(task)
    smoothed = [smooth(scene, training, recipe) for recipe in task.recipes]
    own = smooth(scene, training, find_recipe("matched"))
    measurements: list[Measurement] = []
    for done, view in enumerate(task.views):
        progress(done, len(task.views))
        measurements += _one_view(view, smoothed, own, training, task)
    progress(len(task.views), len(task.views))
    order = [CEILING, *(recipe.name for recipe in task.recipes)]
    measurements.sort(key=lambda m: (order.index(m.recipe), task.scales.index(m.scale)))
    return Report(tuple(measurements), _protocol(task) | dict(facts or {}))


def _check(task: Task) -> None:
    if not (task.recipes and task.scales and task.views):
        raise UsageError("evaluate", "needs at least one recipe, one scale and one view")
    if any(not scale > 0 for scale in task.scales):
        raise UsageError("--scale", f"sizes must be above 0, got {min(task.scales):g}")
    names = [recipe.name for recipe in task.recipes]
    if len(set(names)) != len(names) or len(set(task.scales)) != len(task.scales):
        raise UsageError("evaluate", "a recipe or a scale is named twice")
    missing = [view.name for view in task.views if view.photo is None]
    if task.truth == "photographs" and missing:
        raise UsageError(
            missing[0],
            "has no photograph to compare with; --truth self compares with the scene's own look",
        )


def _protocol(task: Task) -> dict[str, Any]:
    return {
        "truth": task.truth,
        "downscale": "box average (area-weighted where the factor is not whole), after compositing and 8-bit rounding",
        "rounding": "renders clamped to [0, 1] and rounded to 8 bits",
        "background": list(task.background),
        "metrics": {metric.name: metric.protocol for metric in METRICS.values()},
        "views": len(task.views),
        "view_names": [view.name for view in task.views],
        "scales": list(task.scales),
        "recipes": {recipe.name: recipe.source for recipe in task.recipes},
    }


def _one_view(
    view: Camera, smoothed: Sequence[Gaussians], own: Gaussians, training: Training, task: Task
) -> Iterator[Measurement]:
    """Measure one view; its photograph is read and its training-size render made once for all scales."""
    started = time.perf_counter()
    full = render(own, view, find_recipe("matched"), training, task.rasterizer, task.background).rgb
    full = full.clamp(0.0, 1.0)
    seconds = time.perf_counter() - started
    photo = _photograph(view, task)
    for scale in task.scales:
        camera = view.scaled(scale)
        ceiling = resampled(full, scale)
        truth = _self_truth(own, camera, ceiling, training, task) if photo is None else None
        truth = truth if photo is None else _scaled_photograph(photo, camera, view, scale)
        yield _measure(CEILING, scale, view, ceiling, truth, 1, seconds)
        for recipe, scene in zip(task.recipes, smoothed, strict=True):
            started = time.perf_counter()
            image = render(scene, camera, recipe, training, task.rasterizer, task.background).rgb
            seconds_taken = time.perf_counter() - started
            samples = recipe.samples_at(training.rate(camera))
            yield _measure(recipe.name, scale, view, image, truth, samples, seconds_taken)


def _photograph(view: Camera, task: Task) -> Float[Tensor, "h w 3"] | None:
    if task.truth == "self":
        return None
    assert view.photo is not None
    return quantise(read_image(view.photo, task.background))


def _scaled_photograph(
    photo: Float[Tensor, "H W 3"], camera: Camera, view: Camera, scale: float
) -> Float[Tensor, "h w 3"] | None:
    """The photograph box-averaged to the camera's size; None where the render is larger than the photograph."""
    factor = scale * view.width / photo.shape[1]
    return None if factor > 1 else resampled(photo, factor, camera.hw)


def _self_truth(
    own: Gaussians, camera: Camera, ceiling: Tensor, training: Training, task: Task
) -> Float[Tensor, "h w 3"]:
    if training.rate(camera) <= 1:
        return quantise(ceiling)
    recipe = find_recipe("auto", quality="best")
    return quantise(render(own, camera, recipe, training, task.rasterizer, task.background).rgb)


def _measure(
    recipe: str,
    scale: float,
    view: Camera,
    image: Tensor,
    truth: Tensor | None,
    samples: int,
    seconds: float,
) -> Measurement:
    if truth is None:
        values: dict[str, float | None] = dict.fromkeys(METRICS)
        return Measurement(recipe, scale, view.name, values, samples, seconds, NO_PHOTOGRAPH)
    image = quantise(image)
    values = {metric.name: metric.measure(image, truth) for metric in METRICS.values()}
    return Measurement(recipe, scale, view.name, values, samples, seconds, _note(values))


def _note(values: Mapping[str, float | None]) -> str:
    notes = {"PSNR": EQUAL_IMAGES, "SSIM": TOO_SMALL}
    return "; ".join(notes[name] for name, value in values.items() if value is None)

"""Multi-scale evaluation: candidates, each a name and a renderer, at every scale against one truth.

For every view and scale: make the truth, draw each candidate, compare, note a `Measurement`.  A protocol says what a
scale changes and where the truth comes from (`evaluation.protocols`).  Renders are clamped and rounded to 8 bits
before they are compared.  Views stream: only the numbers of finished views are kept.
"""

import math
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property, partial
from os import PathLike
from pathlib import Path
from typing import Any

from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.choices import Background
from aaplug.core.errors import UsageError
from aaplug.core.executors import Apply
from aaplug.core.gaussians import Gaussians
from aaplug.core.imaging import quantised
from aaplug.core.interfaces import Rasterizer, WorldFilter
from aaplug.core.monitor import Tell
from aaplug.core.pyramids import Pyramid
from aaplug.core.training import TrainingViews
from aaplug.evaluation.image_store import ImageStore
from aaplug.evaluation.journal import Journal
from aaplug.evaluation.metric import Drawn, Image, Metric, Series, TimedRenderer
from aaplug.evaluation.metrics import PSNR, SSIM
from aaplug.evaluation.results import CEILING, Measurement, Report
from aaplug.evaluation.truth import Truth, ViewTruth, source_of
from aaplug.io.photographs import DOWNSCALES
from aaplug.methods.recipe import Recipe
from aaplug.methods.recipes import suited
from aaplug.rendering.renderer import Renderer

NO_PHOTOGRAPH = "no photograph is this large: metrics above the photographs' own size are undefined"
CORNER = 64  # px

Values = Mapping[str, float | None]


@dataclass(frozen=True)
class Candidate:
    """A scene as one recipe shows it, under a name of its own."""

    name: str
    renderer: Renderer


def candidates_of(
    scene: Gaussians | Pyramid,
    training: TrainingViews,
    recipes: Sequence[Recipe],
    rasterizer: str | Rasterizer = "auto",
    background: Background = "auto",
) -> list[Candidate]:
    """One scene by several recipes; those with the same world filter share the filtered scene."""
    prepared: dict[tuple[WorldFilter | None, bool], Renderer] = {}
    found, finest = [], scene.finest if isinstance(scene, Pyramid) else scene
    for recipe in (suited(recipe, finest) for recipe in recipes):
        key = recipe.world, recipe.levels is not None
        if key not in prepared:
            prepared[key] = Renderer.of(scene, training, recipe, rasterizer=rasterizer, background=background)
        found.append(Candidate(recipe.name, replace(prepared[key], recipe=recipe)))
    return found


@dataclass(frozen=True)
class Task:
    """What to evaluate and against which truth.

    views: at the training size.
    metrics: None takes PSNR and the protocol's SSIM.
    ceiling: add a row for the scene's own training-size look, resampled (where the protocol changes the size).
    """

    candidates: Sequence[Candidate]
    scales: Sequence[float]
    views: Sequence[Camera]
    truth: Truth
    metrics: Sequence[Metric] | None = None
    ceiling: bool = True

    @property
    def measured(self) -> tuple[Metric, ...]:
        """Every metric, first those that compare with the truth."""
        if self.metrics is None:
            return (PSNR, SSIM[self.truth.protocol.ssim])
        return tuple(sorted(self.metrics, key=lambda metric: metric.measure is None))

    @property
    def names(self) -> list[str]:
        """Rows of the report."""
        return [CEILING, *(candidate.name for candidate in self.candidates)]


def evaluate(
    task: Task,
    facts: Mapping[str, Any] | None = None,
    tell: Tell = lambda done, total: None,
    journal: str | PathLike[str] | None = None,
    resume: bool = False,
    images: ImageStore | None = None,
    apply: Apply = map,
) -> Report:
    """Measure every candidate at every scale on every view.

    facts: JSON-ready entries to add to the report's protocol (versions, hashes).
    tell: called with (views done, views in all).
    journal: file that keeps what is finished; resume: do not measure the views again that it holds.
    images: where to store images.
    apply: calls a function with every item, like `map`; an executor's does so in several processes.

    Raises:
        UsageError: nothing to measure, a view lacks the photograph it needs, or the journal is of another request.
    """
    task = replace(task, views=_distinct(task.views))
    _check(task)
    request = _request(task) | dict(facts or {})
    written = None if journal is None else Journal(Path(journal), request, resume)
    known = {} if written is None else written.known
    found, left = dict(known), [index for index in range(len(task.views)) if index not in known]
    with written or nullcontext():
        tell(len(found), len(task.views))
        for index, measured in apply(_Measuring(task, images), left) if left else ():
            found[index] = measured
            if written is not None:
                written.add(index, measured)
            tell(len(found), len(task.views))
    order, measurements = task.names, [m for index in sorted(found) for m in found[index]]
    measurements.sort(key=lambda m: (order.index(m.recipe), task.scales.index(m.scale)))
    return Report(tuple(measurements), request, task.measured)


def compare(
    candidates: Sequence[Candidate],
    views: Sequence[Camera],
    scales: Sequence[float],
    truth: Truth,
    tell: Tell = lambda done, total: None,
) -> Report:
    """Candidates side by side, in PSNR and SSIM."""
    return evaluate(Task(candidates, scales, views, truth, ceiling=False), tell=tell)


def _distinct(views: Sequence[Camera]) -> Sequence[Camera]:
    """Number the views where two have the same name, as views of two splits may."""
    if len({view.name for view in views}) == len(views):
        return views
    return [replace(view, name=f"{i:05d}_{view.name}") for i, view in enumerate(views)]


def _check(task: Task) -> None:
    if not (task.candidates and task.scales and task.views):
        raise UsageError("evaluate", "needs at least one recipe, one scale and one view")
    if any(not (scale > 0 and math.isfinite(scale)) for scale in task.scales):
        raise UsageError("scale", f"sizes must be above 0, got {min(task.scales):g}")
    if len(set(task.names)) != len(task.names) or len(set(task.scales)) != len(task.scales):
        raise UsageError("evaluate", "a recipe or a scale is named twice")
    if task.truth.source == "photographs" and task.truth.protocol.change != "size":
        raise UsageError("truth", f"protocol {task.truth.protocol.name} moves the camera: no photograph shows that")
    if task.truth.source == "photographs":
        source_of(task.views, task.truth.source)


def _request(task: Task) -> dict[str, Any]:
    """What the numbers mean; a journal is of the same request if these are equal."""
    photographs = task.truth.source == "photographs"
    return {
        "protocol": task.truth.protocol.facts,
        "truth": task.truth.source,
        "downscale": DOWNSCALES[task.truth.protocol.downscale if photographs else "box"].protocol,
        "rounding": "renders clamped to [0, 1] and rounded to 8 bits",
        "background": list(task.truth.own.background),
        "metrics": {metric.name: metric.protocol for metric in task.measured},
        "views": len(task.views),
        "view_names": [view.name for view in task.views],
        "scales": list(task.scales),
        "recipes": {c.name: c.renderer.recipe.source for c in task.candidates},
        "recipes_sha256": {c.name: c.renderer.recipe.digest for c in task.candidates},
        "rasterizer": task.candidates[0].renderer.rasterizer.name,
    }


@dataclass(frozen=True)
class _Measuring:
    """Measures the view of an index."""

    task: Task
    images: ImageStore | None

    def __call__(self, index: int) -> tuple[int, tuple[Measurement, ...]]:
        return index, tuple(self._bench.measure(index, self.task.views[index]))

    @cached_property
    def _bench(self) -> "_Bench":
        return _Bench(self.task, self.images)

    def __getstate__(self) -> dict[str, Any]:
        """For another process, wherever it runs: without the scenes' files, which may be open."""
        bare: dict[int, Gaussians] = {}  # what is shared stays so

        def portable(renderer: Renderer) -> Renderer:
            return replace(renderer, scene=bare.setdefault(id(renderer.scene), replace(renderer.scene, origin=None)))

        candidates = [Candidate(c.name, portable(c.renderer)) for c in self.task.candidates]
        truth = replace(self.task.truth, own=portable(self.task.truth.own))
        views = [view if view.photo is None else replace(view, photo=view.photo.absolute()) for view in self.task.views]
        images = self.images and replace(self.images, folder=self.images.folder.absolute())
        return {"task": replace(self.task, candidates=candidates, truth=truth, views=views), "images": images}


class _Bench:
    """Measures one view after another."""

    def __init__(self, task: Task, images: ImageStore | None):
        self.task, self.images = task, images
        self.timed = {c.name: TimedRenderer(c.renderer) for c in task.candidates}
        self.sized = task.truth.protocol.change == "size"

    def measure(self, index: int, view: Camera) -> Iterator[Measurement]:
        """Measure every candidate at every scale."""
        truth = ViewTruth(self.task.truth, view)
        fulls: dict[str, Drawn] = {}
        for scale in sorted(self.task.scales, key=lambda scale: scale != 1):  # figures need scale 1
            comparison = _Comparison(self.task.measured, truth.compared(scale))
            for name, drawn in self._drawn(truth, scale):
                if scale == 1 and self.sized:
                    fulls[name] = drawn
                series = None if name == CEILING else self._series(truth, name, scale, drawn, fulls.get(name))
                values, note = comparison.values(drawn, series)
                if self.images is not None:
                    self.images.keep(index, name, scale, drawn.rgb, comparison.truth)
                cost = drawn.samples, drawn.seconds
                yield Measurement(name, scale, view.name, values, *cost, note, drawn.evaluations)

    def _drawn(self, truth: ViewTruth, scale: float) -> Iterator[tuple[str, Drawn]]:
        """The rows' images at a scale; candidates that draw alike, as several do at the training size, draw once."""
        camera = truth.camera(scale)
        drawings: dict[Hashable, Drawn] = {}
        if truth.truth.source == "reference":
            drawings[_work(truth.truth.own, camera)] = truth.drawn(scale)
        elif self.task.ceiling and self.sized:
            yield CEILING, truth.look.resampled_to(truth.resized_look(scale))
            if scale == 1:
                drawings[_work(truth.truth.own, camera)] = truth.look
        for name, timed in self.timed.items():
            work = _work(timed.renderer, camera)
            if work not in drawings:
                drawings[work] = timed(camera)
            yield name, drawings[work]

    def _series(self, truth: ViewTruth, name: str, scale: float, drawn: Drawn, full: Drawn | None) -> Series:
        camera, timed = truth.camera(scale), self.timed[name]
        still = truth.truth.source == "reference" and drawn is truth.drawn(scale)  # it moves as the truth does

        def frames() -> tuple[list[Image], list[Image]]:
            expected = truth.motion(scale)
            return (expected if still else timed.motion(camera, first=drawn)), expected

        smaller = partial(self.task.truth.protocol.resized, camera=camera, scale=scale)
        return Series(scale, drawn, full, smaller, frames if self.sized else None)


def _work(renderer: Renderer, camera: Camera) -> Hashable:
    """Equal for renderers that draw the same image of a view."""
    recipe = renderer.recipe
    method = recipe.selection, recipe.screen, recipe.pixel, recipe.compositor
    fine, samples = renderer.sampled(camera)
    sampled = samples, renderer.neighbours(camera), renderer.coarsening(fine, samples)
    how = sampled, renderer.background, renderer.rasterizer.name
    return id(renderer.scene), id(renderer.training), method, how


class _Comparison:
    """Compares images with one truth; equal images are compared once."""

    def __init__(self, metrics: Sequence[Metric], truth: Image | None):
        self.metrics, self.truth = metrics, truth
        self._known: list[tuple[Tensor, Values]] = []

    def values(self, drawn: Drawn, series: Series | None) -> tuple[Values, str]:
        """Every metric's value, and why values are undefined; the ceiling has no series, and so no figures."""
        compared = self._compared(drawn.rgb)
        values = {m.name: compared[m.name] if m.measure else (series and m.of(series)) for m in self.metrics}
        if self.truth is None:
            return values, NO_PHOTOGRAPH
        undefined = [m.undefined for m in self.metrics if m.measure and values[m.name] is None]
        return values, "; ".join(dict.fromkeys(undefined))

    def _compared(self, rgb: Image) -> Values:
        metrics = [metric for metric in self.metrics if metric.measure]
        if self.truth is None:
            return dict.fromkeys(metric.name for metric in metrics)
        image = quantised(rgb)
        for known, values in self._known:
            if image.equal(known):
                return values
        assert self.truth is not None
        part = slice(CORNER if image.equal(self.truth) else None)  # of equal images, a corner says as much
        values = {m.name: m.compare(image[part, part], self.truth[part, part]) for m in metrics}
        self._known.append((image, values))
        return values

"""Multi-scale evaluation: renderers, each with a name, at every scale against one truth.

For every view and scale: make the truth, draw by each renderer, compare, note a `Measurement`.  A protocol says what a
scale changes and where the truth comes from (`evaluation.protocols`).  Renders are clamped and rounded to 8 bits
before they are compared.  Views stream: only the numbers of finished views are kept.
"""

import math
import platform
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib.metadata import version
from itertools import product
from os import PathLike
from typing import Any

from aaplug.core.cameras import Camera, digest_of_cameras
from aaplug.core.gaussians import Gaussians
from aaplug.core.imaging import quantised
from aaplug.core.interfaces import WorldFilter
from aaplug.core.training import TrainingViews
from aaplug.evaluation.coverage import Coverage, above_nyquist, coverage
from aaplug.evaluation.image_store import ImageStore
from aaplug.evaluation.journal import Journal
from aaplug.evaluation.metric import Image, Metric, Series, TimedImage, TimedRenderer
from aaplug.evaluation.metrics import PSNR, SSIM
from aaplug.evaluation.results import CEILING, NO_PHOTOGRAPH, Measurement, Report
from aaplug.evaluation.truth import Truth, ViewTruth, source_of
from aaplug.io.images import image_size
from aaplug.io.photographs import DOWNSCALES
from aaplug.methods.recipe import Recipe
from aaplug.rendering.cost import COMPARED, Cost, cost_of
from aaplug.rendering.renderer import Renderer
from aaplug.system.digests import digest_of_files, digest_of_values
from aaplug.system.errors import UsageError
from aaplug.system.executors import Apply
from aaplug.system.monitor import Tell

PACKAGES = ("aaplug", "torch", "numpy", "opencv-contrib-python-headless")
EQUAL_IMAGES_SIDE = 64  # px: of images that equal their truth, metrics look at this corner

Values = Mapping[str, float | None]


def renderers_of(look: Renderer, recipes: Sequence[Recipe]) -> dict[str, Renderer]:
    """A renderer's scene by several recipes that suit it; those with the same world filter share the filtered scene."""
    shared, renderers = dict[tuple[WorldFilter | None, bool], Renderer](), dict[str, Renderer]()
    for recipe in recipes:
        key = recipe.world, recipe.levels is not None
        if key not in shared:
            shared[key] = look.by(recipe)
        renderers[recipe.name] = replace(shared[key], recipe=recipe)
    if len(renderers) < len(recipes):
        raise UsageError("evaluate", "a recipe is named twice")
    return renderers


@dataclass(frozen=True, eq=False)
class Task:
    """Renderers, scales and views to evaluate, and the truth to evaluate them against.

    renderers: by the names of their rows.
    views: at the training size.
    metrics: None takes PSNR and the protocol's SSIM.
    ceiling: add a row for the scene's own training-size look, resampled (where the protocol changes the size).
    """

    renderers: Mapping[str, Renderer]
    scales: Sequence[float]
    views: Sequence[Camera]
    truth: Truth
    metrics: Sequence[Metric] | None = None
    ceiling: bool = True

    def __post_init__(self) -> None:
        """Raises UsageError: nothing is to be measured, or a view or scale lacks the photograph that it needs."""
        if not (self.renderers and self.scales and self.views):
            raise UsageError("evaluate", "needs at least one recipe, one scale and one view")
        for each in self.renderers.values():
            if not len(each.scene) and each.in_time is None:
                raise UsageError(each.scene.name, "has no Gaussians to measure")
        if any(not (scale > 0 and math.isfinite(scale)) for scale in self.scales):
            raise UsageError("scale", f"sizes must be above 0, got {min(self.scales):g}")
        if CEILING in self.renderers or len(set(self.scales)) != len(self.scales):
            raise UsageError("evaluate", "a recipe or a scale is named twice")
        if self.truth.source == "photographs":
            source_of(self.views, "photographs", self.truth.protocol)
            if check := DOWNSCALES[self.truth.protocol.downscale].check:
                undistorted = [(v.width, v.photo) for v in self.views if v.photo and v.undistortion is None]
                sizes = {width / image_size(photo)[0] for width, photo in undistorted}
                for factor in (size * scale for size, scale in product(sizes, self.scales)):
                    if factor <= 1:
                        check(factor)

    @property
    def measured(self) -> tuple[Metric, ...]:
        """The metrics, first those that compare with the truth."""
        if self.metrics is None:
            return (PSNR, SSIM[self.truth.protocol.ssim])
        return tuple(sorted(self.metrics, key=lambda metric: metric.measure is None))

    @property
    def rows(self) -> list[str]:
        """Rows of the report; every view has a measurement of each at every scale."""
        ceiling = [CEILING] if self.ceiling and self.resizes and self.truth.source != "reference" else []
        return [*ceiling, *self.renderers]

    @cached_property
    def sized_views(self) -> list[Camera]:
        """Every view at every scale, as the protocol draws it."""
        truths = [ViewTruth(self.truth, view) for view in self.views]
        return [truth.camera(scale) for truth in truths for scale in self.scales]

    @property
    def cost(self) -> Cost:
        """An estimate: every renderer's images, the truths, which are as fine as training, and their comparison."""
        images, sized, count = cost_of([*self.renderers.values()], self.sized_views), self.sized_views, len(self.scales)
        if self.resizes:
            truths = [cost_of([self.truth.renderer], self.views)]
        else:
            looks = map(self.truth.supersampled, self.scales)
            truths = [cost_of([look], sized[i::count]) for i, look in enumerate(looks)]
        compared = len(self.rows) * sum(view.width * view.height for view in sized)  # px
        seconds = images.seconds + sum(cost.seconds for cost in truths) + COMPARED * compared
        return images._replace(seconds=seconds, image=max(images.image, *(cost.image for cost in truths)))

    def coverage(self, scene: Gaussians, training: TrainingViews) -> Coverage:
        """The scene's extents against its sampling bounds, and the renderers' energy above the Nyquist rate."""
        drawn = product(self.renderers.items(), self.scales if self.resizes else ())
        above = {(name, scale): above_nyquist(renderer, self.views, scale) for (name, renderer), scale in drawn}
        return replace(coverage(scene, training, self.scales), above_nyquist=above)

    @property
    def resizes(self) -> bool:
        """True where a scale changes the image's size, so that images of one view can be averaged down."""
        return self.truth.protocol.change == "size"


def evaluate(
    task: Task,
    facts: Mapping[str, Any] | None = None,
    tell: Tell = lambda done, total: None,
    journal: str | PathLike[str] | None = None,
    resume: bool = False,
    images: ImageStore | None = None,
    apply: Apply = map,
) -> Report:
    """Measure every renderer at every scale on every view.

    facts: JSON-ready entries to add to the report's protocol (versions, hashes).
    tell: called with (views done, views in all).
    journal: file that keeps what is finished; resume: do not measure the views again that it holds.
    images: where to store images.
    apply: calls a function with every item, like `map`; an executor's does so in several processes.

    Raises:
        UsageError: the journal is of another request.
    """
    if len({view.name for view in task.views}) < len(task.views):  # as views of two splits may
        task = replace(task, views=[replace(view, name=f"{i:05d}_{view.name}") for i, view in enumerate(task.views)])
    request = _request(task) | dict(facts or {})
    with Journal(journal, request, resume) as finished:
        remaining = [index for index in range(len(task.views)) if index not in finished.views]
        tell(len(finished.views), len(task.views))
        for index, measurements in apply(ViewMeasurer(task, images), remaining) if remaining else ():
            finished.add(index, measurements)
            tell(len(finished.views), len(task.views))
    rows, measurements = task.rows, [m for index in sorted(finished.views) for m in finished.views[index]]
    measurements.sort(key=lambda m: (rows.index(m.recipe), task.scales.index(m.scale)))
    return Report(tuple(measurements), request, task.measured)


def _request(task: Task) -> dict[str, Any]:
    """The meaning of the numbers; a journal is of the same request if these are equal."""
    photographs = task.truth.source == "photographs"
    return {
        "protocol": task.truth.protocol.facts,
        "truth": task.truth.source,
        "downscale": DOWNSCALES[task.truth.protocol.downscale if photographs else "box"].protocol,
        "rounding": "renders clamped to [0, 1] and rounded to 8 bits",
        "background": list(task.truth.renderer.background),
        "metrics": {metric.name: metric.protocol for metric in task.measured},
        "metrics_sha256": {metric.name: digest_of_values(metric) for metric in task.measured},
        "views": len(task.views),
        "view_names": [view.name for view in task.views],
        "scales": list(task.scales),
        "recipes": {name: renderer.recipe.source for name, renderer in task.renderers.items()},
        "recipes_sha256": {name: renderer.recipe.digest for name, renderer in task.renderers.items()},
        "rasterizer": next(iter(task.renderers.values())).rasterizer.name,
    }


def facts_of(task: Task, notes: Sequence[str]) -> dict[str, Any]:
    """Versions, platform, and hashes of the cameras and photographs that a task reads; notes: of the cameras."""
    training, source = task.truth.renderer.training, task.truth.source
    facts = {
        "versions": {name: version(name) for name in PACKAGES} | {"python": platform.python_version()},
        "platform": f"{platform.system()} {platform.machine()}",
        "cameras": {
            "notes": list(notes),
            "sha256": digest_of_cameras(task.views),
            "training_sha256": digest_of_cameras(training.cameras),
        },
        "cull_margin": training.cull_margin if math.isfinite(training.cull_margin) else None,
    }
    if source == "reference":
        return facts
    photos = [view.photo for view in task.views if view.photo] if source == "photographs" else []
    return facts | {"photographs": {"count": len(photos), "sha256": digest_of_files(photos) if photos else None}}


@dataclass(frozen=True, eq=False)
class ViewMeasurer:
    """Measures the view of an index; can be sent to another process."""

    task: Task
    images: ImageStore | None

    def __call__(self, index: int) -> tuple[int, tuple[Measurement, ...]]:
        """Measure every renderer at every scale."""
        view, measured, measurements = self.task.views[index], self.task.measured, list[Measurement]()
        truth = ViewTruth(self.task.truth, view)
        training_size: dict[str, TimedImage] = {}  # by row
        for scale in sorted(self.task.scales, key=lambda scale: scale != 1):  # figures need scale 1
            expected, compared = truth.compared(scale), dict[TimedImage, Values]()
            for name, image in self._images(truth, scale):
                if scale == 1 and self.task.resizes:
                    training_size[name] = image
                series = None if name == CEILING else self._series(truth, name, scale, image, training_size.get(name))
                if image not in compared:
                    compared[image] = self._compared(image, expected)
                values = {**compared[image], **{m.name: series and m.of(series) for m in measured if m.figure}}
                undefined = [m.undefined for m in measured if m.measure and values[m.name] is None]
                note = NO_PHOTOGRAPH if expected is None else "; ".join(dict.fromkeys(undefined))
                if self.images is not None:
                    self.images.keep(index, name, scale, image.rgb, expected)
                cost = image.samples, image.seconds
                measurements.append(Measurement(name, scale, view.name, values, *cost, note, image.evaluations))
        return index, tuple(measurements)

    def _images(self, truth: ViewTruth, scale: float) -> Iterator[tuple[str, TimedImage]]:
        """The rows' images at a scale; renderers that draw alike, as several do at the training size, draw once."""
        camera = truth.camera(scale)
        images: dict[Hashable, TimedImage] = {}
        if truth.truth.source == "reference":
            images[_work(truth.truth.renderer, camera)] = truth.reference(scale)
        elif CEILING in self.task.rows:
            if scale == 1:
                images[_work(truth.truth.renderer, camera)] = truth.look
            ceiling = truth.look
            if scale != 1:
                rgb = truth.resized_look(scale)
                ceiling = replace(ceiling, rgb=rgb, alpha=rgb.new_ones(rgb.shape[:2]), samples=1)
            yield CEILING, ceiling
        for name, renderer in self._renderers.items():
            work = _work(renderer.renderer, camera)
            if work not in images:
                images[work] = renderer(camera)
            yield name, images[work]

    def _compared(self, image: TimedImage, truth: Image | None) -> Values:
        """Values of the metrics that compare with the truth; None where there is none."""
        measures = [metric for metric in self.task.measured if metric.measure]
        if truth is None:
            return dict.fromkeys(metric.name for metric in measures)
        rgb = quantised(image.rgb)
        part = slice(EQUAL_IMAGES_SIDE if rgb.equal(truth) else None)
        return {metric.name: metric.compare(rgb[part, part], truth[part, part]) for metric in measures}

    @cached_property
    def _renderers(self) -> dict[str, TimedRenderer]:
        return {name: TimedRenderer(renderer) for name, renderer in self.task.renderers.items()}

    def _series(self, truth: ViewTruth, name: str, scale: float, image: TimedImage, full: TimedImage | None) -> Series:
        def frames() -> tuple[list[Image], list[Image]]:
            expected = truth.motion(scale)
            if truth.truth.source == "reference" and image is truth.reference(scale):  # it moves as the truth does
                return expected, expected
            return self._renderers[name].motion(truth.camera(scale), image), expected

        smaller = partial(self.task.truth.protocol.resized, camera=truth.camera(scale), scale=scale)
        return Series(scale, image, full, smaller, frames if self.task.resizes else None)

    def __getstate__(self) -> dict[str, Any]:
        """The work without the scenes' files, which may be open, and with absolute paths."""
        renderers = {name: renderer.portable() for name, renderer in self.task.renderers.items()}
        truth = replace(self.task.truth, renderer=self.task.truth.renderer.portable())
        views = [view if view.photo is None else replace(view, photo=view.photo.absolute()) for view in self.task.views]
        images = self.images and replace(self.images, folder=self.images.folder.absolute())
        return {"task": replace(self.task, renderers=renderers, truth=truth, views=views), "images": images}


def _work(renderer: Renderer, camera: Camera) -> Hashable:
    """Equal for renderers that draw the same image of a view."""
    recipe = renderer.recipe
    method = recipe.selection, recipe.screen, recipe.pixel, recipe.compositor
    fine, samples = renderer.sampled(camera)
    sampling = *renderer.sampling(camera), renderer.coarsening(fine, samples)
    scene = *map(id, renderer.scene.columns.values()), id(renderer.training)
    return scene, method, sampling, renderer.background, renderer.rasterizer.name

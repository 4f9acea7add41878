"""Multi-scale evaluation: every recipe at every scale against one truth, as a protocol says.

What a scale changes, where the truth comes from and how it is made smaller is the protocol's (`aaplug.evaluation.protocols`).
Truth "self" is the scene's own look: for sizes its training-size render averaged down, and `matched` above that size;
for distances and fields of view `matched` with as many samples as reach training's rate.  Renders are clamped and
rounded to 8 bits before they are compared.  Views stream: nothing grows with their number but the numbers, and a
photograph is read once for all scales.
"""

import math
import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.training import TrainingViews
from aaplug.evaluation.image_store import Images
from aaplug.evaluation.journal import Record
from aaplug.evaluation.metrics import (
    CONSISTENCY,
    ENERGY,
    FLICKER,
    PSNR,
    SSIM,
    Metric,
    energy_drift,
    flicker,
    psnr,
)
from aaplug.evaluation.protocols import PROTOCOLS, Protocol, Truth, median_depth
from aaplug.evaluation.results import CEILING, Measurement, Report
from aaplug.io.images import quantised, resampled, stretched
from aaplug.io.photographs import DOWNSCALES, Photograph
from aaplug.methods.recipes import Recipe, find_recipe
from aaplug.rasterizers import RASTERIZERS, Tiled
from aaplug.rasterizers.tiled.counting import Counting
from aaplug.rendering.renderer import rate_of, render, smooth

NO_PHOTOGRAPH = "no photograph is this large: metrics above the photographs' own size are undefined"
EQUAL_IMAGES = "equal images: PSNR is infinite and left out of the mean"
TOO_SMALL = "image smaller than the SSIM window"
FLICKER_STEPS = 4  # frames, a step of 1/4 px right and down between them


@dataclass(frozen=True)
class Task:
    """What to evaluate and against which truth.

    metrics: None takes PSNR and the protocol's SSIM.  figures: what is measured without a photograph, out of
    CONSISTENCY, ENERGY and FLICKER.
    """

    recipes: Sequence[Recipe]
    scales: Sequence[float]
    views: Sequence[Camera]
    background: tuple[float, float, float]
    truth: Truth
    rasterizer: Rasterizer = RASTERIZERS["eager"]
    protocol: Protocol = PROTOCOLS["default"]
    metrics: Sequence[Metric] | None = None
    figures: Sequence[Metric] = ()

    @property
    def judges(self) -> tuple[Metric, ...]:
        """The metrics that compare with the truth."""
        own = (PSNR, SSIM[self.protocol.ssim])
        return own if self.metrics is None else tuple(self.metrics)


def evaluate(
    scene: Gaussians,
    training: TrainingViews,
    task: Task,
    facts: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    record: Path | None = None,
    resume: bool = False,
    images: Images | None = None,
) -> Report:
    """Measure every recipe at every scale on every view.

    facts: JSON-ready entries for the protocol (versions, hashes).  progress: told (views done, views in all).
    record: a file that holds what is finished; with `resume` the views that it holds are not measured again.
    images: where images are stored.

    Raises:
        UsageError: nothing to measure, the truth is photographs and a view has none, or the record is of another
            request.
        FormatError: a photograph cannot be read.
        OutputError: the record or an image cannot be written.
    """
    task = replace(task, views=_distinct(task.views))
    _check(task)
    protocol = _protocol(task) | dict(facts or {})
    finished = None if record is None else Record(record, protocol, resume)
    known = {} if finished is None else finished.known
    try:
        bench = _Bench(scene, training, task, images)
        measurements: list[Measurement] = []
        for index, view in enumerate(task.views):
            progress(index, len(task.views))
            measured = known.get(index) or tuple(bench.measure(index, view))
            if finished is not None and index not in known:
                finished.add(index, measured)
            measurements += measured
    finally:
        if finished is not None:
            finished.close()
    progress(len(task.views), len(task.views))
    order = [CEILING, *(recipe.name for recipe in task.recipes)]
    measurements.sort(key=lambda m: (order.index(m.recipe), task.scales.index(m.scale)))
    return Report(tuple(measurements), protocol)


def _distinct(views: Sequence[Camera]) -> Sequence[Camera]:
    """Views of the same name, as two splits may hold, get their place before it."""
    if len({view.name for view in views}) == len(views):
        return views
    return [replace(view, name=f"{i:05d}_{view.name}") for i, view in enumerate(views)]


def _check(task: Task) -> None:
    if not (task.recipes and task.scales and task.views):
        raise UsageError("evaluate", "needs at least one recipe, one scale and one view")
    if any(not (scale > 0 and math.isfinite(scale)) for scale in task.scales):
        raise UsageError("--scale", f"sizes must be above 0, got {min(task.scales):g}")
    names = [recipe.name for recipe in task.recipes]
    if len(set(names)) != len(names) or len(set(task.scales)) != len(task.scales):
        raise UsageError("evaluate", "a recipe or a scale is named twice")
    if task.truth == "photographs" and task.protocol.change != "size":
        raise UsageError(
            "--truth", f"protocol {task.protocol.name} moves the camera: no photograph shows that"
        )
    missing = [view.name for view in task.views if view.photo is None]
    if task.truth == "photographs" and missing:
        raise UsageError(
            missing[0],
            "has no photograph to compare with; --truth self compares with the scene's own look",
        )


def _protocol(task: Task) -> dict[str, Any]:
    protocol = task.protocol
    downscale = DOWNSCALES[protocol.downscale] if task.truth == "photographs" else DOWNSCALES["box"]
    return {
        "protocol": {
            "name": protocol.name,
            "source": protocol.source,
            "scale changes": protocol.change,
            "sizes": "rounded, pixels stretched by less than one"
            if protocol.whole_sizes
            else "what does not fill a pixel is cropped",
        },
        "truth": task.truth,
        "downscale": downscale.protocol,
        "rounding": "renders clamped to [0, 1] and rounded to 8 bits",
        "background": list(task.background),
        "metrics": {m.name: m.protocol for m in (*task.judges, *task.figures)},
        "views": len(task.views),
        "view_names": [view.name for view in task.views],
        "scales": list(task.scales),
        "recipes": {recipe.name: recipe.source for recipe in task.recipes},
        "rasterizer": task.rasterizer.kernels.name
        if isinstance(task.rasterizer, Tiled)
        else type(task.rasterizer).__name__.lower(),
    }


class _Drawn(NamedTuple):
    """A timed render.  own: its light without the background, for energy."""

    rgb: Float[Tensor, "h w 3"]
    own: Float[Tensor, "h w 3"]
    samples: int
    seconds: float
    pairs: int | None


class _Bench:
    """What all views share, and the measuring of one."""

    def __init__(
        self, scene: Gaussians, training: TrainingViews, task: Task, images: Images | None
    ):
        self.training, self.task, self.images = training, task, images
        self.smoothed = {r.name: smooth(scene, training, r) for r in task.recipes}
        self.own = smooth(scene, training, find_recipe("matched"))

    def measure(self, index: int, view: Camera) -> Iterator[Measurement]:
        """Measure one view; its photograph is read and its training-size render made once for all scales."""
        task, protocol = self.task, self.task.protocol
        photo = self._photograph(view)
        depth = median_depth(self.own.means, view) if protocol.change == "distance" else 1.0
        sized = protocol.change == "size"
        full = self._draw(self.own, view, find_recipe("matched")) if sized else None
        fulls: dict[str, _Drawn] = {}
        for scale in sorted(task.scales, key=lambda scale: scale != 1):  # figures look back at 1
            camera = protocol.camera(view, scale, depth)
            ceiling = None if full is None else self._shrunk(full.rgb.clamp(0, 1), camera, scale)
            truth = self._truth(photo, view, camera, scale, ceiling)
            judge = _Judge(self.task.judges, truth)
            if full is not None and ceiling is not None:
                row = full._replace(rgb=ceiling, samples=1)
                values = judge(ceiling)
                yield self._noted(index, CEILING, scale, view, row, truth, values, {})
            motion = self._motion(view, camera, scale)
            drawings: dict[Hashable, _Drawn] = {}
            if full is not None and scale == 1:
                drawings[self._work(find_recipe("matched"), view)] = full
            for recipe in task.recipes:
                work = self._work(recipe, camera)
                if work not in drawings:
                    drawings[work] = self._draw(self.smoothed[recipe.name], camera, recipe)
                drawn = drawings[work]
                if scale == 1:
                    fulls[recipe.name] = drawn
                figures = self._figures(recipe, camera, scale, drawn, fulls, motion)
                values = judge(drawn.rgb)
                yield self._noted(index, recipe.name, scale, view, drawn, truth, values, figures)

    def _work(self, recipe: Recipe, camera: Camera) -> Hashable:
        """What a recipe does at a view's rate: `auto` is `matched` where it takes one sample, and not drawn again."""
        samples = recipe.samples_at(rate_of(self.own, camera, self.training))
        return recipe.world, recipe.selection, recipe.screen, samples, recipe.pixel

    def _draw(self, scene: Gaussians, camera: Camera, recipe: Recipe) -> _Drawn:
        rasterizer, counting = self.task.rasterizer, None
        if isinstance(rasterizer, Tiled):
            counting = Counting(rasterizer.kernels)
            rasterizer = replace(rasterizer, kernels=counting)
        behind = self.task.background
        started = time.perf_counter()
        with torch.no_grad():
            rgb, alpha = render(scene, camera, recipe, self.training, rasterizer, behind)
        seconds = time.perf_counter() - started
        rgb, alpha = rgb.float(), alpha.float()
        own = rgb - (1 - alpha[..., None]) * rgb.new_tensor(behind)
        samples = recipe.samples_at(rate_of(scene, camera, self.training))
        pairs = None if counting is None else counting.pairs
        return _Drawn(rgb, own, samples, seconds, pairs)

    def _shrunk(self, full: Tensor, camera: Camera, scale: float) -> Float[Tensor, "h w 3"]:
        """A training-size image at the camera's size."""
        if self.task.protocol.whole_sizes:
            return stretched(full, camera.hw)
        return resampled(full, scale)

    def _photograph(self, view: Camera) -> Photograph | None:
        if self.task.truth == "self":
            return None
        assert view.photo is not None
        downscale = DOWNSCALES[self.task.protocol.downscale]
        return downscale.read(view.photo, self.task.background, view.lens)

    def _truth(
        self,
        photo: Photograph | None,
        view: Camera,
        camera: Camera,
        scale: float,
        ceiling: Float[Tensor, "h w 3"] | None,
    ) -> Float[Tensor, "h w 3"] | None:
        """What the images are compared with; None where the render is larger than the photograph."""
        if photo is not None:
            factor = scale * view.width / photo.hw[1]
            return None if factor > 1 else photo.at(camera.hw, factor)
        if ceiling is not None and self.training.relative_rate(camera) <= 1:
            return quantised(ceiling)
        if ceiling is not None:
            recipe = find_recipe("auto", quality="best")
        else:
            recipe = replace(find_recipe("matched"), grid=max(1, math.ceil(1 / scale)))
        return quantised(self._draw(self.own, camera, recipe).rgb)

    def _motion(self, view: Camera, camera: Camera, scale: float) -> list[Tensor] | None:
        """The training-size look, averaged down, as it moves by steps of a part of a pixel."""
        if FLICKER not in self.task.figures or scale >= 1 or self.task.protocol.change != "size":
            return None
        recipe = find_recipe("matched")
        moved = [_moved(view, step / scale) for step in range(FLICKER_STEPS)]
        fulls = [self._draw(self.own, shifted, recipe).rgb.clamp(0, 1) for shifted in moved]
        return [self._shrunk(full, camera, scale) for full in fulls]

    def _figures(
        self,
        recipe: Recipe,
        camera: Camera,
        scale: float,
        drawn: _Drawn,
        fulls: Mapping[str, _Drawn],
        motion: list[Tensor] | None,
    ) -> dict[str, float | None]:
        """What needs no photograph."""
        figures: dict[str, float | None] = {metric.name: None for metric in self.task.figures}
        full = fulls.get(recipe.name) if self.task.protocol.change == "size" else None
        if full is not None and CONSISTENCY.name in figures and scale < 1:
            expected = self._shrunk(full.rgb.clamp(0, 1), camera, scale)
            figures[CONSISTENCY.name] = psnr(drawn.rgb.clamp(0, 1), expected)
        if full is not None and ENERGY.name in figures:
            rows, columns = (math.ceil(side / scale) for side in camera.hw)
            figures[ENERGY.name] = energy_drift(drawn.own, full.own[:rows, :columns])
        if motion is not None:
            scene = self.smoothed[recipe.name]
            moved = [_moved(camera, float(step)) for step in range(FLICKER_STEPS)]
            frames = [self._draw(scene, shifted, recipe).rgb.clamp(0, 1) for shifted in moved]
            figures[FLICKER.name] = flicker(frames, motion)
        return figures

    def _noted(
        self,
        index: int,
        recipe: str,
        scale: float,
        view: Camera,
        drawn: _Drawn,
        truth: Tensor | None,
        values: Mapping[str, float | None],
        figures: Mapping[str, float | None],
    ) -> Measurement:
        """The measurement, once its images are in place."""
        if self.images is not None:
            self.images.keep(index, recipe, scale, drawn.rgb, truth)
        found = {**values, **{m.name: figures.get(m.name) for m in self.task.figures}}
        note = _note(values, truth is None)
        return Measurement(
            recipe, scale, view.name, found, drawn.samples, drawn.seconds, note, drawn.pairs
        )


class _Judge:
    """Compares images with one truth; what recipes draw alike, as they do at the training rate, is compared once."""

    def __init__(self, metrics: Sequence[Metric], truth: Tensor | None):
        self.metrics, self.truth = metrics, truth
        self.seen: list[tuple[Tensor, dict[str, float | None]]] = []

    def __call__(self, rgb: Float[Tensor, "h w 3"]) -> dict[str, float | None]:
        """Every metric's value, None for all where there is no truth."""
        if self.truth is None:
            return {metric.name: None for metric in self.metrics}
        image = quantised(rgb)
        for known, values in self.seen:
            if image.equal(known):
                return values
        values: dict[str, float | None] = {}
        for metric in self.metrics:
            assert metric.measure is not None
            values[metric.name] = metric.measure(image, self.truth)
        self.seen.append((image, values))
        return values


def _moved(camera: Camera, steps: float) -> Camera:
    """The image content moved right and down by `steps` quarters of a pixel."""
    step = steps / FLICKER_STEPS
    return replace(camera, cx=camera.cx + step, cy=camera.cy + step)


def _note(values: Mapping[str, float | None], no_photograph: bool) -> str:
    if no_photograph:
        return NO_PHOTOGRAPH
    notes = {"PSNR": EQUAL_IMAGES, "SSIM": TOO_SMALL, "LPIPS": TOO_SMALL, "FLIP": TOO_SMALL}
    return "; ".join(dict.fromkeys(notes[name] for name, value in values.items() if value is None))

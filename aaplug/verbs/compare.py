"""Scenes against the first of them: what compression, conversion, pruning or training again costs, at every size."""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from aaplug.core.gaussians import digest_of_scene
from aaplug.evaluation import PROTOCOLS
from aaplug.evaluation.alignment import mismatch
from aaplug.evaluation.comparison import ComparedScene, Comparison, differences
from aaplug.evaluation.coverage import coverage
from aaplug.evaluation.engine import Candidate, Task, evaluate
from aaplug.evaluation.image_store import ImageStore
from aaplug.evaluation.metrics import find_metrics
from aaplug.evaluation.report.files import COMPARED, PAGE, write_comparison
from aaplug.evaluation.truth import Truth
from aaplug.io.scenes import scene_of
from aaplug.io.scenes.scene import Scene, usable
from aaplug.methods import RECIPES
from aaplug.methods.viewers import Viewer, find_viewer
from aaplug.options.shared import AnyPath
from aaplug.options.verbs import COMPARED_SCALES, CompareOptions
from aaplug.rendering.agreement import settled
from aaplug.rendering.job import CamerasLike, Job, running
from aaplug.rendering.renderer import Renderer
from aaplug.system.errors import FrameError, UsageError
from aaplug.system.executors import ProcessesIfLong
from aaplug.verbs.evaluate import (
    JOURNAL,
    check_journalled,
    cost_of_task,
    environment,
    facts_of_cameras,
    views_in_report,
)
from aaplug.verbs.verb import ScenesLike, compares
from aaplug.verbs.views import file_names

PROTOCOL = replace(
    PROTOCOLS["self"],
    name="compare",
    source="the first scene as its recipe draws it at each size",
    scales=COMPARED_SCALES,
)

log = logging.getLogger("aaplug")


@compares(CompareOptions)
def compare(scenes: ScenesLike, cameras: CamerasLike, output: AnyPath | None, options: CompareOptions) -> Comparison:
    """Compare scenes with the first of them: images at several sizes, files and Gaussians.

    The truth at a size is the first scene as its recipe draws it there.

    Args:
        scenes: two or more, each as `render` takes it; or by the names that the results give them.
        cameras: see `render`; None for the cameras of the first scene's model folder, or an orbit around it.
        output: folder for compare.json, compare.csv, report.html and contact-sheet.png; None writes nothing.

    Raises:
        FrameError: a scene is turned, scaled or moved against the first, and `any_frame` is false.
        AaplugError: as `render`; also, there are fewer than two scenes, or one is named twice.
    """
    folder, viewer = None if output is None else Path(output), find_viewer(options.viewer)
    check = partial(check_compared, folder, options)
    check()
    metrics = [options.metric] if isinstance(options.metric, str) else options.metric
    metrics = find_metrics(metrics, PROTOCOL)
    named = _in_one_frame(_named(scenes), options)
    job = Job.of(next(iter(named.values())), cameras, options)
    views, scales = job.views, options.scale
    images = folder and ImageStore(folder, views_in_report(options.show, views))
    inputs = [*job.inputs, *(file for scene in named.values() for file in scene.files)]
    with running(options, folder, check, inputs, folder=True) as workers:
        named = {name: settled(scene, job.cameras, options.monitor) for name, scene in named.items()}
        rows = _rows(named, options)
        look = job.look(len(views) * len(scales) * len(rows))
        job.say_assumed(look)
        recipe = job.recipe(options.recipe)
        renderers = [replace(look, source=scene, training=job.training(scene)).by(recipe) for scene in named.values()]
        truth = Truth(renderers[0], "reference", PROTOCOL)
        if viewer is not None:
            renderers = [_by_viewer(viewer, renderer) for renderer in renderers]
        candidates = [Candidate(name, renderer) for name, renderer in zip(named, renderers, strict=True)]
        task = Task(candidates, scales, views, truth, metrics, ceiling=False)
        sized = [view.scaled(scale) for view in views for scale in scales]
        job.announce(renderers, sized, cost=cost_of_task(task, sized), processes=workers.threads)
        facts = _facts(rows, named, job, viewer)
        pool = workers.cluster or ProcessesIfLong(workers.threads)
        with job.monitor.progress("comparing", "views") as tell:
            report = evaluate(task, facts, tell, folder and folder / JOURNAL, options.resume, images, pool.map)
        comparison = Comparison(rows, report)
        if folder and images:
            bounds, replaces = coverage(job.scene.gaussians(), look.training, report.scales), options.overwrite
            files = write_comparison(comparison, task, folder, bounds, images, replaces or options.resume)
            for file in files:
                job.monitor.say(f"wrote {file}")
    return comparison


def check_compared(folder: Path | None, options: CompareOptions) -> None:
    """Refuse, before any work, what needs a folder, contradicts itself or would replace results."""
    check_journalled(folder, (*COMPARED, PAGE), "a comparison", options.resume, options.overwrite)


def _named(scenes: ScenesLike) -> dict[str, Scene]:
    """The scenes by name, opened; without names they get those of their files."""
    opened = [scene_of(scene) for scene in (scenes.values() if isinstance(scenes, Mapping) else scenes)]
    if len(opened) < 2:
        raise UsageError(
            "compare", f"needs two scenes or more, got {len(opened)}; the first is what others are held to"
        )
    if isinstance(scenes, Mapping):
        return dict(zip(scenes, opened, strict=True))
    files = [scene.file for scene in opened]
    for file in filter(None, files[1:]):
        if files[1:].count(file) > 1:
            problem = "is named twice; a scene is compared once (with itself, if it is the first too)"
            raise UsageError(str(file), problem)
    names = [f"scene {place}" if scene.file is None else scene.title for place, scene in enumerate(opened)]
    if len(set(names)) < len({file or place for place, file in enumerate(files)}):
        pairs = zip(names, files, strict=True)
        names = [name if file is None else f"{file.parent.name}/{name}" for name, file in pairs]
    again = [place > 0 and file is not None and file == files[0] for place, file in enumerate(files)]
    names = [name + " again" * same for name, same in zip(names, again, strict=True)]
    return dict(zip(file_names(names, "scene", 1), opened, strict=True))


def _in_one_frame(scenes: dict[str, Scene], options: CompareOptions) -> dict[str, Scene]:
    """The scenes; where a file can be read in two ways and another scene's in one, the reading in that one's frame."""
    certain = next((name for name, scene in scenes.items() if scene.other is None), None)
    if certain is None or all(scene.other is None for scene in scenes.values()):
        return scenes
    reference = usable(scenes[certain].raw(0, scenes[certain].count))

    def fitting(scene: Scene) -> Scene:
        if scene.other is None:
            return scene
        readings = scene.decoded(), scene.other.decoded()
        first, second = (mismatch(reference, usable(reading.raw(0, reading.count))) for reading in readings)
        if (first is None) == (second is None):
            return scene
        reading = readings[first is not None]
        options.monitor.say(f"{scene.title}: {reading.notes[-1].partition(' (')[0]}, as fits {certain}")
        return reading

    return {name: fitting(scene) for name, scene in scenes.items()}


def _rows(scenes: Mapping[str, Scene], options: CompareOptions) -> tuple[ComparedScene, ...]:
    """Facts of the scenes, the reference first; says what they lack."""
    reference, first = next((name, scene.gaussians()) for name, scene in scenes.items())
    rows: list[ComparedScene] = []
    for name, scene in scenes.items():
        gaussians = scene.gaussians()
        frame = mismatch(first, gaussians) if rows else None
        if frame is not None:
            problem = f"is {reference} {frame}"
            if not options.any_frame:
                raise FrameError(name, f"{problem}; bring both into one frame, or pass `any_frame`")
            log.warning("%s: %s", name, problem)
        if gaussians.sh_degree != first.sh_degree:
            degrees = f"{name}: has SH degree {gaussians.sh_degree}, {reference} {first.sh_degree}"
            options.monitor.say(f"{degrees}: what one lacks counts as a difference from 0")
        rows.append(
            ComparedScene(
                name=name,
                file=scene.file and scene.file.name,
                format="levels" if scene.levels is not None else scene.format or None,
                bytes=scene.bytes,
                gaussians=len(gaussians),
                sh_degree=gaussians.sh_degree,
                convention=gaussians.convention.name,
                frame=frame,
                differences=differences(first, gaussians) if rows else None,
            )
        )
    return tuple(rows)


def _by_viewer(viewer: Viewer, renderer: Renderer) -> Renderer:
    """The scene as the viewer draws it."""
    assert renderer.source is not None
    scene = Scene.in_memory(viewer.shown(renderer.source.gaussians()))
    return replace(renderer, source=scene).by(RECIPES[viewer.recipe])


def _facts(
    rows: Sequence[ComparedScene], scenes: Mapping[str, Scene], job: Job[CompareOptions], viewer: Viewer | None
) -> dict[str, Any]:
    """Versions, options and hashes of the inputs, which a journal must agree on besides scales and metrics."""
    options = job.options
    return {
        **environment(),
        "rows": "compared scene",
        "reference": rows[0].name,
        "viewer": viewer and viewer.name,
        "scenes_sha256": {name: digest_of_scene(scene.gaussians()) for name, scene in scenes.items()},
        "cameras": facts_of_cameras(job.cameras, job.views),
        "options": {
            "quality": options.quality,
            "rate_reference": options.rate_reference or "pose",
            "shown": options.show,
        },
        "cull_margin": options.cull_margin if math.isfinite(options.cull_margin) else None,
    }

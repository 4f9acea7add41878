"""Scenes against the first of them: what compression, conversion, pruning or training again costs, at every size."""

import logging
import math
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.digests import digest_of_scene
from aaplug.core.errors import FrameError, UsageError
from aaplug.core.executors import ProcessesIfLong
from aaplug.core.gaussians import Gaussians
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.training import TrainingViews
from aaplug.evaluation.comparison import ComparedScene, Comparison
from aaplug.evaluation.engine import Candidate, Task, evaluate
from aaplug.evaluation.image_store import ImageStore
from aaplug.evaluation.metrics import find_metrics
from aaplug.evaluation.protocols import PROTOCOLS
from aaplug.evaluation.report.comparison_files import COMPARED, write_comparison
from aaplug.evaluation.report.files import PAGE
from aaplug.evaluation.truth import Truth
from aaplug.inspection.alignment import mismatch
from aaplug.inspection.coverage import coverage
from aaplug.inspection.differences import differences
from aaplug.io.atomic import claimed, output_folder
from aaplug.io.cameras import select_views
from aaplug.io.scenes import bytes_of, called, open_scene
from aaplug.io.scenes.scene_file import SceneFile, usable
from aaplug.methods.recipes import RECIPES
from aaplug.methods.viewers import Viewer, find_viewer
from aaplug.options.compare import SIZES, CompareOptions
from aaplug.options.objects import AnyPath
from aaplug.rendering.renderer import Renderer
from aaplug.verbs.agreement import settled
from aaplug.verbs.announce import announce
from aaplug.verbs.assumed import say_assumed
from aaplug.verbs.evaluate import JOURNAL, check_journalled, environment, facts_of_cameras, seconds_of, shown_views
from aaplug.verbs.inputs import (
    CamerasLike,
    Held,
    SceneLike,
    drawn_by,
    file_of,
    look_of,
    opened_and_seen,
    processor,
    recipe_of,
    scheduled,
    shown_of,
    whole_of,
)
from aaplug.verbs.views import file_names

METHOD = replace(
    PROTOCOLS["self"], name="compare", source="the first scene as its recipe draws it at each size", scales=SIZES
)

log = logging.getLogger("aaplug")


@CompareOptions.shown
def compare(
    scenes: Mapping[str, SceneLike | SceneFile] | Sequence[SceneLike | SceneFile],
    cameras: CamerasLike = None,
    output: AnyPath | None = None,
    *,
    drop_bad: bool = False,
    monitor: Monitor = SILENT,
    **options: Any,
) -> Comparison:
    """Compare scenes with the first of them: images at several sizes, files and Gaussians.

    The truth at a size is the first scene as its recipe draws it there.

    Args:
        scenes: two or more, each as `render` takes it; or by the names that the results give them.
        cameras: see `render`; None for the cameras of the first scene's model folder, or an orbit around it.
        drop_bad: see `render`.
        monitor: see `render`.
        output: folder for compare.json, compare.csv, report.html and contact-sheet.png; None writes nothing.
        options: fields of `CompareOptions`.

    Raises:
        FrameError: a scene is turned, scaled or moved against the first, and `any_frame` is false.
        AaplugError: as `render`; also, there are fewer than two scenes, or one is named twice.
    """
    o = CompareOptions.of(options)
    viewer, folder = find_viewer(o.viewer), None if output is None else Path(output)
    check_compared(folder, o)
    metrics = find_metrics([o.metric] if isinstance(o.metric, str) else o.metric, METHOD)
    named = _one_reading(_named(scenes), monitor)
    first, *others = named.values()
    first, cameras = opened_and_seen(first, cameras, monitor)
    seen = select_views(cameras, o.views)
    made = nullcontext() if folder is None else output_folder(folder)
    with processor(o.threads) as workers, made, claimed(folder, lambda: check_compared(folder, o)):
        sources = [first, *(s if isinstance(s, Held) else settled(s, cameras, monitor) for s in others)]
        held = [shown_of(source, drop_bad) for source in sources]
        rows = _rows(dict(zip(named, zip(sources, held, strict=True), strict=True)), o.any_frame, monitor)
        look = look_of(held[0], cameras, len(seen) * len(o.scale) * len(held), o, monitor)
        say_assumed(cameras, monitor, look)
        looks = [look, *(_look_of(scene, look, cameras, o) for scene in held[1:])]
        recipe = recipe_of(o.recipe, o)
        own = [drawn_by(recipe, scene, each) for scene, each in zip(held, looks, strict=True)]
        drawn = [_drawn(viewer, scene, renderer) for scene, renderer in zip(held, own, strict=True)]
        candidates = [Candidate(name, renderer) for name, renderer in zip(named, drawn, strict=True)]
        task = Task(candidates, o.scale, seen, Truth(own[0], "reference", METHOD), metrics, ceiling=False)
        sized = [view.scaled(scale) for view in seen for scale in o.scale]
        announce(drawn, sized, monitor, seconds=seconds_of(task, sized), processes=workers)
        images = folder and ImageStore(folder, shown_views(o.show, seen))
        facts = _facts(rows, held, cameras, seen, viewer, o)
        with scheduled(o, folder, monitor) as cluster, monitor.progress("comparing", "views") as tell:
            pool = cluster or ProcessesIfLong(workers)
            report = evaluate(task, facts, tell, folder and folder / JOURNAL, o.resume, images, pool.map)
        found = Comparison(rows, report)
        if folder and images:
            bounds = coverage(whole_of(held[0]), look.training, found.report.scales)
            for path in write_comparison(found, task, folder, bounds, images, o.overwrite or o.resume):
                monitor.say(f"wrote {path}")
    return found


def check_compared(folder: Path | None, o: CompareOptions) -> None:
    """Refuse, before any work, what needs a folder, contradicts itself or would replace results."""
    check_journalled(folder, (*COMPARED, PAGE), "a comparison", o.resume, o.overwrite)


def _named(
    scenes: Mapping[str, SceneLike | SceneFile] | Sequence[SceneLike | SceneFile],
) -> dict[str, Held | SceneFile]:
    """The scenes by name, their files opened; without names they get those of their files."""
    given = list(scenes.values() if isinstance(scenes, Mapping) else scenes)
    if len(given) < 2:
        raise UsageError("compare", f"needs two scenes or more, got {len(given)}; the first is what others are held to")
    opened = [scene if isinstance(scene, Held | SceneFile) else open_scene(scene) for scene in given]
    if isinstance(scenes, Mapping):
        return dict(zip(scenes, opened, strict=True))
    files = [file_of(scene) for scene in opened]
    for file in filter(None, files[1:]):
        if files[1:].count(file) > 1:
            raise UsageError(
                str(file), "is named twice; a scene is compared once (with itself, if it is the first too)"
            )
    names = [f"scene {place}" if file is None else called(file) for place, file in enumerate(files)]
    if len(set(names)) < len({file or place for place, file in enumerate(files)}):
        names = [
            name if file is None else f"{file.parent.name}/{name}" for name, file in zip(names, files, strict=True)
        ]
    itself = [place > 0 and file is not None and file == files[0] for place, file in enumerate(files)]
    names = [name + " again" * same for name, same in zip(names, itself, strict=True)]
    return dict(zip(file_names(names, "scene", 1), opened, strict=True))


def _one_reading(scenes: dict[str, Held | SceneFile], monitor: Monitor) -> dict[str, Held | SceneFile]:
    """The scenes; where a file can be read in two ways and another scene's in one, the reading in that one's frame."""
    sure = next((name for name, s in scenes.items() if not (isinstance(s, SceneFile) and s.other)), None)
    if sure is None or not any(isinstance(s, SceneFile) and s.other for s in scenes.values()):
        return scenes
    known = _usable(scenes[sure])

    def one(scene: Held | SceneFile) -> Held | SceneFile:
        if not isinstance(scene, SceneFile) or scene.other is None:
            return scene
        readings = scene.held(), scene.other.held()
        odd, fits = (mismatch(known, _usable(reading)) for reading in readings)
        if (odd is None) == (fits is None):
            return scene
        chosen = readings[odd is not None]
        monitor.say(f"{scene.path.name}: {chosen.notes[-1].partition(' (')[0]}, as fits {sure}")
        return chosen

    return {name: one(scene) for name, scene in scenes.items()}


def _usable(scene: Held | SceneFile) -> Gaussians:
    return usable(scene.raw(0, scene.count)) if isinstance(scene, SceneFile) else whole_of(scene)


def _rows(
    scenes: Mapping[str, tuple[Held | SceneFile, Held]], any_frame: bool, monitor: Monitor
) -> tuple[ComparedScene, ...]:
    """What the scenes are, by name, the reference first; says what they lack."""
    (reference, (_, first)), known = next(iter(scenes.items())), list[ComparedScene]()
    for name, (source, held) in scenes.items():
        scene, file = whole_of(held), file_of(source)
        odd = mismatch(whole_of(first), scene) if known else None
        if odd is not None:
            problem = f"is {reference} {odd}"
            if not any_frame:
                raise FrameError(name, f"{problem}; bring both into one frame, or pass `any_frame`")
            log.warning("%s: %s", name, problem)
        if scene.sh_degree != (degree := whole_of(first).sh_degree):
            told = f"{name}: has SH degree {scene.sh_degree}, {reference} {degree}"
            monitor.say(f"{told}: what one lacks counts as a difference from 0")
        known.append(
            ComparedScene(
                name=name,
                file=file and file.name,
                format="levels" if scene is not held else scene.origin and scene.origin.format,
                bytes=file and bytes_of(file),
                gaussians=len(scene),
                sh_degree=scene.sh_degree,
                convention=scene.convention.name,
                frame=odd,
                differences=differences(whole_of(first), scene) if known else None,
            )
        )
    return tuple(known)


def _look_of(scene: Held, look: Renderer, cameras: CameraSet, o: CompareOptions) -> Renderer:
    """Another scene as training showed it, with all else as in the first one's look."""
    return replace(look, training=TrainingViews.of(whole_of(scene), cameras, o.cull_margin, o.min_seen))


def _drawn(viewer: Viewer | None, scene: Held, own: Renderer) -> Renderer:
    """A scene as the viewer draws it; without one, by its own recipe."""
    return own if viewer is None else drawn_by(RECIPES[viewer.recipe], viewer.shown(whole_of(scene)), own)


def _facts(
    rows: Sequence[ComparedScene],
    held: Sequence[Held],
    cameras: CameraSet,
    views: Sequence[Camera],
    viewer: Viewer | None,
    o: CompareOptions,
) -> dict[str, Any]:
    """What a journal must agree on besides scales and metrics."""
    hashes = [digest_of_scene(whole_of(scene)) for scene in held]
    return {
        **environment(),
        "rows": "compared scene",
        "reference": rows[0].name,
        "viewer": viewer and viewer.name,
        "scenes_sha256": {row.name: value for row, value in zip(rows, hashes, strict=True)},
        "cameras": facts_of_cameras(cameras, views),
        "options": {"quality": o.quality, "rate_reference": o.rate_reference or "pose", "shown": o.show},
        "cull_margin": o.cull_margin if math.isfinite(o.cull_margin) else None,
    }

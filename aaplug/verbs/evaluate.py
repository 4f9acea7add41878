"""Recipes measured at several scales, against photographs or the scene's own supersampled look."""

import math
import platform
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.choices import USER_RECIPES, metric_option
from aaplug.core.digests import digest_of_cameras, digest_of_files, digest_of_scene
from aaplug.core.errors import OutputError, UsageError, not_one_of
from aaplug.core.gaussians import Gaussians
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.pyramids import Pyramid
from aaplug.evaluation.engine import Task, candidates_of
from aaplug.evaluation.engine import evaluate as measure
from aaplug.evaluation.image_store import ImageStore
from aaplug.evaluation.metric import Metric
from aaplug.evaluation.metrics import default_metrics, find_metrics
from aaplug.evaluation.protocols import PROTOCOLS, LpipsFlavour, Protocol, SsimFlavour, TruthSource
from aaplug.evaluation.report.files import PAGE, RESULTS, write_page, write_results
from aaplug.evaluation.results import Report
from aaplug.evaluation.truth import Truth, source_of
from aaplug.inspection.coverage import coverage
from aaplug.io.atomic import claimed, output_folder, refuse_existing
from aaplug.io.cameras import select_views
from aaplug.methods.recipe import Recipe
from aaplug.methods.recipes import RECIPES, suited
from aaplug.options.evaluate import ALL, EvaluateOptions, Layout
from aaplug.options.objects import AnyPath
from aaplug.rendering.cost import comparing, cost_of
from aaplug.verbs.announce import announce
from aaplug.verbs.assumed import say_assumed
from aaplug.verbs.inputs import (
    CamerasLike,
    Held,
    SceneLike,
    inputs_of,
    look_of,
    processor,
    recipe_of,
    scheduled,
    whole_of,
)

FLAVOURS = {"ssim": get_args(SsimFlavour), "lpips": get_args(LpipsFlavour)}
JOURNAL = "progress.jsonl"
PACKAGES = ("aaplug", "torch", "numpy", "opencv-contrib-python-headless")


@EvaluateOptions.shown
def evaluate(
    scene: SceneLike,
    cameras: CamerasLike = None,
    output: AnyPath | None = None,
    *,
    name: str | None = None,
    monitor: Monitor = SILENT,
    **options: Any,
) -> Report:
    """Measure recipes at several scales.

    Args:
        scene: see `render`.
        cameras: see `render`.
        monitor: see `render`.
        output: folder for results.json, per_view.json and results.csv; None writes nothing.
        name: the scene's name in the results; None for its file's.
        options: fields of `EvaluateOptions`.

    Raises:
        AaplugError: as `render`.
    """
    o = EvaluateOptions.of(options)
    folder = None if output is None else Path(output)
    check_results(folder, o)
    name = name or Path(whole_of(scene).name if isinstance(scene, Held) else scene).stem
    metrics, rules = _metrics(o)
    if o.background == "auto" and rules.background is not None:
        o = replace(o, background=rules.background)
    scene, cameras = inputs_of(scene, cameras, monitor)
    finest = whole_of(scene)
    recipes = _recipes(o, finest, monitor)
    seen, scales = select_views(cameras, o.views), o.scale or rules.scales
    shown = shown_views(o.show, seen) if o.report else ()
    source = _source(o.truth, rules, seen, monitor)
    facts = _facts(scene.scene if isinstance(scene, Pyramid) else scene, cameras, seen, source, o)
    images = folder and ImageStore(folder, shown, everything=o.layout == "inria")
    made = nullcontext() if folder is None else output_folder(folder)
    with processor(o.threads), made, claimed(folder, lambda: check_results(folder, o)):
        look = look_of(scene, cameras, len(seen) * len(recipes) * len(scales), o, monitor)
        say_assumed(cameras, monitor, look)
        candidates = candidates_of(scene, look.training, recipes, look.rasterizer, look.background)
        task = Task(candidates, scales, seen, Truth(look, source, rules), metrics)
        drawn = [view.scaled(scale) if rules.change == "size" else view for view in seen for scale in scales]
        announce([candidate.renderer for candidate in candidates], drawn, monitor, seconds=seconds_of(task, drawn))
        with scheduled(o, folder, monitor) as cluster, monitor.progress(f"evaluating {name}", "views") as tell:
            apply = cluster.map if cluster else map
            found = measure(task, facts, tell, folder and folder / JOURNAL, o.resume, images, apply)
        if folder and images:
            replaces = o.overwrite or o.resume
            written = write_results(found, folder, replaces, name)
            if o.report:
                bounds = coverage(finest, look.training, found.scales)
                written += write_page(folder, name, found, bounds, images, replaces)
            for path in written:
                monitor.say(f"wrote {path}")
    return found


def seconds_of(task: Task, drawn: Sequence[Camera]) -> float:
    """An estimate: every candidate's images, the truths, which are as fine as training, and their comparison."""
    truths = [*task.views] * (1 if task.truth.protocol.change == "size" else len(task.scales))
    rendering = cost_of([c.renderer for c in task.candidates], drawn), cost_of([task.truth.own], truths)
    return sum(cost.seconds for cost in rendering) + comparing(drawn, len(task.names))


def environment() -> dict[str, Any]:
    """What results depend on besides inputs and options."""
    versions = {name: version(name) for name in PACKAGES} | {"python": platform.python_version()}
    return {"versions": versions, "platform": f"{platform.system()} {platform.machine()}"}


def facts_of_cameras(cameras: CameraSet, views: Sequence[Camera]) -> dict[str, Any]:
    """What cameras and views were read."""
    return {
        "notes": list(cameras.notes),
        "sha256": digest_of_cameras(views),
        "training_sha256": digest_of_cameras(cameras.train),
    }


def check_results(folder: Path | None, o: EvaluateOptions) -> None:
    """Refuse, before any work, what needs a folder, contradicts itself or would replace results."""
    if o.layout not in get_args(Layout):
        raise UsageError("layout", not_one_of(o.layout, get_args(Layout)))
    for parameter, given in {"report": o.report, "layout": o.layout != "plain"}.items():
        if given and folder is None:
            raise UsageError(parameter, "needs a folder; give `output`")
    check_journalled(folder, (*RESULTS, PAGE) if o.report else RESULTS, "an evaluation", o.resume, o.overwrite)


def check_journalled(folder: Path | None, files: Sequence[str], what: str, resume: bool, overwrite: bool) -> None:
    """Refuse to resume without a folder, and to replace in it a journal of `what` or any of the files unasked."""
    if resume and folder is None:
        raise UsageError("resume", "needs a folder; give `output`")
    if resume and overwrite:
        raise UsageError("resume", "and `overwrite` contradict each other; give one")
    if folder is None or overwrite or resume:
        return
    if (folder / JOURNAL).exists():
        raise OutputError(folder, f"holds {what}; `resume` continues it, `overwrite` starts anew")
    refuse_existing([folder / name for name in files], overwrite=False)


def _metrics(o: EvaluateOptions) -> tuple[list[Metric], Protocol]:
    """Metrics by name, and the protocol with the flavours that the names ask for; weights add LPIPS."""
    protocol = PROTOCOLS.find(o.protocol, "protocol") if isinstance(o.protocol, str) else o.protocol
    names = (o.metric,) if isinstance(o.metric, str) else o.metric
    chosen = list(default_metrics(protocol) if names is None else names)
    if o.lpips is not None and not any(metric_option(n).startswith("lpips") for n in chosen):
        chosen.append("lpips")
    parts = [metric_option(name).partition(":") for name in chosen]
    for metric, colon, flavour in parts:
        if colon and flavour not in FLAVOURS.get(metric, ()):
            known = [f"{name}:{f}" for name in FLAVOURS for f in FLAVOURS[name]]
            raise UsageError("metric", not_one_of(f"{metric}:{flavour}", known))
    protocol = replace(protocol, **{metric: flavour for metric, _, flavour in parts if flavour})
    files = None if o.lpips is None else (Path(o.lpips[0]), Path(o.lpips[1]))
    return find_metrics([metric for metric, _, _ in parts], protocol, files), protocol


def _recipes(o: EvaluateOptions, scene: Gaussians, monitor: Monitor) -> list[Recipe]:
    """The recipes with the user's choices; of "all", those that the scene has everything for."""
    names = [o.recipe] if isinstance(o.recipe, str) else o.recipe
    if ALL not in names:
        return [suited(_recipe(name, o), scene) for name in names]
    fitting = []
    for recipe in (_recipe(name, o) for name in RECIPES):
        if missing := recipe.lacks(scene):
            monitor.say(f"recipe {recipe.name} left out: {missing}")
        else:
            fitting.append(suited(recipe, scene))
    return fitting


def _recipe(recipe: str | Recipe, o: EvaluateOptions) -> Recipe:
    """A recipe with the user's choices; research recipes keep their own rate reference, which is what they compare."""
    return recipe_of(recipe, o if recipe in USER_RECIPES else replace(o, rate_reference=None))


def shown_views(text: str, views: Sequence[Camera]) -> tuple[int, ...]:
    """Places of the views in the report's viewer: that many, evenly spread, or those named."""
    if text.isdecimal():
        count = min(int(text), len(views))
        return tuple(i * len(views) // count for i in range(count))
    places = {view.name: place for place, view in enumerate(views)}
    unknown = [name for name in text.split(",") if name not in places]
    if unknown:
        raise UsageError("show", f"there is no view '{unknown[0]}' among those evaluated")
    return tuple(places[name] for name in text.split(","))


def _source(truth: str, protocol: Protocol, views: Sequence[Camera], monitor: Monitor) -> TruthSource:
    asked = protocol.truth or "auto" if truth == "auto" else truth
    source = source_of(views, asked)
    if asked == "auto":
        monitor.say(f"truth: {source}{' (not every view has a photograph)' * (source == 'self')}")
    return source


def _facts(
    scene: Gaussians, cameras: CameraSet, views: Sequence[Camera], truth: TruthSource, o: EvaluateOptions
) -> dict[str, Any]:
    """What a journal must agree on besides scales, recipes and metrics: versions, options, hashes of what was read."""
    photos = [view.photo for view in views if view.photo] if truth == "photographs" else []
    origin = scene.origin
    return {
        **environment(),
        "scene": {
            "file": origin and Path(origin.path).name,
            "sha256": digest_of_files([origin.path]) if origin and Path(origin.path).is_file() else None,
            "gaussians": len(scene),
            "gaussians_sha256": digest_of_scene(scene),
            "convention": scene.convention.name,
            "evidence": origin and origin.evidence,
        },
        "cameras": facts_of_cameras(cameras, views),
        "photographs": {"count": len(photos), "sha256": digest_of_files(photos) if photos else None},
        "options": {
            "quality": o.quality,
            "rate_reference": o.rate_reference or "pose",
            "shown": o.show if o.report else None,
            "layout": o.layout,
        },
        "cull_margin": o.cull_margin if math.isfinite(o.cull_margin) else None,
    }

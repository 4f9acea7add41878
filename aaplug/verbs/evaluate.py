"""Recipes measured at several scales, against photographs or the scene's own supersampled look."""

import math
import platform
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

from aaplug.core.cameras import Camera, CameraSet, digest_of_cameras
from aaplug.evaluation import PROTOCOLS
from aaplug.evaluation.coverage import coverage
from aaplug.evaluation.engine import Task, candidates_of
from aaplug.evaluation.engine import evaluate as measure
from aaplug.evaluation.image_store import ImageStore
from aaplug.evaluation.metric import Metric
from aaplug.evaluation.metrics import default_metrics, find_metrics
from aaplug.evaluation.protocols import LpipsFlavour, Protocol, SsimFlavour, TruthSource
from aaplug.evaluation.report.files import PAGE, RESULTS, write_page, write_results
from aaplug.evaluation.results import Report
from aaplug.evaluation.truth import Truth, source_of
from aaplug.io.atomic import refuse_existing
from aaplug.io.scenes import SceneLike
from aaplug.methods import RECIPES
from aaplug.methods.recipe import Recipe
from aaplug.methods.recipes import suited
from aaplug.options.shared import AnyPath, metric_option
from aaplug.options.verbs import ALL, EvaluateOptions, Layout
from aaplug.rendering.cost import Cost, comparing, cost_of
from aaplug.rendering.job import CamerasLike, Job, running
from aaplug.system.digests import digest_of_files
from aaplug.system.errors import OutputError, UsageError, not_one_of
from aaplug.verbs.verb import writes

FLAVOURS = {"ssim": get_args(SsimFlavour), "lpips": get_args(LpipsFlavour)}
JOURNAL = "progress.jsonl"
PACKAGES = ("aaplug", "torch", "numpy", "opencv-contrib-python-headless")


@writes(EvaluateOptions)
def evaluate(scene: SceneLike, cameras: CamerasLike, output: AnyPath | None, options: EvaluateOptions) -> Report:
    """Measure recipes at several scales.

    Args:
        scene: see `render`.
        cameras: see `render`.
        output: folder for results.json, per_view.json and results.csv; None writes nothing.

    Raises:
        AaplugError: as `render`.
    """
    folder = None if output is None else Path(output)
    check_results(folder, options)
    metrics, protocol = _metrics(options)
    if options.background == "auto" and protocol.background is not None:
        options = replace(options, background=protocol.background)
    job = Job.of(scene, cameras, options)
    name = options.name or Path(job.scene.title).stem
    recipes, views, scales = _recipes(job), job.views, options.scale or protocol.scales
    report_views = views_in_report(options.show, views) if options.report else ()
    source = _truth_source(job, protocol)
    facts = _facts(job, source)
    images = folder and ImageStore(folder, report_views, everything=options.layout == "inria")
    with running(options, folder, lambda: check_results(folder, options), job.inputs, folder=True) as workers:
        look = job.look(len(views) * len(recipes) * len(scales))
        job.say_assumed(look)
        candidates = candidates_of(job.scene, look.training, recipes, look.rasterizer, look.background)
        task = Task(candidates, scales, views, Truth(look, source, protocol), metrics)
        sized = [view.scaled(scale) if protocol.change == "size" else view for view in views for scale in scales]
        job.announce([candidate.renderer for candidate in candidates], sized, cost=cost_of_task(task, sized))
        apply = workers.cluster.map if workers.cluster else map
        with job.monitor.progress(f"evaluating {name}", "views") as tell:
            report = measure(task, facts, tell, folder and folder / JOURNAL, options.resume, images, apply)
        if folder and images:
            replaces = options.overwrite or options.resume
            files = write_results(report, folder, replaces, name)
            if options.report:
                bounds = coverage(job.scene.gaussians(), look.training, report.scales)
                files += write_page(folder, name, report, bounds, images, replaces)
            for file in files:
                job.monitor.say(f"wrote {file}")
    return report


def cost_of_task(task: Task, sized: Sequence[Camera]) -> Cost:
    """An estimate: every candidate's images, the truths, which are as fine as training, and their comparison."""
    truths = [*task.views] * (1 if task.truth.protocol.change == "size" else len(task.scales))
    images, truth = cost_of([c.renderer for c in task.candidates], sized), cost_of([task.truth.renderer], truths)
    seconds = images.seconds + truth.seconds + comparing(sized, len(task.names))
    return images._replace(seconds=seconds)


def environment() -> dict[str, Any]:
    """Versions and platform, which results depend on besides inputs and options."""
    versions = {name: version(name) for name in PACKAGES} | {"python": platform.python_version()}
    return {"versions": versions, "platform": f"{platform.system()} {platform.machine()}"}


def facts_of_cameras(cameras: CameraSet, views: Sequence[Camera]) -> dict[str, Any]:
    """Notes and hashes of the cameras and views that were read."""
    return {
        "notes": list(cameras.notes),
        "sha256": digest_of_cameras(views),
        "training_sha256": digest_of_cameras(cameras.train),
    }


def check_results(folder: Path | None, options: EvaluateOptions) -> None:
    """Refuse, before any work, what needs a folder, contradicts itself or would replace results."""
    if options.layout not in get_args(Layout):
        raise UsageError("layout", not_one_of(options.layout, get_args(Layout)))
    for parameter, asked in {"report": options.report, "layout": options.layout != "plain"}.items():
        if asked and folder is None:
            raise UsageError(parameter, "needs a folder; give `output`")
    check_journalled(
        folder, (*RESULTS, PAGE) if options.report else RESULTS, "an evaluation", options.resume, options.overwrite
    )


def check_journalled(folder: Path | None, files: Sequence[str], what: str, resume: bool, overwrite: bool) -> None:
    """Refuse to resume without a folder, and to replace in it a journal of `what` or any of the files unasked."""
    if resume and folder is None:
        raise UsageError("resume", "needs a folder; give `output`")
    if resume and overwrite:
        raise UsageError("resume", "and `overwrite` contradict each other; give one")
    if folder is None:
        return
    if (folder / JOURNAL).exists() and not (overwrite or resume):
        raise OutputError(folder, f"holds {what}; `resume` continues it, `overwrite` starts anew")
    refuse_existing([folder / name for name in (JOURNAL, *files)], overwrite or resume)


def _metrics(options: EvaluateOptions) -> tuple[list[Metric], Protocol]:
    """Metrics by name, and the protocol with the flavours that the names ask for; weights add LPIPS."""
    protocol = options.protocol
    protocol = PROTOCOLS.find(protocol, "protocol") if isinstance(protocol, str) else protocol
    names = (options.metric,) if isinstance(options.metric, str) else options.metric
    names = list(default_metrics(protocol) if names is None else names)
    if options.lpips is not None and not any(metric_option(name).startswith("lpips") for name in names):
        names.append("lpips")
    parts = [metric_option(name).partition(":") for name in names]
    for metric, colon, flavour in parts:
        if colon and flavour not in FLAVOURS.get(metric, ()):
            flavours = [f"{name}:{f}" for name in FLAVOURS for f in FLAVOURS[name]]
            raise UsageError("metric", not_one_of(f"{metric}:{flavour}", flavours))
    protocol = replace(protocol, **{metric: flavour for metric, _, flavour in parts if flavour})
    weights = None if options.lpips is None else (Path(options.lpips[0]), Path(options.lpips[1]))
    return find_metrics([metric for metric, _, _ in parts], protocol, weights), protocol


def _recipes(job: Job[EvaluateOptions]) -> list[Recipe]:
    """The recipes with the user's choices; of "all", those that the scene has everything for."""
    choice, gaussians = job.options.recipe, job.scene.gaussians()
    names = [choice] if isinstance(choice, str) else choice
    if ALL not in names:
        return [suited(job.recipe(name), gaussians) for name in names]
    fitting = []
    for recipe in map(job.recipe, RECIPES):
        if lack := recipe.lacks(gaussians):
            job.monitor.say(f"recipe {recipe.name} left out: {lack}")
        else:
            fitting.append(suited(recipe, gaussians))
    return fitting


def views_in_report(text: str, views: Sequence[Camera]) -> tuple[int, ...]:
    """Places of the views in the report's viewer: that many, evenly spread, or those named."""
    if text.isdecimal():
        count = min(int(text), len(views))
        return tuple(i * len(views) // count for i in range(count))
    places = {view.name: place for place, view in enumerate(views)}
    unknown = [name for name in text.split(",") if name not in places]
    if unknown:
        raise UsageError("show", f"there is no view '{unknown[0]}' among those evaluated")
    return tuple(places[name] for name in text.split(","))


def _truth_source(job: Job[EvaluateOptions], protocol: Protocol) -> TruthSource:
    asked = protocol.truth or "auto" if job.options.truth == "auto" else job.options.truth
    source = source_of(job.views, asked)
    if asked == "auto":
        job.monitor.say(f"truth: {source}{' (not every view has a photograph)' * (source == 'self')}")
    return source


def _facts(job: Job[EvaluateOptions], truth: TruthSource) -> dict[str, Any]:
    """Versions, options and hashes of the inputs, which a journal must agree on besides scales, recipes and metrics."""
    photos = [view.photo for view in job.views if view.photo] if truth == "photographs" else []
    scene, options = job.scene, job.options
    gaussians = scene.gaussians() if scene.levels is None else scene.levels.scene
    origin = gaussians.origin
    return {
        **environment(),
        "scene": {
            "file": origin and Path(origin.path).name,
            "sha256": digest_of_files([origin.path]) if origin and Path(origin.path).is_file() else None,
            "gaussians": len(gaussians),
            "gaussians_sha256": scene.digest,
            "convention": gaussians.convention.name,
            "evidence": origin and origin.evidence,
        },
        "cameras": facts_of_cameras(job.cameras, job.views),
        "photographs": {"count": len(photos), "sha256": digest_of_files(photos) if photos else None},
        "options": {
            "quality": options.quality,
            "rate_reference": options.rate_reference or "pose",
            "shown": options.show if options.report else None,
            "layout": options.layout,
        },
        "cull_margin": options.cull_margin if math.isfinite(options.cull_margin) else None,
    }

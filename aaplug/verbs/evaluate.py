"""Recipes measured at several scales, against photographs or the scene's own supersampled look."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from aaplug.evaluation import PROTOCOLS
from aaplug.evaluation.engine import Task, facts_of, renderers_of
from aaplug.evaluation.engine import evaluate as measure
from aaplug.evaluation.image_store import ImageStore
from aaplug.evaluation.journal import JOURNAL
from aaplug.evaluation.metrics import find_metrics
from aaplug.evaluation.report.files import PAGE, RESULTS, as_json, remove_run, write_page, write_texts
from aaplug.evaluation.results import Report, as_csv, per_view, results
from aaplug.evaluation.truth import Truth, source_of
from aaplug.finetuning.poses import refined
from aaplug.io.atomic import AnyPath, check_name, refuse_existing
from aaplug.options.verbs import EvaluateOptions
from aaplug.rendering.job import CamerasLike, Job, running
from aaplug.system.digests import digest_of_files
from aaplug.system.errors import RESUME_OR_OVERWRITE, OutputError, UsageError, counted
from aaplug.verbs.verb import SceneLike, writes


@writes(EvaluateOptions)
def evaluate(scene: SceneLike, cameras: CamerasLike, output: AnyPath | None, options: EvaluateOptions) -> Report:
    """Measure recipes at several scales.

    Args:
        scene: see `render`; of a scene in time each view counts at every frame, without its photograph.
        cameras: see `render`.
        output: folder for results.json, per_view.json and results.csv; None writes nothing.

    Raises:
        AaplugError: as `render`.
    """
    folder, replaces = None if output is None else Path(output), options.overwrite or options.resume
    check = partial(check_results, folder, options.resume, options.overwrite, options.report, options.layout)
    check()
    protocol = options.protocol
    protocol = PROTOCOLS.find(protocol, "protocol") if isinstance(protocol, str) else protocol
    metrics = find_metrics(options.metric, protocol, options.lpips)
    if protocol.background is not None and options.background == "auto":
        options = replace(options, background=protocol.background)
    job = Job.of(scene, cameras, options)
    name = options.name or Path(job.scene.title).stem
    recipes, views, scales = job.recipes(options.recipe), job.views, options.scale or protocol.scales
    truth = protocol.truth or "auto" if options.truth == "auto" else options.truth
    source = source_of(views, truth, protocol)
    if truth == "auto":
        photos = f"{sum(view.photo is not None for view in views):,} of {counted(len(views), 'view')} with a photograph"
        job.monitor.say(f"truth: {source}{f' ({photos})' * (source == 'self')}")
    if options.poses and source != "photographs":
        raise UsageError("poses", "are refined on photographs, and the truth is the scene itself: leave out `poses`")
    everything, show = options.layout == "inria", options.show if options.report else "0"
    images = None if folder is None else ImageStore.of(folder, show, views, everything)
    with running(options, folder, check, job.inputs, folder=True) as workers:
        frames = len(views) * len(recipes) * len(scales)
        look = job.look(frames, gradients=options.poses)
        if options.poses:
            job = replace(job, cameras=refined(look, job.cameras, views, job.monitor)[0])
            look, views = job.second_look(look), job.views
        renderers = renderers_of(look, recipes)
        task = Task(renderers, scales, views, Truth(look, source, protocol), metrics)
        job.announce([*task.renderers.values()], task.sized_views, cost=task.cost)
        job.say_assumed(look)
        with job.monitor.progress(f"evaluating {name}", "views") as tell:
            choices = options.choices | {"shown": options.show if options.report else None, "layout": options.layout}
            whole = job.scene.gaussians() if job.scene.levels is None else job.scene.levels.scene
            file = whole.origin and Path(whole.origin.path)
            about = {
                "file": file and file.name,
                "sha256": digest_of_files([file]) if file and file.is_file() else None,
                "gaussians": len(whole),
                "gaussians_sha256": job.scene.digest,
                "convention": whole.convention.name,
                "evidence": whole.origin and whole.origin.evidence,
            }
            facts = {**facts_of(task, job.cameras.notes), "scene": about, "options": choices}
            apply = workers.cluster.map if workers.cluster else map
            if folder and options.overwrite:
                remove_run(folder)
            report = measure(task, facts, tell, folder and folder / JOURNAL, options.resume, images, apply)
        if folder and images:
            texts = as_json(results(report)), as_json(per_view(report)), as_csv({name: report})
            files = write_texts(folder, dict(zip(RESULTS, texts, strict=True)), replaces)
            if options.report:
                bounds = task.coverage(job.scene.gaussians(), look.training)
                files += write_page(name, report, bounds, images, replaces)
            for written in files:
                job.monitor.say(f"wrote {written}")
    return report


def check_results(
    folder: Path | None, resume: bool, overwrite: bool, report: bool = False, layout: str = "plain"
) -> None:
    """Refuse, before any work, what needs a folder, contradicts itself or would replace results."""
    files = (*RESULTS, PAGE) if report else RESULTS
    check_journalled(folder, files, "an evaluation", resume, overwrite, report=report, layout=layout != "plain")


def check_journalled(
    folder: Path | None, files: Sequence[str], what: str, resume: bool, overwrite: bool, **asked: bool
) -> None:
    """Refuse to replace in a folder a journal of `what` or any of the files unasked, and to do without one.

    asked: whether other options ask for something in the folder.
    """
    if resume and overwrite:
        raise UsageError("resume", RESUME_OR_OVERWRITE)
    if folder is None:
        for option in [name for name, is_asked in (*asked.items(), ("resume", resume)) if is_asked]:
            raise UsageError(option, "needs a folder; give `output`")
        return
    check_name(folder)
    if (folder / JOURNAL).exists() and not (overwrite or resume):
        raise OutputError(folder, f"holds {what}; `resume` continues it, `overwrite` starts anew")
    refuse_existing([folder / name for name in (JOURNAL, *files)], overwrite or resume)

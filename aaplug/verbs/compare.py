"""Scenes against the first of them: what compression, conversion, pruning or training again costs, at every size."""

from dataclasses import replace
from functools import partial
from pathlib import Path

from aaplug.evaluation import PROTOCOLS
from aaplug.evaluation.comparison import Comparison, compared_scenes, in_one_frame, named_scenes
from aaplug.evaluation.engine import Task, evaluate, facts_of
from aaplug.evaluation.image_store import ImageStore
from aaplug.evaluation.journal import JOURNAL
from aaplug.evaluation.metrics import PSNR, find_metrics
from aaplug.evaluation.report.contact_sheet import sheet_of
from aaplug.evaluation.report.files import COMPARED, PAGE, as_json, remove_run, write_page, write_texts
from aaplug.evaluation.results import as_csv
from aaplug.evaluation.truth import Truth
from aaplug.io.images import write_png
from aaplug.methods.presets import recipe_of
from aaplug.methods.viewers import find_viewer
from aaplug.options.verbs import COMPARED_SCALES, CompareOptions
from aaplug.rendering.job import CamerasLike, Job, running
from aaplug.rendering.renderer import Renderer
from aaplug.verbs.evaluate import check_journalled
from aaplug.verbs.verb import AnyPath, ScenesLike, compares

SOURCE = "the first scene as its recipe draws it at each size"
PROTOCOL = replace(PROTOCOLS["self"], name="compare", source=SOURCE, scales=COMPARED_SCALES)


@compares(CompareOptions)
def compare(scenes: ScenesLike, cameras: CamerasLike, output: AnyPath | None, options: CompareOptions) -> Comparison:
    """Compare scenes with the first of them: images at several sizes, files and Gaussians.

    The truth at a size is the first scene as its recipe draws it there.

    Args:
        scenes: two or more, each as `render` takes it; or by the names that the results give them.
        cameras: see `render`; None for the first scene's own, or an orbit around it.
        output: folder for compare.json, compare.csv, report.html and contact-sheet.png; None writes nothing.

    Raises:
        FrameError: a scene is turned, scaled or moved against the first, and `any_frame` is false.
        AaplugError: as `render`; also, there are fewer than two scenes.
    """
    folder, viewer = None if output is None else Path(output), find_viewer(options.viewer)
    check = partial(check_compared, folder, options.resume, options.overwrite, options.show)
    check()
    metrics, say = find_metrics(options.metric, PROTOCOL), options.monitor.say
    named = in_one_frame(named_scenes(scenes), say)
    job = Job.of(next(iter(named.values())), cameras, options)
    named = in_one_frame(named | {next(iter(named)): job.scene}, say)  # whose reading cameras may have told
    rows = compared_scenes(named, options.any_frame, say)
    views, scales = job.views, options.scale
    images = None if folder is None else ImageStore.of(folder, options.show, views)
    inputs = [*job.inputs, *(file for scene in named.values() for file in scene.files)]
    with running(options, folder, check, inputs, folder=True) as workers:
        look = job.look(len(views) * len(scales) * len(rows))
        [recipe], same = job.named(options.recipe), {"rasterizer": look.rasterizer, "background": look.background}
        renderers = [
            Renderer.of(s, job.cameras, recipe, **same, cull_margin=options.cull_margin, min_seen=options.min_seen)
            for s in named.values()
        ]
        truth = Truth(renderers[0], "reference", PROTOCOL)
        if viewer is not None:
            recipe, pairs = recipe_of(viewer), zip(named.values(), renderers, strict=True)
            renderers = [Renderer.of(viewer.shown(s.gaussians()), r.training, recipe, **same) for s, r in pairs]
        task = Task(dict(zip(named, renderers, strict=True)), scales, views, truth, metrics, ceiling=False)
        job.announce([*task.renderers.values()], task.sized_views, cost=task.cost, processes=workers.threads)
        job.say_assumed(look)
        with job.monitor.progress("comparing", "views") as tell:
            facts = facts_of(task, job.cameras.notes) | {
                "rows": "compared scene",
                "reference": rows[0].name,
                "viewer": viewer and viewer.name,
                "scenes_sha256": {name: scene.digest for name, scene in named.items()},
                "options": options.choices | {"shown": options.show},
            }
            if folder and options.overwrite:
                remove_run(folder)
            report = evaluate(task, facts, tell, folder and folder / JOURNAL, options.resume, images, workers.pool.map)
        comparison = Comparison(rows, report)
        if folder and images:
            bounds = task.coverage(job.scene.gaussians(), look.training)
            replaces = options.overwrite or options.resume
            data, table, sheet = COMPARED
            texts = {data: as_json(comparison.summary()), table: as_csv({rows[0].name: report})}
            files = write_texts(folder, texts, replaces)
            title = f"{rows[0].name} and {', '.join(scene.name for scene in rows[1:])}"
            files += write_page(title, report, bounds, images, replaces, comparison.facts())
            others = dict([*task.renderers.items()][1:])
            psnr = [(m.values.get(PSNR.name), m.view) for m in report.measurements if m.recipe in others]
            lowest = min(((value, view) for value, view in psnr if value is not None), default=None)
            worst = report.protocol["view_names"].index(lowest[1]) if lowest else 0
            how = (sorted(scales, reverse=True), others, rows[0].name)
            write_png(folder / sheet, sheet_of(truth, views[worst], *how, errors=True), overwrite=replaces)
            for file in [*files, folder / sheet]:
                say(f"wrote {file}")
    return comparison


def check_compared(folder: Path | None, resume: bool, overwrite: bool, show: str) -> None:
    """Refuse, before any work, what needs a folder, contradicts itself or would replace results."""
    seen = show != CompareOptions.show
    check_journalled(folder, (*COMPARED, PAGE), "a comparison", resume, overwrite, show=seen)

"""Fine-tuning: a plain scene file that looks right at every scale by the rule that will show it."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from statistics import mean
from typing import Any

import torch

from aaplug.core.cameras import Camera, spread
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import ReadsColumns
from aaplug.core.sampling import sampling_bounds
from aaplug.evaluation.engine import Task, evaluate
from aaplug.evaluation.metrics import PSNR
from aaplug.evaluation.report.contact_sheet import sheet_of
from aaplug.evaluation.results import Report, figure_of, mean_square_error, results, scale_name
from aaplug.evaluation.truth import MEMORY, Truth, back_projected, source_of, upsampled
from aaplug.evaluation.upsamplers import find_upsampler
from aaplug.finetuning import METHODS
from aaplug.finetuning.poses import refined
from aaplug.finetuning.session import PROBE_VIEWS, tune, tuned_scene
from aaplug.finetuning.settings import LEARNED_COLUMNS, Settings, settings_of, slowed
from aaplug.finetuning.state import TuningJob
from aaplug.io.atomic import AnyPath, check_output, write_file
from aaplug.io.images import image_size, write_png
from aaplug.io.scenes import SceneLike, check_scene_output, kept_by, read_scene, write_scene, written_format
from aaplug.methods.conversion import fuse_for
from aaplug.methods.presets import recipe_of
from aaplug.methods.viewers import FAST, VIEWERS
from aaplug.options.verbs import FinetuneOptions
from aaplug.rendering.cost import GRADIENTS, Cost, cost_of
from aaplug.rendering.job import CamerasLike, Job, running
from aaplug.rendering.renderer import Renderer
from aaplug.system.digests import digest_of_files
from aaplug.system.errors import IS_COMPLETE, OutputError, UsageError, counted, listing
from aaplug.system.monitor import Monitor
from aaplug.verbs.verb import writes


@dataclass(frozen=True)
class Tuned:
    """A fine-tuned scene.

    report: the scene before, its closed form where that differs, and after, as the output holds it and the viewer shows
        them.
    curve: number, view and loss by scale of each step.  probes: PSNR measured on the way.
    """

    scene: Gaussians
    report: Report
    settings: Settings
    curve: Sequence[Mapping[str, Any]]
    probes: Sequence[Mapping[str, Any]]

    def as_json(self) -> dict[str, Any]:
        """The report, with the settings and the probes."""
        weights = {f"{scale:g}": weight for scale, weight in self.settings.weights.items()}
        settings = asdict(self.settings) | {"weights": weights}
        return results(self.report) | {"settings": settings, "probes": list(self.probes)}


@writes(FinetuneOptions)
def finetune(scene: SceneLike, cameras: CamerasLike, output: AnyPath | None, options: FinetuneOptions) -> Tuned:
    """Optimize the Gaussians until every scale looks like the training size, averaged down.

    Args:
        scene: see `render`.
        cameras: see `render`.
        output: scene file to write; a report (.finetune.json), pictures (.finetune.png) and, until the run ends, a
            checkpoint (.finetune.pt) go beside it.  None writes nothing.

    Raises:
        AaplugError: as `render`; also, the scene holds 2D Gaussians, the checkpoint is of another run, or no gradient
            is finite.
        KeyboardInterrupt: Ctrl-C stopped the run; its checkpoint is written.
    """
    method = METHODS.find("learned-filters" if options.learn_filters else options.method, "method")
    path = None if output is None else Path(output)
    settings, viewer = settings_of(method, options), options.viewer or method.viewer
    if options.viewer and LEARNED_COLUMNS in settings.rates:
        raise UsageError("viewer", "shows no learned filters; only aaplug's recipe learned does")
    if isinstance(viewer, str):
        viewer = FAST if viewer == FAST.name else VIEWERS.find(viewer, "viewer")
    job = Job.of(scene, cameras, options)
    checkpoint = path and _beside(path, "pt")
    resumes = options.resume and checkpoint is not None and checkpoint.exists()
    replaces = options.overwrite or resumes  # beside a checkpoint, the other files are of the same run
    check = partial(_check, path, job.scene.files, options.resume, replaces)
    check()
    if path is not None and LEARNED_COLUMNS in settings.rates and "extras" not in kept_by(written_format(path)):
        raise OutputError(path, "holds no learned filters; a .ply does")
    truth_source = source_of(job.cameras.train, options.truth)
    photographs = truth_source == "photographs"
    own = (image_size(v.photo)[0] / v.width if photographs and v.photo else 1.0 for v in job.cameras.train)
    if options.upsampler is not None and max(options.scale) <= min(own):
        raise UsageError("upsampler", "is for scales above the source images', and there is none: give such a `scale`")
    enlarge = back_projected if options.upsampler is None else upsampled(find_upsampler(options.upsampler))
    upsampler = str(options.upsampler)
    upsampler = digest_of_files([upsampler]) if Path(upsampler).is_file() else upsampler
    with running(options, path, check, job.inputs), _resumable(checkpoint, resumes, job.monitor):
        raw, look = job.scene.gaussians(), job.look(settings.steps, gradients=True)
        if options.poses:
            job = replace(job, cameras=refined(look, job.cameras, job.cameras.all, job.monitor)[0])
            look = job.second_look(look)
        train = job.cameras.train if photographs else tuple(view.straight() for view in job.cameras.train)
        before = replace(look, scene=viewer.shown(look.scene), recipe=recipe_of(viewer))
        fused = fuse_for(raw, look.training, viewer)
        if isinstance(screen := before.recipe.screen, ReadsColumns):
            zeros = dict.fromkeys(screen.columns, torch.zeros_like(fused.logit_opacities))
            fused = replace(fused, extras={**zeros, **fused.extras})
        start = replace(before, scene=fused)
        truth = Truth(look, truth_source, enlarge=enlarge, memory=MEMORY)
        scales = sorted({1.0, *settings.weights}, reverse=True)
        if settings.steps and settings.usual_error and len(fused):
            first = evaluate(Task({"start": start}, scales, spread(train, PROBE_VIEWS), truth, (PSNR,), ceiling=False))
            settings = slowed(settings, {s: mean_square_error(first.select("start", s)) for s in scales})
        tuning = TuningJob(start, train, truth, settings, upsampler, method)
        steps = f"{settings.name}, {counted(settings.steps, 'step')}, truth: {truth_source}"
        job.monitor.say(f"tuning for {start.recipe.name} ({start.recipe.source}): {steps}")
        cost = _cost(start, train, settings)
        job.announce([start], train, cost=cost, work=counted(settings.steps, "step"), fewer="steps")
        job.say_assumed(look)
        state = tune(tuning, checkpoint, options.checkpoint_every, options.resume, job.monitor)
        record = {"for": viewer.name, "method": settings.name}
        result = tuned_scene(state, tuning, viewer.convention_of(raw), record)
        written = result
        if path is not None:
            files = viewer.spz(options.spz_axes)
            write_scene(path, result, overwrite=replaces, **files)
            reading = {"convention": result.convention, "spz_axes": files["spz_axes"]}
            written = read_scene(path, **reading).gaussians()  # many formats hold less
        closed = {"closed form": start} if len(start.scene.fused) > len(raw.fused) else {}
        bounds = sampling_bounds(written.means, train)  # densification may have changed the number of Gaussians
        after = replace(start, scene=written, training=replace(start.training, bounds=bounds))
        renderers = {"before": before, **closed, "after": after}
        truth = replace(truth, source=source_of(job.views))
        with job.monitor.progress("measuring", "views") as tell:
            report = evaluate(Task(renderers, scales, job.views, truth, ceiling=False), tell=tell)
        for name in ("before", *closed) if state.step else ():
            psnr = ([figure_of(PSNR, report.select(row, s)) for row in (name, "after")] for s in scales)
            lost = (was - now if was and now else 0.0 for was, now in psnr)
            worse = [scale_name(scale) for scale, dB in zip(scales, lost, strict=True) if round(dB, PSNR.digits) > 0]
            if worse:
                problem = f"tuning left the measured views worse than {name} at {listing(worse)}"
                job.monitor.say(f"{problem}: fewer steps, a lower learning rate or more training views may help")
        tuned = Tuned(result, report, settings, state.curve, state.probes)
        if path is not None:
            told = json.dumps(tuned.as_json() | {"curve": list(tuned.curve)}, indent=1)
            write_file(_beside(path, "json"), told.encode(), replaces)
            sheet = sheet_of(truth, job.views[0], scales, renderers, "truth")
            write_png(_beside(path, "png"), sheet, overwrite=replaces)
            _beside(path, "pt").unlink(missing_ok=True)
    return tuned


def _beside(scene: Path, kind: str) -> Path:
    """A file beside the scene, by its suffix; .pt is the checkpoint."""
    return scene.with_suffix(f".finetune.{kind}")


@contextmanager
def _resumable(checkpoint: Path | None, resumes: bool, monitor: Monitor) -> Iterator[None]:
    """Say, where Ctrl-C ends the block, that its checkpoint continues: not one of a run that this one replaces."""

    def written() -> int | None:
        return checkpoint.stat().st_mtime_ns if checkpoint is not None and checkpoint.exists() else None

    before = None if resumes else written()
    try:
        yield
    except KeyboardInterrupt:
        if written() not in (None, before):
            monitor.say(f"{checkpoint} is kept; --resume continues")
        raise


def _check(path: Path | None, inputs: Sequence[Path], resume: bool, replaces: bool) -> None:
    """Check, before any work, that the scene and the files beside it may be written; a complete run is not resumed."""
    if path is None:
        if resume:
            raise UsageError("resume", "needs the `output` of the interrupted run")
        return
    if resume and not replaces and path.exists() and _beside(path, "json").exists():
        raise OutputError(path, IS_COMPLETE)
    if not replaces and (checkpoint := _beside(path, "pt")).exists():
        raise OutputError(checkpoint, "is of an interrupted run; `resume` continues it, `overwrite` starts anew")
    check_scene_output(path, replaces, inputs)
    for kind in ("json", "png", "pt"):
        check_output(_beside(path, kind), replaces, inputs)


def _cost(start: Renderer, views: Sequence[Camera], settings: Settings) -> Cost:
    """An estimate: a step draws one scale and the anchor; each view's truth is rendered once for each scale."""
    frame = {s: cost_of([start], [v.scaled(s) for v in views]).seconds / len(views) for s in (1.0, *settings.weights)}
    anchors = 1 if settings.anchor else 0
    step = mean(frame[scale] for scale in settings.weights) + anchors * frame[1.0]
    truths = min(settings.steps * (1 + anchors), len(views) * len(frame))
    seconds = GRADIENTS * settings.steps * step + truths * frame[1.0]
    return cost_of([start], views)._replace(seconds=seconds)

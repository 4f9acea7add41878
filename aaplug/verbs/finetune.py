"""Fine-tuning: a plain scene file that looks right at every scale by the rule that will show it."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.sampling import MIN_SEEN_SHARE, sampling_bounds
from aaplug.core.training import TrainingViews
from aaplug.evaluation.engine import Candidate, compare
from aaplug.evaluation.protocols import TruthSource
from aaplug.evaluation.report.contact_sheet import contact_sheet
from aaplug.evaluation.results import Report, results, scale_name
from aaplug.evaluation.truth import MEMORY, Enlarge, Truth, back_projected, own_look, source_of, upsampled
from aaplug.evaluation.upsamplers import find_upsampler
from aaplug.finetuning.parameters import RATES
from aaplug.finetuning.session import recorded, tune
from aaplug.finetuning.settings import METHODS, OURS, Settings, settings_of
from aaplug.finetuning.state import TuningJob
from aaplug.io.atomic import check_output, replacing
from aaplug.io.cameras import select_views
from aaplug.io.images import write_png
from aaplug.io.scenes import SpzAxes, check_scene_output, write_scene
from aaplug.methods.recipes import RECIPES
from aaplug.methods.viewers import FAST, VIEWERS, Viewer, fuse_for
from aaplug.rendering.renderer import Background, Renderer
from aaplug.verbs.inputs import CamerasLike, SceneLike, background_of, cameras_of, processor, rasterizer_of, scene_of


@dataclass(frozen=True)
class Tuned:
    """A fine-tuned scene.

    report: the scene before, its closed form where that differs, and after, as the viewer shows them.
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


def finetune(
    scene: SceneLike,
    cameras: CamerasLike = None,
    output: str | PathLike[str] | None = None,
    *,
    target: str | Viewer | None = None,
    method: str = "consistency",
    scale: Sequence[float] = tuple(OURS.weights),
    steps: int | None = None,
    loss: str = OURS.loss,
    anchor: float = OURS.anchor,
    move: Sequence[str] = tuple(RATES),
    learning_rate: float = 1.0,
    densify_every: int | None = None,
    truth: str = "auto",
    upsampler: str | None = None,
    seed: int = 0,
    checkpoint_every: int = 100,
    resume: bool = False,
    views: str = "test",
    background: Background = "auto",
    rasterizer: str | Rasterizer = "auto",
    threads: int | None = None,
    memory: float | None = None,
    cull_margin: float = math.inf,
    min_seen: float = MIN_SEEN_SHARE,
    spz_axes: SpzAxes = "opengl",
    overwrite: bool = False,
    monitor: Monitor = SILENT,
) -> Tuned:
    """Optimize the Gaussians until every scale looks like the training size, averaged down.

    Args:
        scene: Gaussians, a scene's file or a model folder.
        cameras: a camera set, its file or folder, or None for those of the scene's model folder.
        output: scene file to write; a report (.finetune.json), pictures (.finetune.png) and, until the run ends, a
            checkpoint (.finetune.pt) go beside it.  None writes nothing.
        target: what will show the scene: a viewer, its name in `VIEWERS`, or "fast" for aaplug's recipe matched with
            one sample per pixel; None for the method's own.
        method: "consistency" makes one model for all scales, "mipmap-gs" one for a single scale.
        scale: sizes against the training size that must look right, beside the training size itself.
        steps: number of steps; None for the method's own.
        loss: "l2" or "l1-dssim", 3DGS's.
        anchor: weight of the training size in every step, against 1 for the other scales.
        move: parameters that move, names in `RATES`.
        learning_rate: factor on the method's learning rates.
        densify_every: steps between densifications, 0 for none; None for the method's own.
        truth: "self" (the scene's own render), "photographs", or "auto" for photographs where every training view has
            one.
        upsampler: for scales above 1 without photographs that large: "bicubic", "lanczos" or a network's file; None for
            the scene's own render there, corrected to the averages of the training size.
        seed: of what the steps draw.
        checkpoint_every: steps between checkpoints.
        resume: continue from the checkpoint.
        views: for the report: "train", "test", "all", or names separated by commas.
        background, rasterizer, threads, memory, cull_margin, min_seen: see `render`.
        spz_axes: of a .spz to write; see `open_scene`.
        overwrite: replace existing outputs.
        monitor: receives messages and progress.

    Raises:
        AaplugError: an input cannot be read, an argument does not fit, there is nothing to resume, no gradient is
            finite, or an output cannot be written.
        KeyboardInterrupt: Ctrl-C stopped the run; its checkpoint is written.
    """
    chosen = METHODS.find(method, "method")
    settings = settings_of(
        chosen,
        scale=scale,
        steps=steps,
        loss=loss,
        anchor=anchor,
        move=move,
        learning_rate=learning_rate,
        densify_every=densify_every,
        seed=seed,
    )
    viewer = chosen.viewer if target is None else _viewer(target)
    cameras, scene = cameras_of(cameras, scene), scene_of(scene)
    if checkpoint_every < 1:
        raise UsageError("checkpoint_every", f"must be 1 or more, got {checkpoint_every}")
    files = _Files.of(output, scene, resume, overwrite)
    shown = select_views(cameras, views)
    source, enlarge = _source(truth, cameras), _enlarge(upsampler)
    colour = background_of(background, cameras, monitor)
    with processor(threads):
        drawing = rasterizer_of(rasterizer, settings.steps, memory, monitor)
        training = TrainingViews.of(scene, cameras, cull_margin, min_seen)
        look = own_look(scene, training, drawing, colour)
        before = replace(look, recipe=RECIPES[viewer.recipe])
        start = replace(before, scene=fuse_for(scene, training, viewer))
        reference = Truth(look, source, enlarge=enlarge, memory=MEMORY)
        job = TuningJob(start, cameras.train, reference, settings)
        monitor.say(_described(job))
        state = tune(job, files and files.checkpoint, checkpoint_every, resume, monitor)
        how = {"for": viewer.name, "method": settings.name}
        tuned = recorded(state, job, viewer.convention_of(scene), how)
        if files is not None:
            write_scene(files.scene, tuned, overwrite=overwrite, spz_axes=spz_axes)
        candidates = [Candidate("before", before), Candidate("after", _drawn(tuned, start))]
        if len(start.scene.fused) > len(scene.fused):
            candidates.insert(1, Candidate("closed form", start))
        compared = _Comparison(candidates, shown, settings.weights, job.truth)
        found = Tuned(tuned, compared.report(monitor), settings, state.curve, state.probes)
        if files is not None:
            files.write(found, compared, overwrite)
    return found


@dataclass(frozen=True)
class _Files:
    """The files of a run."""

    scene: Path

    @classmethod
    def of(cls, output: str | PathLike[str] | None, scene: Gaussians, resume: bool, overwrite: bool) -> "_Files | None":
        """The files beside an output, after a check, before any work, that they may be written."""
        if output is None:
            if resume:
                raise UsageError("resume", "needs the `output` of the interrupted run")
            return None
        files = cls(Path(output))
        sources = [Path(scene.origin.path)] if scene.origin else []
        check_scene_output(files.scene, overwrite, sources)
        check_output(files.beside("json"), overwrite, sources)
        check_output(files.beside("png"), overwrite, sources)
        check_output(files.checkpoint, resume or overwrite, sources)
        return files

    def beside(self, kind: str) -> Path:
        """A file beside the scene, by its suffix."""
        return self.scene.with_suffix(f".finetune.{kind}")

    @property
    def checkpoint(self) -> Path:
        """Of the run, until it ends."""
        return self.beside("pt")

    def write(self, found: Tuned, compared: "_Comparison", overwrite: bool) -> None:
        """Write the report and the pictures, and remove the checkpoint."""
        report = json.dumps(found.as_json() | {"curve": list(found.curve)}, indent=1)
        with replacing(self.beside("json"), overwrite) as stream:
            stream.write(report.encode())
        write_png(self.beside("png"), compared.sheet(), overwrite=overwrite)
        self.checkpoint.unlink(missing_ok=True)


class _Comparison:
    """Candidates beside the truth, at the training size and at the scales of a run."""

    def __init__(
        self, candidates: Sequence[Candidate], views: Sequence[Camera], scales: Iterable[float], truth: Truth
    ) -> None:
        self.candidates, self.views = candidates, views
        self.scales = sorted({1.0, *scales}, reverse=True)
        self.truth = replace(truth, source=source_of(views))

    def report(self, monitor: Monitor) -> Report:
        """Measure all views."""
        with monitor.progress("measuring", "views") as tell:
            return compare(self.candidates, self.views, self.scales, self.truth, tell)

    def sheet(self) -> Float[Tensor, "h w 3"]:
        """The first view at every scale."""
        view, rows = self.views[0], []
        for scale in self.scales:
            camera = view.scaled(scale)
            drawn = [candidate.renderer(camera).rgb for candidate in self.candidates]
            label = f"{scale_name(scale)}: {camera.width}x{camera.height}"
            rows.append((label, [self.truth(view, scale), *drawn]))
        return contact_sheet(("truth", *(c.name for c in self.candidates)), rows)


def _viewer(target: str | Viewer) -> Viewer:
    if isinstance(target, Viewer):
        return target
    known = {FAST.name: FAST, **VIEWERS}
    if target not in known:
        raise UsageError("target", f"'{target}' is not one of {', '.join(known)}")
    return known[target]


def _source(truth: str, cameras: CameraSet) -> TruthSource:
    """Where the images that renders are compared with come from."""
    sources: dict[str, TruthSource] = {"self": "self", "photographs": "photographs", "auto": source_of(cameras.train)}
    if truth not in sources:
        raise UsageError("truth", f"'{truth}' is not one of {', '.join(sources)}")
    missing = [view.name for view in cameras.train if view.photo is None]
    if sources[truth] == "photographs" and missing:
        raise UsageError(missing[0], "has no photograph; `truth` self needs none")
    return sources[truth]


def _enlarge(upsampler: str | None) -> Enlarge:
    return back_projected if upsampler is None else upsampled(find_upsampler(upsampler))


def _described(job: TuningJob) -> str:
    recipe, settings = job.start.recipe, job.settings
    return (
        f"tuning for {recipe.name} ({recipe.source}): {settings.name}, {settings.steps} steps, "
        f"truth: {job.truth.source}"
    )


def _drawn(tuned: Gaussians, start: Renderer) -> Renderer:
    """Draws the tuned scene; densification may have changed the number of Gaussians, so it has bounds of its own."""
    bounds = sampling_bounds(tuned.means, start.training.cameras)
    return replace(start, scene=tuned, training=replace(start.training, bounds=bounds))

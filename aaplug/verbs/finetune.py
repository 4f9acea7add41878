"""Fine-tuning: a plain scene file that looks right at every scale by the rule that will show it."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from statistics import mean
from typing import Any

from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.choices import SpzAxes
from aaplug.core.digests import digest_of_files
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.sampling import sampling_bounds
from aaplug.evaluation.engine import Candidate, compare
from aaplug.evaluation.protocols import TruthSource
from aaplug.evaluation.report.contact_sheet import contact_sheet
from aaplug.evaluation.results import Report, results, scale_name
from aaplug.evaluation.truth import MEMORY, Truth, back_projected, source_of, upsampled
from aaplug.evaluation.upsamplers import find_upsampler
from aaplug.finetuning.session import recorded, tune
from aaplug.finetuning.settings import METHODS, Settings, settings_of
from aaplug.finetuning.state import TuningJob
from aaplug.io.atomic import check_output, claimed, replacing
from aaplug.io.cameras import select_views
from aaplug.io.images import write_png
from aaplug.io.scenes import check_scene_output, write_scene
from aaplug.methods.recipes import RECIPES
from aaplug.methods.viewers import FAST, VIEWERS, Viewer, fuse_for
from aaplug.options.finetune import FinetuneOptions
from aaplug.options.objects import AnyPath
from aaplug.rendering.cost import GRADIENTS, cost_of
from aaplug.rendering.renderer import Renderer
from aaplug.verbs.announce import announce
from aaplug.verbs.assumed import say_assumed
from aaplug.verbs.inputs import CamerasLike, SceneLike, inputs_of, look_of, processor, sources_of, whole_of

Image = Float[Tensor, "h w 3"]


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


@FinetuneOptions.shown
def finetune(
    scene: SceneLike,
    cameras: CamerasLike = None,
    output: AnyPath | None = None,
    *,
    spz_axes: SpzAxes = "auto",
    monitor: Monitor = SILENT,
    **options: Any,
) -> Tuned:
    """Optimize the Gaussians until every scale looks like the training size, averaged down.

    Args:
        scene: see `render`.
        cameras: see `render`.
        monitor: see `render`.
        output: scene file to write; a report (.finetune.json), pictures (.finetune.png) and, until the run ends, a
            checkpoint (.finetune.pt) go beside it.  None writes nothing.
        spz_axes: of a .spz to write; see `open_scene`.
        options: fields of `FinetuneOptions`.

    Raises:
        AaplugError: as `render`; also, the checkpoint is of another run, or no gradient is finite.
        KeyboardInterrupt: Ctrl-C stopped the run; its checkpoint is written.
    """
    o = FinetuneOptions.of(options)
    settings, viewer, path = _settings(o), _viewer(o), None if output is None else Path(output)
    held, cameras = inputs_of(scene, cameras, monitor)
    scene = whole_of(held)
    check = partial(_check, path, sources_of(scene), o)
    check()
    shown, source = select_views(cameras, o.views), _source(o.truth, cameras)
    enlarge = back_projected if o.upsampler is None else upsampled(find_upsampler(o.upsampler))
    named = str(o.upsampler)
    written = digest_of_files([named]) if Path(named).is_file() else named
    with processor(o.threads), claimed(path, check):
        look = look_of(scene, cameras, settings.steps, o, monitor)
        say_assumed(cameras, monitor, look)
        before = replace(look, scene=viewer.shown(look.scene), recipe=RECIPES[viewer.recipe])
        start = replace(before, scene=fuse_for(scene, look.training, viewer))
        job = TuningJob(start, cameras.train, Truth(look, source, enlarge=enlarge, memory=MEMORY), settings, written)
        how = f"{settings.name}, {settings.steps} steps, truth: {source}"
        monitor.say(f"tuning for {start.recipe.name} ({start.recipe.source}): {how}")
        seconds = _seconds(start, cameras.train, settings)
        announce([start], cameras.train, monitor, work=f"{settings.steps} steps", seconds=seconds, fewer="steps")
        state = tune(job, path and _beside(path, "pt"), o.checkpoint_every, o.resume, monitor)
        tuned = recorded(state, job, viewer.convention_of(scene), {"for": viewer.name, "method": settings.name})
        if path is not None:
            write_scene(path, tuned, overwrite=o.overwrite, spz_axes=spz_axes)
        closed = [Candidate("closed form", start)] * (len(start.scene.fused) > len(scene.fused))
        candidates = [Candidate("before", before), *closed, Candidate("after", _drawn(tuned, start))]
        scales = sorted({1.0, *settings.weights}, reverse=True)
        truth = replace(job.truth, source=source_of(shown))
        with monitor.progress("measuring", "views") as tell:
            report = compare(candidates, shown, scales, truth, tell)
        found = Tuned(tuned, report, settings, state.curve, state.probes)
        if path is not None:
            _write(path, found, _sheet(candidates, shown[0], scales, truth), o.overwrite)
    return found


def _beside(scene: Path, kind: str) -> Path:
    """A file beside the scene, by its suffix; .pt is the checkpoint."""
    return scene.with_suffix(f".finetune.{kind}")


def _settings(o: FinetuneOptions) -> Settings:
    names = ("scale", "steps", "loss", "anchor", "move", "learning_rate", "densify_every", "seed")
    return settings_of(METHODS.find(o.method, "method"), **{name: getattr(o, name) for name in names})


def _check(path: Path | None, sources: Sequence[Path], o: FinetuneOptions) -> None:
    """Check, before any work, the checkpoints, and that the scene and the files beside it may be written."""
    if path is None:
        if o.resume:
            raise UsageError("resume", "needs the `output` of the interrupted run")
        return
    check_scene_output(path, o.overwrite, sources)
    for kind, replaces in (("json", o.overwrite), ("png", o.overwrite), ("pt", o.resume or o.overwrite)):
        check_output(_beside(path, kind), replaces, sources)


def _seconds(start: Renderer, views: Sequence[Camera], settings: Settings) -> float:
    """An estimate: a step draws one scale and the anchor; each view's truth is rendered once for each scale."""
    frame = {s: cost_of([start], [v.scaled(s) for v in views]).seconds / len(views) for s in (1.0, *settings.weights)}
    anchors = 1 if settings.anchor else 0
    drawn = mean(frame[scale] for scale in settings.weights) + anchors * frame[1.0]
    truths = min(settings.steps * (1 + anchors), len(views) * len(frame))
    return GRADIENTS * settings.steps * drawn + truths * frame[1.0]


def _sheet(candidates: Sequence[Candidate], view: Camera, scales: Iterable[float], truth: Truth) -> Image:
    """A view at every scale: the truth, and each candidate."""
    rows = []
    for scale in scales:
        camera = view.scaled(scale)
        drawn = [candidate.renderer(camera).rgb for candidate in candidates]
        rows.append((f"{scale_name(scale)}: {camera.width}x{camera.height}", [truth(view, scale), *drawn]))
    return contact_sheet(("truth", *(c.name for c in candidates)), rows)


def _write(path: Path, found: Tuned, sheet: Image, overwrite: bool) -> None:
    """Write the report and the pictures, and remove the checkpoint."""
    with replacing(_beside(path, "json"), overwrite) as stream:
        stream.write(json.dumps(found.as_json() | {"curve": list(found.curve)}, indent=1).encode())
    write_png(_beside(path, "png"), sheet, overwrite=overwrite)
    _beside(path, "pt").unlink(missing_ok=True)


def _viewer(o: FinetuneOptions) -> Viewer:
    """What will show the scene: as asked, or the method's own."""
    if not isinstance(o.target, str):
        return o.target or METHODS[o.method].viewer
    return FAST if o.target == FAST.name else VIEWERS.find(o.target, "target")


def _source(truth: str, cameras: CameraSet) -> TruthSource:
    """Where the images that renders are compared with come from."""
    missing = [view.name for view in cameras.train if view.photo is None]
    if truth == "photographs" and missing:
        raise UsageError(missing[0], "has no photograph; `truth` self needs none")
    return source_of(cameras.train, truth)


def _drawn(tuned: Gaussians, start: Renderer) -> Renderer:
    """Draws the tuned scene; densification may have changed the number of Gaussians, so it has bounds of its own."""
    bounds = sampling_bounds(tuned.means, start.training.cameras)
    return replace(start, scene=tuned, training=replace(start.training, bounds=bounds))

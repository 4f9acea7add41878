"""Conversion: a plain scene file that anti-aliased viewers show right."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians
from aaplug.core.sampling import SamplingBounds, sampling_bounds
from aaplug.core.training import TrainingViews
from aaplug.evaluation.coverage import check_frame_of
from aaplug.evaluation.results import Report, results
from aaplug.finetuning.fitting import fit, steps_for
from aaplug.io.atomic import AnyPath, refuse_existing
from aaplug.io.scenes import SceneLike, check_scene_output, kind_written, write_parts, write_scene, written_format
from aaplug.io.scenes.scene import PART, Scene
from aaplug.methods.conversion import FORMS, Form, blurring, fuse
from aaplug.methods.filters.smoothing import Smoothing3D
from aaplug.methods.viewers import DISC_VIEWER, MIP_VIEWER, Viewer, find_viewer
from aaplug.options.verbs import ConvertOptions
from aaplug.rendering.job import CamerasLike, Job, running
from aaplug.rendering.renderer import own_look
from aaplug.system.errors import UsageError
from aaplug.system.executors import Threads
from aaplug.system.monitor import Tell
from aaplug.verbs.verb import writes

LARGE_SCENE = 1_000_000  # Gaussians: larger files are converted in parts; a million take 0.3 GB, and more at work


@dataclass(frozen=True, eq=False)
class Converted:
    """A converted scene.

    gaussians: their number.
    scene: None if it went to the output in parts, being large, or frame by frame.
    viewer: whose rule draws it.
    report: the original, the closed form and the result as the viewer shows them; None unless a viewer was named.
    """

    gaussians: int
    scene: Gaussians | None
    viewer: Viewer
    report: Report | None = None

    def as_json(self) -> dict[str, Any]:
        """The number of Gaussians, what is fused, and for a named viewer its settings and the remaining error."""
        facts: dict[str, Any] = {"gaussians": self.gaussians}
        if self.scene is not None:
            facts["fused"] = [{"method": f.method, **f.settings} for f in self.scene.fused]
        if self.report is not None:
            viewer = {"for": self.viewer.name, "settings": self.viewer.settings}
            facts |= {**viewer, "residual": results(self.report)}
        return facts


@writes(ConvertOptions)
def convert(scene: SceneLike, cameras: CamerasLike, output: AnyPath | None, options: ConvertOptions) -> Converted:
    """Fuse anti-aliasing into a plain scene, in closed form for the Mip rule or fitted to a named viewer.

    Files of more than a million Gaussians are converted to `output` in parts, unless a viewer is named.

    Args:
        scene: see `render`; of a scene in time every frame is converted.
        cameras: see `render`; not needed where the scene stores a 3D filter.
        output: file to write, of a format that can be written, or a folder for frames; None writes none.

    Raises:
        AaplugError: as `render`; also, something is fused already.
        KeyboardInterrupt: Ctrl-C stopped the optimization; nothing is written.
    """
    job, path = Job.of(scene, cameras, options), None if output is None else Path(output)
    rule: Form | Viewer | None = find_viewer(options.viewer)
    viewer = rule or (DISC_VIEWER if job.scene.flat else MIP_VIEWER)
    if rule is None:
        rule = FORMS[options.form or ("mip-splatting" if job.scene.flat else "matched-energy")]
        if options.variance is not None:
            rule = replace(rule, variance=options.variance)
    files = {"overwrite": options.overwrite, **viewer.spz(options.spz_axes)}
    frames = job.scene.frames
    if frames is not None and isinstance(rule, Viewer):
        raise UsageError("viewer", "fits each frame alone, which flickers: leave it out")
    if frames is not None and (path is None or written_format(path)):
        raise UsageError("output", "of frames is a folder: name one")
    outputs = [path / file.name for file in frames.paths] if path and frames else []

    def check() -> None:
        if outputs:
            refuse_existing(outputs, options.overwrite)
        elif path is not None:
            check_scene_output(path, options.overwrite, job.scene.files)

    check()
    if path is not None and (caveat := viewer.caveat(kind_written(path), path.name)):
        job.monitor.say(caveat)
    with running(options, path, check, job.inputs, folder=frames is not None) as workers:
        report = None
        if isinstance(rule, Viewer):
            gaussians = job.scene.gaussians()
            steps = steps_for(gaussians, rule) if options.steps is None else options.steps
            look = job.look(steps, gradients=True)
            job.say_assumed(look)
            fused, report = fit(gaussians, rule, look, job.views, steps, job.monitor)
        elif frames is not None:
            job.say_assumed()
            look = own_look(job.scene, job.cameras, "auto", options.background, options.cull_margin, options.min_seen)
            job.check_fit(look)
            count = 0
            with job.monitor.progress("converting", "frames") as tell:
                for done, (frame, target) in enumerate(zip(frames, outputs, strict=True), start=1):
                    gaussians = frame.gaussians()
                    training = frames.training_of(gaussians, look.training)
                    write_scene(target, fuse(gaussians, training, rule), **files)
                    count += len(gaussians)
                    tell(done, len(frames))
            return Converted(count, None, viewer)
        elif path and job.scene.path and job.scene.count > LARGE_SCENE:
            large, train = job.scene, job.cameras.train
            if blurring(large.fused) or large.raw(0, min(1, large.count)).filter_3d is not None:
                train = ()  # it needs no cameras, or is refused anyway
            else:
                job.say_assumed()
                if not job.cameras.assumed:
                    check_frame_of(large, train, options.min_seen)
            with job.monitor.progress("converting", "Gaussians") as tell:
                parts = convert_parts(large, train, rule, tell, threads=workers.threads)
                write_parts(path, parts, large.count, **files)
            return Converted(large.count, None, viewer)
        else:
            gaussians, training = job.scene.gaussians(), None
            if not blurring(gaussians.fused) and gaussians.filter_3d is None:  # else it needs no cameras, or is refused
                look = own_look(gaussians, job.cameras, background=options.background, min_seen=options.min_seen)
                job.check_fit(look)
                job.say_assumed(look)
                training = look.training
            fused = fuse(gaussians, training, rule)
        if path is not None:
            write_scene(path, fused, **files)
    return Converted(len(fused), fused, viewer, report)


def convert_parts(
    scene: Scene,
    cameras: Sequence[Camera],
    form: Form,
    tell: Tell = lambda done, total: None,
    size: int = PART,
    threads: int = 1,
) -> Iterator[Gaussians]:
    """Yield the parts of a scene that may be larger than memory, each as `conversion.fuse` would convert the whole.

    A closed form treats each Gaussian alone.  One value depends on all: the coarsest sampling rate, which stands in for
    those of Gaussians that no camera sees; a first pass over the file finds it.

    cameras: training cameras; none where the scene stores its 3D filter.
    tell: called with (Gaussians done, Gaussians in all).
    size: Gaussians per part.  threads: parts converted at once.
    """
    bounded, coarsest = bool(cameras) and isinstance(form, Smoothing3D), math.inf
    for part in scene.parts(size) if bounded else ():
        bounds = sampling_bounds(part.means, cameras)
        if bounds.seen.any():
            coarsest = min(coarsest, bounds.highest[bounds.seen].min().item())

    def converted(part: Gaussians) -> Gaussians:
        if not cameras:
            return fuse(part, None, form)
        none = torch.zeros(len(part))  # matched energy reads no bounds
        bounds = SamplingBounds(none, none, none, none.int())
        if bounded:
            bounds = sampling_bounds(part.means, cameras)
            highest = torch.where(bounds.seen, bounds.highest, coarsest)
            bounds = replace(bounds, highest=highest, views=bounds.views.clamp(min=1))
        return fuse(part, TrainingViews(part.convention, cameras, bounds), form)

    done = 0
    tell(0, scene.count)  # parts differ in size, so the rate counts from here
    for part in Threads(threads).map(converted, scene.parts(size)):
        yield part
        done += len(part)
        tell(min(done, scene.count), scene.count)

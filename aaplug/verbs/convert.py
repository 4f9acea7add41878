"""Conversion: a plain scene file with anti-aliasing fused in."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.choices import SpzAxes
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.training import TrainingViews
from aaplug.evaluation.results import Report
from aaplug.evaluation.truth import own_look
from aaplug.finetuning.fitting import fit, steps_for
from aaplug.inspection.survey import check_frame_of
from aaplug.io.atomic import claimed
from aaplug.io.cameras import select_views
from aaplug.io.scenes import check_scene_output, write_parts, write_scene
from aaplug.io.scenes.scene_file import SceneFile
from aaplug.methods.viewers import FORMS, MATCHED_ENERGY, MIP_VIEWER, Form, Viewer, blurring, find_viewer, fuse
from aaplug.options.convert import ConvertOptions
from aaplug.options.objects import AnyPath
from aaplug.verbs.assumed import say_assumed
from aaplug.verbs.in_parts import LARGE, convert_parts
from aaplug.verbs.inputs import CamerasLike, SceneLike, look_of, opened_and_seen, processor, sources_of, whole_of


@dataclass(frozen=True)
class Converted:
    """A converted scene.

    scene: None if it was large and went to the output in parts.
    viewer: whose rule draws it.
    report: the original, the closed form and the result as the viewer shows them; None unless a viewer was named.
    """

    scene: Gaussians | None
    viewer: Viewer
    report: Report | None = None


@ConvertOptions.shown
def convert(
    scene: SceneLike | SceneFile,
    cameras: CamerasLike = None,
    output: AnyPath | None = None,
    *,
    drop_bad: bool = False,
    spz_axes: SpzAxes = "auto",
    monitor: Monitor = SILENT,
    **options: Any,
) -> Converted:
    """Fuse anti-aliasing into a plain scene, in closed form for the Mip rule or fitted to a named viewer.

    Files of more than a million Gaussians are converted to `output` in parts, unless a viewer is named.

    Args:
        scene: Gaussians, a scene's file, opened or not, or a model folder.
        cameras: see `render`; not needed where the scene stores a 3D filter.
        output: file to write, .ply, .spz or .splat; None writes none.
        drop_bad: leave out Gaussians of a file that cannot be used.
        spz_axes: of a .spz to write; see `open_scene`.
        monitor: see `render`.
        options: fields of `ConvertOptions`.

    Raises:
        AaplugError: as `render`; also, something is fused already.
        KeyboardInterrupt: Ctrl-C stopped the optimization; nothing is written.
    """
    o = ConvertOptions.of(options)
    chosen, path = _chosen(o), None if output is None else Path(output)
    opened, known = opened_and_seen(scene, cameras, monitor)
    check = partial(check_scene_output, path, o.overwrite, sources_of(opened)) if path else lambda: None
    check()
    writing = {"overwrite": o.overwrite, "spz_axes": spz_axes}
    with processor(o.threads) as workers, claimed(path, check):
        if path and isinstance(opened, SceneFile) and opened.count > LARGE and isinstance(chosen, Form):
            train = _train_of(opened, known, o.min_seen, monitor)
            with monitor.progress("converting", "Gaussians") as tell:
                parts = convert_parts(opened, train, chosen, drop_bad, tell, threads=workers)
                write_parts(path, parts, opened.count, **writing)
            return Converted(None, MIP_VIEWER)
        whole = whole_of(opened, drop_bad)
        if isinstance(chosen, Form):
            found = Converted(_fused(whole, known, chosen, o.min_seen, monitor), MIP_VIEWER)
        else:
            found = _fitted(whole, known, chosen, o, monitor)
        if path is not None:
            assert found.scene is not None
            write_scene(path, found.scene, **writing)
    return found


def _chosen(o: ConvertOptions) -> Form | Viewer:
    """What to convert for: a viewer, or the Mip rule by a closed form."""
    viewer = find_viewer(o.viewer)
    if viewer is not None:
        if o.form is not None or o.variance is not None:
            raise UsageError("viewer", "sets form and variance itself; leave out `form`, `variance`")
        return viewer
    if o.steps is not None:
        raise UsageError("steps", "belongs to the optimization for a `viewer`; name one")
    found = MATCHED_ENERGY if o.form is None else FORMS.find(o.form, "form")
    return found if o.variance is None else found.with_variance(o.variance)


def _fitted(scene: Gaussians, cameras: CameraSet, viewer: Viewer, o: ConvertOptions, monitor: Monitor) -> Converted:
    steps = steps_for(scene, viewer) if o.steps is None else o.steps
    look = look_of(scene, cameras, steps, o, monitor)
    say_assumed(cameras, monitor, look)
    fitted = fit(scene, viewer, look, select_views(cameras, o.views), steps, monitor)
    return Converted(fitted.scene, viewer, fitted.report)


def _train_of(opened: SceneFile, cameras: CameraSet, min_seen: float, monitor: Monitor) -> Sequence[Camera]:
    """The training cameras; none where the scene needs none, or is refused anyway."""
    if blurring(opened.fused) or opened.raw(0, min(1, opened.count)).filter_3d is not None:
        return ()
    say_assumed(cameras, monitor)
    if not cameras.assumed:
        check_frame_of(opened, cameras.train, min_seen)
    return cameras.train


def _fused(scene: Gaussians, cameras: CameraSet, form: Form, min_seen: float, monitor: Monitor) -> Gaussians:
    """The closed form for the Mip rule."""
    if blurring(scene.fused) or scene.filter_3d is not None:  # needs none, or is refused anyway
        return fuse(scene, None, form)
    training = TrainingViews.of(scene, cameras, min_seen=min_seen)
    say_assumed(cameras, monitor, own_look(scene, training))
    return fuse(scene, training, form)

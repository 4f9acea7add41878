"""Conversion: a plain scene file with anti-aliasing fused in."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TypeGuard

from aaplug.core.cameras import Camera
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.sampling import MIN_SEEN_SHARE
from aaplug.core.training import TrainingViews
from aaplug.evaluation.results import Report
from aaplug.evaluation.truth import own_look
from aaplug.finetuning.fitting import fit, steps_for
from aaplug.inspection.survey import check_frame_of
from aaplug.io.cameras import select_views
from aaplug.io.scenes import SpzAxes, check_scene_output, find_scene, open_scene, write_parts, write_scene
from aaplug.io.scenes.scene_file import SceneFile
from aaplug.methods.viewers import FORMS, MATCHED_ENERGY, MIP_VIEWER, VIEWERS, Form, Viewer, blurring, fuse
from aaplug.rendering.renderer import Background
from aaplug.verbs.in_parts import LARGE, convert_parts
from aaplug.verbs.inputs import CamerasLike, SceneLike, background_of, cameras_of, processor, rasterizer_of


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


def convert(
    scene: SceneLike | SceneFile,
    cameras: CamerasLike = None,
    output: str | PathLike[str] | None = None,
    *,
    viewer: str | Viewer | None = None,
    steps: int | None = None,
    form: str | None = None,
    variance: float | None = None,
    views: str = "train",
    background: Background = "auto",
    rasterizer: str | Rasterizer = "auto",
    threads: int | None = None,
    memory: float | None = None,
    cull_margin: float = math.inf,
    min_seen: float = MIN_SEEN_SHARE,
    drop_bad: bool = False,
    spz_axes: SpzAxes = "opengl",
    overwrite: bool = False,
    monitor: Monitor = SILENT,
) -> Converted:
    """Fuse anti-aliasing into a plain scene, in closed form for the Mip rule or fitted to a named viewer.

    Files of more than a million Gaussians are converted to `output` in parts, unless a viewer is named.

    Args:
        scene: Gaussians, a scene's file, opened or not, or a model folder.
        cameras: a camera set, its file or folder, or None for those of the scene's model folder; not needed where the
            scene stores a 3D filter.
        output: file to write, .ply, .spz or .splat; None writes none.
        viewer: a viewer, or its name in `VIEWERS`: fit the scene to it by a short optimization from the closed form.
        steps: of that optimization; None for 300, or for 0 where the viewer draws as training did.
        form: without a viewer, what to fuse: a name in `FORMS`; None for "matched-energy".
        variance: without a viewer, the variance to fuse, in px² at the training rate; None for 0.2.
        views: to measure the fit on: "train", "test", "all", or names separated by commas.
        background, rasterizer, threads, memory, cull_margin, min_seen: see `render`.
        drop_bad: leave out Gaussians of a file that cannot be used.
        spz_axes: of a .spz to write; see `open_scene`.
        overwrite: replace an existing output.
        monitor: receives messages and progress.

    Raises:
        AaplugError: an input cannot be read, an argument does not fit, something is fused already, or the output cannot
            be written.
        KeyboardInterrupt: Ctrl-C stopped the optimization; nothing is written.
    """
    chosen = _chosen(viewer, steps, form, variance)
    opened, path = _opened(scene), None if output is None else Path(output)
    if path is not None:
        check_scene_output(path, overwrite, _sources(opened))
    with processor(threads) as workers:
        if path and isinstance(chosen, Form) and _is_large(opened):
            train = _train_of(opened, cameras, min_seen)
            with monitor.progress("converting", "Gaussians") as tell:
                parts = convert_parts(opened, train, chosen, drop_bad, tell, threads=workers)
                write_parts(path, parts, opened.count, overwrite=overwrite, spz_axes=spz_axes)
            return Converted(None, MIP_VIEWER)
        whole = opened.whole(drop_bad) if isinstance(opened, SceneFile) else opened
        if isinstance(chosen, Form):
            found = Converted(_fused(whole, cameras, chosen, min_seen), MIP_VIEWER)
        else:
            known = cameras_of(cameras, whole)
            colour = background_of(background, known, monitor)
            steps = steps_for(whole, chosen) if steps is None else steps
            drawing = rasterizer_of(rasterizer, steps, memory, monitor)
            training = TrainingViews.of(whole, known, cull_margin, min_seen)
            look = own_look(whole, training, drawing, colour)
            fitted = fit(whole, chosen, look, select_views(known, views), steps, monitor)
            found = Converted(fitted.scene, chosen, fitted.report)
    if path is not None:
        assert found.scene is not None
        write_scene(path, found.scene, overwrite=overwrite, spz_axes=spz_axes)
    return found


def _chosen(viewer: str | Viewer | None, steps: int | None, form: str | None, variance: float | None) -> Form | Viewer:
    """What to convert for: a viewer, or the Mip rule by a closed form."""
    if viewer is None:
        if steps is not None:
            raise UsageError("steps", "belongs to the optimization for a `viewer`; name one")
        found = MATCHED_ENERGY if form is None else FORMS.find(form, "form")
        return found if variance is None else found.with_variance(variance)
    if form is not None or variance is not None:
        raise UsageError("viewer", "sets form and variance itself; leave out `form`, `variance`")
    if steps is not None and steps < 0:
        raise UsageError("steps", f"must be 0 or more, got {steps}")
    return VIEWERS.find(viewer, "viewer") if isinstance(viewer, str) else viewer


def _opened(scene: SceneLike | SceneFile) -> Gaussians | SceneFile:
    if isinstance(scene, Gaussians | SceneFile):
        return scene
    return open_scene(find_scene(Path(scene)))


def _is_large(scene: Gaussians | SceneFile) -> TypeGuard[SceneFile]:
    return isinstance(scene, SceneFile) and scene.count > LARGE


def _sources(scene: Gaussians | SceneFile) -> list[Path]:
    """Files that the output must not replace."""
    if isinstance(scene, SceneFile):
        return [scene.path]
    return [] if scene.origin is None else [Path(scene.origin.path)]


def _train_of(opened: SceneFile, cameras: CamerasLike, min_seen: float) -> Sequence[Camera]:
    """The training cameras; none where the scene needs none, or is refused anyway."""
    if blurring(opened.fused) or opened.raw(0, min(1, opened.count)).filter_3d is not None:
        return ()
    train = cameras_of(cameras, str(opened.path)).train
    check_frame_of(opened, train, min_seen)
    return train


def _fused(scene: Gaussians, cameras: CamerasLike, form: Form, min_seen: float) -> Gaussians:
    """The closed form for the Mip rule."""
    if blurring(scene.fused) or scene.filter_3d is not None:  # needs none, or is refused anyway
        return fuse(scene, None, form)
    known = cameras_of(cameras, scene)
    return fuse(scene, TrainingViews.of(scene, known, min_seen=min_seen), form)

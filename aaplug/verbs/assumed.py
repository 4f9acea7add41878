"""What stands in for cameras where there are none: views on an orbit, and an assumption about the training rate.

A scene's file does not say how finely training sampled it.  The assumption: by images of `TRAIN_VIEW` px taken from the
default orbit.  A 3D filter that the file stores tells the rate itself; `cfg_args` beside the file may tell the width.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from aaplug.core.cameras import Camera, CameraSet, look_at
from aaplug.core.errors import AaplugError, UsageError
from aaplug.core.gaussians import Gaussians, joined
from aaplug.core.monitor import Monitor
from aaplug.core.orbits import Frame, frame_of, orbit, pinhole
from aaplug.core.pyramids import Cutter
from aaplug.core.sampling import sampling_bounds
from aaplug.inspection.survey import probes
from aaplug.io.cameras import holds_cameras
from aaplug.io.cameras.cfg_args import CAPPED, DIVISORS, NAME, WIDTH_CAP, read_cfg_args
from aaplug.io.scenes.ply import Document
from aaplug.io.scenes.ply_tags import NERFSTUDIO
from aaplug.io.scenes.scene_file import SceneFile
from aaplug.methods.filters import NYQUIST_VARIANCE
from aaplug.options.orbit import FOV, OrbitOptions
from aaplug.options.shared import size_of
from aaplug.rendering.renderer import Renderer

TRAIN_VIEW = (WIDTH_CAP, WIDTH_CAP * 2 // 3)  # px: the width that 3DGS trains at by default, in a camera's usual shape
ORBIT = 8  # views
ELEVATION = 20.0  # degrees
RINGS = (0.0, 20.0, 40.0)  # degrees of elevation: the assumed training views
PROBE_ROWS = 16  # Gaussians at each place that is looked at
CROP = 128  # px: side of the part of a picture that is compared at other training rates
Z_UP = (0.0, 0.0, 1.0)  # nerfstudio turns its scenes so

TRAINING_RATE = "training rate: "  # how the note begins


@dataclass(frozen=True, kw_only=True)
class Orbit(OrbitOptions):
    """Without cameras: views on an orbit around the scene, and the training that is assumed."""

    def single(self) -> "Orbit":
        """The same for one picture, unless a number of views is given."""
        return self if self.orbit is not None or self.eye is not None else replace(self, orbit=1)

    def around(self, scene: Gaussians | SceneFile) -> CameraSet:
        """Cameras for a scene: the assumed training views, and as test views those to show.

        Raises:
            UsageError: the scene is empty, or a direction is none.
        """
        some, path = probed(scene), _path_of(scene)
        frame = self.frame(scene, some)
        train, why = self._trained(frame, some, path)
        found = CameraSet(train, self._shown(frame, train[0]), assumed=True)
        size, rate = f"{train[0].width}x{train[0].height}", rate_of(found, frame)
        note = f"{TRAINING_RATE}assumed as of {size} px from the orbit, {rate:.4g} px per unit in its middle ({why})"
        if path is not None and holds_cameras(path.parent):
            return replace(found, notes=(note, f"there are cameras: --cameras {path.parent}"))
        return replace(found, notes=(note,))

    def frame(self, scene: Gaussians | SceneFile, some: Gaussians | None = None) -> Frame:
        """What an orbit frames; raises UsageError as `around`.  some: the scene's `probed` ones, if they are known."""
        return frame_of(probed(scene) if some is None else some, self.up if self.up is not None else _stated_up(scene))

    def _trained(self, frame: Frame, some: Gaussians, path: Path | None) -> tuple[tuple[Camera, ...], str]:
        """The assumed training views, and what the assumption rests on."""
        size, why = TRAIN_VIEW, "as nothing says; --train-view or --train-rate do"
        if self.train_view is not None:
            size, why = size_of(self.train_view, "train_view"), "--train-view"
        elif width := _width_in_run(path):
            size, why = (width, round(width * TRAIN_VIEW[1] / TRAIN_VIEW[0])), f"width from {NAME}"
        views = _rings(frame, size)
        if self.train_rate is not None:
            factor = self.train_rate * frame.distance(math.radians(FOV)) / views[0].focal
            return _denser(views, factor), "--train-rate"
        if self.train_view is None and (factor := _filtered_rate(some, views)):
            return _denser(views, factor), "from the file's 3D filter"
        return views, why

    def _shown(self, frame: Frame, trained: Camera) -> tuple[Camera, ...]:
        """The views to show, as poses of the data set where they are like the training views."""
        size = trained.width, trained.height
        fov = math.radians(self.fov)
        centre = frame.centre if self.look_at is None else frame.centre.new_tensor(self.look_at)
        if self.eye is not None:
            pose = _pose(frame.centre.new_tensor(self.eye), centre, frame)
            return (pinhole("eye", size, min(size) / 2 / math.tan(fov / 2), pose),)
        elevation = math.radians(ELEVATION if self.elevation is None else self.elevation)
        views = orbit(replace(frame, centre=centre), self.orbit or ORBIT, size, elevation, fov)
        if self.look_at is not None or self.fov != FOV:
            return views
        return tuple(replace(view, fx=trained.fx, fy=trained.fy).as_trained() for view in views)


def rate_of(cameras: CameraSet, frame: Frame) -> float:
    """The assumed training rate in the middle of the frame, px per world unit."""
    return cameras.train[0].focal / frame.distance(math.radians(FOV))


def probed(scene: Gaussians | SceneFile) -> Gaussians:
    """Usable Gaussians from evenly spaced places of a scene or its file: enough of them to know where it is."""
    ranges = probes(scene.count if isinstance(scene, SceneFile) else len(scene), PROBE_ROWS)
    if isinstance(scene, SceneFile):
        some = joined([scene.raw(rows.start, rows.stop) for rows in ranges] or [scene.raw(0, 0)])
    else:
        some = scene[torch.cat([torch.arange(rows.start, rows.stop) for rows in ranges])] if ranges else scene
    finite = [column.flatten(1 if column.ndim > 1 else 0).isfinite() for column in some.columns.values()]
    return some[torch.stack([f if f.ndim == 1 else f.all(dim=1) for f in finite]).all(dim=0)]


def say_assumed(
    cameras: CameraSet, monitor: Monitor, renderer: Renderer | None = None, view: Camera | None = None
) -> None:
    """Say what is assumed, and how much a picture hangs on it; nothing where the cameras are known.

    view: the picture; None for the first test view at the training size.
    """
    if not cameras.assumed:
        return
    for note in cameras.notes:
        monitor.say(note)
    if renderer is not None:
        half, twice = decibels_at(renderer, view or cameras.test[0], (0.5, 2.0))
        monitor.say(f"with half that rate the image would be {_apart(half)}, with twice {_apart(twice)}")


@torch.no_grad()
def decibels_at(renderer: Renderer, view: Camera, factors: Sequence[float]) -> list[float]:
    """PSNR between the middle of a view, and what it would be if training had been `factors` times as fine; in dB."""
    width, height = min(view.width, CROP), min(view.height, CROP)
    left, top = (view.width - width) // 2, (view.height - height) // 2
    crop = replace(view, width=width, height=height, cx=view.cx - left, cy=view.cy - top)
    image, found = renderer(crop).rgb.clamp(0, 1), []
    for factor in factors:
        trained = None if view.trained_focal is None else view.trained_focal * factor
        training = renderer.training.finer(factor)
        cutter = None if renderer.cutter is None else Cutter.of(renderer.cutter.pyramid, training)
        other = replace(renderer, training=training, cutter=cutter)
        error = float((image - other(replace(crop, trained_focal=trained)).rgb.clamp(0, 1)).square().mean())
        found.append(math.inf if error == 0 else -10 * math.log10(error))
    return found


def _apart(decibels: float) -> str:
    return "the same" if decibels == math.inf else f"{decibels:.0f} dB from this one"


def _rings(frame: Frame, size: tuple[int, int]) -> tuple[Camera, ...]:
    """Training views at poses of the data set."""
    fov = math.radians(FOV)
    rings = [orbit(frame, ORBIT, size, math.radians(e), fov, f"training_{e:.0f}") for e in RINGS]
    return tuple(view.as_trained() for ring in rings for view in ring)


def _denser(views: Sequence[Camera], factor: float) -> tuple[Camera, ...]:
    """The views at `factor` times their sampling rate, in whole pixels."""
    size = [max(1, round(side * factor)) for side in (views[0].width, views[0].height)]
    focal = views[0].focal * factor
    return tuple(pinhole(v.name, (size[0], size[1]), focal, v.cam_from_world).as_trained() for v in views)


def _filtered_rate(some: Gaussians, views: Sequence[Camera]) -> float | None:
    """How much finer training was than the views, by the 3D filter: its variance is 0.2 px² at the highest rate."""
    if some.filter_3d is None:
        return None
    bounds = sampling_bounds(some.means, views)
    known = bounds.seen & (some.filter_3d > 0)
    if not known.any():
        return None
    return float((math.sqrt(NYQUIST_VARIANCE) / some.filter_3d[known] / bounds.highest[known]).median())


def _stated_up(scene: Gaussians | SceneFile) -> tuple[float, float, float] | None:
    """The direction that the program which wrote the file turns up."""
    document = scene.document if isinstance(scene, SceneFile) else scene.origin and scene.origin.document
    comments = document.header.comments if isinstance(document, Document) else []
    return Z_UP if any(NERFSTUDIO.match(comment) for comment in comments) else None


def _path_of(scene: Gaussians | SceneFile) -> Path | None:
    if isinstance(scene, SceneFile):
        return scene.path
    return None if scene.origin is None else Path(scene.origin.path)


def _width_in_run(path: Path | None) -> int | None:
    """The width in px that a training run's `cfg_args` beside the file, or in its model folder, states."""
    if path is None:
        return None
    for folder in (path.parent, *path.absolute().parents[2:3]):
        try:
            resolution = read_cfg_args(folder / NAME).resolution
        except AaplugError:  # there is none, or it is of another program
            continue
        return None if resolution in (CAPPED, *DIVISORS) else int(resolution)
    return None


def _pose(eye: torch.Tensor, target: torch.Tensor, frame: Frame) -> torch.Tensor:
    """`look_at` with the frame's up; where that is the direction of sight, its front points up in the image."""
    sight = target - eye
    if not float(sight.norm()) > 0:
        raise UsageError("eye", "and the place to look at are the same; move one")
    beside = torch.linalg.cross(sight / sight.norm(), frame.up).norm()
    return look_at(eye, target, frame.up if float(beside) > 1e-6 else frame.front)

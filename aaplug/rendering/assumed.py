"""Stand-ins for cameras where there are none: views on an orbit, and an assumed training rate.

A scene's file does not say how finely training sampled it.  The assumption: by images of `TRAIN_VIEW` px taken from the
default orbit.  A 3D filter that the file stores tells the rate itself; `cfg_args` beside the file may tell the width.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from aaplug.core.cameras import Camera, CameraSet, centred, look_at
from aaplug.core.gaussians import Gaussians
from aaplug.core.orbits import DOWN_IS_Y, Frame, frame_of
from aaplug.core.orbits import orbit as orbit_views
from aaplug.core.sampling import sampling_bounds
from aaplug.io.cameras import recognized
from aaplug.io.cameras.inria import CAPPED, CFG_ARGS, DIVISORS, read_cfg_args
from aaplug.io.cameras.sets import WIDTH_CAP
from aaplug.io.scenes import SceneLike, scene_of
from aaplug.io.scenes.ply import Document
from aaplug.io.scenes.ply_tags import NERFSTUDIO
from aaplug.io.scenes.scene import Scene
from aaplug.methods.filters.smoothing import NYQUIST_VARIANCE
from aaplug.options.verbs import DEFAULT_FOV, Orbit, size_of
from aaplug.rendering.renderer import Renderer
from aaplug.system.contracts import contract
from aaplug.system.errors import AaplugError, UsageError

TRAIN_VIEW = (WIDTH_CAP, WIDTH_CAP * 2 // 3)  # px: the width that 3DGS trains at by default, in a camera's usual shape
ORBIT_VIEWS = 8
ELEVATION = 20.0  # degrees
RINGS = (0.0, 20.0, 40.0)  # degrees of elevation: the assumed training views
PROBE_ROWS = 16  # Gaussians at each place that is looked at
CROP_SIDE = 128  # px: side of the part of a picture that is compared at other training rates
CROP_SAMPLES = 1024  # along its side, at most
Z_UP = (0.0, 0.0, 1.0)  # nerfstudio turns its scenes so

TRAINING_RATE = "training rate: "  # how the note begins


@contract
def cameras_around(scene: SceneLike, orbit: Orbit, single: bool = False) -> CameraSet:
    """The scene's own training views, or else assumed ones, and as test views those that an orbit shows.

    single: show one view, unless the orbit says how many.

    Raises:
        UsageError: the scene is empty, or a direction is none.
        FormatError: the scene's own cameras cannot be read.
    """
    if single and orbit.orbit is None and orbit.eye is None:
        orbit = replace(orbit, orbit=1)
    scene = scene_of(scene)
    sample = scene.sample(PROBE_ROWS)
    frame = frame_around(scene, orbit, sample)
    path = scene.source
    up = f"up: {' '.join(f'{x:.4g}' for x in frame.up.tolist())} ({up_evidence(scene, orbit, frame)})"
    if orbit.train_view is orbit.train_rate is None and (own := scene.cameras) is not None:
        free = replace(own.train[0], trained_focal=None)
        return replace(own, test=_orbit_views(orbit, frame, free), notes=(*own.notes, up))
    train, reason = _assumed_training(orbit, frame, sample, path)
    cameras = CameraSet(train, _orbit_views(orbit, frame, train[0]), assumed=True)
    size, rate = f"{train[0].width}x{train[0].height}", rate_of(cameras, frame)
    note = f"{TRAINING_RATE}assumed as of {size} px from the orbit, {rate:.4g} px per unit in its middle ({reason})"
    notes = (note, up)
    if path is not None and recognized(path.parent):
        notes = (*notes, f"there are cameras: --cameras {path.parent}")
    return replace(cameras, notes=notes)


def frame_around(scene: Scene, orbit: Orbit, sample: Gaussians | None = None) -> Frame:
    """The frame of an orbit; raises UsageError as `cameras_around`.  sample: the scene's, if it is known."""
    up = orbit.up
    if up is None and _by_nerfstudio(scene):
        up = Z_UP
    return frame_of(scene.sample(PROBE_ROWS) if sample is None else sample, up)


def up_evidence(scene: Scene, orbit: Orbit, frame: Frame) -> str:
    """The evidence for the direction that points up in the frame, in words."""
    if orbit.up is not None:
        return "--up"
    if _by_nerfstudio(scene):
        return "as nerfstudio wrote the file; --up changes it"
    if frame.up.tolist() == [*DOWN_IS_Y]:
        return "assumed; --up changes it"
    return "as colours vary most seen from there; --up changes it"


def _by_nerfstudio(scene: Scene) -> bool:
    comments = scene.document.header.comments if isinstance(scene.document, Document) else []
    return any(NERFSTUDIO.match(comment) for comment in comments)


def _assumed_training(
    orbit: Orbit, frame: Frame, sample: Gaussians, path: Path | None
) -> tuple[tuple[Camera, ...], str]:
    """The assumed training views, and what the assumption rests on."""
    size, reason = TRAIN_VIEW, "the default; --train-view or --train-rate set it"
    if orbit.train_view is not None:
        size, reason = size_of(orbit.train_view, "train_view"), "--train-view"
    elif width := _width_in_run(path):
        size, reason = (width, round(width * TRAIN_VIEW[1] / TRAIN_VIEW[0])), f"width from {CFG_ARGS}"
    fov = math.radians(DEFAULT_FOV)
    rings = [orbit_views(frame, ORBIT_VIEWS, size, math.radians(e), fov, f"training_{e:.0f}") for e in RINGS]
    views = tuple(view.as_trained() for ring in rings for view in ring)
    if orbit.train_rate is not None:
        factor, reason = orbit.train_rate * frame.distance(fov) / views[0].focal, "--train-rate"
    elif orbit.train_view is None and sample.filter_3d is not None:
        bounds = sampling_bounds(sample.means, views)
        filtered = bounds.seen & (sample.filter_3d > 0)
        if not filtered.any():
            return views, reason
        # the filter's variance is 0.2 px² at the highest rate
        rates = math.sqrt(NYQUIST_VARIANCE) / sample.filter_3d[filtered] / bounds.highest[filtered]
        factor, reason = float(rates.median()), "from the file's 3D filter"
    else:
        return views, reason
    width, height = (max(1, round(side * factor)) for side in (views[0].width, views[0].height))
    focal = views[0].focal * factor  # the views at `factor` times their sampling rate, in whole pixels
    return tuple(centred(v.name, (width, height), focal, v.cam_from_world).as_trained() for v in views), reason


def _orbit_views(orbit: Orbit, frame: Frame, trained: Camera) -> tuple[Camera, ...]:
    """The views to show, of a training view's size; poses of the data set where it is one and they are like it."""
    size = trained.width, trained.height
    fov = math.radians(orbit.fov)
    centre = frame.centre if orbit.look_at is None else frame.centre.new_tensor(orbit.look_at)
    if orbit.eye is not None:
        eye = frame.centre.new_tensor(orbit.eye)
        sight = centre - eye
        if not float(sight.norm()) > 0:
            raise UsageError("eye", "and the place to look at are the same; move one")
        beside = torch.linalg.cross(sight / sight.norm(), frame.up).norm()
        up = frame.up if float(beside) > 1e-6 else frame.front  # which points up where up is the direction of sight
        return (centred("eye", size, min(size) / 2 / math.tan(fov / 2), look_at(eye, centre, up)),)
    elevation = math.radians(ELEVATION if orbit.elevation is None else orbit.elevation)
    views = orbit_views(replace(frame, centre=centre), orbit.orbit or ORBIT_VIEWS, size, elevation, fov)
    if trained.trained_focal is None or orbit.look_at is not None or orbit.fov != DEFAULT_FOV:
        return views
    return tuple(replace(view, fx=trained.fx, fy=trained.fy).as_trained() for view in views)


def rate_of(cameras: CameraSet, frame: Frame) -> float:
    """The assumed training rate in the middle of the frame, px per world unit."""
    return cameras.train[0].focal / frame.distance(math.radians(DEFAULT_FOV))


@torch.no_grad()
def decibels_at(renderer: Renderer, view: Camera, factors: Sequence[float]) -> list[float]:
    """PSNR between the middle of a view, and what it would be if training had been `factors` times as fine; in dB."""
    side = max(1, min(CROP_SIDE, CROP_SAMPLES // renderer.samples(view)))
    width, height = min(view.width, side), min(view.height, side)
    crop = view.cropped((view.width - width) // 2, (view.height - height) // 2, width, height)
    image, decibels = renderer(crop).rgb.clamp(0, 1), []
    for factor in factors:
        trained = None if view.trained_focal is None else view.trained_focal * factor
        other = renderer.trained_at(factor)(replace(crop, trained_focal=trained)).rgb.clamp(0, 1)
        error = float((image - other).square().mean())
        decibels.append(math.inf if error == 0 else -10 * math.log10(error))
    return decibels


def _width_in_run(path: Path | None) -> int | None:
    """The width in px that a training run's `cfg_args` beside the file, or in its model folder, states."""
    if path is None:
        return None
    for folder in (path.parent, *path.absolute().parents[2:3]):
        try:
            resolution = read_cfg_args(folder / CFG_ARGS).resolution
        except AaplugError:  # there is none, or it is of another program
            continue
        return None if resolution in (CAPPED, *DIVISORS) else int(resolution)
    return None

"""Views with the lens, size, aperture and shutter that options ask for, and how their images are stored.

All is checked before anything is drawn.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import torch

from aaplug.core.camera_paths import median_depth, toward
from aaplug.core.cameras import NEEDS_PINHOLE, Aperture, Camera, Exposure
from aaplug.core.colours import BLACK
from aaplug.core.lenses import EQUIDISTANT, EQUIRECT, EQUISOLID, ORTHO, PINHOLE, Lens
from aaplug.io.cameras.camera_path import CameraPath
from aaplug.io.image_formats import Storage
from aaplug.options.verbs import DEFAULT_SENSOR, ImageOptions, check_side, size_of
from aaplug.rendering.job import Job
from aaplug.system.errors import UsageError, listing

Drawn = TypeVar("Drawn", bound=ImageOptions)
STRETCH = 0.02  # of the aspect, above which images are said to be stretched
SAMPLES, FAST_SAMPLES = 16, 5  # of an exposure


def storage_of(output: Path, options: Drawn) -> tuple[Storage, Drawn]:
    """How images are stored, and the options; those for images with alpha have no background.

    Raises UsageError if the format does not hold what is asked for, or there is to be a background and alpha or no rgb.
    """
    passes = [options.passes] if isinstance(options.passes, str) else options.passes
    stored = (options.transparent, options.bit_depth, options.colour, options.normal_axes)
    storage = Storage.of(output, options.format, passes, *stored)
    if options.background != "auto" and "rgb" not in storage.passes:
        raise UsageError("background", "is of the pass rgb, which `passes` leaves out")
    if "alpha" not in storage.passes:
        return storage, options
    if options.background != "auto":
        raise UsageError("background", "is not stored where alpha is; leave one of them out")
    return storage, replace(options, background=BLACK)


def drawn(job: Job[ImageOptions], path: CameraPath | None, ends: Sequence[Camera] = ()) -> list[list[Camera]]:
    """The cameras of each eye: two for vr180, else one; with the lens, size and exposure that a job's options ask for.

    path: frames of one motion; None for the job's views.  ends: where the shutter closes, see `filmed`.
    """
    moves, path = path is not None, path or CameraPath(job.views, unsized=job.cameras.assumed)
    cameras, count = path.cameras, 2 if job.options.lens == "vr180" else 1
    if moves and job.scene.frames is not None:  # a scene in time passes once
        moments = len(job.scene.frames)
        cameras = [replace(view, frame=i * moments // len(cameras)) for i, view in enumerate(cameras)]
    views, ends = (_seen(job, each, path.unsized) for each in (cameras, ends))
    eyes = [(views[eye::count], ends[eye::count]) for eye in range(count)]
    return [filmed(eye_views, job.options, moves, path.shutter, eye_ends) for eye_views, eye_ends in eyes]


def _seen(job: Job[ImageOptions], views: Sequence[Camera], unsized: bool) -> list[Camera]:
    """The views through the lens and at the size that a job's options ask for; with vr180 of both eyes in turn.

    unsized: pixels stay square where a resolution changes the aspect, as they do through a lens that shows its angle
        along the shorter side.

    Raises UsageError if an image would be larger than `MAX_SIDE`.
    """
    options = job.options
    views = [replace(view, exposure=None) for view in views] if options.samples == 0 else views
    if options.lens not in (None, "pinhole") and any(view.exposure and view.exposure.aperture for view in views):
        raise UsageError("lens", f"{NEEDS_PINHOLE}; `samples` of 0 leaves out that of the path file")
    bent = views if options.lens is None else [seen for view in views for seen in _through_lens(job, view)]
    if options.resolution is None:
        sized = [view.scaled(options.scale or 1.0) for view in bent]
    else:
        sizes = [size_of(options.resolution, shape=(view.width, view.height)) for view in bent]
        square = unsized or options.lens in ("fisheye", "equisolid", "ortho")
        sized = [(v.framed if square else v.resized)(*size) for v, size in zip(bent, sizes, strict=True)]
        stretched = [v for v, by in zip(sized, bent, strict=True) if abs(v.fx / by.fx * by.fy / v.fy - 1) > STRETCH]
        if stretched and "-1" not in options.resolution:
            what = f"{stretched[0].width}x{stretched[0].height} px stretches view {stretched[0].name}"
            job.monitor.say(f"resolution: {what}; -1 on one side keeps its aspect")
    for view in sized:
        check_side(view.name, view.width, view.height)
    return sized


def _through_lens(job: Job[ImageOptions], view: Camera) -> list[Camera]:
    """The view through the lens that the options name, with pixels as dense at the image's centre.

    Ortho shows things at the scene's median depth as large as the view does, a fisheye its angle along the shorter
    side, equirect all around, vr180 half of that by two eyes, of which the names say left and right.
    """
    options = job.options
    half, side = math.radians(options.lens_angle) / 2, min(view.hw)
    if options.lens == "pinhole":
        return [replace(view, lens=PINHOLE)]
    if options.lens == "ortho":
        factor = 1 / median_depth(job.scene.gaussians().means, view)
        return [replace(view, lens=ORTHO, fx=view.fx * factor, fy=view.fy * factor, trained_focal=None)]
    if options.lens in ("fisheye", "equisolid"):
        lens = EQUIDISTANT if options.lens == "fisheye" else EQUISOLID
        focal = side / 2 / (half if lens == EQUIDISTANT else 2 * math.sin(half / 2))
        lens = replace(lens, max_angle=min(180.0, math.degrees(half)))
        return [_centred(view, lens, view.width, view.height, focal)]
    height = 2 * round(math.pi * view.focal / 2)
    if options.lens == "equirect":
        return [_centred(view, EQUIRECT, 2 * height, height, height / math.pi)]
    eyes = []
    for name, sign in (("left", 1), ("right", -1)):
        eye = _centred(view, replace(EQUIRECT, max_angle=90.0), height, height, height / math.pi)
        pose = eye.cam_from_world.clone()
        pose[0, 3] += sign * (options.eye_distance or 0.0) / 2
        eyes.append(replace(eye, name=f"{view.name}-{name}", cam_from_world=pose))
    return eyes


def _centred(view: Camera, lens: Lens, width: int, height: int, focal: float) -> Camera:
    """A free camera in the view's place, with its principal point in the middle."""
    size = {"width": width, "height": height, "cx": width / 2, "cy": height / 2, "fx": focal, "fy": focal}
    return replace(view, lens=lens, **size, trained_focal=None, photo=None)


def filmed(
    views: Sequence[Camera],
    options: ImageOptions,
    path: bool,
    shutter: float | None = None,
    camera_to: Sequence[Camera] = (),
) -> list[Camera]:
    """The views with an exposure each, where the options or the views themselves ask for one.

    views: at the size to draw; the frames of one motion in order, if `path`.
    options: they win over what the views say, and over `shutter`, which is of the path's file.
    camera_to: for one view, the camera where the shutter closes.

    Raises UsageError if an aperture is asked for through a lens that bends, the focus lies behind a camera, nothing
        moves, sizes or kinds of lenses differ along a motion, or samples of nothing are asked for.
    """
    shutter = shutter if options.shutter is None else options.shutter
    if options.samples == 0:
        return [replace(view, exposure=None) for view in views]
    apertures = [_aperture(view, options) for view in views]
    motions: Sequence[tuple[Camera, Camera]] = ()
    option = "camera_to" if camera_to else "shutter"
    if camera_to or shutter is not None:
        kinds = {(view.hw, view.lens.projection) for view in (*views, *camera_to)}
        if len(kinds) > 1:
            raise UsageError(option, "moves between views of different sizes or lenses; give `resolution` or `lens`")
    if camera_to:
        if path or not len(views) == len(camera_to) == 1:
            got = " to ".join(listing([view.name for view in each], most=3) for each in (views, camera_to))
            raise UsageError("camera_to", f"moves one view to one other, not a path or a scene in time; got {got}")
        if options.shutter is not None:
            raise UsageError("camera_to", "is where the shutter closes; leave out `shutter`")
        motions = [(_instant(views[0]), _instant(camera_to[0]))]
    elif shutter is not None and (len(views) > 1 or options.shutter is not None):
        if not path:
            problem = "is a share of the time between frames of a path; for one view give `camera_to`"
            raise UsageError("shutter", problem)
        if len(views) < 2:
            raise UsageError("shutter", "finds no motion: the path has one frame")
        frames, half = [_instant(view) for view in views], shutter / 2
        ends = toward(frames[0], frames[1], -1.0), toward(frames[-1], frames[-2], -1.0)  # the path goes straight on
        around = zip(frames, [ends[0], *frames[:-1]], [*frames[1:], ends[1]], strict=True)
        motions = [(_moved(*each, -half), _moved(*each, half)) for each in around]
    if motions and all(
        torch.allclose(first.cam_from_world, last.cam_from_world, 1e-9, 1e-12) and first.intrinsics == last.intrinsics
        for first, last in motions
    ):
        if camera_to or options.shutter is not None:
            raise UsageError(option, "finds no motion: the path has zero length")
        motions = ()  # the path's file has a shutter, and a camera that stands still
    if options.samples is not None and not any(apertures) and not motions and shutter is None:
        moving = "`shutter`" if path else "`camera_to`"
        raise UsageError("samples", f"are of an aperture or a shutter; give `f_stop` or {moving}")
    count = options.samples or (FAST_SAMPLES if options.quality == "fast" else SAMPLES)
    exposures = [
        Exposure(aperture, motion, count) if aperture or motion else None
        for aperture, motion in zip(apertures, motions or [None] * len(views), strict=True)
    ]
    return [replace(view, exposure=exposure) for view, exposure in zip(views, exposures, strict=True)]


def _aperture(view: Camera, options: ImageOptions) -> Aperture | None:
    """The aperture that the options give the view, or else its own."""
    if options.f_stop is None:
        return view.exposure and view.exposure.aperture
    if view.lens != PINHOLE:
        raise UsageError("f_stop", f"{NEEDS_PINHOLE}, got {view.lens.kind}; give `lens` pinhole")
    focus = options.focus_distance
    if options.focus_at is not None:
        place = torch.tensor([options.focus_at], dtype=torch.float64)
        focus = float(view.project(place)[1])
        if focus <= 0:
            raise UsageError("focus_at", f"lies behind the camera of view {view.name}, at a depth of {focus:.4g}")
    assert focus is not None
    sensor = DEFAULT_SENSOR if options.sensor is None else options.sensor
    focal = view.fx / view.width * sensor  # in scene units
    return Aperture(focal / options.f_stop / 2, focus, options.blades or 0)


def _instant(view: Camera) -> Camera:
    return replace(view, exposure=None)


def _moved(frame: Camera, before: Camera, after: Camera, share: float) -> Camera:
    """The frame's camera after a share of the time between frames, at the mean of the speeds before and after it.

    Each of the speeds alone would cut the corner: on a curve, the frame would lie beside its own pose.
    """
    return toward(toward(frame, before, -share), toward(frame, after, share), 0.5)

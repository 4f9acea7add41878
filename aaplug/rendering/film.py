"""Views with the aperture and the shutter that options ask for, checked before anything is drawn."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from aaplug.core.camera_paths import toward
from aaplug.core.cameras import NEEDS_PINHOLE, Aperture, Camera, Exposure
from aaplug.core.lenses import PINHOLE
from aaplug.options.verbs import DEFAULT_SENSOR, ImageOptions
from aaplug.system.errors import UsageError, counted

SAMPLES, FAST_SAMPLES = 16, 5  # a lattice of a prime number of points fills the opening far better than one of 4 or 6


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
            got = f"got {counted(len(camera_to), 'view')} for {counted(len(views), 'view')}"
            raise UsageError("camera_to", f"names one view, for one of `views` that is not of a path; {got}")
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

"""Cameras of USD, .usda, .usdc, .usd and .usdz: the first that time samples move, or else the first.

A camera looks along -z with y up, in the stage's world.  Its focal length, apertures (the size of the film) and their
offsets are in tenths of a world unit; f-stop, focus distance and shutter are UsdGeom.Camera's.  The frames are those of
the stage's framesPerSecond, else its time codes.  Layers that the file names must lie in its folder: others are refused
before the stage is composed.
"""

import os
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

from aaplug.core.cameras import Aperture, Camera, Exposure, numbered
from aaplug.io.cameras.camera_path import CameraPath
from aaplug.io.cameras.keyframes import UNSIZED, frame_times
from aaplug.io.cameras.poses import inverse, pose
from aaplug.io.values import Place, focal, number
from aaplug.system.errors import FormatError, UsageError
from aaplug.system.extras import check_installed

UNIT = 10.0  # of the camera's lengths in a world unit
MAX_LAYERS = 1000


def sniff(path: Path) -> bool:
    """True for a file of that name."""
    return path.suffix.lower() in (".usd", ".usda", ".usdc", ".usdz")


def path_of(path: Path, fps: float | None = None) -> CameraPath:
    """The camera at each frame, or at rest as a path of one; fps: how many a second, None for the stage's own."""
    check_installed("pxr", "usd", "path", f"{path.suffix} files need the extra `usd`")
    Usd, UsdGeom = module("Usd"), module("UsdGeom")
    try:
        _check_layers(path)
        stage = Usd.Stage.Open(str(path))
        found = [UsdGeom.Camera(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)]
        if not found:
            raise FormatError(path, "holds no camera")
        camera = next(filter(_moves, found), found[0])
        place = Place(path, f"camera {camera.GetPath()}")
        times, moving = [Usd.TimeCode.EarliestTime()], _moves(camera)
        codes = number(stage.GetTimeCodesPerSecond(), place, "timeCodesPerSecond")
        authored = stage.HasAuthoredMetadata("framesPerSecond")
        rate = number(stage.GetFramesPerSecond(), place, "framesPerSecond") if authored else codes
        place.expect(codes > 0 and rate > 0, "frames and time codes per second", "above 0", [rate, codes])
        fps = fps or rate
        if stage.HasAuthoredTimeCodeRange() and moving:
            first, last = (number(t, place, "time codes") for t in (stage.GetStartTimeCode(), stage.GetEndTimeCode()))
            place.expect(first <= last, "time codes", "rising", [first, last])
            times = list(map(Usd.TimeCode, frame_times(first, last, fps / codes, place).tolist()))
        elif moving:
            raise place.error("it is animated, but the stage has no startTimeCode and endTimeCode")
        named = zip(numbered(len(times)), times, strict=True)
        cameras, shutters = zip(*(_camera(name, camera, time, place) for name, time in named), strict=True)
        shutter = shutters[0] * rate / codes
        return CameraPath(cameras, fps, shutter if 0 < shutter <= 1 else None, unsized=True)
    except (module("Tf").ErrorException, UnicodeDecodeError) as error:  # its message may be no text
        raise FormatError(path, "cannot be read: it breaks the format of USD") from error


def module(name: str) -> Any:
    """A module of the package `usd-core`, whose stubs are not complete."""
    return import_module(f"pxr.{name}")


def _check_layers(path: Path) -> None:
    """Refuse layers outside of the file's folder, whoever names them."""
    from aaplug.io.usd_child import layers_of  # its package is an extra

    home = path.parent.resolve()
    try:
        for number, (asset, file) in enumerate(layers_of(str(path))):
            if "://" in asset or not Path(os.path.realpath(file)).is_relative_to(home):
                raise FormatError(path, f"names a layer outside of its folder: {asset!r}")
            if number >= MAX_LAYERS:
                raise FormatError(path, f"names more than {MAX_LAYERS} layers")
    except ValueError as error:
        raise FormatError(path, str(error)) from error


def _moves(camera: Any) -> bool:
    """True if the camera, or a prim above it, has time samples."""
    UsdGeom, prim = module("UsdGeom"), camera.GetPrim()
    names = UsdGeom.Camera.GetSchemaAttributeNames(False)
    own = any(prim.GetAttribute(name).ValueMightBeTimeVarying() for name in names)
    while prim and not own:
        own = UsdGeom.Xformable(prim).TransformMightBeTimeVarying() if prim.IsA(UsdGeom.Xformable) else False
        prim = prim.GetParent()
    return own


def _camera(name: str, camera: Any, time: Any, place: Place) -> tuple[Camera, float]:
    """The camera at a time, and its shutter in time codes."""

    def value(field: str) -> float:
        return number(getattr(camera, f"Get{field}Attr")().Get(time), place, field)

    kind = camera.GetProjectionAttr().Get(time)
    place.expect(kind == "perspective", "projection", "perspective", kind)
    length, across, down = value("FocalLength"), value("HorizontalAperture"), value("VerticalAperture")
    right = length > 0 and across > 0 and down > 0 and 1 / 64 <= across / down <= 64
    place.expect(right, "focalLength and apertures", "above 0, of a usual shape", (length, across, down))
    width, rate = UNSIZED[0], UNSIZED[0] / across  # px per unit of the film
    height = max(1, round(down * rate))
    f = focal(length * rate, place, "focalLength")
    cx = width / 2 - value("HorizontalApertureOffset") * rate
    cy = height / 2 + value("VerticalApertureOffset") * rate
    rows = [list(row) for row in camera.ComputeLocalToWorldTransform(time)]
    motion = torch.tensor(rows, dtype=torch.float64).T
    motion[:3, :3] /= motion[:3, :3].norm(dim=0)
    place.expect(bool(motion.isfinite().all()), "its transform", "finite", rows)
    cam_from_world = inverse(pose(motion, place, "its transform", opengl=True))
    stop, focus = value("FStop"), value("FocusDistance")
    shutter = value("ShutterClose") - value("ShutterOpen")
    try:
        aperture = Exposure(Aperture(length / UNIT / stop / 2, focus)) if stop > 0 and focus > 0 else None
        view = Camera(name, width, height, f, f, cx, cy, cam_from_world, exposure=aperture)
    except UsageError as error:
        raise place.error(str(error)) from error
    return view, shutter

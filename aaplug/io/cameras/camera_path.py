"""nerfstudio's `camera_path.json`: free cameras along a path, the frames of a video.

{render_width, render_height, fps, camera_type, camera_path: [{camera_to_world, fov}]}.  camera_to_world: 16 numbers,
row by row, OpenGL axes, in the frame of the trained scene; fov: the vertical angle in degrees; sizes in px.  The live
page adds what makes a camera exact, in px: fl_x, fl_y, cx, cy and, at a pose of the data set, trained_focal.  Our
add-on for Blender adds shutter, a share of the time between frames, and to a frame an aperture {radius, focus, blades}.
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from aaplug.core.cameras import Aperture, Camera, CameraSet, Exposure, centred, numbered
from aaplug.io.cameras.poses import inverse, pose
from aaplug.io.cameras.sets import CameraFileOptions, at_file_size, described_sizes, undivided
from aaplug.io.values import entries, focal, mentions, number, object_of, pixels, read_json
from aaplug.system.errors import UsageError, counted

KEY = "camera_path"
PERSPECTIVE = "perspective"
DEFAULT_FPS = 24.0  # frames per second, if the file does not say
EXACT = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", "trained_focal": "trained_focal"}  # fields by key
MAX_ANGLE = 180.0  # degrees: the angle of view of a pinhole is less

name = "camera_path"
sign = "a JSON file with camera_path (nerfstudio)"
sniff = partial(mentions, keys=[KEY, "camera_to_world"])


@dataclass(frozen=True)
class CameraPath:
    """Cameras in order, and how they are filmed.

    fps: frames per second; None if nothing says.
    shutter: time that the shutter is open, as a share of that from frame to frame; None if nothing says.
    unsized: the file gives no size, and an image of another shape keeps its pixels square.
    """

    cameras: tuple[Camera, ...]
    fps: float | None = None
    shutter: float | None = None
    unsized: bool = False


def read(path: Path, options: CameraFileOptions) -> CameraSet:
    """The cameras.  They are free: not poses of a dataset, so they say nothing about the sampling of training."""
    source = [replace(camera, exposure=None) for camera in path_of(path).cameras]
    sized, _ = at_file_size(source, options)
    cameras = [replace(new, trained_focal=old.trained_focal) for new, old in zip(sized, source, strict=True)]
    split = undivided(cameras, "a path has no split")
    what = f"camera path: {counted(len(cameras), 'free camera')}, {described_sizes(cameras)}"
    note = f"{what}; used in place of training cameras, which would give better sampling bounds"
    return replace(split, notes=(note, *split.notes))


def path_of(path: Path, _: float | None = None) -> CameraPath:
    """The frames of a video, as the file lists them; raises FormatError for a file that breaks its format."""
    about = object_of(read_json(path), path, "the path", f"'{KEY}', as nerfstudio writes", KEY)
    kind = about.fields.get("camera_type", PERSPECTIVE)
    about.place.expect(kind == PERSPECTIVE, "camera_type", PERSPECTIVE, kind)
    size = about.get("render_width", pixels), about.get("render_height", pixels)
    fps = about.get("fps", number, DEFAULT_FPS)
    about.place.expect(fps > 0, "fps", "above 0", fps)
    frames = entries(path, "frame", about.fields[KEY])
    shutter = about.get("shutter", number) if about.fields.get("shutter") is not None else None
    about.place.expect(shutter is None or 0 < shutter <= 1, "shutter", "above 0, at most 1", shutter)
    cameras = list[Camera]()
    for entry, name in zip(frames, numbered(len(frames)), strict=True):
        angle = entry.get("fov", number)
        entry.place.expect(0 < angle < MAX_ANGLE, "fov", f"above 0 and below {MAX_ANGLE:g} degrees", angle)
        f = focal(size[1] / 2 / math.tan(math.radians(angle) / 2), entry.place, "fov's focal length")
        motion = entry.vector("camera_to_world", 16).reshape(4, 4)
        cam_from_world = inverse(pose(motion, entry.place, "camera_to_world", opengl=True))
        exact = {
            field: entry.get(key, number if key in ("cx", "cy") else focal)
            for key, field in EXACT.items()
            if entry.fields.get(key) is not None
        }
        exposure = None
        if entry.fields.get("aperture") is not None:
            aperture = entry.entry("aperture")
            radius, focus = aperture.get("radius", number), aperture.get("focus", number)
            blades = aperture.get("blades", number, 0.0)
            try:
                exposure = Exposure(Aperture(radius, focus, int(blades)))
            except UsageError as error:
                raise entry.place.error(f"aperture: {error}") from error
        cameras.append(replace(centred(name, size, f, cam_from_world), **exact, exposure=exposure))
    return CameraPath(tuple(cameras), fps, shutter)

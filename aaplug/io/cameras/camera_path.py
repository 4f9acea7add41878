"""nerfstudio's `camera_path.json`: the frames of a video.

{render_width, render_height, fps, camera_type, camera_path: [{camera_to_world, fov}]}.  Sizes are in px;
camera_to_world: 16 numbers, row by row, OpenGL axes (x right, y up, z backward), world units; fov: the vertical angle
in degrees.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import torch

from aaplug.cameras import Camera
from aaplug.errors import FormatError
from aaplug.io.cameras.values import Entry, Place, entries, inverse, mentions, pose, read_json

PERSPECTIVE = "perspective"
LEAST_ANGLE, MOST_ANGLE = 1e-6, 180 - 1e-6  # degrees
OPENCV_FROM_OPENGL = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)  # y and z change sign


@dataclass(frozen=True)
class CameraPath:
    """Cameras in order, and how many are shown a second."""

    cameras: tuple[Camera, ...]
    fps: float


def sniff(path: Path) -> bool:
    """Whether a file's keys are those of a camera path."""
    return mentions(path, ["camera_path"])


def read_camera_path(path: Path) -> CameraPath:
    """The frames of a camera path.

    Raises:
        FormatError: the file is not what it should be.
    """
    document = read_json(path)
    if not isinstance(document, dict) or "camera_path" not in document:
        raise FormatError(path, "should be an object with 'camera_path', as nerfstudio writes")
    about = Entry(Place(path, "the path"), document)
    kind = document.get("camera_type", PERSPECTIVE)
    if kind != PERSPECTIVE:
        raise about.place.wrong("camera_type", PERSPECTIVE, kind)
    width, height = about.pixels("render_width"), about.pixels("render_height")
    fps = about.number("fps")
    if not fps > 0:
        raise about.place.wrong("fps", "above 0", fps)
    frames = entries(path, "frame", document["camera_path"])
    digits = len(str(len(frames) - 1))
    cameras = (_camera(e, f"{i:0{digits}}", width, height) for i, e in enumerate(frames))
    return CameraPath(tuple(cameras), fps)


def _camera(entry: Entry, name: str, width: int, height: int) -> Camera:
    angle = entry.number("fov")
    if not LEAST_ANGLE < angle < MOST_ANGLE:
        raise entry.place.wrong("fov", "an angle between 0 and 180 degrees", angle)
    focal = 0.5 * height / math.tan(math.radians(angle) / 2)
    motion = entry.vector("camera_to_world", 16).reshape(4, 4)
    world_from_cam = pose(
        motion[:3, :3] * OPENCV_FROM_OPENGL, motion[:3, 3], entry.place, "camera_to_world"
    )
    cam_from_world = inverse(world_from_cam, entry.place, "camera_to_world")
    return Camera(name, width, height, focal, focal, width / 2, height / 2, cam_from_world)

"""The timeline of LichtFeld Studio's sequencer, versions 2 to 4 (`src/sequencer/timeline.cpp`, 2026).

{version, keyframes: [{time, position, rotation, focal_length_mm, easing}]}.  time: in s; position: of the camera, in
scene units; rotation: camera-to-world, wxyz, OpenGL axes; easing: of the way to the next key, 0 even, 1 in, 2 out, 3 in
and out, cubic.  The world's y and z point against those of the scene.  The focal length is that of a sensor 24 mm high.
Positions lie on a Catmull-Rom spline.  The file has no frame rate and no size.  Older versions eased otherwise;
version 1 has an angle of view for the focal length, and is not known by its keys.
"""

from pathlib import Path

import torch

from aaplug.core.projection import rotation_matrices
from aaplug.io.cameras.camera_path import CameraPath
from aaplug.io.cameras.keyframes import FPS, UNSIZED, cameras_of, frame_times, hermite, rising, segments, slerp
from aaplug.io.cameras.poses import OPENCV_FROM_OPENGL
from aaplug.io.values import entries, mentions, number, object_of, read_json, unit

LAST_VERSION = 4
SENSOR_HEIGHT = 24.0  # mm
WORLD = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)  # signs of the scene's axes in the sequencer's world
EASINGS = (
    lambda t: t,
    lambda t: t**3,
    lambda t: 1 - (1 - t) ** 3,
    lambda t: torch.where(t < 0.5, 4 * t**3, 1 - 4 * (1 - t) ** 3),
)


def sniff(path: Path) -> bool:
    """True for a file with the keys of a timeline."""
    return mentions(path, ["focal_length_mm"]) and mentions(path, ["keyframes"])


def path_of(path: Path, fps: float | None = None) -> CameraPath:
    """The frames of the timeline; fps: how many a second, None for 30."""
    about = object_of(read_json(path), path, "the timeline", "'keyframes', as LichtFeld Studio writes", "keyframes")
    version = about.get("version", number, 1.0)
    about.place.expect(version in range(1, LAST_VERSION + 1), "version", f"1 to {LAST_VERSION}", version)
    keys = sorted(entries(path, "keyframe", about.fields["keyframes"]), key=lambda key: key.get("time", number))
    times = rising(torch.tensor([key.get("time", number) for key in keys], dtype=torch.float64), about.place)
    places = torch.stack([key.vector("position", 3) for key in keys])
    quats = unit(torch.stack([key.vector("rotation", 4) for key in keys]), about.place).roll(-1, dims=1)  # xyzw
    focals = torch.tensor([key.get("focal_length_mm", number) for key in keys], dtype=torch.float64)
    easings = [key.get("easing", number, 0.0) for key in keys]
    for key, easing, focal in zip(keys, easings, focals.tolist(), strict=True):
        key.place.expect(easing in range(len(EASINGS)), "easing", f"0 to {len(EASINGS) - 1}", easing)
        key.place.expect(focal > 0, "focal_length_mm", "above 0", focal)
    fps = fps or FPS
    at = frame_times(float(times[0]), float(times[-1]), fps, about.place)
    index, after, share = segments(times, at)
    eased = torch.stack([ease(share) for ease in EASINGS])
    share = eased[torch.tensor(easings, dtype=torch.int64)[index], torch.arange(len(at))]
    padded = torch.cat([places[:1], places, places[-1:]])
    slopes = (padded[2:] - padded[:-2]) / 2
    points = hermite(places[index], slopes[index], slopes[after], places[after], share)
    motions = torch.eye(4, dtype=torch.float64).repeat(len(at), 1, 1)
    turns = rotation_matrices(slerp(quats[index], quats[after], share).roll(1, dims=1))
    motions[:, :3, :3], motions[:, :3, 3] = WORLD[:, None] * turns * OPENCV_FROM_OPENGL, WORLD * points
    focals = UNSIZED[1] / SENSOR_HEIGHT * focals[index].lerp(focals[after], share)
    return CameraPath(cameras_of(motions, focals, about.place), fps, unsized=True)

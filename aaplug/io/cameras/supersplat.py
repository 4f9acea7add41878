"""Camera animations of SuperSplat: the settings of its viewer, versions 1 and 2, which its export writes.

Settings (playcanvas/supersplat-viewer, `src/schemas`, 2026): {animTracks: [{duration, frameRate, loopMode,
interpolation, smoothness, keyframes: {times, values: {position, target, fov}}}]}.  duration is in s, times are in
frames, position and target are flat lists; version 1 has one fov for all, in `camera`.

The viewer turns scenes by 180° about z, so the scene's x and y point against the world's, and up is the scene's -y.
fov is the angle in degrees along the image's longer side.  Values lie on a cubic spline whose slopes are the mean
slopes to the neighbours, times smoothness; looping tracks go from the last key to the first.  That spline is read from
the sources, not documented, and may change.
"""

from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import look_at
from aaplug.io.cameras.camera_path import CameraPath
from aaplug.io.cameras.keyframes import FPS, cameras_of, frame_times, hermite, rising, segments
from aaplug.io.values import Entry, entries, mentions, number, numbers, object_of, read_json
from aaplug.system.errors import UsageError

WORLD = torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)  # signs of the scene's axes in the viewer's world
UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
MAX_ANGLE = 180.0  # degrees
FOV = 60.0  # degrees, if nothing says

name = "supersplat"


class Track(NamedTuple):
    """Keys in frames, their values (position, target, fov), and how they are played."""

    times: Float[Tensor, " n"]
    values: Float[Tensor, "n 7"]
    frames: float
    fps: float
    smoothness: float
    loops: bool
    holds: bool


def sniff(path: Path) -> bool:
    """True for a file with animations."""
    return mentions(path, ["animTracks"])


def path_of(path: Path) -> CameraPath:
    """The frames of the first animation."""
    about = object_of(read_json(path), path, "it", "'animTracks', as SuperSplat writes", "animTracks")
    track = _track(about)
    times = rising(track.times, about.place, "times")
    at = frame_times(0.0, track.frames - 1, 1.0, about.place)
    times, values = _looped(track) if track.loops else (times, track.values)
    index, share = segments(times, at)
    after = (index + 1).clamp(max=len(times) - 1)
    if track.holds:
        values = values[index]
    else:
        rates = values.diff(dim=0) / times.diff()[:, None]
        ends = torch.cat([rates[:1], rates, rates[-1:]]) if len(rates) else torch.zeros(2, values.shape[1])
        slopes = track.smoothness * (ends[1:] + ends[:-1]) / 2
        width = (times[after] - times[index])[:, None]
        values = hermite(values[index], slopes[index] * width, slopes[after] * width, values[after], share)
    eyes, targets, angles = values[:, :3] * WORLD, values[:, 3:6] * WORLD, values[:, 6]
    right = bool(((angles > 0) & (angles < MAX_ANGLE)).all())
    about.place.expect(right, "fov", f"above 0 and below {MAX_ANGLE:g} degrees", angles.tolist())
    try:
        poses = torch.stack([look_at(eye, target, UP) for eye, target in zip(eyes, targets, strict=True)])
    except UsageError as error:
        raise about.place.error(f"position and target: {error}") from error
    tangents = torch.tan(torch.deg2rad(angles) / 2)
    return CameraPath(cameras_of(torch.linalg.inv(poses), tangents, max, about.place), track.fps, unsized=True)


def _track(about: Entry) -> Track:
    version = about.fields.get("version", 1)
    about.place.expect(version in (1, 2), "version", "1 or 2", version)
    [track, *_] = entries(about.place.file, "track", about.fields["animTracks"])
    keys = track.entry("keyframes")
    times, values = keys.value("times"), keys.entry("values")
    keys.place.expect(isinstance(times, list) and len(times) > 0, "times", "a list of numbers", times)
    n, fps = len(times), track.get("frameRate", number, FPS)
    track.place.expect(fps > 0, "frameRate", "above 0", fps)
    if "fov" in values:
        angles = numbers(values.value("fov"), n, values.place, "fov")
    else:
        angles = [about.entry("camera").get("fov", number, FOV) if "camera" in about else FOV] * n
    frames = torch.tensor(numbers(times, n, keys.place, "times"), dtype=torch.float64)
    places = [values.vector(key, 3 * n).view(n, 3) for key in ("position", "target")]
    return Track(
        frames * (1 if "frameRate" in track else fps),  # early files count times in s
        torch.cat([*places, torch.tensor(angles, dtype=torch.float64)[:, None]], dim=1),
        track.get("duration", number) * fps,
        fps,
        track.get("smoothness", number, 0.0),
        track.fields.get("loopMode") == "repeat",
        track.fields.get("interpolation") == "step",
    )


def _looped(track: Track) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 7"]]:
    """The keys between copies of them a round earlier and a round later."""
    inside = track.times < track.frames
    times, values = track.times[inside], track.values[inside]
    rounds = torch.cat([times - track.frames, times, times + track.frames])
    return (rounds, values.repeat(3, 1)) if len(times) > 1 else (track.times, track.values)

"""Camera animations of SuperSplat: the settings of its viewer, versions 1 and 2, which its export writes.

Settings (playcanvas/supersplat-viewer, `src/schemas`, 2026): {animTracks: [{duration, frameRate, loopMode,
interpolation, smoothness, keyframes: {times, values: {position, target, fov}}}]}.  duration is in s, times are in
frames, position and target are flat lists; version 1 has one fov for all, in `camera`.

The viewer turns scenes by 180° about z, so the scene's x and y point against the world's, and up is the scene's -y.
fov is the angle in degrees along the image's longer side.  Values lie on a cubic spline whose slopes are the mean
slopes to the neighbours, times smoothness; looping tracks go from the last key to the first.  That spline is read from
the sources, not documented, and may change.
"""

from functools import partial
from pathlib import Path

import torch

from aaplug.core.cameras import look_at
from aaplug.io.cameras.camera_path import MAX_ANGLE, CameraPath
from aaplug.io.cameras.keyframes import FPS, UNSIZED, cameras_of, frame_times, hermite, rising, segments
from aaplug.io.values import entries, mentions, number, object_of, read_json
from aaplug.system.errors import UsageError

WORLD = torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)  # signs of the scene's axes in the viewer's world
UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
FOV = 60.0  # degrees, if nothing says

sniff = partial(mentions, keys=["animTracks"])


def path_of(path: Path, fps: float | None = None) -> CameraPath:
    """The frames of the first animation; fps: how many a second, None for as many as the file says."""
    about = object_of(read_json(path), path, "it", "'animTracks', as SuperSplat writes", "animTracks")
    version = about.fields.get("version", 1)
    about.place.expect(version in (1, 2), "version", "1 or 2", version)
    [track, *_] = entries(path, "track", about.fields["animTracks"])
    rate, smoothness = track.get("frameRate", number, FPS), track.get("smoothness", number, 0.0)
    track.place.expect(rate > 0, "frameRate", "above 0", rate)
    frames, keys = track.get("duration", number) * rate, track.entry("keyframes")
    listed, columns = keys.value("times"), keys.entry("values")
    keys.place.expect(isinstance(listed, list) and len(listed) > 0, "times", "a list of numbers", listed)
    n = len(listed)
    angles = torch.full((n,), FOV, dtype=torch.float64)
    if "fov" in columns:
        angles = columns.vector("fov", n)
    elif "camera" in about:
        angles.fill_(about.entry("camera").get("fov", number, FOV))
    places = (columns.vector(key, 3 * n).view(n, 3) for key in ("position", "target"))
    values = torch.cat([*places, angles[:, None]], dim=1)
    frames_per_time = 1.0 if "frameRate" in track else rate  # early files count times in s
    times = rising(keys.vector("times", n) * frames_per_time, about.place)
    fps = fps or rate
    at = frame_times(0.0, frames * (fps / rate) - 1, 1.0, about.place) * (rate / fps)
    inside = times < frames
    if track.fields.get("loopMode") == "repeat" and inside.sum() > 1:  # between copies a round earlier and later
        times, values = times[inside], values[inside].repeat(3, 1)
        times = torch.cat([times - frames, times, times + frames])
    index, after, share = segments(times, at)
    if track.fields.get("interpolation") == "step":
        values = values[index]
    else:
        rates = values.diff(dim=0) / times.diff()[:, None]
        ends = torch.cat([rates[:1], rates, rates[-1:]]) if len(rates) else torch.zeros(2, values.shape[1])
        slopes = smoothness * (ends[1:] + ends[:-1]) / 2
        width = (times[after] - times[index])[:, None]
        values = hermite(values[index], slopes[index] * width, slopes[after] * width, values[after], share)
    eyes, targets, angles = values[:, :3] * WORLD, values[:, 3:6] * WORLD, values[:, 6]
    right = bool(((angles > 0) & (angles < MAX_ANGLE)).all())
    about.place.expect(right, "fov", f"above 0 and below {MAX_ANGLE:g} degrees", angles.tolist())
    try:
        poses = torch.stack([look_at(eye, target, UP) for eye, target in zip(eyes, targets, strict=True)])
    except UsageError as error:
        raise about.place.error(f"position and target: {error}") from error
    focals = max(UNSIZED) / 2 / torch.tan(torch.deg2rad(angles) / 2)
    return CameraPath(cameras_of(torch.linalg.inv(poses), focals, about.place), fps, unsized=True)

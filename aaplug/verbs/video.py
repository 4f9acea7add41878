"""A video of a scene along a camera path, one recipe or two side by side."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core import camera_paths
from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.sampling import MIN_SEEN_SHARE
from aaplug.evaluation.protocols import median_depth
from aaplug.evaluation.report.contact_sheet import labelled
from aaplug.io.cameras import select_views
from aaplug.io.cameras.camera_path import read_camera_path
from aaplug.io.video import check_video
from aaplug.rendering.renderer import Background
from aaplug.rendering.videos import make_video
from aaplug.verbs.inputs import CamerasLike, SceneLike, cameras_of, processor, recipes_of, renderers_of, scene_of
from aaplug.verbs.views import resized

FPS = 30.0  # frames per second, where neither the caller nor a path file says
GAP = 4  # px between two panes
MOST_FRAMES = 100_000


class Clip(NamedTuple):
    """A written video.  fps: frames per second."""

    file: Path
    frames: int
    fps: float


class Move(NamedTuple):
    """A built-in camera path: start and end relative to the training rate, and its length in seconds."""

    start: float
    end: float
    seconds: float

    def check(self) -> None:
        """Refuse values that are not above 0."""
        for name, value in self._asdict().items():
            if not value > 0:
                raise UsageError(name, f"must be above 0, got {value:g}")


def video(
    scene: SceneLike, cameras: CamerasLike = None, output: str | PathLike[str] = "video.webm", *,
    path: str | PathLike[str] = "zoom", recipe: str = "auto", beside: str | None = "classic",
    views: str = "test", start: float = 1.0, end: float = 0.125, seconds: float = 6.0,
    fps: float | None = None, quality: str = "balanced", rate_reference: str | None = None,
    scale: float | None = None, resolution: str | None = None,
    background: Background = "auto", rasterizer: str | Rasterizer = "auto",
    threads: int | None = None, memory: float | None = None,
    cull_margin: float = math.inf, min_seen: float = MIN_SEEN_SHARE,
    overwrite: bool = False, monitor: Monitor = SILENT,
) -> Clip:  # fmt: skip
    """Render a camera path to a video; parameters that are not listed are those of `render`.

    Args:
        scene: Gaussians, a scene's file or a model folder.
        cameras: a camera set, its file or folder, or None for those of the scene's model folder.
        output: a .webm file (VP9), or .mp4 (H.264) with the extra `mp4`.
        path: "zoom", "dolly" or "orbit" from the first of `views`, or nerfstudio's camera_path.json.
        recipe, beside: names of the recipe, and of one to show to its left, or None.
        start, end: sampling rate relative to training at both ends of a zoom or dolly.
        seconds: length of a zoom, dolly or orbit.
        fps: frames per second; None for the path file's, or 30.
        scale: size of a pane relative to the training size, or to the path file's.

    Raises:
        AaplugError: an input cannot be read, an argument does not fit, or the video cannot be written.
    """
    names = [name for name in (beside, recipe) if name is not None]
    recipes = recipes_of(names, quality, rate_reference)
    free = None if str(path) in MOVES else read_camera_path(Path(path))
    fps = fps or (FPS if free is None else free.fps)
    check_video(Path(output), fps, overwrite)
    cameras, scene = cameras_of(cameras, scene), scene_of(scene)
    move = Move(start, end, seconds)
    along = free.cameras if free else _along(path, scene, cameras, views, move, fps, monitor)
    shown = resized(along, scale, resolution)
    compose = partial(side_by_side, labels=[_label(name) for name in names])
    look = (background, rasterizer, memory, cull_margin, min_seen, monitor)
    with processor(threads) as workers:
        renderers = renderers_of(scene, cameras, recipes, len(shown) * len(names), *look)
        size = f"{shown[0].width}x{shown[0].height}"
        monitor.say(f"{len(shown)} frames of {size} px per pane, {fps:g} per second")
        with monitor.progress("rendering", "images") as tell:
            options = {"threads": workers, "overwrite": overwrite, "tell": tell}
            make_video(output, renderers, shown, fps, compose, **options)
    return Clip(Path(output), len(shown), fps)


def side_by_side(images: Sequence[Float[Tensor, "h _ 3"]], labels: Sequence[str]) -> Float[Tensor, "h w 3"]:
    """Images from left to right, each with its label; a single image stays as it is."""
    if len(images) == 1:
        return images[0]
    shown = [labelled(image, label) for image, label in zip(images, labels, strict=True)]
    gap = torch.zeros(shown[0].shape[0], GAP, 3)
    return torch.cat([part for image in shown for part in (gap, image)][1:], dim=1)


def _label(recipe: str) -> str:
    return f"aaplug {recipe}" if recipe == "auto" else recipe


def _along(
    path: str | PathLike[str],
    scene: Gaussians,
    cameras: CameraSet,
    views: str,
    move: Move,
    fps: float,
    monitor: Monitor,
) -> list[Camera]:
    """The cameras of a built-in path."""
    move.check()
    count = max(1, round(move.seconds * fps))
    if count > MOST_FRAMES:
        raise UsageError("seconds", f"makes {count:,} frames; the limit is {MOST_FRAMES:,}")
    view = select_views(cameras, views)[0]
    monitor.say(f"path: {path} from view {view.name}")
    return camera_paths.frames(MOVES[str(path)](scene, cameras, view, move), count)


Along = Callable[[float], Camera]  # of t in [0, 1)


def _zoom(scene: Gaussians, cameras: CameraSet, view: Camera, move: Move) -> Along:
    return lambda t: camera_paths.zoom(view, t, move.start, move.end)


def _dolly(scene: Gaussians, cameras: CameraSet, view: Camera, move: Move) -> Along:
    depth = median_depth(scene.means, view)
    return lambda t: camera_paths.dolly(view, t, move.start, move.end, depth)


def _orbit(scene: Gaussians, cameras: CameraSet, view: Camera, move: Move) -> Along:
    depth, up = median_depth(scene.means, view), camera_paths.up_of(cameras)
    return lambda t: camera_paths.orbit(view, t, depth, up)


MOVES = {"zoom": _zoom, "dolly": _dolly, "orbit": _orbit}

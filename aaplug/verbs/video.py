"""A video of a scene along a camera path, one recipe or two side by side."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core import camera_paths
from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.errors import UsageError
from aaplug.core.executors import ProcessesIfLong
from aaplug.core.gaussians import Gaussians
from aaplug.core.monitor import SILENT, Monitor
from aaplug.evaluation.protocols import median_depth
from aaplug.evaluation.report.contact_sheet import labelled, magnified
from aaplug.io.atomic import claimed
from aaplug.io.cameras import select_views
from aaplug.io.cameras.camera_path import read_camera_path
from aaplug.io.video import check_video
from aaplug.options.objects import AnyPath
from aaplug.options.video import VideoOptions
from aaplug.rendering.videos import make_video
from aaplug.verbs.announce import announce
from aaplug.verbs.assumed import say_assumed
from aaplug.verbs.inputs import (
    CamerasLike,
    SceneLike,
    drawn_by,
    inputs_of,
    look_of,
    processor,
    recipe_of,
    scheduled,
    whole_of,
)
from aaplug.verbs.views import resized

FPS = 30.0  # frames per second, where neither the caller nor a path file says
GAP = 4  # px between two panes
MOST_FRAMES = 100_000
RECEDING = ("zoom", "dolly")  # paths on which things become small


class Clip(NamedTuple):
    """A written video.  fps: frames per second."""

    file: Path
    frames: int
    fps: float


@VideoOptions.shown
def video(
    scene: SceneLike,
    cameras: CamerasLike = None,
    output: AnyPath = "video.webm",
    *,
    monitor: Monitor = SILENT,
    **options: Any,
) -> Clip:
    """Render a camera path to a video.

    Args:
        scene: see `render`.
        cameras: see `render`.
        monitor: see `render`.
        output: a .webm file (VP9), or .mp4 (H.264).
        options: fields of `VideoOptions`; `beside` may be None.

    Raises:
        AaplugError: as `render`.
    """
    o = VideoOptions.of(options)
    left = "none" if o.beside is None else o.beside
    recipes = [recipe_of(recipe, o) for recipe in (left, o.recipe) if recipe != "none"]
    free = None if str(o.path) in MOVES else read_camera_path(Path(o.path))
    fps = o.fps or (FPS if free is None else free.fps)
    check = partial(check_video, Path(output), fps, o.overwrite)
    check()
    scene, cameras = inputs_of(scene, cameras, monitor)
    path = free.cameras if free else _along(whole_of(scene), cameras, o, fps, monitor)
    shown = resized(path, o.scale, o.resolution, cameras.assumed and free is None)
    labels = [{"auto": "aaplug auto"}.get(recipe.name, recipe.name) for recipe in recipes]

    def compose(index: int, images: Sequence[Float[Tensor, "h _ 3"]]) -> Float[Tensor, "h w 3"]:
        rate = camera_paths.factor(index / len(shown), o.start, o.end) if str(o.path) in RECEDING else 1.0
        return side_by_side(images, labels, rate, shown[index].width / path[index].width)

    with processor(o.threads) as workers, claimed(output, check):
        look = look_of(scene, cameras, len(shown) * len(recipes), o, monitor)
        renderers = [drawn_by(recipe, scene, look) for recipe in recipes]
        size = f"{shown[0].width}x{shown[0].height}"
        monitor.say(f"{len(shown)} frames of {size} px per pane, {fps:g} per second")
        say_assumed(cameras, monitor, renderers[-1], shown[0])
        announce(renderers, shown, monitor, processes=workers, fewer="seconds or frames per second")
        folder = Path(output).parent
        with scheduled(o, folder, monitor) as cluster, monitor.progress("rendering", "images") as tell:
            pool = cluster or ProcessesIfLong(workers)
            how = {"overwrite": o.overwrite, "tell": tell, "folder": cluster and folder}
            make_video(output, renderers, shown, fps, compose, pool.map, **how)
    return Clip(Path(output), len(shown), fps)


def side_by_side(
    images: Sequence[Float[Tensor, "h _ 3"]], labels: Sequence[str], rate: float = 1.0, size: float = 1.0
) -> Float[Tensor, "h w 3"]:
    """Images from left to right, each with its label; a single image stays as it is.

    rate: size of things against the data set's view; where it falls, the middle is also shown enlarged.
    size: of the images, relative to the training size.
    """
    if len(images) == 1:
        return images[0]
    caption = f"{rate * size:.2f} of training's sampling, {{times}}x"
    inset = [magnified(image, min(1.0, rate), caption) for image in images]
    shown = [labelled(image, label) for image, label in zip(inset, labels, strict=True)]
    gap = torch.zeros(shown[0].shape[0], GAP, 3)
    return torch.cat([part for image in shown for part in (gap, image)][1:], dim=1)


def _along(scene: Gaussians, cameras: CameraSet, o: VideoOptions, fps: float, monitor: Monitor) -> list[Camera]:
    """The cameras of a built-in path."""
    count = max(1, round(o.seconds * fps))
    if count > MOST_FRAMES:
        raise UsageError("seconds", f"makes {count:,} frames; the limit is {MOST_FRAMES:,}")
    view = select_views(cameras, o.views)[0]
    monitor.say(f"path: {o.path} from view {view.name}")
    return camera_paths.frames(MOVES[str(o.path)](scene, cameras, view, o), count)


Along = Callable[[float], Camera]  # of t in [0, 1)
MOVES: dict[str, Callable[[Gaussians, CameraSet, Camera, VideoOptions], Along]] = {
    "zoom": lambda scene, cameras, view, o: partial(camera_paths.zoom, view, start=o.start, end=o.end),
    "dolly": lambda scene, cameras, view, o: partial(
        camera_paths.dolly, view, start=o.start, end=o.end, depth=median_depth(scene.means, view)
    ),
    "orbit": lambda scene, cameras, view, o: partial(
        camera_paths.orbit, view, depth=median_depth(scene.means, view), up=camera_paths.up_of(cameras)
    ),
}

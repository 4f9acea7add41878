"""A video of a scene along a camera path, one recipe or two side by side."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core import camera_paths
from aaplug.core.cameras import Camera
from aaplug.evaluation.protocols import median_depth
from aaplug.evaluation.report.contact_sheet import labelled, magnified
from aaplug.io.atomic import AnyPath
from aaplug.io.cameras import read_camera_path
from aaplug.io.scenes import SceneLike
from aaplug.io.video import check_video
from aaplug.options.verbs import VideoOptions
from aaplug.rendering.film import filmed
from aaplug.rendering.job import CamerasLike, Job, running
from aaplug.rendering.videos import make_video
from aaplug.system.errors import UsageError
from aaplug.system.executors import ProcessesIfLong
from aaplug.verbs.verb import writes
from aaplug.verbs.views import seen

DEFAULT_FPS = 30.0  # frames per second, where neither the caller nor a path file says
PANE_GAP = 4  # px
MAX_FRAMES = 100_000
RECEDING_PATHS = ("zoom", "dolly")  # on which things become small


class Clip(NamedTuple):
    """A written video.  fps: frames per second."""

    file: Path
    frames: int
    fps: float


@writes(VideoOptions)
def video(scene: SceneLike, cameras: CamerasLike, output: AnyPath | None, options: VideoOptions) -> Clip:
    """Render a camera path to a video.

    Args:
        scene: see `render`.
        cameras: see `render`.
        output: a .webm file (VP9), or .mp4 (H.264); None: "video.webm".

    Raises:
        AaplugError: as `render`.
    """
    if options.lens == "vr180":
        raise UsageError("lens", "vr180 is a pair of images, which `render` writes; a video takes equirect")
    target = Path("video.webm" if output is None else output)
    file = None if str(options.path) in PATHS else read_camera_path(Path(options.path))
    fps = options.fps or (file and file.fps) or DEFAULT_FPS
    check = partial(check_video, target, fps, options.overwrite)
    check()
    job = Job.of(scene, cameras, options)
    recipes = [job.recipe(name) for name in (options.beside or "none", options.recipe) if name != "none"]
    path = file.cameras if file else _built_in_path(job, fps)
    views = seen(job, path, file.unsized if file else job.cameras.assumed)
    views = filmed(views, options, True, file and file.shutter)
    labels = [{"auto": "aaplug auto"}.get(recipe.name, recipe.name) for recipe in recipes]

    def compose(index: int, images: Sequence[Float[Tensor, "h _ 3"]]) -> Float[Tensor, "h w 3"]:
        share = index / len(views)
        receding = str(options.path) in RECEDING_PATHS
        rate = camera_paths.factor(share, options.start, options.end) if receding else 1.0
        return side_by_side(images, labels, rate, views[index].width / path[index].width)

    path_file = [] if file is None else [str(options.path)]
    with running(options, target, check, [*job.inputs, *path_file]) as workers:
        look = job.look(len(views) * len(recipes))
        renderers = [look.by(recipe) for recipe in recipes]
        size = f"{views[0].width}x{views[0].height}"
        job.monitor.say(f"{len(views)} frames of {size} px per pane, {fps:g} per second")
        job.announce(renderers, views, processes=workers.threads, fewer="seconds or frames per second")
        job.say_assumed(renderers[-1], views[0])
        with job.monitor.progress("rendering", "images") as tell:
            pool = workers.cluster or ProcessesIfLong(workers.threads)
            how = {"overwrite": options.overwrite, "tell": tell, "folder": workers.cluster and target.parent}
            make_video(target, renderers, views, fps, compose, pool.map, **how)
    return Clip(target, len(views), fps)


def _built_in_path(job: Job[VideoOptions], fps: float) -> list[Camera]:
    """The cameras of a zoom, a dolly or an orbit.

    Raises:
        UsageError: it has more than `MAX_FRAMES`, or the view is not known.
    """
    options = job.options
    count = max(1, round(options.seconds * fps))
    if count > MAX_FRAMES:
        raise UsageError("seconds", f"makes {count:,} frames; the limit is {MAX_FRAMES:,}")
    view = job.views[0]
    job.monitor.say(f"path: {options.path} from view {view.name}")
    return camera_paths.frames(PATHS[str(options.path)](job, view), count)


PATHS: dict[str, Callable[[Job[VideoOptions], Camera], Callable[[float], Camera]]] = {  # cameras of t in [0, 1)
    "zoom": lambda job, view: partial(camera_paths.zoom, view, start=job.options.start, end=job.options.end),
    "dolly": lambda job, view: partial(
        camera_paths.dolly,
        view,
        start=job.options.start,
        end=job.options.end,
        depth=median_depth(job.scene.gaussians().means, view),
    ),
    "orbit": lambda job, view: partial(
        camera_paths.orbit,
        view,
        depth=median_depth(job.scene.gaussians().means, view),
        up=camera_paths.up_of(job.cameras),
    ),
}


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
    insets = [magnified(image, min(1.0, rate), caption) for image in images]
    panes = [labelled(image, label) for image, label in zip(insets, labels, strict=True)]
    gap = torch.zeros(panes[0].shape[0], PANE_GAP, 3)
    return torch.cat([part for pane in panes for part in (gap, pane)][1:], dim=1)

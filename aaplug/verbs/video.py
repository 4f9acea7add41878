"""A video of a scene along a camera path, one recipe or two side by side."""

import os
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import starmap
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core import camera_paths
from aaplug.core.cameras import Camera, digest_of_cameras
from aaplug.evaluation.report.contact_sheet import side_by_side
from aaplug.io.cameras import read_camera_path
from aaplug.io.cameras.camera_path import CameraPath
from aaplug.io.image_files import FrameSequence
from aaplug.io.image_formats import Storage
from aaplug.io.images import read_image
from aaplug.io.video import CODECS, check_video, write_video
from aaplug.options.verbs import BUILT_IN_PATHS, RECEDING_PATHS, VideoOptions
from aaplug.rendering.film import drawn, storage_of
from aaplug.rendering.frames import write_frames
from aaplug.rendering.job import CamerasLike, Job, running, sizes_of
from aaplug.rendering.renderer import Renderer
from aaplug.system.errors import UsageError, counted, listing
from aaplug.system.locks import scratch
from aaplug.system.monitor import Tell
from aaplug.verbs.verb import AnyPath, SceneLike, writes

DEFAULT_FPS = 30.0  # frames per second, where neither the caller nor a path file says
MAX_FRAMES = 100_000
SEQUENCE = "name a sequence, such as frames/frame.####.exr"
IN_VIDEO = {  # what a video can hold of the options of image files
    "format": (None,),
    "passes": ("rgb", ["rgb"], ("rgb",)),
    "transparent": (False,),
    "colour": (None, "srgb"),
    "bit_depth": (None, 8),
    "resume": (False,),
    "first_frame": (1,),
}


class Clip(NamedTuple):
    """A written video.  fps: frames per second."""

    file: Path
    frames: int
    fps: float


@writes(VideoOptions)
def video(scene: SceneLike, cameras: CamerasLike, output: AnyPath | None, options: VideoOptions) -> Clip:
    """Render a camera path to a video, or to a sequence of image files.

    Args:
        scene: see `render`; a scene in time passes once.
        cameras: see `render`.
        output: a .webm file (VP9), or .mp4 (H.264); None: "video.webm"; or a sequence, frame.####.exr, or with `format`
            a folder for one.

    Raises:
        AaplugError: as `render`.
    """
    target = Path("video.webm" if output is None else output)
    sequence = FrameSequence.of(target, options.format)
    if sequence is None and target.suffix.lower() in CODECS:
        for name, held in IN_VIDEO.items():
            if getattr(options, name) not in held:
                raise UsageError(name, f"a video is one file of 8-bit sRGB colours, which is not resumed; {SEQUENCE}")
    storage, options = storage_of(target if sequence is None else sequence.pattern, options)
    if options.lens == "vr180" and sequence is not None:
        raise UsageError("lens", "vr180 is a pair of images, of which a sequence has one: `render --path` writes both")
    alone = sequence is not None or options.lens == "vr180"
    if alone and options.beside not in ("classic", "none", None):
        raise UsageError("beside", "is for videos of one eye; a frame sequence and vr180 show `recipe` alone")
    built_in = str(options.path) in BUILT_IN_PATHS
    if not built_in and not os.path.exists(options.path):
        raise UsageError("path", f"takes {listing(BUILT_IN_PATHS)} or a file of cameras; there is no {options.path}")
    file = None if built_in else read_camera_path(Path(options.path), fps=options.fps)
    fps = options.fps or (file and file.fps) or DEFAULT_FPS
    check = partial(check_video, target, fps, options.overwrite)
    if sequence is None:
        check()
    job = Job.of(scene, cameras, options)
    beside = "none" if alone or options.beside is None else options.beside
    recipes = job.fitted(*(name for name in (beside, options.recipe) if name != "none"))
    path = file or CameraPath(tuple(_built_in_path(job, fps)), unsized=job.cameras.assumed)
    eyes = drawn(job, path)
    views = eyes[0]
    if len({view.hw for view in views}) > 1:
        raise UsageError("path", f"has frames of different sizes ({sizes_of(views)} px); give `resolution`")
    if sequence is not None:
        sequence = replace(sequence, count=len(views), first=options.first_frame)
        check = partial(sequence.check, options.overwrite, options.resume)
        check()
    labels = [{"auto": "aaplug auto"}.get(recipe.name, recipe.name) for recipe in recipes]

    def compose(index: int, images: Sequence[Float[Tensor, "h _ 3"]]) -> Float[Tensor, "h w 3"]:
        share = index / len(views)
        if len(eyes) > 1:  # side by side, as headsets take them
            return torch.cat([*images], dim=1)
        receding = str(options.path) in RECEDING_PATHS
        rate = camera_paths.factor(share, options.start, options.end) if receding else 1.0
        return side_by_side(images, labels, rate, renderers[-1].relative_rate(views[index]) if rate < 1 else 1.0)

    path_file = [] if file is None else [str(options.path)]
    place = target if sequence is None else sequence.pattern.parent
    with running(options, place, check, [*job.inputs, *path_file], folder=sequence is not None) as workers:
        look = job.look(len(views) * len(recipes))
        renderers = [look.by(recipe) for recipe in recipes]
        panes, files = [(renderer, eye) for renderer in renderers for eye in eyes], list[list[Path]]()
        size = f"{views[0].width}x{views[0].height} px{' per pane' * (len(panes) > 1)}"
        job.monitor.say(f"{counted(len(views), 'frame')} of {size}, {fps:g} per second")
        job.announce(renderers * len(eyes), views, processes=workers.threads, fewer="seconds or frames per second")
        job.say_assumed(renderers[-1], views[0])
        with job.monitor.progress("rendering", "images") as tell:

            def tell_after(done: int) -> Tell:
                return lambda now, _: tell(done + now, len(panes) * len(views))

            if sequence is not None:
                left = sequence.begin(_request(job, renderers[0], views, storage, fps), options.resume)
                if len(left) < len(views):
                    job.monitor.say(f"resumed with {len(views) - len(left)} of {counted(len(views), 'frame')}")
                paths, cameras_left = [sequence.paths[place] for place in left], [views[place] for place in left]
                tell_left = tell_after(len(views) - len(left))
                write_frames(renderers[0], cameras_left, paths, workers.pool.map, storage=storage, tell=tell_left)
                return Clip(sequence.pattern, len(views), fps)
            with scratch(str(target.parent) if workers.cluster else None) as kept:  # images until the video is written
                for place, (renderer, eye) in enumerate(panes):
                    files.append([kept / f"{place}-{index:06d}.png" for index in range(len(views))])
                    write_frames(renderer, eye, files[-1], workers.pool.map, tell=tell_after(place * len(views)))
                images = ([read_image(file, None) for file in each] for each in zip(*files, strict=True))
                write_video(target, starmap(compose, enumerate(images)), fps, options.overwrite)
    return Clip(target, len(views), fps)


def _request(
    job: Job[VideoOptions], renderer: Renderer, views: Sequence[Camera], storage: Storage, fps: float
) -> dict[str, Any]:
    """All that the frames of a sequence depend on; a run continues another if these are equal."""
    return {
        "frames": len(views),
        "fps": fps,
        "size": f"{views[0].width}x{views[0].height}",
        "scene": job.scene.digest,
        "views": digest_of_cameras(views),
        "training": digest_of_cameras(renderer.training.cameras),
        "recipe": f"{renderer.recipe.name} {renderer.recipe.digest}",
        "rasterizer": renderer.rasterizer.name,
        "background": renderer.background,
        "cull_margin": str(renderer.training.cull_margin),
        **vars(storage),
        "format": storage.format.name,
    }


def _built_in_path(job: Job[VideoOptions], fps: float) -> list[Camera]:
    """The cameras of a zoom, a dolly or an orbit.

    Raises UsageError if it has more than `MAX_FRAMES`, or the view is not known.
    """
    options = job.options
    count = max(1, round(options.seconds * fps))
    if count > MAX_FRAMES:
        raise UsageError("seconds", f"makes {count:,} frames; the limit is {MAX_FRAMES:,}")
    view, name = job.views[0], str(options.path)
    rate = partial(camera_paths.factor, start=options.start, end=options.end)
    job.monitor.say(f"path: {name} from view {view.name}")
    if name == "zoom":
        return camera_paths.frames(lambda t: camera_paths.zoomed(view, rate(t)), count)
    depth = camera_paths.median_depth(job.scene.gaussians().means, view)
    if name == "dolly":
        return camera_paths.frames(lambda t: camera_paths.moved(view, rate(t), depth), count)
    up = camera_paths.up_of(job.cameras)
    return camera_paths.frames(partial(camera_paths.orbit, view, depth=depth, up=up), count)

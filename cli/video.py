"""aaplug video: a zoom, a dolly, an orbit or a path of your own, classic beside ours."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
import tyro

from aaplug.core import camera_paths as paths
from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.evaluation.protocols import median_depth
from aaplug.io.cameras.camera_path import read_camera_path
from aaplug.io.video import check_video
from aaplug.methods.recipes import RECIPES, suited
from aaplug.rendering.videos import Video as Clip
from aaplug.rendering.videos import make_video

from .console import print_json, progress, say
from .options import CameraOptions, RenderOptions, SceneOptions, flag
from .render import size_of

FPS = 30.0  # frames a second where nothing says
MOST_FRAMES = 100_000
MOVES = ("zoom", "dolly", "orbit")


@dataclass(frozen=True)
class Video:
    """Render a camera path to .webm, classic and ours side by side."""

    output: Annotated[Path, flag("FILE.webm", "-o")]
    """The video: VP9 .webm, or H.264 .mp4 with the extra `mp4`."""
    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    rendering: RenderOptions = field(default_factory=RenderOptions)
    path: Annotated[str, tyro.conf.arg(metavar="zoom|dolly|orbit|FILE.json")] = "zoom"
    """zoom (focal length), dolly (distance) or orbit from the first of --views, or nerfstudio's camera_path.json."""
    recipe: Annotated[str, tyro.conf.arg(metavar="|".join(RECIPES))] = "auto"
    """How to render."""
    beside: Annotated[str, tyro.conf.arg(metavar="none|" + "|".join(RECIPES))] = "classic"
    """What to show left of it."""
    start: float = 1.0
    """How finely a zoom or dolly samples the scene where it begins, against training."""
    end: float = 0.125
    """The same where it turns back."""
    seconds: float = 6.0
    """Length of a zoom, dolly or orbit."""
    fps: Annotated[float | None, flag("N")] = None
    """Frames a second (default: the path file's, or 30)."""
    scale: Annotated[float | None, flag("FACTOR")] = None
    """Size of a pane against the training size (default 1), or against the path file's."""
    resolution: Annotated[str | None, flag("WxH")] = None
    """Size of a pane in px, such as 640x480; -1 on one side keeps the aspect."""
    overwrite: bool = False
    """Replace an existing video."""
    json: bool = False
    """Print what was written as one JSON object on stdout."""


def video(options: Video) -> int:
    """Render a camera path to a video."""
    size = size_of(options.scale, options.resolution)
    names = [name for name in (options.beside, options.recipe) if name != "none"]
    recipes = options.rendering.recipes(names)
    free = None if options.path in MOVES else read_camera_path(Path(options.path))
    fps = options.fps or (FPS if free is None else free.fps)
    check_video(options.output, fps, options.overwrite)
    scene = options.scene.read()
    recipes = [suited(recipe, scene) for recipe in recipes]
    cameras = options.cameras.read(options.scene)
    along = _along(options, scene, cameras, fps) if free is None else free.cameras
    shown = [size(camera) for camera in along]
    background = options.rendering.background_of(cameras)
    training = options.cameras.learn(scene, cameras)
    rasterizer = options.rendering.rasterize(len(shown) * len(recipes))
    clip = Clip(scene, training, recipes, _labels(names), background, shown, fps)
    say(f"{len(shown)} frames of {shown[0].width}x{shown[0].height} px a pane, {fps:g} a second")
    with progress("rendering", "images") as tell:
        make_video(
            clip, options.output, rasterizer, torch.get_num_threads(), options.overwrite, tell
        )
    if options.json:
        print_json({"file": str(options.output), "frames": len(shown), "fps": fps})
    else:
        say(f"wrote {options.output}")
    return 0


def _labels(names: Sequence[str]) -> list[str]:
    return [f"aaplug {name}" if name == "auto" else name for name in names]


def _along(options: Video, scene: Gaussians, cameras: CameraSet, fps: float) -> Sequence[Camera]:
    given = {"--start": options.start, "--end": options.end, "--seconds": options.seconds}
    for name, value in given.items():
        if not value > 0:
            raise UsageError(name, f"must be above 0, got {value:g}")
    count = max(1, round(options.seconds * fps))
    if count > MOST_FRAMES:
        raise UsageError("--seconds", f"makes {count:,} frames; the limit is {MOST_FRAMES:,}")
    view = options.rendering.select(cameras)[0]
    say(f"path: {options.path} from view {view.name}")
    if options.path == "zoom":
        return paths.frames(lambda t: paths.zoom(view, t, options.start, options.end), count)
    depth = median_depth(scene.means, view)
    if options.path == "orbit":
        up = paths.up_of(cameras)
        return paths.frames(lambda t: paths.orbit(view, t, depth, up), count)
    return paths.frames(lambda t: paths.dolly(view, t, options.start, options.end, depth), count)

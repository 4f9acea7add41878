"""aaplug video: a zoom, a dolly, an orbit or a path of your own, two recipes side by side."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from aaplug.verbs import video as verb

from .console import TERMINAL, print_json, say
from .options import RECIPE_NAMES, CameraOptions, RecipeName, RenderOptions, SceneOptions, arguments, choice, flag


@dataclass(frozen=True)
class Video:
    """Render a camera path to .webm, classic 3DGS and aaplug side by side."""

    output: Annotated[Path, flag("FILE.webm", "-o")]
    """The video: VP9 .webm, or H.264 .mp4 with the extra `mp4`."""
    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    rendering: RenderOptions = field(default_factory=RenderOptions)
    path: Annotated[str, tyro.conf.arg(metavar="|".join([*verb.MOVES, "FILE.json"]))] = "zoom"
    """zoom (focal length), dolly (distance) or orbit from the first of --views, or nerfstudio's camera_path.json."""
    recipe: RecipeName = "auto"
    """How to render."""
    beside: Annotated[str, choice(["none", *RECIPE_NAMES, "..."])] = "classic"
    """Recipe to show on the left."""
    start: float = 1.0
    """Sampling rate at the start of a zoom or dolly, relative to training."""
    end: float = 0.125
    """Sampling rate where it turns back."""
    seconds: float = 6.0
    """Length of a zoom, dolly or orbit."""
    fps: Annotated[float | None, flag("N")] = None
    """Frames per second (default: the path file's, or 30)."""
    scale: Annotated[float | None, flag("FACTOR")] = None
    """Size of a pane relative to the training size, or to the path file's (default: 1)."""
    resolution: Annotated[str | None, flag("WxH")] = None
    """Size of a pane in px, such as 640x480; -1 on one side keeps the aspect."""
    overwrite: bool = False
    """Replace an existing video."""
    json: bool = False
    """Print what was written as one JSON object on stdout."""


def video(options: Video) -> int:
    """Render a camera path to a video."""
    scene, cameras = options.scene.read(), options.cameras.read(options.scene)
    chosen = arguments(options, verb.video)
    chosen["beside"] = None if options.beside == "none" else options.beside
    clip = verb.video(scene, cameras, monitor=TERMINAL, **chosen)
    if options.json:
        print_json({"file": str(clip.file), "frames": clip.frames, "fps": clip.fps})
    else:
        say(f"wrote {clip.file}")
    return 0

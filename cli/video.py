"""aaplug video: a zoom, a dolly, an orbit or a path of your own, two recipes side by side."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import aaplug
from aaplug.options.video import VideoOptions

from .console import TERMINAL, print_json, say
from .options import CameraOptions, Flat, SceneOptions, flag, read_inputs


@dataclass(frozen=True)
class Video:
    """Render a camera path to .webm, classic 3DGS and aaplug side by side."""

    output: Annotated[Path, flag("FILE.webm", "-o")]
    """The video: VP9 .webm, or H.264 .mp4."""
    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    how: Annotated[VideoOptions, Flat] = field(default_factory=VideoOptions)
    json: bool = False
    """Print what was written as one JSON object on stdout."""

    def __call__(self) -> int:
        """Render, and say what was written."""
        scene, cameras = read_inputs(self.scene, self.cameras)
        clip = aaplug.video(scene, cameras, self.output, monitor=TERMINAL, **vars(self.how))
        if self.json:
            print_json(clip._asdict() | {"file": str(clip.file)})
        else:
            say(f"wrote {clip.file}")
        return 0

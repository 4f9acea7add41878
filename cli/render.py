"""aaplug render: images at new resolutions."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import aaplug
from aaplug.options.render import RenderOptions

from .console import TERMINAL, print_json, say
from .options import CameraOptions, Flat, SceneOptions, flag


@dataclass(frozen=True)
class Render:
    """Render views at any resolution to PNG."""

    output: Annotated[Path, flag("PATH", "-o")]
    """A folder for the images, or one .png for one view."""
    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    how: Annotated[RenderOptions, Flat] = field(default_factory=RenderOptions)
    json: bool = False
    """Print what was written as one JSON object on stdout."""

    def __call__(self) -> int:
        """Render, and say what was written."""
        opened, cameras = self.scene.open(), self.cameras.read(self.scene.path)
        own = {"drop_bad": self.scene.drop_bad} | vars(self.how)
        written = aaplug.render(opened, cameras, self.output, monitor=TERMINAL, **own)
        if self.json:
            images = [{"view": v.name, "file": str(p), "width": v.width, "height": v.height} for v, p in written]
            print_json({"recipe": self.how.recipe, "images": images})
        else:
            say(f"wrote {len(written)} image{'s' * (len(written) != 1)} to {self.output}")
        return 0

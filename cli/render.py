"""aaplug render: images at new resolutions."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from aaplug.verbs import render as verb

from .console import TERMINAL, print_json, say
from .options import CameraOptions, RecipeName, RenderOptions, SceneOptions, arguments, flag


@dataclass(frozen=True)
class Render:
    """Render views at any resolution to PNG."""

    output: Annotated[Path, flag("PATH", "-o")]
    """A folder for the images, or one .png for one view."""
    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    rendering: RenderOptions = field(default_factory=RenderOptions)
    recipe: RecipeName = "auto"
    """How to render; examples/guides/methods.md lists further recipes, for research."""
    scale: Annotated[float | None, flag("FACTOR")] = None
    """Size relative to the training size (default: 1)."""
    resolution: Annotated[str | None, flag("WxH")] = None
    """Size in px, such as 400x400; -1 on one side keeps the aspect (-1x720)."""
    bit_depth: Literal[8, 16] = 8
    """Bits per colour channel."""
    overwrite: bool = False
    """Replace existing images."""
    json: bool = False
    """Print what was written as one JSON object on stdout."""


def render(options: Render) -> int:
    """Render views at any resolution to PNG."""
    scene, cameras = options.scene.read(), options.cameras.read(options.scene)
    written = verb.render(scene, cameras, monitor=TERMINAL, **arguments(options, verb.render))
    if options.json:
        images = [{"view": v.name, "file": str(p), "width": v.width, "height": v.height} for v, p in written]
        print_json({"recipe": options.recipe, "images": images})
    else:
        say(f"wrote {len(written)} image{'s' * (len(written) != 1)} to {options.output}")
    return 0

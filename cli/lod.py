"""aaplug lod: lighter scenes for smaller images."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from aaplug.verbs import lod as verb

from .console import TERMINAL, print_json, say
from .options import CameraOptions, Flat, SceneOptions, flag


@dataclass(frozen=True)
class Lod:
    """Merge Gaussians: into one lighter scene (--simplify, --budget), or into levels for smaller and smaller images."""

    output: Annotated[Path, flag("PATH", "-o")]
    """The one scene's file (.ply, .spz or .splat), or a folder for the levels (.ply)."""
    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    how: Annotated[verb.LodOptions, Flat] = field(default_factory=verb.LodOptions)
    json: bool = False
    """Print what was made as one JSON object on stdout."""

    def __call__(self) -> int:
        """Merge, and say what was written."""
        opened = self.scene.open()
        cameras = self.cameras.read(self.scene.path)
        own = {"drop_bad": self.scene.drop_bad, "spz_axes": self.scene.spz_axes} | vars(self.how)
        found = verb.lod(opened, cameras, self.output, monitor=TERMINAL, **own)
        levels = [{"rate": level.rate, "gaussians": len(level.scene)} for level in found]
        if self.json:
            print_json({"output": str(self.output), "gaussians": opened.count, "levels": levels})
        counts = " > ".join(f"{level['gaussians']:,}" for level in levels)
        say(f"wrote {self.output}: {counts} Gaussians")
        return 0

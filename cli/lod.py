"""aaplug lod: lighter scenes for smaller images."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import aaplug
from aaplug.options.lod import LodOptions

from .console import TERMINAL, print_json, say
from .options import CameraOptions, Flat, SceneOptions, SeveralScenes, flag


@dataclass(frozen=True)
class Lod:
    """Merge Gaussians: into one lighter scene (--simplify, --budget), or into levels for smaller and smaller images."""

    output: Annotated[Path, flag("PATH", "-o")]
    """The one scene's file (.ply, .spz or .splat), or a folder for the levels (.ply) or, with --batch, for all."""
    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    how: Annotated[LodOptions, Flat] = field(default_factory=LodOptions)
    several: SeveralScenes = field(default_factory=SeveralScenes)
    json: bool = False
    """Print what was made as one JSON object on stdout."""

    def __call__(self) -> int:
        """Merge, and say what was written."""
        if self.several.batch is not None:
            from .several import of_all

            return of_all(self, lambda own: ".ply" if own.how.single else "")
        facts, counts = self.made()
        if self.json:
            print_json(facts)
        say(f"wrote {self.output}: {counts} Gaussians")
        return 0

    def made(self) -> tuple[dict[str, Any], str]:
        """Merge, and tell what was made, and the numbers of Gaussians in words."""
        opened = self.scene.open()
        cameras = self.cameras.read(self.scene.path)
        own = {"drop_bad": self.scene.drop_bad, "spz_axes": self.scene.spz_axes} | vars(self.how)
        found = aaplug.lod(opened, cameras, self.output, monitor=TERMINAL, **own)
        levels = [{"rate": level.rate, "gaussians": len(level.scene)} for level in found]
        counts = " > ".join(f"{level['gaussians']:,}" for level in levels)
        return {"output": str(self.output), "gaussians": opened.count, "levels": levels}, counts

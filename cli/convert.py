"""aaplug convert: a plain scene file with anti-aliasing fused in."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import aaplug
from aaplug.options.convert import ConvertOptions

from .console import TERMINAL, out, print_json, say
from .options import CameraOptions, Flat, SceneOptions, SeveralScenes, flag

if TYPE_CHECKING:
    from aaplug.verbs.convert import Converted


@dataclass(frozen=True)
class Convert:
    """Fuse anti-aliasing into a plain scene file, for the 2D Mip filter (0.1 px², compensated) or a named viewer."""

    output: Annotated[Path, flag("FILE", "-o")]
    """Where to write: .ply, or .spz or .splat, which round values and keep less; with --batch, a folder."""
    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    how: Annotated[ConvertOptions, Flat] = field(default_factory=ConvertOptions)
    several: SeveralScenes = field(default_factory=SeveralScenes)
    json: bool = False
    """Print what was done as one JSON object on stdout."""

    def __call__(self) -> int:
        """Fuse, and say what was done."""
        if self.several.batch is not None:
            from .several import of_all

            return of_all(self, lambda own: ".ply")
        facts, found = self.made()
        from aaplug.evaluation.results import tables
        from aaplug.methods.viewers import fused_in

        scene, report = found.scene, found.report
        if self.json:
            print_json(facts)
        elif report is not None:
            out.print("As the viewer draws it, against the scene's own training-size render:")
            out.print(tables(report)[0])
        how = "in parts" if scene is None else f"fused {fused_in(scene)}"
        say(f"wrote {self.output}: {how}; show it with {found.viewer.rule} ({found.viewer.name})")
        say(found.viewer.advice)
        return 0

    def made(self) -> "tuple[dict[str, Any], Converted]":
        """Fuse, and tell what was made."""
        opened = self.scene.open()
        cameras = self.cameras.read(self.scene.path)
        own = {"drop_bad": self.scene.drop_bad, "spz_axes": self.scene.spz_axes} | vars(self.how)
        found = aaplug.convert(opened, cameras, self.output, monitor=TERMINAL, **own)
        facts: dict[str, Any] = {"output": str(self.output), "gaussians": opened.count}
        if found.scene is not None:
            fused = [{"method": f.method, **f.settings} for f in found.scene.fused]
            facts |= {"gaussians": len(found.scene), "fused": fused}
        if found.report is not None:
            from aaplug.evaluation.results import results

            viewer = {"for": found.viewer.name, "settings": found.viewer.settings}
            facts |= {**viewer, "residual": results(found.report)}
        return facts, found

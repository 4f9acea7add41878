"""aaplug finetune: move the Gaussians until every scale looks like the training size."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import aaplug
from aaplug.options.finetune import FinetuneOptions

from .console import TERMINAL, out, print_json, say
from .options import CameraOptions, Flat, SceneOptions, flag, read_inputs


@dataclass(frozen=True)
class Finetune:
    """Optimize the Gaussians until every scale looks like the training size, averaged down; write a plain scene file.

    A report (.finetune.json), pictures (.finetune.png) and a checkpoint go beside it.  Ctrl-C stops after the current
    step; --resume continues.
    """

    output: Annotated[Path, flag("FILE.ply", "-o")]
    """Where to write the scene."""
    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    how: Annotated[FinetuneOptions, Flat] = field(default_factory=FinetuneOptions)
    json: bool = False
    """Print the report on stdout as JSON instead of the table."""

    def __call__(self) -> int:
        """Optimize, and say what was written."""
        scene, cameras = read_inputs(self.scene, self.cameras)
        axes = self.scene.spz_axes
        found = aaplug.finetune(scene, cameras, self.output, spz_axes=axes, monitor=TERMINAL, **vars(self.how))
        if self.json:
            print_json(found.as_json())
        else:
            from aaplug.evaluation.results import tables

            out.print(*tables(found.report))
        stem = self.output.stem
        say(f"wrote {self.output}, {stem}.finetune.json and {stem}.finetune.png")
        return 0

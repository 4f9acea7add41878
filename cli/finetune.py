"""aaplug finetune: move the Gaussians until every scale looks like the training size."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from aaplug.evaluation.results import tables
from aaplug.verbs import finetune as verb

from .console import TERMINAL, out, print_json, say
from .options import CameraOptions, Flat, SceneOptions, flag


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
    how: Annotated[verb.FinetuneOptions, Flat] = field(default_factory=verb.FinetuneOptions)
    json: bool = False
    """Print the report on stdout as JSON instead of the table."""


def finetune(options: Finetune) -> int:
    """Optimize the Gaussians until every scale looks like the training size."""
    scene, cameras = options.scene.read(), options.cameras.read(options.scene)
    found = verb.finetune(
        scene, cameras, options.output, spz_axes=options.scene.spz_axes, monitor=TERMINAL, **vars(options.how)
    )
    if options.json:
        print_json(found.as_json())
    else:
        out.print(*tables(found.report))
    stem = options.output.stem
    say(f"wrote {options.output}, {stem}.finetune.json and {stem}.finetune.png")
    return 0

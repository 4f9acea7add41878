"""aaplug finetune: move the Gaussians until every scale looks like the training size."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from aaplug.evaluation.results import tables
from aaplug.finetuning.losses import LOSSES
from aaplug.finetuning.parameters import RATES
from aaplug.finetuning.settings import METHODS, OURS
from aaplug.methods.viewers import FAST, VIEWERS
from aaplug.verbs import finetune as verb

from .console import TERMINAL, out, print_json, say
from .options import CameraOptions, SceneOptions, ViewOptions, arguments, choice, flag


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
    viewing: ViewOptions = field(default_factory=ViewOptions)
    target: Annotated[str | None, flag("|".join([FAST.name, *VIEWERS]), "--for")] = None
    """What will show the scene: fast (aaplug's recipe matched, one sample per pixel; the default of consistency) or a
    viewer with a rule of its own (default of mipmap-gs: classic-viewer)."""
    method: Annotated[str, choice(METHODS)] = "consistency"
    """consistency makes one model for all scales; mipmap-gs makes one for a single --scale, as Mipmap-GS does."""
    scale: tuple[float, ...] = tuple(OURS.weights)
    """Sizes against the training size that must look right, beside the training size itself."""
    steps: Annotated[int | None, flag("N")] = None
    """Number of steps (default: 1000)."""
    loss: Annotated[str, choice(LOSSES)] = OURS.loss
    """l2, or 3DGS's 0.8 L1 + 0.2 D-SSIM."""
    anchor: float = OURS.anchor
    """Weight of the training size in every step, against 1 for the other scales."""
    move: Annotated[tuple[str, ...], choice(RATES)] = tuple(RATES)
    """Parameters that move."""
    learning_rate: float = 1.0
    """Factor on the method's learning rates."""
    densify_every: Annotated[int | None, flag("N")] = None
    """Clone, split and prune every N steps; 0 for never (default: the method's own)."""
    truth: Annotated[str, choice(("auto", "self", "photographs"))] = "auto"
    """What the training size should look like: the scene's own render (self) or the photographs; auto takes
    photographs if every training view has one."""
    upsampler: Annotated[str | None, flag("bicubic|lanczos|FILE")] = None
    """For scales above 1 without photographs that large: an interpolation, or a network's weights (ESPCN_x4.pb, a
    torch.export .pt2); default: the scene's own render there, corrected to the averages of the training size."""
    seed: int = 0
    """Seed of the views and scales that the steps draw."""
    checkpoint_every: Annotated[int, flag("N")] = 100
    """Steps between checkpoints."""
    resume: bool = False
    """Continue an interrupted run from its checkpoint."""
    overwrite: bool = False
    """Replace existing outputs."""
    json: bool = False
    """Print the report on stdout as JSON instead of the table."""


def finetune(options: Finetune) -> int:
    """Optimize the Gaussians until every scale looks like the training size."""
    scene, cameras = options.scene.read(), options.cameras.read(options.scene)
    found = verb.finetune(scene, cameras, monitor=TERMINAL, **arguments(options, verb.finetune))
    if options.json:
        print_json(found.as_json())
    else:
        out.print(*tables(found.report))
    stem = options.output.stem
    say(f"wrote {options.output}, {stem}.finetune.json and {stem}.finetune.png")
    return 0

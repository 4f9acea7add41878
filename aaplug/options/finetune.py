"""Options of `finetune`, of which the defaults were measured."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import tyro

from aaplug.options.base import UNSET, OneOf, choice, choices, flag, number
from aaplug.options.objects import Viewer
from aaplug.options.shared import SCALES, STEPS, ViewOptions
from aaplug.system.registry import names_of

LossName = Literal["l2", "l1-dssim"]
WEIGHTS = {0.5: 1.0, 0.25: 2.0, 0.125: 1.0}  # weight of the loss by scale
ANCHOR = 3.0  # weight of the loss at the training size, beside those of the scales
PARAMETERS = ("means", "quats", "log_scales", "logit_opacities", "dc", "rest")
TRUTHS = ("auto", "self", "photographs")


@dataclass(frozen=True, kw_only=True)
class FinetuneOptions(ViewOptions):
    """The optimization."""

    target: Annotated[
        str | Viewer | None, flag("fast|VIEWER", "--for", kind=str | None), OneOf(("fast",), "viewer")
    ] = None
    """Who will show the scene: fast (aaplug's matched, the default) or a viewer of examples/guides/viewers.md."""
    views: Annotated[str, tyro.conf.arg(metavar="NAME,...|test|train|all")] = "test"
    """Views that the result is measured on, by name or split; training views are what it is tuned on."""
    method: Annotated[str, choice(names_of("method")), OneOf(kind="method")] = "consistency"
    """consistency makes one model for all scales; mipmap-gs makes one for a single --scale, as Mipmap-GS does."""
    scale: Annotated[Sequence[float], SCALES] = tuple(WEIGHTS)
    """Sizes against the training size that must look right, beside the training size itself."""
    steps: Annotated[int | None, STEPS, UNSET] = None
    """Number of steps (default: 1000)."""
    loss: Annotated[str, choice(get_args(LossName)), OneOf(get_args(LossName))] = "l2"
    """l2, or 3DGS's 0.8 L1 + 0.2 D-SSIM."""
    anchor: Annotated[float, number(0, 1_000_000)] = ANCHOR
    """Weight of the training size in every step, against 1 for the other scales."""
    move: Annotated[Sequence[str], choices(PARAMETERS)] = PARAMETERS
    """Parameters that move."""
    learning_rate: Annotated[float, number(1e-6, 100)] = 1.0
    """Factor on the method's learning rates."""
    densify_every: Annotated[int | None, STEPS, UNSET] = None
    """Clone, split and prune every N steps, with mipmap-gs; 0 for never (default: the method's own)."""
    truth: Annotated[str, choice(TRUTHS), OneOf(TRUTHS)] = "auto"
    """What the training size should look like: self is the scene's own render; auto takes photographs if all exist."""
    upsampler: Annotated[str | None, flag("bicubic|lanczos|FILE")] = None
    """For scales above the photographs': an interpolation or a network (.pb, .pt2); default: the scene's own render."""
    seed: Annotated[int, number(0, 2**31 - 1, whole=True)] = 0
    """Seed of the views and scales that the steps draw."""
    checkpoint_every: Annotated[int, number(1, 1_000_000, whole=True)] = 100
    """Steps between checkpoints."""
    resume: bool = False
    """Continue an interrupted run from its checkpoint."""
    overwrite: bool = False
    """Replace existing outputs."""

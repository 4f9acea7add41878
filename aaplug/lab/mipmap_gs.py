"""Mipmap-GS (Li et al. 2024): fine-tuning that makes one model for one scale."""

from collections.abc import Sequence

from aaplug.finetuning.parameters import RATES
from aaplug.finetuning.settings import Method, Settings
from aaplug.lab.densification import with_densification
from aaplug.methods.viewers import CLASSIC_VIEWER
from aaplug.system.errors import UsageError


def mipmap_gs(scales: Sequence[float], move: Sequence[str] = (), anchor: float = 0.0) -> Settings:
    """Mipmap-GS (Li et al. 2024), one model for one scale: all parameters at 3DGS's rates, 1000 steps of L2.

    Its truth is a bilinear resize at the test poses; here it is the box average at the training poses.  It moves every
    parameter and has no anchor.  More than one scale raises UsageError.
    """
    if len(scales) != 1:
        raise UsageError("scale", "mipmap-gs makes one model for one scale; give one")
    return Settings("mipmap-gs", 1000, {scales[0]: 1.0}, RATES)


MIPMAP_GS = Method(mipmap_gs, CLASSIC_VIEWER, with_densification)

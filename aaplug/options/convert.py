"""Options of `convert`."""

from dataclasses import dataclass
from typing import Annotated

import tyro

from aaplug.core.registry import names_of
from aaplug.options.base import UNSET, OneOf, flag, number
from aaplug.options.shared import STEPS, OneViewer, ViewOptions


@dataclass(frozen=True, kw_only=True)
class ConvertOptions(ViewOptions):
    """What to fuse, and how to measure it."""

    views: Annotated[str, tyro.conf.arg(metavar="NAME,...|test|train|all")] = "train"
    """Views that --for is measured on, by name or split."""
    viewer: OneViewer = None
    """Fit the scene to spark, playcanvas or another of examples/guides/viewers.md, and print the remaining error."""
    steps: Annotated[int | None, STEPS, UNSET] = None
    """With --for: steps of the fit, 0 for none (default: 300, or 0 if the viewer draws as training did)."""
    form: Annotated[str | None, flag("|".join(names_of("form"))), OneOf(kind="form")] = None
    """Without --for: keep training's energy (matched-energy, the default), or smooth as Mip-Splatting does."""
    variance: Annotated[float | None, number(0.001, 100), UNSET] = None
    """Without --for: variance to fuse, in px² at the training rate (default: 0.2)."""
    overwrite: bool = False
    """Replace an existing output."""

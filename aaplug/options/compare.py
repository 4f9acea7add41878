"""Options of `compare`."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from aaplug.core.choices import metric_option
from aaplug.core.errors import UsageError
from aaplug.core.registry import names_of
from aaplug.options.base import flag
from aaplug.options.shared import SCALES, OneRecipe, OneViewer, RecipeOptions

SIZES = (2.0, 1.0, 0.5, 0.25)
MEASURED = ("psnr", "ssim", "flicker")


@dataclass(frozen=True, kw_only=True)
class CompareOptions(RecipeOptions):
    """Sizes, metrics and how the scenes are shown."""

    recipe: OneRecipe = "auto"
    """How to draw every scene, each by the convention that it was trained with."""
    viewer: OneViewer = None
    """Draw the scenes as spark or another of examples/guides/viewers.md does; the truth stays the first by --recipe."""
    scale: Annotated[Sequence[float], SCALES] = SIZES
    """One or more sizes relative to the training size."""
    metric: Annotated[
        str | Sequence[str], flag("|".join(map(metric_option, names_of("metric"))), kind=tuple[str, ...])
    ] = MEASURED
    """Metrics (default: psnr ssim flicker)."""
    show: Annotated[str, tyro.conf.arg(metavar="N|NAME,...")] = "3"
    """Views in the report's viewer: how many, or which."""
    any_frame: bool = False
    """Compare scenes that lie in different frames too."""
    resume: bool = False
    """Continue an interrupted comparison; finished views are not measured again."""
    overwrite: bool = False
    """Replace existing results."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.viewer is not None and self.recipe != "auto":
            raise UsageError("viewer", "sets the recipe itself; leave out `recipe`")

"""Options of `evaluate`."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from aaplug.core.choices import metric_option
from aaplug.core.registry import names_of
from aaplug.options.base import UNSET, OneOf, choice, choices, flag
from aaplug.options.objects import AnyPath, Protocol, Recipe
from aaplug.options.shared import RECIPE_NAMES, SCALES, RecipeOptions

ALL = "all"  # instead of recipes' names: every recipe that the scene suits
DEFAULT_RECIPES = ("classic", "mip", "matched", "auto")

Layout = Literal["plain", "inria"]


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions(RecipeOptions):
    """Recipes, scales, truth and metrics."""

    protocol: Annotated[str | Protocol, choice(names_of("protocol")), OneOf(kind="protocol")] = "default"
    """Scales, truth, downscaling and flavours of metrics, by name."""
    recipe: Annotated[str | Sequence[str | Recipe], choices([*RECIPE_NAMES, ALL, "..."]), OneOf((ALL,), "recipe")] = (
        DEFAULT_RECIPES
    )
    """One or more recipes.  all adds the research recipes, which examples/guides/methods.md lists."""
    scale: Annotated[Sequence[float] | None, SCALES, UNSET] = None
    """One or more sizes relative to the training size (default: the protocol's)."""
    truth: Literal["auto", "photographs", "self"] = "auto"
    """Compare with photographs, or with the scene's own supersampled look; auto leaves it to the protocol."""
    metric: Annotated[
        str | Sequence[str] | None, flag("|".join(map(metric_option, names_of("metric"))), kind=tuple[str, ...] | None)
    ] = None
    """Metrics, with flavours ssim:wang|3dgs, lpips:3dgs|vgg|alex (default: psnr ssim consistency energy-drift)."""
    lpips: Annotated[tuple[AnyPath, AnyPath] | None, flag("TRUNK HEADS", kind=tuple[str, str] | None)] = None
    """Weights of LPIPS, which is then measured: torchvision's VGG16 (AlexNet), and the lpips package's heads for it."""
    report: bool = False
    """Write report.html, one page with pictures side by side, tables and curves, and its plots."""
    show: Annotated[str, tyro.conf.arg(metavar="N|NAME,...")] = "3"
    """Views in the report's viewer: how many, or which."""
    layout: Layout = "plain"
    """inria stores every render and its truth in test/METHOD/{renders,gt}, where other metric scripts look."""
    resume: bool = False
    """Continue an interrupted evaluation; finished views are not measured again."""
    overwrite: bool = False
    """Replace existing results."""

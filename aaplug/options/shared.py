"""Options that several verbs share."""

import math
import os
import re
from dataclasses import dataclass
from typing import Annotated, get_args

import tyro

from aaplug.core.choices import MIN_SEEN_SHARE, NAMES, QUALITIES, USER_RECIPES, Background, RateReference
from aaplug.core.errors import SHOWN, UsageError
from aaplug.core.registry import names_of
from aaplug.options.base import UNSET, OneOf, Options, choice, flag, number
from aaplug.options.objects import Executor, Rasterizer, Recipe, Viewer

SCALE = number(0.001, 64)  # sizes of images against the training size
SCALES = number(0.001, 64, several=True)
STEPS = number(0, 1_000_000, whole=True)
_SHARE = number(0, 1)
THREADS = number(1, max(8, os.cpu_count() or 1), whole=True)  # more gain nothing, and can exhaust the machine
_GIGABYTES = number(0.01, 1024)
_MARGIN = number(0, math.inf)
RECIPE_NAMES = [name for name in names_of("recipe") if name in USER_RECIPES or name not in NAMES["recipe"]]
_DRAWN_BY = ("auto", "compiled")  # beside those of the registry
_REFERENCES = get_args(RateReference)
MAX_SIDE = 16384  # px

OneRecipe = Annotated[str | Recipe, choice([*RECIPE_NAMES, "..."]), OneOf(kind="recipe")]
OneViewer = Annotated[str | Viewer | None, flag("VIEWER", "--for", kind=str | None), OneOf(kind="viewer")]


@dataclass(frozen=True, kw_only=True)
class FrameOptions(Options):
    """Whether scene and cameras belong together."""

    min_seen: Annotated[float, _SHARE] = MIN_SEEN_SHARE
    """Stop if the cameras see a smaller share of the Gaussians than this."""


@dataclass(frozen=True, kw_only=True)
class ViewOptions(FrameOptions):
    """Views, background and rasterizer."""

    views: Annotated[str, tyro.conf.arg(metavar="NAME,...|test|train|all")] = "test"
    """Views, by name or split."""
    background: Annotated[Background, choice(("auto", "white", "black"))] = "auto"
    """Colour behind the scene; auto is what training had."""
    rasterizer: Annotated[
        str | Rasterizer, choice([*_DRAWN_BY, *names_of("rasterizer")]), OneOf(_DRAWN_BY, "rasterizer")
    ] = "auto"
    """auto: compiled if `aaplug warmup` has run, else eager.  reference: slow, exact, float64."""
    threads: Annotated[int | None, THREADS, UNSET] = None
    """Processor threads (default: all)."""
    memory: Annotated[float | None, _GIGABYTES, UNSET] = None
    """GB that drawing a frame may take, beside the scene and the image themselves (default: 1)."""
    cull_margin: Annotated[float, _MARGIN, UNSET] = math.inf
    """For scenes trained so: leave out Gaussians centred off the image by more than this share of its longer side."""


@dataclass(frozen=True, kw_only=True)
class RecipeOptions(ViewOptions):
    """What a recipe samples and compares with, and who draws it."""

    quality: Annotated[str, choice(QUALITIES), OneOf(tuple(QUALITIES))] = "balanced"
    """How finely recipe auto samples: fast reaches a quarter of the training rate, balanced half, best all of it."""
    rate_reference: Annotated[str | None, flag("|".join(_REFERENCES)), OneOf(_REFERENCES)] = None
    """Sampling rate that matched and auto compare with (default: pose: global, but interval for free cameras)."""
    scheduler: Annotated[str | Executor | None, flag("local|tcp://HOST:PORT", kind=str | None)] = None
    """Draw views on a Dask cluster: of --threads processes on this machine, or of the machines at an address."""


@dataclass(frozen=True, kw_only=True)
class ImageOptions(Options):
    """Images by one recipe at one size."""

    recipe: OneRecipe = "auto"
    """How to render; examples/guides/methods.md lists further recipes, for research."""
    scale: Annotated[float | None, SCALE, UNSET] = None
    """Size relative to the training size (default: 1)."""
    resolution: Annotated[str | None, flag("WxH")] = None
    """Size in px, such as 400x400; -1 on one side keeps the aspect (-1x720)."""
    overwrite: bool = False
    """Replace existing outputs."""


def size_of(text: str, where: str = "resolution") -> tuple[int, int]:
    """Width and height of "400x300", in px; `where` is the option that it is of.

    Raises:
        UsageError: it is no size, or a side is above `MAX_SIDE`.
    """
    match = re.fullmatch(r"([1-9]\d{0,8})x([1-9]\d{0,8})", text, re.ASCII)
    if match is None:
        raise UsageError(where, f"takes sizes such as 400x400, got {text[:SHOWN]}")
    width, height = int(match[1]), int(match[2])
    check_side(where, width, height)
    return width, height


def check_side(where: str, width: int, height: int) -> None:
    """Refuse an image with a side above `MAX_SIDE`; raises UsageError."""
    if max(width, height) > MAX_SIDE:
        raise UsageError(where, f"would be {width}x{height} px; the limit is {MAX_SIDE} a side")

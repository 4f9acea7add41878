"""Options of the verbs, each stated once: a field is a verb's keyword, its docstring the help of the command line."""

import inspect
import math
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cache
from numbers import Integral, Real
from typing import Annotated, Any, TypeVar, cast, get_args, get_type_hints

import tyro

from aaplug.core.errors import SHOWN, UsageError, did_you_mean
from aaplug.core.executors import Executor
from aaplug.core.interfaces import Rasterizer
from aaplug.core.sampling import MIN_SEEN_SHARE
from aaplug.methods.filters.matched import RateReference
from aaplug.methods.recipe import Recipe
from aaplug.methods.recipes import QUALITIES, RECIPES
from aaplug.methods.research_recipes import RESEARCH_RECIPES
from aaplug.rasterizers import RASTERIZERS
from aaplug.rendering.renderer import Background

Chosen = TypeVar("Chosen", bound="Options")
Verb = TypeVar("Verb", bound=Callable[..., Any])


def flag(metavar: str, *aliases: str, kind: Any = None) -> Any:
    """An option whose help shows `metavar` and no default, for what is absent unless given."""
    return tyro.conf.arg(metavar=metavar, aliases=aliases, help_behavior_hint="", constructor=kind)


def choice(names: Iterable[str]) -> Any:
    """An option that takes one of these names, or in Python an object; the library refuses other names."""
    return tyro.constructors.PrimitiveConstructorSpec(
        1, "|".join(names), "".join, lambda _: True, lambda one: [str(one)]
    )


def choices(names: Iterable[str]) -> Any:
    """An option that takes some of these names, or in Python objects."""
    return tyro.constructors.PrimitiveConstructorSpec(
        "*", "|".join(names), tuple, lambda _: True, lambda some: [*map(str, some)]
    )


def number(least: int | float, most: int | float, *, whole: bool = False, several: bool = False, unit: str = "") -> Any:
    """An option that takes a number from `least` to `most`, an integer if `whole`, or one or more if `several`.

    `--help` shows the range, and `Options` refuses what is outside of it.  unit: may follow the number as a word's end.
    """
    kind, shown = int if whole else float, f"{least:.10g}..{most:.10g}" + " ..." * several

    def read(words: list[str]) -> Any:
        try:
            values = tuple(kind(word.removesuffix(unit)) for word in words)
        except ValueError as error:
            raise ValueError(f"takes {shown}, got {' '.join(words)[:SHOWN]}") from error
        return values if several else values[0]

    def holds(value: Any) -> bool:
        kinds = Integral if whole else Real  # NumPy's too
        return not isinstance(value, bool) and isinstance(value, kinds) and least <= cast(float, value) <= most

    def fits(value: Any) -> bool:
        values = value if several else [value]
        return isinstance(values, (list, tuple)) and len(values) > 0 and all(map(holds, values))

    return tyro.constructors.PrimitiveConstructorSpec(
        "*" if several else 1,
        shown,
        read,
        fits,
        lambda value: [str(v) for v in (value if several and value else [value])],
    )


UNSET: Any = tyro.conf.arg(help_behavior_hint="")  # an option that is absent unless given: its help shows no default
SCALE = number(0.001, 64)  # sizes of images against the training size
SCALES = number(0.001, 64, several=True)
STEPS = number(0, 1_000_000, whole=True)
_SHARE = number(0, 1)
THREADS = number(1, max(8, os.cpu_count() or 1), whole=True)  # more gain nothing, and can exhaust the machine
_GIGABYTES = number(0.01, 1024)
_MARGIN = number(0, math.inf)
_RESEARCH = {recipe.name for recipe in RESEARCH_RECIPES}
RECIPE_NAMES = [name for name in RECIPES if name not in _RESEARCH]  # a user's, and plug-ins'


@dataclass(frozen=True, kw_only=True)
class Options:
    """The options of a verb.

    Raises:
        UsageError: a number is outside of its option's range.
    """

    def __post_init__(self) -> None:
        for name, spec in _specs(type(self)).items():
            value = getattr(self, name)
            if value is not None and not spec.is_instance(value):
                got = ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
                raise UsageError(name, f"takes {spec.metavar}, got {got[:SHOWN] or 'nothing'}")

    @classmethod
    def of(cls: type[Chosen], given: Mapping[str, Any]) -> Chosen:
        """The options that a caller gave, checked by name, and the defaults."""
        known = [field.name for field in fields(cls)]
        for name in given.keys() - known:
            raise UsageError(name, f"is no option here{did_you_mean(name, known)}")
        return cls(**given)

    @classmethod
    def shown(cls, verb: Verb) -> Verb:
        """Decorate a verb: its signature shows these options instead of `**options`."""
        signature = inspect.signature(verb)
        own = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
        options = inspect.signature(cls).parameters.values()
        vars(verb)["__signature__"] = signature.replace(parameters=[*own, *options])
        return verb


@cache
def _specs(options: type[Options]) -> dict[str, Any]:
    """How values of options are read and checked, by the option's name."""
    found = {}
    for name, hint in get_type_hints(options, include_extras=True).items():
        for spec in getattr(hint, "__metadata__", ()):
            if isinstance(spec, tyro.constructors.PrimitiveConstructorSpec):
                found[name] = spec
    return found


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
    rasterizer: Annotated[str | Rasterizer, choice(("auto", "compiled", *RASTERIZERS))] = "auto"
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

    quality: Annotated[str, choice(QUALITIES)] = "balanced"
    """How finely recipe auto samples: fast reaches a quarter of the training rate, balanced half, best all of it."""
    rate_reference: Annotated[str | None, flag("|".join(get_args(RateReference)))] = None
    """Sampling rate that matched and auto compare with (default: pose: global, but interval for free cameras)."""
    scheduler: Annotated[str | Executor | None, flag("local|tcp://HOST:PORT", kind=str | None)] = None
    """Draw views on a Dask cluster: of --threads processes on this machine, or of the machines at an address."""


@dataclass(frozen=True, kw_only=True)
class ImageOptions(Options):
    """Images by one recipe at one size."""

    recipe: Annotated[str | Recipe, choice([*RECIPE_NAMES, "..."])] = "auto"
    """How to render; examples/guides/methods.md lists further recipes, for research."""
    scale: Annotated[float | None, SCALE, UNSET] = None
    """Size relative to the training size (default: 1)."""
    resolution: Annotated[str | None, flag("WxH")] = None
    """Size in px, such as 400x400; -1 on one side keeps the aspect (-1x720)."""
    overwrite: bool = False
    """Replace existing outputs."""

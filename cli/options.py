"""Options that several verbs share, and reading what they name.

Each class is a group of options.  `arguments` passes them to the library's verb, whose parameters have the same names.
"""

import inspect
import math
import re
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, get_args

import tyro

from aaplug.core.cameras import CameraSet
from aaplug.core.errors import UsageError, listing
from aaplug.core.gaussians import CONVENTIONS, Gaussians
from aaplug.core.sampling import MIN_SEEN_SHARE
from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import SpzAxes, find_scene, open_scene
from aaplug.io.scenes.scene_file import SceneFile
from aaplug.methods.filters.matched import RateReference
from aaplug.methods.recipes import QUALITIES, RECIPES
from aaplug.methods.research_recipes import RESEARCH_RECIPES
from aaplug.methods.viewers import describe
from aaplug.rasterizers import RASTERIZERS

from .console import say

CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)  # how classes become options


def worded(text: str, names: Collection[str]) -> str:
    """The library's text with parameters as options: min_seen or `min_seen` becomes --min-seen."""

    def option(match: re.Match[str]) -> str:
        name = match[1] or match[2]
        if name not in names:
            return match[0]
        return "SCENE" if name == "scene" else "--" + name.replace("_", "-")

    return re.sub(r"`(\w+)`|\b([a-z]+(?:_[a-z]+)+)\b", option, text)


def flag(metavar: str, *aliases: str) -> Any:
    """An option whose help shows `metavar` and no default, for what is absent unless given."""
    return tyro.conf.arg(metavar=metavar, aliases=aliases, help_behavior_hint="")


def choice(names: Iterable[str]) -> Any:
    """An option that takes one of these names; the library refuses others."""
    return tyro.conf.arg(metavar="|".join(names))


_RESEARCH = {recipe.name for recipe in RESEARCH_RECIPES}
RECIPE_NAMES = [name for name in RECIPES if name not in _RESEARCH]  # a user's, and plug-ins'
RecipeName = Annotated[str, choice([*RECIPE_NAMES, "..."])]


@dataclass(frozen=True)
class SceneOptions:
    """The scene."""

    scene: Annotated[Path | None, tyro.conf.Positional, flag("SCENE")] = None
    """A scene (.ply, .compressed.ply, .spz, .sog, .splat, .ksplat) or its folder (INRIA model, SOG)."""
    model_path: Annotated[Path | None, flag("FOLDER", "-m")] = None
    """An INRIA model folder, instead of SCENE."""
    iteration: Annotated[int | None, flag("N")] = None
    """Iteration of a model folder (default: the last)."""
    convention: Annotated[str | None, flag("|".join(CONVENTIONS))] = None
    """How the scene was trained, where its file does not say."""
    drop_bad: bool = False
    """Leave out Gaussians with NaN, infinite or unusable values instead of stopping."""
    allow_checkpoint: bool = False
    """Also read gsplat's .pt, a pickle; only its tensors are loaded."""
    spz_axes: SpzAxes = "opengl"
    """Axes of a .spz, read or written: opengl (its specification) or opencv (splat-transform, gsply)."""

    @property
    def path(self) -> Path:
        """What the user named."""
        if (self.scene is None) == (self.model_path is None):
            raise UsageError("scene", "name one scene: a .ply, a model folder, or -m FOLDER")
        path = self.scene or self.model_path
        assert path is not None
        return path

    def open(self) -> SceneFile:
        """Open the scene's file and say what it is."""
        if self.convention is not None and self.convention not in CONVENTIONS:
            known = listing(list(CONVENTIONS))
            raise UsageError("convention", f"'{self.convention}' is not one of {known}")
        opened = open_scene(
            find_scene(self.path, self.iteration),
            convention=None if self.convention is None else CONVENTIONS[self.convention],
            allow_checkpoint=self.allow_checkpoint,
            spz_axes=self.spz_axes,
        )
        say(
            f"scene: {opened.path}: {opened.count:,} Gaussians, SH degree {opened.sh_degree}, "
            f"{opened.convention.name} ({opened.evidence})"
        )
        for note in opened.notes:
            say(worded(f"scene: {note}", SceneOptions.__dataclass_fields__))
        for fusion in opened.fused:
            say(f"fused: {describe(fusion)}")
        return opened

    def read(self) -> Gaussians:
        """Read the scene and say what it is."""
        return self.open().whole(self.drop_bad)


@dataclass(frozen=True)
class CameraOptions:
    """The cameras."""

    cameras: Annotated[Path | None, flag("PATH")] = None
    """cameras.json, COLMAP model, Blender transforms_*.json, or their folder (default: SCENE's model folder)."""
    train_scale: Annotated[float | None, flag("FACTOR")] = None
    """Training size relative to the cameras' source size, where the files do not say."""
    images: Annotated[str | None, flag("FOLDER")] = None
    """Folder of photographs inside the data set (default: the format's own)."""
    test_every: Annotated[int | None, flag("N")] = None
    """Hold out every N-th view by name; 0 for no split (default: as usual for the format)."""
    min_seen: float = MIN_SEEN_SHARE
    """Stop if the cameras see a smaller share of the Gaussians than this."""
    cull_margin: Annotated[float, flag("SHARE")] = math.inf
    """Cull Gaussians centred farther outside the image than this share of its longer side, if training did."""

    def read(self, options: SceneOptions) -> CameraSet:
        """Read the cameras and say where sizes and split come from."""
        path = self.cameras
        if path is None and options.path.is_dir():
            path = options.path
        if path is None:
            raise UsageError("cameras", "name cameras.json, a COLMAP model or transforms_*.json")
        cameras = read_cameras(path, train_scale=self.train_scale, images=self.images, test_every=self.test_every)
        for note in cameras.notes:
            say(worded(f"cameras: {note}", CameraOptions.__dataclass_fields__))
        return cameras


@dataclass(frozen=True)
class ViewOptions:
    """Views, background and rasterizer."""

    views: Annotated[str, tyro.conf.arg(metavar="NAME,...|test|train|all")] = "test"
    """Views, by name or split."""
    background: Annotated[str, choice(("auto", "white", "black"))] = "auto"
    """Colour behind the scene; auto is what training had."""
    rasterizer: Annotated[str, choice(("auto", "compiled", *RASTERIZERS))] = "auto"
    """auto: compiled if `aaplug warmup` has run, else eager.  reference: slow, exact, float64."""
    threads: Annotated[int | None, flag("N")] = None
    """Processor threads (default: all)."""
    memory: Annotated[float | None, flag("GB")] = None
    """Memory per frame, beside the scene and the image (default: 1)."""


@dataclass(frozen=True)
class RenderOptions(ViewOptions):
    """Rendering."""

    quality: Annotated[str, choice(QUALITIES)] = "balanced"
    """How finely recipe auto samples: fast reaches a quarter of the training rate, balanced half, best all of it."""
    rate_reference: Annotated[str | None, flag("|".join(get_args(RateReference)))] = None
    """Sampling rate that matched and auto compare with (default: pose: global, or interval for a free camera)."""


def values_of(options: Any) -> dict[str, Any]:
    """All options of a verb by name, those of its groups included."""
    found: dict[str, Any] = {}
    for field in fields(options):
        value = getattr(options, field.name)
        found |= values_of(value) if is_dataclass(value) else {field.name: value}
    return found


def arguments(options: Any, verb: Callable[..., Any]) -> dict[str, Any]:
    """The options that a function of the library takes by name; scene and cameras are passed as objects instead."""
    known = inspect.signature(verb).parameters.keys() - {"scene", "cameras"}
    return {name: value for name, value in values_of(options).items() if name in known}

"""Options that several verbs share, and the reading that follows from them.

Each class is a group of flags; its methods read what the flags name and say on stderr what they found.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro

from aaplug.core.cameras import BLACK, WHITE, Camera, CameraSet
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import CONVENTIONS, Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.training import TrainingViews
from aaplug.core.sampling import MIN_SEEN_SHARE, check_frame
from aaplug.io.cameras import read_cameras, select_views
from aaplug.io.scenes import SpzAxes, find_scene, open_scene
from aaplug.io.scenes.scene_file import SceneFile
from aaplug.methods.recipes import SAMPLING, Recipe, find_recipe
from aaplug.methods.viewers import describe
from aaplug.rasterizers import Tiled
from aaplug.rasterizers.tiled.ahead_of_time import choose
from aaplug.rasterizers.tiled.binning import MEMORY
from aaplug.rendering.renderer import learn

from .console import say

CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)  # how classes become flags
Quality = Literal["fast", "balanced", "best"]
Rate = Literal["pose", "global", "sharpest", "interval"]


def flag(metavar: str, *aliases: str) -> Any:
    """A flag whose help shows `metavar` and no default, for what is absent unless given."""
    return tyro.conf.arg(metavar=metavar, aliases=aliases, help_behavior_hint="")


assert set(SAMPLING) == {"fast", "balanced", "best"}


@dataclass(frozen=True)
class SceneOptions:
    """The scene."""

    scene: Annotated[Path | None, tyro.conf.Positional, flag("SCENE")] = None
    """A scene (.ply, .compressed.ply, .spz, .sog, .splat, .ksplat) or its folder (INRIA model, SOG)."""
    model_path: Annotated[Path | None, flag("FOLDER", "-m")] = None
    """An INRIA model folder, instead of SCENE."""
    iteration: Annotated[int | None, flag("N")] = None
    """Which iteration of a model folder (default: the last)."""
    convention: Annotated[
        Literal["classic", "antialiased", "mip"] | None, flag("classic|antialiased|mip")
    ] = None
    """How the scene was trained, where its file does not say."""
    drop_bad: bool = False
    """Leave out Gaussians with NaN, infinite or unusable values instead of stopping."""
    allow_checkpoint: bool = False
    """Read gsplat's .pt too: a pickle, of which nothing but tensors is taken."""
    spz_axes: SpzAxes = "opengl"
    """Axes of a .spz, read or written: opengl by its specification; opencv as splat-transform and gsply have them."""

    @property
    def path(self) -> Path:
        """What the user named."""
        if (self.scene is None) == (self.model_path is None):
            raise UsageError("SCENE", "name one scene: a .ply, a model folder, or -m FOLDER")
        path = self.scene or self.model_path
        assert path is not None
        return path

    def open(self) -> SceneFile:
        """Look at the scene and say what it is."""
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
            say(f"scene: {note}")
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
    """Training size over the cameras' source size, where the files do not say."""
    images: Annotated[str | None, flag("FOLDER")] = None
    """Folder of photographs inside the data set (default: the format's own)."""
    test_every: Annotated[int | None, flag("N")] = None
    """Hold out every N-th view by name; 0 for no split (default: as the format's users do)."""
    min_seen: float = MIN_SEEN_SHARE
    """Stop if fewer of the Gaussians than this share are seen by any camera."""
    guard: Annotated[float, flag("SHARE")] = math.inf
    """Draw no Gaussian centred farther outside the image than this share of its longer side, if training did not."""

    def read(self, options: SceneOptions) -> CameraSet:
        """Read the cameras and say where sizes and split come from."""
        path = self.cameras
        if path is None and options.path.is_dir():
            path = options.path
        if path is None:
            raise UsageError(
                "--cameras", "is needed: cameras.json, a COLMAP model or transforms_*.json"
            )
        cameras = read_cameras(
            path, train_scale=self.train_scale, images=self.images, test_every=self.test_every
        )
        for note in cameras.notes:
            say(f"cameras: {note}")
        return cameras

    def learn(self, scene: Gaussians, cameras: CameraSet) -> TrainingViews:
        """Check that scene and cameras share a frame, and compute the sampling bounds."""
        assert scene.origin is not None
        check_frame(scene.means, cameras.train, scene.origin.path, self.min_seen)
        return learn(scene, cameras.train, self.guard)


@dataclass(frozen=True)
class ViewOptions:
    """Which views, over what, and what draws them."""

    views: Annotated[str, tyro.conf.arg(metavar="NAME,...|test|train|all")] = "test"
    """Which views."""
    background: Literal["auto", "white", "black"] = "auto"
    """Behind the scene; auto is what training had."""
    rasterizer: Literal["auto", "compiled", "eager", "reference"] = "auto"
    """auto is compiled where `aaplug warmup` has run, else eager; reference is slow, exact and float64."""
    threads: Annotated[int | None, flag("N")] = None
    """Processor threads (default: all)."""
    memory: Annotated[float, flag("GB")] = MEMORY / 1e9
    """Memory of a frame beside the scene and the image."""

    def select(self, cameras: CameraSet) -> Sequence[Camera]:
        """The views that --views names."""
        return select_views(cameras, self.views)

    def background_of(self, cameras: CameraSet) -> tuple[float, float, float]:
        """The colour behind the scene; says which."""
        if self.background != "auto":
            return WHITE if self.background == "white" else BLACK
        colour = cameras.background or BLACK
        name = {WHITE: "white", BLACK: "black"}.get(colour, str(colour))
        why = "from the camera files" if cameras.background else "assumed; --background sets it"
        say(f"background: {name} ({why})")
        return colour

    def rasterize(self, frames: int) -> Rasterizer:
        """The rasterizer by name, on as many threads as asked for; says which."""
        if self.threads is not None:
            if self.threads < 1:
                raise UsageError("--threads", f"must be 1 or more, got {self.threads}")
            torch.set_num_threads(self.threads)
        if not self.memory > 0:
            raise UsageError("--memory", f"must be above 0, got {self.memory:g}")
        chosen = choose(self.rasterizer, frames, say)
        tiled = isinstance(chosen, Tiled)
        return replace(chosen, memory=self.memory * 1e9) if tiled else chosen


@dataclass(frozen=True)
class RenderOptions(ViewOptions):
    """How views are rendered."""

    quality: Quality = "balanced"
    """Samples a pixel of recipe auto: fast reaches a quarter of the training rate, balanced half, best all of it."""
    rate: Annotated[Rate | None, flag("pose|global|sharpest|interval")] = None
    """What matched and auto compare rates with; pose: training's size at its poses, its range of rates elsewhere."""

    def recipes(self, names: Iterable[str]) -> list[Recipe]:
        """Several by name; --rate concerns those that match one."""
        return [
            find_recipe(
                name,
                quality=self.quality,
                rate=self.rate if name in ("matched", "auto") else None,
            )
            for name in names
        ]

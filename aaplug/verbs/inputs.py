"""What verbs take: scenes and cameras as objects or paths, backgrounds, rasterizers and threads by name."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

import torch

from aaplug.core.cameras import BLACK, WHITE, CameraSet
from aaplug.core.errors import UsageError
from aaplug.core.executors import torch_threads
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Colour, MatchesRates, Rasterizer, TakesMemory
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.sampling import MIN_SEEN_SHARE
from aaplug.core.training import TrainingViews
from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import find_scene, read_scene
from aaplug.methods.recipe import Recipe
from aaplug.methods.recipes import RECIPES, find_recipe
from aaplug.rasterizers import find_rasterizer
from aaplug.rendering.renderer import Background, Renderer, background_colour

SceneLike = Gaussians | str | PathLike[str]
CamerasLike = CameraSet | str | PathLike[str] | None
MODEL_SCENE = "point_cloud/iteration_*/point_cloud.ply"  # in an INRIA model folder


def scene_of(scene: SceneLike) -> Gaussians:
    """The scene itself, or the one in a file or model folder."""
    return scene if isinstance(scene, Gaussians) else read_scene(find_scene(Path(scene)))


def cameras_of(cameras: CamerasLike, scene: SceneLike) -> CameraSet:
    """The cameras themselves, those at a path, or those of the model folder that the scene is in.

    Raises:
        UsageError: no cameras are given, and the scene is in no model folder.
    """
    if isinstance(cameras, CameraSet):
        return cameras
    if cameras is not None:
        return read_cameras(Path(cameras))
    path = Path(scene.name if isinstance(scene, Gaussians) else scene)
    if path.match(MODEL_SCENE):
        path = path.parents[2]
    if not path.is_dir():
        raise UsageError("cameras", "expected cameras.json, a COLMAP model or transforms_*.json")
    return read_cameras(path)


def background_of(background: Background, cameras: CameraSet, monitor: Monitor = SILENT) -> Colour:
    """The colour behind the scene; "auto" is reported, with its source.

    Raises:
        UsageError: the name is not known.
    """
    colour = background_colour(background, cameras)
    if background == "auto":
        name = {WHITE: "white", BLACK: "black"}.get(colour, str(colour))
        known = "from the camera files" if cameras.background else "the camera files do not say"
        monitor.say(f"background: {name} ({known})")
    return colour


def rasterizer_of(
    rasterizer: str | Rasterizer, frames: int, memory: float | None, monitor: Monitor = SILENT
) -> Rasterizer:
    """A rasterizer, or the one of that name for so many frames, within a memory budget.

    memory: GB that a frame may take beside the scene and the image; None for the rasterizer's default.

    Raises:
        UsageError: the name is not known, or the memory is not above 0.
    """
    if memory is not None and not memory > 0:
        raise UsageError("memory", f"must be above 0, got {memory:g}")
    if isinstance(rasterizer, str):
        rasterizer = find_rasterizer(rasterizer, frames, monitor.say)
    if memory is not None and isinstance(rasterizer, TakesMemory):
        return rasterizer.within(memory * 1e9)
    return rasterizer


def recipes_of(names: Sequence[str], quality: str = "balanced", rate_reference: str | None = None) -> list[Recipe]:
    """Recipes by name; the rate reference goes to those that compare rates.

    Raises:
        UsageError: a name is not known.
    """
    found = []
    for name in names:
        matches = isinstance(RECIPES.find(name, "recipe").screen, MatchesRates)
        reference = rate_reference if matches else None
        found.append(find_recipe(name, quality=quality, rate_reference=reference))
    return found


def renderers_of(
    scene: Gaussians,
    cameras: CameraSet,
    recipes: Sequence[Recipe],
    frames: int,
    background: Background = "auto",
    rasterizer: str | Rasterizer = "auto",
    memory: float | None = None,
    cull_margin: float = math.inf,
    min_seen: float = MIN_SEEN_SHARE,
    monitor: Monitor = SILENT,
) -> list[Renderer]:
    """One renderer per recipe, with the training views, background and rasterizer in common.

    frames: how many images they will render in all.  The others: see `Renderer.of` and `rasterizer_of`.

    Raises:
        FrameError: the cameras see little of the scene.
        UsageError: an argument does not fit, or the scene lacks what a recipe needs.
    """
    colour = background_of(background, cameras, monitor)
    training = TrainingViews.of(scene, cameras, cull_margin, min_seen)
    drawing = rasterizer_of(rasterizer, frames, memory, monitor)
    return [Renderer.of(scene, training, recipe, background=colour, rasterizer=drawing) for recipe in recipes]


@contextmanager
def processor(threads: int | None) -> Iterator[int]:
    """Limit torch to `threads` threads inside the block (None for its own default); yields their number.

    Raises:
        UsageError: the number is below 1.
    """
    if threads is not None and threads < 1:
        raise UsageError("threads", f"must be 1 or more, got {threads}")
    count = torch.get_num_threads() if threads is None else threads
    with torch_threads(count):
        yield count

"""What verbs take: scenes and cameras as objects or paths, backgrounds, rasterizers and threads by name."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

import torch

from aaplug.core.cameras import BLACK, WHITE, CameraSet
from aaplug.core.errors import UsageError
from aaplug.core.executors import torch_threads
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import MatchesRates, TakesMemory
from aaplug.core.monitor import Monitor
from aaplug.core.pyramids import Pyramid
from aaplug.core.training import TrainingViews
from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import MODEL_SCENE, open_scene, ply
from aaplug.io.scenes.harmonics import without_harmonics
from aaplug.io.scenes.scene_file import SceneFile
from aaplug.levels.pyramids import read_pyramid
from aaplug.methods.recipe import Recipe
from aaplug.methods.recipes import RECIPES, find_recipe
from aaplug.rasterizers import find_rasterizer
from aaplug.rendering.renderer import Harmonics, Renderer, background_colour
from aaplug.verbs.agreement import agreement, settled
from aaplug.verbs.options import RecipeOptions, ViewOptions

log = logging.getLogger("aaplug")

AnyPath = str | PathLike[str]
SceneLike = Gaussians | Pyramid | AnyPath
Held = Gaussians | Pyramid  # in memory
CamerasLike = CameraSet | AnyPath | None
HELD_HARMONICS = 2 * 10**9  # bytes: reading more for each view costs less than holding them; 10 M Gaussians of degree 3


def opened_of(scene: SceneFile | AnyPath, cameras: CameraSet | None, monitor: Monitor) -> SceneFile:
    """The scene's file, opened or in a model folder, by the reading that fits the cameras, if there are any."""
    opened = scene if isinstance(scene, SceneFile) else open_scene(scene)
    return opened if cameras is None else settled(opened, cameras, monitor)


def opened_with(scene: SceneLike | SceneFile, cameras: CameraSet | None, monitor: Monitor) -> Held | SceneFile:
    """The scene itself, or its opened file; see `opened_of`."""
    return scene if isinstance(scene, Held) else opened_of(scene, cameras, monitor)


def whole_of(scene: Held | SceneFile, drop_bad: bool = False) -> Gaussians:
    """The scene itself, or all of its file; of levels of detail the finest."""
    if isinstance(scene, Pyramid):
        return scene.finest
    return scene if isinstance(scene, Gaussians) else scene.whole(drop_bad)


def shown_of(scene: Held | SceneFile, drop_bad: bool = False) -> Held:
    """The scene itself, or all of its file, with all levels of detail."""
    if isinstance(scene, SceneFile) and scene.pyramid is not None:
        return read_pyramid(scene.pyramid)
    return scene if isinstance(scene, Held) else scene.whole(drop_bad)


def sources_of(scene: Held | SceneFile) -> list[Path]:
    """Files that outputs must not replace."""
    if isinstance(scene, SceneFile):
        return [scene.path]
    return [Path(scene.origin.path)] if isinstance(scene, Gaussians) and scene.origin else []


def drawable(scene: Held | SceneFile, drop_bad: bool = False) -> tuple[Held, Harmonics | None]:
    """The scene, and what reads its harmonics if they are large and stay in the file; only a .ply is read by rows."""
    if isinstance(scene, SceneFile) and scene.format == ply.name and scene.harmonics_bytes > HELD_HARMONICS:
        return without_harmonics(scene, drop_bad)
    return shown_of(scene, drop_bad), None


def cameras_of(cameras: CamerasLike, scene: SceneLike | SceneFile) -> CameraSet:
    """The cameras themselves, those at a path, or those of the model folder that the scene is in."""
    if isinstance(cameras, CameraSet):
        return cameras
    if cameras is not None:
        return read_cameras(cameras)
    named = scene.path if isinstance(scene, SceneFile) else scene
    path = Path(whole_of(named).name if isinstance(named, Held) else named)
    if path.match(MODEL_SCENE):
        path = path.parents[2]
    if not path.is_dir():
        raise UsageError("cameras", "expected cameras.json, a COLMAP model or transforms_*.json")
    return read_cameras(path)


def inputs_of(
    scene: SceneLike | SceneFile, cameras: CamerasLike, monitor: Monitor, drop_bad: bool = False
) -> tuple[Held, CameraSet]:
    """The scene, with its levels of detail, and its cameras; the cameras are read first, as they are small."""
    known = cameras_of(cameras, scene)
    return shown_of(opened_with(scene, known, monitor), drop_bad), known


def recipe_of(recipe: str | Recipe, o: RecipeOptions) -> Recipe:
    """A recipe as it is, or by name as the options say; the rate reference goes to those that compare rates."""
    if isinstance(recipe, Recipe):
        return recipe
    matches = isinstance(RECIPES.find(recipe, "recipe").screen, MatchesRates)
    return find_recipe(recipe, quality=o.quality, rate_reference=o.rate_reference if matches else None)


def look_of(scene: Held, cameras: CameraSet, frames: int, o: ViewOptions, monitor: Monitor) -> Renderer:
    """The scene as training showed it, with the training views, background and rasterizer that the options say.

    frames: how many images will be rendered in all.
    """
    # its packages take a third of a second to import, which `--help` need not wait for
    from aaplug.evaluation.truth import own_look

    colour = background_colour(o.background, cameras)
    if o.background == "auto":
        name = {WHITE: "white", BLACK: "black"}.get(colour, str(colour))
        source = "from the camera files" if cameras.background else "the camera files do not say"
        monitor.say(f"background: {name} ({source})")
    drawing = o.rasterizer
    if isinstance(drawing, str):
        drawing = find_rasterizer(drawing, frames, monitor.say)
    if o.memory is not None and isinstance(drawing, TakesMemory):
        drawing = drawing.within(o.memory * 1e9)
    scene = whole_of(scene)
    look = own_look(scene, TrainingViews.of(scene, cameras, o.cull_margin, o.min_seen), drawing, colour)
    fit = agreement(look, cameras)
    monitor.say(f"fit: {fit}")
    if fit.doubt:
        log.warning("%s: scene and cameras seem to be of different captures: %s", scene.name, fit.doubt)
    return look


def drawn_by(recipe: Recipe, scene: Held, look: Renderer) -> Renderer:
    """The scene as it was read, by a recipe and otherwise as its own look is drawn."""
    return Renderer.of(scene, look.training, recipe, background=look.background, rasterizer=look.rasterizer)


@contextmanager
def processor(threads: int | None) -> Iterator[int]:
    """Limit torch to `threads` threads inside the block (None for its own default); yields their number."""
    count = torch.get_num_threads() if threads is None else threads
    with torch_threads(count):
        yield count

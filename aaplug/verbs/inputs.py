"""What verbs take: scenes and cameras as objects or paths, backgrounds, rasterizers and threads by name."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import overload

import torch

from aaplug.core.cameras import BLACK, WHITE, CameraSet
from aaplug.core.errors import UsageError
from aaplug.core.executors import Executor, torch_threads
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import MatchesRates, TakesMemory
from aaplug.core.monitor import Monitor
from aaplug.core.pyramids import Pyramid
from aaplug.core.training import TrainingViews
from aaplug.io.cameras import holds_cameras, read_cameras
from aaplug.io.scenes import MODEL_SCENE, open_scene, ply
from aaplug.io.scenes.harmonics import without_harmonics
from aaplug.io.scenes.scene_file import SceneFile
from aaplug.levels.pyramids import read_pyramid
from aaplug.methods.recipe import Recipe
from aaplug.methods.recipes import RECIPES, find_recipe
from aaplug.options.objects import AnyPath
from aaplug.options.shared import RecipeOptions, ViewOptions
from aaplug.rasterizers import find_rasterizer
from aaplug.rendering.renderer import Harmonics, Renderer, background_colour
from aaplug.verbs.agreement import agreement, settled
from aaplug.verbs.assumed import Orbit

log = logging.getLogger("aaplug")

SceneLike = Gaussians | Pyramid | AnyPath
Held = Gaussians | Pyramid  # in memory
CamerasLike = CameraSet | Orbit | AnyPath | None
HELD_HARMONICS = 2 * 10**9  # bytes: reading more for each view costs less than holding them; 10 M Gaussians of degree 3


@overload
def opened_and_seen(
    scene: SceneFile | AnyPath, cameras: CamerasLike, monitor: Monitor, single: bool = False
) -> tuple[SceneFile, CameraSet]: ...


@overload
def opened_and_seen(
    scene: SceneLike | SceneFile, cameras: CamerasLike, monitor: Monitor, single: bool = False
) -> tuple[Held | SceneFile, CameraSet]: ...


def opened_and_seen(
    scene: SceneLike | SceneFile, cameras: CamerasLike, monitor: Monitor, single: bool = False
) -> tuple[Held | SceneFile, CameraSet]:
    """The scene itself, or its file, opened by the reading that fits the cameras; and its cameras.

    cameras: themselves, or their path; None for those of the model folder that the scene is in, else an `Orbit`.
    single: whether an orbit is asked for one picture.

    Raises:
        AaplugError: a file cannot be read, or there is nothing to look at.
    """
    opened = scene if isinstance(scene, Held | SceneFile) else open_scene(scene)
    known = _cameras_of(cameras, opened, single)
    return opened if isinstance(opened, Held) else settled(opened, known, monitor), known


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


def file_of(scene: Held | SceneFile) -> Path | None:
    """The file that it was read from, or its folder of levels of detail; None if it has none."""
    if isinstance(scene, SceneFile):
        return (scene.pyramid or scene.path).resolve()
    origin = whole_of(scene).origin
    return None if origin is None else Path(origin.path).resolve()


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


def _cameras_of(cameras: CamerasLike, scene: Held | SceneFile, single: bool) -> CameraSet:
    found = cameras if cameras is not None else folder_of_cameras(scene) or Orbit()
    if isinstance(found, CameraSet):
        return found
    if not isinstance(found, Orbit):
        return read_cameras(found)
    return (found.single() if single else found).around(scene if isinstance(scene, SceneFile) else whole_of(scene))


def folder_of_cameras(scene: SceneLike | SceneFile) -> Path | None:
    """The scene's folder, or the model folder that its file is in, if that holds cameras."""
    named = scene.pyramid or scene.path if isinstance(scene, SceneFile) else scene
    path = Path(whole_of(named).name if isinstance(named, Held) else named)
    folder = path.parents[2] if path.match(MODEL_SCENE) else path
    return folder if folder.is_dir() and holds_cameras(folder) else None


def inputs_of(
    scene: SceneLike | SceneFile, cameras: CamerasLike, monitor: Monitor, drop_bad: bool = False
) -> tuple[Held, CameraSet]:
    """The scene, with its levels of detail, and its cameras."""
    opened, known = opened_and_seen(scene, cameras, monitor)
    return shown_of(opened, drop_bad), known


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
    look = unchecked_look_of(scene, cameras, frames, o, monitor)
    if cameras.assumed:
        return look
    fit = agreement(look, cameras)
    monitor.say(f"fit: {fit}")
    if fit.doubt:
        log.warning("%s: scene and cameras seem to be of different captures: %s", look.scene.name, fit.doubt)
    return look


def unchecked_look_of(scene: Held, cameras: CameraSet, frames: int, o: ViewOptions, monitor: Monitor) -> Renderer:
    """The same without seconds spent on whether scene and cameras fit."""
    # its packages take a third of a second to import, which `--help` need not wait for
    from aaplug.evaluation.truth import own_look

    colour = background_colour(o.background, cameras)
    if o.background == "auto":
        name = {WHITE: "white", BLACK: "black"}.get(colour, str(colour))
        unknown = "nothing says" if cameras.assumed else "the camera files do not say"
        monitor.say(f"background: {name} ({'from the camera files' if cameras.background else unknown})")
    drawing = o.rasterizer
    if isinstance(drawing, str):
        drawing = find_rasterizer(drawing, frames, monitor.say)
    if o.memory is not None and isinstance(drawing, TakesMemory):
        drawing = drawing.within(o.memory * 1e9)
    scene = whole_of(scene)
    return own_look(scene, TrainingViews.of(scene, cameras, o.cull_margin, o.min_seen), drawing, colour)


def drawn_by(recipe: Recipe, scene: Held, look: Renderer) -> Renderer:
    """The scene as it was read, by a recipe and otherwise as its own look is drawn."""
    return Renderer.of(scene, look.training, recipe, background=look.background, rasterizer=look.rasterizer)


@contextmanager
def processor(threads: int | None) -> Iterator[int]:
    """Limit torch to `threads` threads inside the block (None for its own default); yields their number."""
    count = torch.get_num_threads() if threads is None else threads
    with torch_threads(count):
        yield count


@contextmanager
def scheduled(o: RecipeOptions, folder: Path | None, monitor: Monitor) -> Iterator[Executor | None]:
    """The workers that `scheduler` names, connected inside the block, or that it is; None if it is not given.

    folder: of the outputs, which all workers see.

    Raises:
        UsageError: the extra `cluster` is missing, nothing answers there, or the workers are unfit.
    """
    if not isinstance(o.scheduler, str):
        yield o.scheduler
        return
    if find_spec("distributed") is None:
        raise UsageError("scheduler", "needs the extra `cluster`: pip install 'aaplug[cluster]'")
    from aaplug.core.cluster import connected  # its package is an extra

    with connected(o.scheduler, o.threads or torch.get_num_threads(), folder, monitor) as cluster:
        yield cluster

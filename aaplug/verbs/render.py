"""Images of a scene at new resolutions."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from aaplug.core.cameras import Camera
from aaplug.core.errors import listing
from aaplug.core.executors import ProcessesIfLong
from aaplug.core.monitor import SILENT, Monitor
from aaplug.io.atomic import claimed, output_folder
from aaplug.io.cameras import select_views
from aaplug.io.scenes.scene_file import SceneFile
from aaplug.methods.recipes import find_recipe
from aaplug.options.objects import AnyPath
from aaplug.options.render import RenderOptions
from aaplug.rendering.frames import write_frames
from aaplug.rendering.renderer import Renderer
from aaplug.verbs.announce import announce
from aaplug.verbs.assumed import say_assumed
from aaplug.verbs.inputs import (
    CamerasLike,
    SceneLike,
    drawable,
    drawn_by,
    look_of,
    opened_and_seen,
    processor,
    scheduled,
)
from aaplug.verbs.views import image_paths, names_image, resized


class Written(NamedTuple):
    """A rendered view and its file."""

    view: Camera
    file: Path


@RenderOptions.shown
def render(
    scene: SceneLike | SceneFile,
    cameras: CamerasLike = None,
    output: AnyPath = "images",
    *,
    drop_bad: bool = False,
    monitor: Monitor = SILENT,
    **options: Any,
) -> list[Written]:
    """Render views at any resolution to PNG.

    Args:
        scene: Gaussians, a scene's file, opened or not, or a model folder.
        cameras: a camera set, its file or folder; or None for those of the scene's model folder, or without one for
            an orbit around the scene; or an `Orbit` of your own.
        output: a folder, or one .png for one view.
        drop_bad: leave out Gaussians of a file that cannot be used.
        monitor: receives messages and progress.
        options: fields of `RenderOptions`.

    Raises:
        AaplugError: an input cannot be read, an option does not fit, or an image cannot be written.
    """
    o = RenderOptions.of(options)
    recipe = o.recipe
    if isinstance(recipe, str):
        recipe = find_recipe(recipe, quality=o.quality, rate_reference=o.rate_reference)
    opened, cameras = opened_and_seen(scene, cameras, monitor, single=names_image(Path(output)))
    shown = resized(select_views(cameras, o.views), o.scale, o.resolution, cameras.assumed)
    check = partial(image_paths, Path(output), shown, o.overwrite)
    paths = check()
    scene, harmonics = drawable(opened, drop_bad)
    with processor(o.threads) as workers, output_folder(paths[0].parent), claimed(output, check):
        renderer = drawn_by(recipe, scene, look_of(scene, cameras, len(shown), o, monitor))
        renderer = replace(renderer, harmonics=harmonics)
        monitor.say(described(renderer, shown))
        say_assumed(cameras, monitor, renderer, shown[0])
        announce([renderer], shown, monitor, processes=workers)
        with scheduled(o, paths[0].parent, monitor) as cluster, monitor.progress("rendering", "views") as tell:
            pool = cluster or ProcessesIfLong(workers)
            write_frames(renderer, shown, paths, pool.map, bit_depth=o.bit_depth, overwrite=o.overwrite, tell=tell)
    return [Written(*pair) for pair in zip(shown, paths, strict=True)]


def described(renderer: Renderer, views: Sequence[Camera]) -> str:
    """What is about to be rendered, in words."""
    rates = [renderer.relative_rate(view) for view in views]
    samples = sorted({renderer.samples(view) for view in views})
    grid = " or ".join(f"{n}×{n}" for n in samples)
    sizes = listing(sorted({f"{view.width}x{view.height}" for view in views}), most=3)
    span = " to ".join(dict.fromkeys(f"{rate:.3g}" for rate in (min(rates), max(rates))))
    kind = f"{renderer.training.convention.name} scene{' of 2D Gaussians' * renderer.scene.flat}"
    return (
        f"recipe: {renderer.recipe.name} for a {kind}, {len(views)} view{'s' * (len(views) != 1)} at {sizes}, "
        f"{span} × the training rate: {grid} sample{'s' * (samples != [1])} per pixel"
    )

"""Images of a scene at new resolutions."""

import math
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

from aaplug.core.cameras import Camera
from aaplug.core.errors import listing
from aaplug.core.interfaces import Rasterizer
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.sampling import MIN_SEEN_SHARE
from aaplug.io.atomic import make_folder
from aaplug.io.cameras import select_views
from aaplug.methods.recipe import Recipe
from aaplug.methods.recipes import find_recipe
from aaplug.rendering.frames import write_frames
from aaplug.rendering.renderer import Background, Renderer
from aaplug.verbs.inputs import CamerasLike, SceneLike, cameras_of, processor, renderers_of, scene_of
from aaplug.verbs.views import image_paths, resized


class Written(NamedTuple):
    """A rendered view and its file."""

    view: Camera
    file: Path


def render(
    scene: SceneLike, cameras: CamerasLike = None, output: str | PathLike[str] = "images", *,
    views: str = "test", recipe: str | Recipe = "auto",
    quality: str = "balanced", rate_reference: str | None = None,
    scale: float | None = None, resolution: str | None = None, bit_depth: int = 8,
    background: Background = "auto", rasterizer: str | Rasterizer = "auto",
    threads: int | None = None, memory: float | None = None,
    cull_margin: float = math.inf, min_seen: float = MIN_SEEN_SHARE,
    overwrite: bool = False, monitor: Monitor = SILENT,
) -> list[Written]:  # fmt: skip
    """Render views at any resolution to PNG.

    Args:
        scene: Gaussians, a scene's file or a model folder.
        cameras: a camera set, its file or folder, or None for those of the scene's model folder.
        output: a folder, or one .png for one view.
        views: "train", "test", "all", or names separated by commas.
        recipe, quality, background, rasterizer, cull_margin, min_seen: see `Renderer.of`.
        rate_reference: what "matched" and "auto" compare sampling rates with; see `Matched`.
        scale, resolution: size relative to the training size (default: 1), or "WIDTHxHEIGHT" in px with -1 for any.
        bit_depth: 8 or 16 bits per colour channel.
        threads, memory: processor threads (None for all); GB per frame, beside the scene and the image.
        overwrite: replace existing images.
        monitor: receives messages and progress.

    Raises:
        AaplugError: an input cannot be read, an argument does not fit, or an image cannot be written.
    """
    if isinstance(recipe, str):
        recipe = find_recipe(recipe, quality=quality, rate_reference=rate_reference)
    cameras, scene = cameras_of(cameras, scene), scene_of(scene)
    shown = resized(select_views(cameras, views), scale, resolution)
    folder, paths = Path(output), image_paths(Path(output), shown, overwrite)
    look = (background, rasterizer, memory, cull_margin, min_seen, monitor)
    with processor(threads) as workers:
        (renderer,) = renderers_of(scene, cameras, [recipe], len(shown), *look)
        monitor.say(described(renderer, shown))
        if not folder.suffix:
            make_folder(folder)
        with monitor.progress("rendering", "views") as tell:
            options = {"bit_depth": bit_depth, "overwrite": overwrite, "tell": tell}
            write_frames(renderer, shown, paths, threads=workers, **options)
    return [Written(*pair) for pair in zip(shown, paths, strict=True)]


def described(renderer: Renderer, views: Sequence[Camera]) -> str:
    """What is about to be rendered, in words."""
    rates = [renderer.relative_rate(view) for view in views]
    samples = sorted({renderer.samples(view) for view in views})
    grid = " or ".join(f"{n}×{n}" for n in samples)
    sizes = listing(sorted({f"{view.width}x{view.height}" for view in views}), most=3)
    span = " to ".join(dict.fromkeys(f"{rate:.3g}" for rate in (min(rates), max(rates))))
    kind = f"{renderer.training.convention.name} scene"
    if renderer.scene.flat:
        kind += " of 2D Gaussians"
    return (
        f"recipe: {renderer.recipe.name} for a {kind}, {len(views)} view{'s' * (len(views) != 1)} at {sizes}, "
        f"{span} × the training rate: {grid} sample{'s' * (samples != [1])} per pixel"
    )

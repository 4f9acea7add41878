"""Scenes side by side: how near each comes to one truth at several scales."""

import math
from collections.abc import Mapping, Sequence

from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.sampling import MIN_SEEN_SHARE
from aaplug.core.training import TrainingViews
from aaplug.evaluation.engine import Candidate
from aaplug.evaluation.engine import compare as compared
from aaplug.evaluation.results import Report
from aaplug.evaluation.truth import Truth, own_look, source_of
from aaplug.io.cameras import select_views
from aaplug.methods.recipe import Recipe
from aaplug.methods.recipes import find_recipe
from aaplug.rendering.renderer import Background, Renderer
from aaplug.verbs.inputs import CamerasLike, SceneLike, background_of, cameras_of, processor, rasterizer_of, scene_of

SCALES = (1.0, 0.5, 0.25, 0.125)


def compare(
    candidates: Mapping[str, SceneLike],
    cameras: CamerasLike = None,
    *,
    recipe: str | Recipe = "auto",
    scale: Sequence[float] = SCALES,
    views: str = "test",
    truth: str = "auto",
    quality: str = "balanced",
    background: Background = "auto",
    rasterizer: str | Rasterizer = "auto",
    threads: int | None = None,
    memory: float | None = None,
    cull_margin: float = math.inf,
    min_seen: float = MIN_SEEN_SHARE,
    monitor: Monitor = SILENT,
) -> Report:
    """Compare scenes, such as an original and its compressed or fine-tuned forms, in PSNR and SSIM.

    Args:
        candidates: scenes by the names that the report gives them; the first is the original.
        cameras: a camera set, its file or folder, or None for those of the first scene's model folder.
        recipe: a recipe for all of them, or its name in `RECIPES`.
        scale: sizes relative to the training size.
        truth: "photographs", "self" (the first scene's own look), or "auto" for photographs where every view has one.
        views, quality, background, rasterizer, threads, memory, cull_margin, min_seen, monitor: see `render`.

    Raises:
        AaplugError: an input cannot be read, or an argument does not fit.
    """
    if not candidates:
        raise UsageError("candidates", "needs at least one scene")
    cameras = cameras_of(cameras, next(iter(candidates.values())))
    chosen = select_views(cameras, views)
    source = source_of(chosen, truth)
    monitor.say(f"truth: {source}")
    if isinstance(recipe, str):
        recipe = find_recipe(recipe, quality=quality)
    colour = background_of(background, cameras, monitor)
    with processor(threads), monitor.progress("comparing", "views") as tell:
        frames = len(chosen) * len(scale) * len(candidates)
        drawing = rasterizer_of(rasterizer, frames, memory, monitor)
        scenes = [scene_of(scene) for scene in candidates.values()]
        trained = [TrainingViews.of(scene, cameras, cull_margin, min_seen) for scene in scenes]
        looks = [own_look(*pair, drawing, colour) for pair in zip(scenes, trained, strict=True)]
        shown = [
            Candidate(name, _shown(scene, recipe, look))
            for name, scene, look in zip(candidates, scenes, looks, strict=True)
        ]
        return compared(shown, chosen, scale, Truth(looks[0], source), tell)


def _shown(scene: Gaussians, recipe: Recipe, look: Renderer) -> Renderer:
    """The scene by a recipe, otherwise drawn as its own look is."""
    rasterizer, background = look.rasterizer, look.background
    return Renderer.of(scene, look.training, recipe, rasterizer=rasterizer, background=background)

"""Scenes side by side: how near each comes to one truth at several scales."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

from aaplug.core.errors import UsageError
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.training import TrainingViews
from aaplug.evaluation.engine import Candidate
from aaplug.evaluation.engine import compare as compared
from aaplug.evaluation.results import Report
from aaplug.evaluation.truth import Truth, source_of
from aaplug.io.cameras import select_views
from aaplug.methods.recipe import Recipe
from aaplug.verbs.assumed import say_assumed
from aaplug.verbs.inputs import (
    CamerasLike,
    SceneLike,
    drawn_by,
    inputs_of,
    look_of,
    opened_and_seen,
    processor,
    recipe_of,
    shown_of,
    whole_of,
)
from aaplug.verbs.options import SCALES, RecipeOptions


@dataclass(frozen=True, kw_only=True)
class CompareOptions(RecipeOptions):
    """Rendering, scales and truth."""

    recipe: str | Recipe = "auto"
    """A recipe for all scenes."""
    scale: Annotated[Sequence[float], SCALES] = (1.0, 0.5, 0.25, 0.125)
    """Sizes relative to the training size."""
    truth: str = "auto"
    """photographs, self (the first scene's own look), or auto for photographs where every view has one."""


@CompareOptions.shown
def compare(
    candidates: Mapping[str, SceneLike], cameras: CamerasLike = None, *, monitor: Monitor = SILENT, **options: Any
) -> Report:
    """Compare scenes, such as an original and its compressed or fine-tuned forms, in PSNR and SSIM.

    Args:
        candidates: scenes by the names that the report gives them; the first is the original.
        cameras, monitor: see `render`; None for the cameras of the first scene's model folder, or an orbit around it.
        options: fields of `CompareOptions`.
    """
    o = CompareOptions.of(options)
    if not candidates:
        raise UsageError("candidates", "needs at least one scene")
    first, *others = candidates.values()
    opened, cameras = opened_and_seen(first, cameras, monitor)
    chosen = select_views(cameras, o.views)
    source = source_of(chosen, o.truth)
    monitor.say(f"truth: {source}")
    recipe = recipe_of(o.recipe, o)
    with processor(o.threads), monitor.progress("comparing", "views") as tell:
        scenes = [shown_of(opened), *(inputs_of(scene, cameras, monitor)[0] for scene in others)]
        look = look_of(scenes[0], cameras, len(chosen) * len(o.scale) * len(scenes), o, monitor)
        say_assumed(cameras, monitor, look)
        trained = [TrainingViews.of(whole_of(scene), cameras, o.cull_margin, o.min_seen) for scene in scenes[1:]]
        looks = [look, *(replace(look, training=training) for training in trained)]
        each = zip(candidates, scenes, looks, strict=True)
        shown = [Candidate(name, drawn_by(recipe, scene, look)) for name, scene, look in each]
        return compared(shown, chosen, o.scale, Truth(look, source), tell)

"""The recipes that a user picks, each with its source; `research_recipes` has the comparisons."""

from dataclasses import replace
from typing import Any

from aaplug.core.choices import QUALITIES
from aaplug.core.errors import UsageError, not_one_of
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import MatchesRates
from aaplug.core.registry import Registry, named
from aaplug.methods.filters import SCREEN_FILTERS, LowPass, Matched, Smoothing3D
from aaplug.methods.pixel_kernels import SURFEL
from aaplug.methods.recipe import LevelChoice, Promises, Recipe
from aaplug.methods.research_recipes import RESEARCH_RECIPES

# 100,000 Gaussians take some 20 ms on two cores, and 27 % of a large scene's a third of the time without levels
LEVELS = {
    "fast": LevelChoice(most_samples=1.0),
    "balanced": LevelChoice(budget=100_000, share=0.27, finer=1.0),
    "best": None,
}


def _set_by(quality: str) -> dict[str, Any]:
    """What a quality sets of a recipe."""
    return {"target_rate": QUALITIES[quality], "levels": LEVELS[quality]}


# Of a sample, the weight of those beside it where samples are few: it takes the noise off what compositing could not
# resolve.  0.02 to 0.04 are best against the scenes' own look (examples/guides/methods.md).
NEIGHBOURS = 0.03

USER_RECIPES = (
    Recipe(
        "auto",
        Matched(),
        "aaplug: matched, with more samples per pixel the smaller the image (--quality), weighed with their neighbours",
        "the default",
        neighbours=NEIGHBOURS,
        takes_quality=True,
        for_discs="2dgs-matched",
        promises=Promises(equals_training=True),
        **_set_by("balanced"),
    ),
    Recipe(
        "matched",
        Matched(),
        "aaplug: training's dilation rescaled to the new sampling rate, then the rest of the pixel's filter",
        "speed, zooming in: one sample per pixel",
        promises=Promises(equals_training=True),
    ),
    Recipe(
        "classic",
        SCREEN_FILTERS["classic"],
        "3DGS (Kerbl et al. 2023): +0.3 px²",
        "comparison: right only at the training size",
        promises=Promises(equals_training=True, keeps_energy=False),
    ),
    Recipe(
        "ewa",
        SCREEN_FILTERS["ewa"],
        "EWA splatting (Zwicker et al. 2002); 3DGS --antialiasing, gsplat antialiased: 0.3 px², compensated",
        "scenes trained with it",
    ),
    Recipe(
        "mip",
        SCREEN_FILTERS["mip"],
        "Mip-Splatting's 2D Mip filter (Yu et al. 2024, eq. 10): 0.1 px², compensated",
        "scenes trained with it; scenes converted by aaplug",
    ),
    Recipe(
        "mip-splatting",
        SCREEN_FILTERS["mip"],
        "Mip-Splatting (Yu et al. 2024): 3D smoothing (eq. 9) with its volume factor, then the 2D Mip filter",
        "scenes trained with it; it dims others",
        world=Smoothing3D(),
        promises=Promises(opaque_when_near=False),
    ),
    Recipe(
        "2dgs",
        LowPass(),
        "2DGS (Huang et al. 2024): surfels intersected by rays, and a low-pass filter of √½ px",
        "scenes of 2D Gaussians at the training size; a 3D Gaussian becomes a surfel across its thinnest axis",
        pixel=SURFEL,
        promises=Promises(keeps_energy=False),
    ),
    Recipe(
        "2dgs-matched",
        LowPass(matched=True),
        "aaplug: 2DGS with its low-pass filter rescaled to the new sampling rate, and samples per pixel as in auto",
        "scenes of 2D Gaussians at other sizes",
        target_rate=0.5,
        pixel=SURFEL,
    ),
)

RECIPES: Registry[Recipe] = Registry("recipe", named((*USER_RECIPES, *RESEARCH_RECIPES)), Recipe)


def find_recipe(
    name: str, *, quality: str = "balanced", rate_reference: str | None = None, target_rate: float | None = None
) -> Recipe:
    """A recipe by name, with the user's choices.

    Args:
        name: of `RECIPES`.
        quality: of `QUALITIES`: how finely `auto` samples a pixel.
        rate_reference: what `matched` and `auto` compare a Gaussian's sampling rate with.
        target_rate: relative rate at which any recipe samples a pixel, instead of its own.

    Raises:
        UsageError: a name or a quality is not known, or the recipe compares no rates.
    """
    recipe = RECIPES.find(name, "recipe")
    if quality not in QUALITIES:
        raise UsageError("quality", not_one_of(quality, QUALITIES))
    if rate_reference is not None:
        if not isinstance(recipe.screen, MatchesRates):
            raise UsageError("rate_reference", f"recipe '{name}' compares no sampling rates")
        recipe = replace(recipe, screen=recipe.screen.with_reference(rate_reference))
    if recipe.takes_quality:
        recipe = replace(recipe, **_set_by(quality))
    return recipe if target_rate is None else replace(recipe, target_rate=target_rate)


def suited(recipe: Recipe, scene: Gaussians) -> Recipe:
    """The recipe as it applies to a scene: `auto` draws discs for a scene of 2D Gaussians.

    Raises:
        UsageError: the scene lacks what the recipe needs.
    """
    missing = recipe.lacks(scene)
    if missing is not None:
        raise UsageError(f"recipe {recipe.name}", missing)
    if recipe.for_discs is None or not scene.flat:
        return recipe
    discs = RECIPES[recipe.for_discs]
    return replace(discs, name=recipe.name, target_rate=recipe.target_rate)

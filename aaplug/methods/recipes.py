"""Finding the recipe that a user means, and fitting it to a scene."""

from dataclasses import replace
from typing import Annotated, get_args

from aaplug.core.gaussians import Gaussians
from aaplug.methods import QUALITIES, RECIPES, RateReference, SplatOrder
from aaplug.methods.filters.matched import Matched
from aaplug.methods.recipe import Recipe, set_by
from aaplug.system.contracts import Range, contract
from aaplug.system.errors import UsageError, not_one_of


@contract
def find_recipe(
    name: str,
    *,
    quality: str = "balanced",
    rate_reference: str | None = None,
    order: SplatOrder = "depth",
    target_rate: Annotated[float, Range(0)] | None = None,
) -> Recipe:
    """A recipe by name, with the user's choices.

    Args:
        name: of `RECIPES`.
        quality: of `QUALITIES`: how finely `auto` samples a pixel.
        rate_reference: what `matched` and `auto` compare a Gaussian's sampling rate with.
        order: of splats; see `Recipe`.
        target_rate: relative rate at which any recipe samples a pixel, instead of its own.

    Raises:
        UsageError: a name or a quality is not known, or the recipe compares no rates.
    """
    recipe = RECIPES.find(name, "recipe")
    if quality not in QUALITIES:
        raise UsageError("quality", not_one_of(quality, QUALITIES))
    if rate_reference is not None:
        if not isinstance(recipe.screen, Matched):
            raise UsageError("rate_reference", f"recipe '{name}' compares no sampling rates")
        references = get_args(RateReference)
        if rate_reference not in references:
            raise UsageError("rate_reference", not_one_of(rate_reference, references))
        recipe = replace(recipe, screen=replace(recipe.screen, reference=rate_reference))
    if order != recipe.order:
        recipe = replace(recipe, order=order)
    if recipe.takes_quality:
        recipe = replace(recipe, **set_by(quality))
    return recipe if target_rate is None else replace(recipe, target_rate=target_rate)


def suited(recipe: Recipe, scene: Gaussians) -> Recipe:
    """The recipe as it applies to a scene: `auto` draws discs for a scene of 2D Gaussians.

    Raises UsageError if the scene lacks what the recipe needs.
    """
    missing = recipe.lacks(scene)
    if missing is not None:
        raise UsageError(f"recipe {recipe.name}", missing)
    if recipe.for_discs is None or not scene.flat:
        return recipe
    discs = RECIPES[recipe.for_discs]
    kept = {name: getattr(recipe, name) for name in ("name", "target_rate", "order", "levels")}
    return replace(discs, **kept)

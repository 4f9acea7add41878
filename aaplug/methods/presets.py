"""The recipes that a user picks, those that predict what other programs draw, each with its source, and finding one."""

from dataclasses import replace
from typing import Annotated, get_args

from aaplug.core.gaussians import Gaussians
from aaplug.methods import QUALITIES, RECIPES, RateReference, SplatOrder
from aaplug.methods.filters.dilation import (
    OF_ANTIALIASED,
    OF_CLASSIC,
    OF_MIP,
    OF_PLAYCANVAS,
    OF_PLAYCANVAS_CLASSIC,
    Dilation,
    LowPass,
)
from aaplug.methods.filters.matched import BY_POSE, Matched
from aaplug.methods.filters.smoothing import BY_VOLUME
from aaplug.methods.pixel_kernels.surfel import SURFEL
from aaplug.methods.recipe import Promises, Recipe, set_by
from aaplug.methods.viewers import Viewer
from aaplug.system.contracts import Range, contract
from aaplug.system.errors import UsageError, not_one_of

# Of a sample, the weight of those beside it where samples are few: it takes the noise off what compositing could not
# resolve.  0.02 to 0.04 are best against the scenes' own look (examples/guides/methods.md).
NEIGHBOURS = 0.03

AUTO = Recipe(
    "auto",
    BY_POSE,
    "aaplug: matched, with more samples per pixel the smaller the image (--quality), weighed with their neighbours",
    "the default",
    neighbours=NEIGHBOURS,
    takes_quality=True,
    for_discs="2dgs-matched",
    time=1.4,
    promises=Promises(equals_training=True),
    **set_by("balanced"),
)
MATCHED = Recipe(
    "matched",
    BY_POSE,
    "aaplug: training's dilation rescaled to the new sampling rate, then the rest of the pixel's filter",
    "speed, zooming in: one sample per pixel",
    promises=Promises(equals_training=True),
)
CLASSIC_RECIPE = Recipe(
    "classic",
    OF_CLASSIC,
    "3DGS (Kerbl et al. 2023): +0.3 px²",
    "comparison: right only at the training size",
    promises=Promises(equals_training=True, keeps_energy=False),
)
EWA = Recipe(
    "ewa",
    OF_ANTIALIASED,
    "EWA splatting (Zwicker et al. 2002); 3DGS --antialiasing, gsplat antialiased: 0.3 px², compensated",
    "scenes trained with it",
)
MIP_RECIPE = Recipe(
    "mip",
    OF_MIP,
    "Mip-Splatting's 2D Mip filter (Yu et al. 2024, eq. 10): 0.1 px², compensated",
    "scenes trained with it; scenes converted by aaplug",
)
MIP_SPLATTING = Recipe(
    "mip-splatting",
    OF_MIP,
    "Mip-Splatting (Yu et al. 2024): 3D smoothing (eq. 9) with its volume factor, then the 2D Mip filter",
    "scenes trained with it; it dims others",
    world=BY_VOLUME,
    time=0.8,
    promises=Promises(opaque_when_near=False),
)
SURFELS = Recipe(
    "2dgs",
    LowPass(),
    "2DGS (Huang et al. 2024): surfels intersected by rays, and a low-pass filter of √½ px",
    "scenes of 2D Gaussians at the training size; a 3D Gaussian becomes a surfel across its thinnest axis",
    pixel=SURFEL,
    time=2.0,
    promises=Promises(keeps_energy=False),
)
SURFELS_MATCHED = Recipe(
    "2dgs-matched",
    LowPass(matched=True),
    "aaplug: 2DGS with its low-pass filter rescaled to the new sampling rate, and samples per pixel as in auto",
    "scenes of 2D Gaussians at other sizes",
    target_rate=0.5,
    pixel=SURFEL,
    time=2.3,
)
PLAYCANVAS_RECIPE = Recipe(
    "playcanvas",
    OF_PLAYCANVAS,
    "PlayCanvas and SuperSplat with anti-aliasing on: 0.3 in half pixels, that is 0.075 px², compensated",
    "predicting their pictures; scenes converted for them",
)
PLAYCANVAS_CLASSIC_RECIPE = Recipe(
    "playcanvas-classic",
    OF_PLAYCANVAS_CLASSIC,
    "PlayCanvas and SuperSplat with anti-aliasing off: 0.075 px²",
    "predicting their pictures; scenes converted for them",
    promises=Promises(keeps_energy=False),
)


def recipe_of(viewer: Viewer) -> Recipe:
    """The recipe that predicts a viewer's pictures."""
    if viewer.convention is None:
        return RECIPES[viewer.recipe]
    screen = Dilation(viewer.convention.kernel, viewer.convention.compensated, viewer.smallest, viewer.apart)
    return Recipe(viewer.name, screen, viewer.program, "predicting its pictures")


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

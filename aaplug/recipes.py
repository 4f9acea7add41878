"""Recipes: a world filter, a screen filter and a number of samples a pixel, each preset with its source.

`samples` says how finely a pixel is sampled: the smallest n is taken for which rate·n reaches it, so 0 is one sample
a pixel at every rate, 1 is training's own pixel size.  At and above the training rate that is always one sample.
"""

import math
from dataclasses import dataclass, replace

from aaplug.errors import UsageError, listing
from aaplug.filters import (
    SCREEN_FILTERS,
    SELECTIONS,
    AnisotropicSmoothing,
    FlatSmoothing,
    LowPass,
    Matched,
    RateChoice,
    Smoothing3D,
)
from aaplug.filters.pixel_size import MISSING
from aaplug.gaussians import Gaussians
from aaplug.interfaces import PixelKernel, ScreenFilter, Selection, WorldFilter

# rate·n that a quality asks for.  A small image's cost is a Gaussian's, not a pixel's: at 1/8 of the training size 2×2
# samples take no more pairs than classic's one.
SAMPLING = {"fast": 0.25, "balanced": 0.5, "best": 1.0}
WHOLE = 1e-6  # slack before one more sample is taken


@dataclass(frozen=True)
class Recipe:
    """How to render a scene.

    source: the paper or design that it follows.  when: what it is for, in a line.
    grid: samples along a pixel's side that it takes at every rate.
    """

    name: str
    screen: ScreenFilter
    source: str
    when: str
    world: WorldFilter | None = None
    samples: float = 0.0
    grid: int = 1
    pixel: PixelKernel = "point"
    selection: Selection | None = None

    def samples_at(self, rate: float) -> int:
        """Samples along a pixel's side for a view at `rate` against training."""
        return max(self.grid, math.ceil(min(self.samples, 1.0) / rate - WHOLE))


RECIPES: dict[str, Recipe] = {
    recipe.name: recipe
    for recipe in (
        Recipe(
            "classic",
            SCREEN_FILTERS["classic"],
            "3DGS (Kerbl et al. 2023): +0.3 px²",
            "the look to compare with; right only at the training size",
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
            "scenes trained with it, and scenes converted by aaplug",
        ),
        Recipe(
            "mip-splatting",
            SCREEN_FILTERS["mip"],
            "Mip-Splatting (Yu et al. 2024): 3D smoothing (eq. 9) with its volume factor, then the 2D Mip filter",
            "comparison: it dims scenes that were not trained with it",
            world=Smoothing3D(),
        ),
        Recipe(
            "mip-splatting-code",
            SCREEN_FILTERS["mip"],
            "Mip-Splatting as its published code has it: the largest focal length for every camera",
            "parity; differs where cameras' focal lengths do",
            world=Smoothing3D(focal="largest"),
        ),
        Recipe(
            "mip-splatting-balanced",
            SCREEN_FILTERS["mip"],
            "aaplug: Mip-Splatting with opacities balanced by the broadest face's area, not by volume, and bounded",
            "comparison: most of the dimming of mip-splatting avoided",
            world=Smoothing3D(opacity="balanced"),
        ),
        Recipe(
            "mip-splatting-anisotropic",
            SCREEN_FILTERS["mip"],
            "aaplug: Mip-Splatting with bounds of each direction: smoothing by what all views together tell along an "
            "axis",
            "comparison: no better than mip-splatting where measured",
            world=AnisotropicSmoothing(),
        ),
        Recipe(
            "aaa",
            SCREEN_FILTERS["aaa"],
            "AAA-Gaussians' adaptive 3D filter (ICCV 2025, arXiv 2504.12811), with its projected-area factor",
            "scenes trained with it",
        ),
        Recipe(
            "multi-scale",
            SCREEN_FILTERS["classic"],
            "Multi-Scale 3DGS (Yan et al. 2024): Gaussians drawn at the sizes that training drew them in, +0.3 px²",
            "scenes trained with it, whose files hold these sizes",
            selection=SELECTIONS["pixel-size"],
        ),
        Recipe(
            "analytic",
            SCREEN_FILTERS["none"],
            "Analytic-Splatting (Liang et al. 2024): no dilation, alpha integrated over the pixel by the exact normal "
            "distribution",
            "scenes trained with it",
            pixel="integral",
        ),
        Recipe(
            "analytic-logistic",
            SCREEN_FILTERS["none"],
            "Analytic-Splatting (Liang et al. 2024) with its logistic approximation",
            "parity with its published figures",
            pixel="logistic",
        ),
        Recipe(
            "sa-gs",
            SCREEN_FILTERS["sa-gs"],
            "SA-GS's 2D scale-adaptive filter (Song et al., arXiv 2403.19615): 0.3 r² px², one rate a view",
            "comparison: matched without its second step",
        ),
        Recipe(
            "sa-gs-integral",
            SCREEN_FILTERS["sa-gs"],
            "SA-GS's filter and integration, by standard deviation (its code divides by the variance)",
            "comparison: it blurs what training had already blurred",
            pixel="integral",
        ),
        Recipe(
            "sa-gs-samples",
            SCREEN_FILTERS["sa-gs"],
            "SA-GS's filter and super-sampling, the background with the true transmittance",
            "comparison: nine samples a pixel at every rate",
            grid=3,
        ),
        Recipe(
            "matched",
            Matched(),
            "aaplug: training's dilation carried to the new rate, then the rest of the pixel's filter",
            "one sample a pixel: the fastest that is right",
        ),
        Recipe(
            "matched-interval",
            Matched("interval"),
            "aaplug: matched, each Gaussian's rate against the range that the training cameras had (choice C)",
            "comparison: `matched` starts from it for cameras nearer or farther than training's",
        ),
        Recipe(
            "matched-sharpest",
            Matched("sharpest"),
            "aaplug: matched, each Gaussian's rate against the highest that a training camera had (choice B)",
            "comparison: the one blur that can be fused, thinner than training's at most views",
        ),
        Recipe(
            "matched-samples",
            Matched(),
            "aaplug: matched, with 3×3 samples a pixel at every rate",
            "comparison",
            grid=3,
        ),
        Recipe(
            "matched-integral",
            Matched(windowed=True),
            "aaplug: matched, with Analytic-Splatting's integral over the rest of the pixel",
            "one sample a pixel, a little sharper and slower",
            pixel="integral",
        ),
        Recipe(
            "matched-square",
            Matched(windowed=True),
            "aaplug, after MipSLAM's elliptical integration (arXiv 2603.06989), whose constants are not published: "
            "matched, with the mean over the rest of the pixel's own square",
            "comparison: as matched-integral, for splats askew",
            pixel="square",
        ),
        Recipe(
            "2dgs",
            LowPass(),
            "2DGS (Huang et al. 2024): discs where rays meet them, and a low-pass filter of √½ px",
            "scenes of 2D Gaussians, as they were trained; Gaussians are taken for discs across their thinnest axis",
            pixel="surfel",
        ),
        Recipe(
            "2dgs-matched",
            LowPass(matched=True),
            "aaplug: 2DGS with its low-pass filter carried to the rate being rendered, and samples a pixel as auto has",
            "scenes of 2D Gaussians at other sizes",
            samples=0.5,
            pixel="surfel",
        ),
        Recipe(
            "aa-2dgs",
            LowPass(),
            "AA-2DGS (Younes et al., NeurIPS 2025): the world-space flat kernel, then the object-space Mip filter",
            "scenes of 2D Gaussians trained with it",
            world=FlatSmoothing(),
            pixel="surfel-mip",
        ),
        Recipe(
            "gaussian-blending",
            Matched(windowed=True),
            "after Gaussian Blending (arXiv 2511.15102), whose update is not published: this one is aaplug's own",
            "comparison: the best of one sample a pixel, slower than several",
            pixel="blending",
        ),
        Recipe(
            "auto",
            Matched(),
            "aaplug: matched, with the samples a pixel that --quality asks for",
            "the default",
            samples=SAMPLING["balanced"],
        ),
    )
}


def find_recipe(
    name: str,
    *,
    quality: str = "balanced",
    rate: RateChoice | None = None,
    samples: float | None = None,
) -> Recipe:
    """A preset by name, with the choices that the user made.

    quality: rate·n of `auto`.  rate: what `matched` and `auto` compare a Gaussian's rate with.
    samples: rate·n of any recipe, over its own.

    Raises:
        UsageError: the name or quality is not known, or the recipe has no rate to choose.
    """
    if name not in RECIPES:
        raise UsageError("--recipe", f"'{name}' is not one of {listing(list(RECIPES), most=99)}")
    if quality not in SAMPLING:
        raise UsageError("--quality", f"'{quality}' is not one of {listing(list(SAMPLING))}")
    recipe = RECIPES[name]
    if rate is not None:
        if not isinstance(recipe.screen, Matched):
            raise UsageError("--rate", f"recipe '{name}' matches no rate; only matched and auto do")
        recipe = replace(recipe, screen=replace(recipe.screen, rate=rate))
    if name == "auto":
        recipe = replace(recipe, samples=SAMPLING[quality])
    return recipe if samples is None else replace(recipe, samples=samples)


def lacking(recipe: Recipe, scene: Gaussians) -> str | None:
    """What a scene lacks for a recipe, in words; None if nothing."""
    return MISSING if recipe.selection is not None and scene.pixel_sizes is None else None


def suited(recipe: Recipe, scene: Gaussians) -> Recipe:
    """The same recipe, but that `auto` draws discs for a scene of 2D Gaussians (`2dgs-matched`).

    Raises:
        UsageError: the scene lacks what the recipe needs.
    """
    missing = lacking(recipe, scene)
    if missing is not None:
        raise UsageError(f"recipe {recipe.name}", missing)
    if recipe.name != "auto" or not scene.flat:
        return recipe
    return replace(RECIPES["2dgs-matched"], name="auto", samples=recipe.samples)

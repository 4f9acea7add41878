"""Recipes for comparison: other methods of the field, and variants that were measured to be no better.

`aaplug evaluate --recipe all` measures them with the others; examples/guides/methods.md has their figures.
"""

from aaplug.methods.compositors import GaussianBlending
from aaplug.methods.filters import (
    SCREEN_FILTERS,
    AnisotropicSmoothing,
    ByPixelSize,
    FlatSmoothing,
    LowPass,
    Matched,
    Smoothing3D,
)
from aaplug.methods.pixel_kernels import INTEGRAL, SURFEL_MIP
from aaplug.methods.recipe import Promises, Recipe

RESEARCH_RECIPES = (
    Recipe(
        "playcanvas",
        SCREEN_FILTERS["playcanvas"],
        "PlayCanvas and SuperSplat with anti-aliasing on: 0.3 in half pixels, that is 0.075 px², compensated",
        "predicting their pictures; scenes converted for them",
    ),
    Recipe(
        "playcanvas-classic",
        SCREEN_FILTERS["playcanvas-classic"],
        "PlayCanvas and SuperSplat with anti-aliasing off: 0.075 px²",
        "predicting their pictures; scenes converted for them",
        promises=Promises(keeps_energy=False),
    ),
    Recipe(
        "mip-splatting-code",
        SCREEN_FILTERS["mip"],
        "Mip-Splatting as in its published code: the largest focal length for every camera",
        "parity with its published code; differs if focal lengths differ",
        world=Smoothing3D(focal="largest"),
        promises=Promises(opaque_when_near=False),
    ),
    Recipe(
        "mip-splatting-balanced",
        SCREEN_FILTERS["mip"],
        "aaplug: Mip-Splatting with opacities balanced by the broadest face's area, not by volume, and bounded",
        "comparison: avoids most of mip-splatting's dimming",
        world=Smoothing3D(opacity="balanced"),
        promises=Promises(opaque_when_near=False),
    ),
    Recipe(
        "mip-splatting-anisotropic",
        SCREEN_FILTERS["mip"],
        "aaplug: Mip-Splatting with directional bounds: smooths each axis by the information of all views along it",
        "comparison: measured to be no better than mip-splatting",
        world=AnisotropicSmoothing(),
        promises=Promises(opaque_when_near=False),
    ),
    Recipe(
        "aaa",
        SCREEN_FILTERS["aaa"],
        "AAA-Gaussians' adaptive 3D filter (ICCV 2025, arXiv 2504.12811), with its projected-area factor",
        "scenes trained with it",
        promises=Promises(opaque_when_near=False),
    ),
    Recipe(
        "multi-scale",
        SCREEN_FILTERS["classic"],
        "Multi-Scale 3DGS (Yan et al. 2024): draws a Gaussian only at the pixel sizes it was trained for, +0.3 px²",
        "scenes trained with it, whose files have its columns",
        selection=ByPixelSize(),
        promises=Promises(keeps_energy=False),
    ),
    Recipe(
        "analytic",
        SCREEN_FILTERS["none"],
        "Analytic-Splatting (Liang et al. 2024): no dilation, alpha integrated over the pixel by the exact normal "
        "distribution",
        "scenes trained with it",
        pixel=INTEGRAL,
    ),
    Recipe(
        "sa-gs",
        SCREEN_FILTERS["sa-gs"],
        "SA-GS's 2D scale-adaptive filter (Song et al., arXiv 2403.19615): 0.3 r² px², one rate per view",
        "comparison: matched without its second step",
        promises=Promises(equals_training=True, fades_when_small=False),
    ),
    Recipe(
        "sa-gs-integral",
        SCREEN_FILTERS["sa-gs"],
        "SA-GS's filter and integration; divides by the standard deviation (its code by the variance)",
        "comparison: it repeats blur that training applied already",
        pixel=INTEGRAL,
    ),
    Recipe(
        "sa-gs-samples",
        SCREEN_FILTERS["sa-gs"],
        "SA-GS's filter and supersampling; composites the background with the true transmittance",
        "comparison: nine samples per pixel at every rate",
        grid=3,
        promises=Promises(fades_when_small=False),
    ),
    Recipe(
        "matched-interval",
        Matched("interval"),
        "aaplug: matched, with rates relative to the range of the training cameras (reference C)",
        "comparison: matched uses it for free cameras",
        promises=Promises(equals_training=True),
    ),
    Recipe(
        "matched-sharpest",
        Matched("sharpest"),
        "aaplug: matched, with rates relative to the highest of any training camera (reference B)",
        "comparison: the only reference whose blur can be fused; thinner than training's at most views",
    ),
    Recipe(
        "matched-samples",
        Matched(),
        "aaplug: matched, with 3×3 samples per pixel at every rate",
        "comparison: nine samples per pixel at every rate",
        grid=3,
    ),
    Recipe(
        "matched-integral",
        Matched(windowed=True),
        "aaplug: matched, with Analytic-Splatting's integral over the rest of the pixel",
        "comparison: slower than matched and no better",
        pixel=INTEGRAL,
        promises=Promises(equals_training=True),
    ),
    Recipe(
        "aa-2dgs",
        LowPass(),
        "AA-2DGS (Younes et al., NeurIPS 2025): the world-space flat kernel, then the object-space Mip filter",
        "scenes of 2D Gaussians trained with it",
        world=FlatSmoothing(),
        pixel=SURFEL_MIP,
        promises=Promises(opaque_when_near=False),
    ),
    Recipe(
        "gaussian-blending",
        SCREEN_FILTERS["none"],
        "Gaussian Blending (arXiv 2511.15102): no dilation, light passes through a window in the pixel",
        "scenes trained with it or with Analytic-Splatting",
        pixel=INTEGRAL,
        compositor=GaussianBlending(),
    ),
    Recipe(
        "matched-blending",
        Matched(windowed=True),
        "aaplug: matched, with Gaussian Blending's window over the rest of the pixel",
        "comparison: the best with one sample per pixel, but slower than several samples",
        pixel=INTEGRAL,
        compositor=GaussianBlending(),
    ),
)

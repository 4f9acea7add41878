"""Recipes for comparison: the field's other methods, and variants that measurement found to be no better.

`aaplug evaluate --recipe all` measures them beside the others; examples/guides/methods.md has their figures.
"""

from aaplug.methods.compositors import WindowBlending
from aaplug.methods.filters import (
    SCREEN_FILTERS,
    AnisotropicSmoothing,
    ByPixelSize,
    FlatSmoothing,
    LowPass,
    Matched,
    Smoothing3D,
)
from aaplug.methods.pixel_kernels import INTEGRAL, LOGISTIC_INTEGRAL, SQUARE, SURFEL_MIP
from aaplug.methods.recipe import Promises, Recipe

RESEARCH_RECIPES = (
    Recipe(
        "mip-splatting-code",
        SCREEN_FILTERS["mip"],
        "Mip-Splatting as its published code has it: the largest focal length for every camera",
        "parity; differs where cameras' focal lengths do",
        world=Smoothing3D(focal="largest"),
        promises=Promises(opaque_when_near=False),
    ),
    Recipe(
        "mip-splatting-balanced",
        SCREEN_FILTERS["mip"],
        "aaplug: Mip-Splatting with opacities balanced by the broadest face's area, not by volume, and bounded",
        "comparison: most of the dimming of mip-splatting avoided",
        world=Smoothing3D(opacity="balanced"),
        promises=Promises(opaque_when_near=False),
    ),
    Recipe(
        "mip-splatting-anisotropic",
        SCREEN_FILTERS["mip"],
        "aaplug: Mip-Splatting with bounds of each direction: smoothing by what all views together tell along an "
        "axis",
        "comparison: no better than mip-splatting where measured",
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
        "Multi-Scale 3DGS (Yan et al. 2024): Gaussians drawn at the sizes that training drew them in, +0.3 px²",
        "scenes trained with it, whose files hold these sizes",
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
        "analytic-logistic",
        SCREEN_FILTERS["none"],
        "Analytic-Splatting (Liang et al. 2024) with its logistic approximation",
        "parity with its published figures",
        pixel=LOGISTIC_INTEGRAL,
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
        "SA-GS's filter and integration, by standard deviation (its code divides by the variance)",
        "comparison: it blurs what training had already blurred",
        pixel=INTEGRAL,
    ),
    Recipe(
        "sa-gs-samples",
        SCREEN_FILTERS["sa-gs"],
        "SA-GS's filter and super-sampling, the background with the true transmittance",
        "comparison: nine samples per pixel at every rate",
        grid=3,
        promises=Promises(fades_when_small=False),
    ),
    Recipe(
        "matched-interval",
        Matched("interval"),
        "aaplug: matched, each Gaussian's rate against the range that the training cameras had (choice C)",
        "comparison: `matched` starts from it for cameras nearer or farther than training's",
        promises=Promises(equals_training=True),
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
        "aaplug: matched, with 3×3 samples per pixel at every rate",
        "comparison",
        grid=3,
    ),
    Recipe(
        "matched-integral",
        Matched(windowed=True),
        "aaplug: matched, with Analytic-Splatting's integral over the rest of the pixel",
        "one sample per pixel, a little sharper and slower",
        pixel=INTEGRAL,
        promises=Promises(equals_training=True),
    ),
    Recipe(
        "matched-square",
        Matched(windowed=True),
        "aaplug, after MipSLAM's elliptical integration (arXiv 2603.06989), whose constants are not published: "
        "matched, with the mean over the rest of the pixel's own square",
        "comparison: as matched-integral, for splats askew",
        pixel=SQUARE,
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
        Matched(windowed=True),
        "after Gaussian Blending (arXiv 2511.15102), whose update is not published: this one is aaplug's own",
        "comparison: the best of one sample per pixel, slower than several",
        pixel=INTEGRAL,
        compositor=WindowBlending(),
        promises=Promises(equals_training=True),
    ),
)

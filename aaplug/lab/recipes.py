"""Recipes for comparison: other methods of the field, and variants that were measured to be no better.

`aaplug evaluate --recipe all` measures them with the others; examples/guides/methods.md has their figures.
"""

from aaplug.lab.elliptical import ELLIPTICAL
from aaplug.lab.filters import ADAPTIVE, ANISOTROPIC, BALANCED, FLAT, LARGEST_FOCAL, SCALE_ADAPTIVE
from aaplug.lab.gaussian_blending import GAUSSIAN_BLENDING as WINDOWED_LIGHT
from aaplug.lab.integral import INTEGRAL
from aaplug.lab.learned import LEARNED as BY_LEARNED_COLUMNS
from aaplug.lab.obbl import BOUNDED_BAND_LIMIT, RENORMALIZED
from aaplug.lab.pixel_size import BY_PIXEL_SIZE
from aaplug.lab.surfel_mip import SURFEL_MIP
from aaplug.methods.filters.dilation import NONE, OF_CLASSIC, OF_MIP, LowPass
from aaplug.methods.filters.matched import Matched
from aaplug.methods.recipe import Promises, Recipe

MIP_SPLATTING_CODE = Recipe(
    "mip-splatting-code",
    OF_MIP,
    "Mip-Splatting as in its published code: the largest focal length for every camera",
    "parity with its published code; differs if focal lengths differ",
    world=LARGEST_FOCAL,
    time=0.8,
    promises=Promises(opaque_when_near=False),
)
MIP_SPLATTING_BALANCED = Recipe(
    "mip-splatting-balanced",
    OF_MIP,
    "aaplug: Mip-Splatting with opacities balanced by the broadest face's area, not by volume, and bounded",
    "comparison: avoids most of mip-splatting's dimming",
    world=BALANCED,
    promises=Promises(opaque_when_near=False),
)
MIP_SPLATTING_ANISOTROPIC = Recipe(
    "mip-splatting-anisotropic",
    OF_MIP,
    "aaplug: Mip-Splatting with directional bounds: smooths each axis by the information of all views along it",
    "comparison: measured to be no better than mip-splatting",
    world=ANISOTROPIC,
    time=0.8,
    promises=Promises(opaque_when_near=False),
)
OBBL = Recipe(
    "obbl",
    OF_MIP,
    "AA-Splat's parts (Suh et al. 2026, arXiv 2603.29394) as aaplug reads them: 3D smoothing with opacities kept and "
    "bounded, then the 2D Mip filter, and colours over alpha where a pixel is covered",
    "comparison: pixel-aligned Gaussians of a feed-forward network",
    world=BOUNDED_BAND_LIMIT,
    compositor=RENORMALIZED,
    time=80.0,
    promises=Promises(opaque_when_near=False),
)
AAA = Recipe(
    "aaa",
    ADAPTIVE,
    "AAA-Gaussians' adaptive 3D filter (ICCV 2025, arXiv 2504.12811), with its projected-area factor",
    "scenes trained with it",
    time=1.1,
    promises=Promises(opaque_when_near=False),
)
MULTI_SCALE = Recipe(
    "multi-scale",
    OF_CLASSIC,
    "Multi-Scale 3DGS (Yan et al. 2024): draws a Gaussian only at the pixel sizes it was trained for, +0.3 px²",
    "scenes trained with it, whose files have its columns",
    selection=BY_PIXEL_SIZE,
    promises=Promises(keeps_energy=False),
)
ANALYTIC = Recipe(
    "analytic",
    NONE,
    "Analytic-Splatting (Liang et al. 2024): no dilation, alpha integrated over the pixel by the exact normal "
    "distribution",
    "scenes trained with it",
    pixel=INTEGRAL,
    time=6.0,
)
EAA = Recipe(
    "eaa",
    NONE,
    "MipSLAM's elliptical adaptive anti-aliasing (Li et al. 2026, eqs. 5, 6) as a third party reads it: no dilation, "
    "alpha from weighted nodes in the pixel",
    "comparison: analytic by sums over nodes, slower and no better",
    pixel=ELLIPTICAL,
    time=13.0,
)
SA_GS = Recipe(
    "sa-gs",
    SCALE_ADAPTIVE,
    "SA-GS's 2D scale-adaptive filter (Song et al., arXiv 2403.19615): 0.3 r² px², one rate per view",
    "comparison: matched without its second step",
    promises=Promises(equals_training=True, fades_when_small=False),
)
SA_GS_INTEGRAL = Recipe(
    "sa-gs-integral",
    SCALE_ADAPTIVE,
    "SA-GS's filter and integration; divides by the standard deviation (its code by the variance)",
    "comparison: it repeats blur that training applied already",
    pixel=INTEGRAL,
    time=6.0,
)
SA_GS_SAMPLES = Recipe(
    "sa-gs-samples",
    SCALE_ADAPTIVE,
    "SA-GS's filter and supersampling; composites the background with the true transmittance",
    "comparison: nine samples per pixel at every rate",
    grid=3,
    time=1.9,
    promises=Promises(fades_when_small=False),
)
MATCHED_SAMPLES = Recipe(
    "matched-samples",
    Matched(),
    "aaplug: matched, with 3×3 samples per pixel at every rate",
    "comparison: nine samples per pixel at every rate",
    grid=3,
    time=1.8,
)
MATCHED_INTEGRAL = Recipe(
    "matched-integral",
    Matched(windowed=True),
    "aaplug: matched, with Analytic-Splatting's integral over the rest of the pixel",
    "comparison: slower than matched and no better",
    pixel=INTEGRAL,
    time=6.0,
    promises=Promises(equals_training=True),
)
LEARNED = Recipe(
    "learned",
    BY_LEARNED_COLUMNS,
    "LOD-GS's learned filters (arXiv 2507.00554) on a scene that is trained: size and opacity by rate, then matched",
    "one sample per pixel, for scenes of aaplug finetune --learn-filters",
    time=1.3,
    promises=Promises(equals_training=True),
)
AA_2DGS = Recipe(
    "aa-2dgs",
    LowPass(),
    "AA-2DGS (Younes et al., NeurIPS 2025): the world-space flat kernel, then the object-space Mip filter",
    "scenes of 2D Gaussians trained with it",
    world=FLAT,
    pixel=SURFEL_MIP,
    time=2.4,
    promises=Promises(opaque_when_near=False),
)
GAUSSIAN_BLENDING = Recipe(
    "gaussian-blending",
    NONE,
    "Gaussian Blending (arXiv 2511.15102): no dilation, light passes through a window in the pixel",
    "scenes trained with it or with Analytic-Splatting",
    pixel=INTEGRAL,
    compositor=WINDOWED_LIGHT,
    time=11.0,
)
MATCHED_BLENDING = Recipe(
    "matched-blending",
    Matched(windowed=True),
    "aaplug: matched, with Gaussian Blending's window over the rest of the pixel",
    "comparison: the best with one sample per pixel, but slower than several samples",
    pixel=INTEGRAL,
    compositor=WINDOWED_LIGHT,
    time=10.0,
)

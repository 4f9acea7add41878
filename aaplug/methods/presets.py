"""The recipes that a user picks, and those that predict what other programs draw, each with its source."""

from aaplug.methods import RECIPES
from aaplug.methods.filters.dilation import (
    OF_ANTIALIASED,
    OF_CLASSIC,
    OF_MIP,
    OF_PLAYCANVAS,
    OF_PLAYCANVAS_CLASSIC,
    Dilation,
    LowPass,
)
from aaplug.methods.filters.matched import BY_POSE
from aaplug.methods.filters.smoothing import BY_VOLUME
from aaplug.methods.pixel_kernels.surfel import SURFEL
from aaplug.methods.recipe import Promises, Recipe, set_by
from aaplug.methods.viewers import Viewer

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

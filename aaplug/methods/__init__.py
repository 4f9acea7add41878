"""Methods: filters, pixel kernels and recipes.  The registries here name them; each is imported when it is first used.

A new one is a file in this folder and a line below.
"""

from typing import TYPE_CHECKING, Literal

from aaplug.system.registry import Registry

if TYPE_CHECKING:
    from aaplug.core.interfaces import Compositor, PixelKernel, ScreenFilter, Selection, WorldFilter
    from aaplug.methods.recipe import Recipe

RateReference = Literal["pose", "global", "sharpest", "interval"]  # what `matched` divides a sampling rate by
SplatOrder = Literal["depth", "tile"]  # by depth of centres, or in each tile along the ray of its middle
# Relative rate that each quality samples a pixel at.  A small image costs per Gaussian, not per pixel: at 1/8 of the
# training size 2x2 samples take no more splat-pixel evaluations than `classic` with one.
QUALITIES = {"fast": 0.25, "balanced": 0.5, "best": 1.0}

WORLD_FILTERS: Registry["WorldFilter"] = Registry(
    "world filter",
    "aaplug.core.interfaces:WorldFilter",
    {
        "smoothing3d": "aaplug.methods.filters.smoothing:BY_VOLUME",
        "matched-energy": "aaplug.methods.filters.energy:MATCHED_ENERGY",
    },
)
SCREEN_FILTERS: Registry["ScreenFilter"] = Registry(
    "screen filter",
    "aaplug.core.interfaces:ScreenFilter",
    {
        "classic": "aaplug.methods.filters.dilation:OF_CLASSIC",
        "ewa": "aaplug.methods.filters.dilation:OF_ANTIALIASED",
        "mip": "aaplug.methods.filters.dilation:OF_MIP",
        "playcanvas": "aaplug.methods.filters.dilation:OF_PLAYCANVAS",
        "playcanvas-classic": "aaplug.methods.filters.dilation:OF_PLAYCANVAS_CLASSIC",
        "none": "aaplug.methods.filters.dilation:NONE",
        "matched": "aaplug.methods.filters.matched:BY_POSE",
        "matched-global": "aaplug.methods.filters.matched:BY_GLOBAL_RATE",
        "matched-sharpest": "aaplug.methods.filters.matched:BY_SHARPEST_RATE",
        "matched-interval": "aaplug.methods.filters.matched:BY_INTERVAL",
    },
)
SELECTIONS: Registry["Selection"] = Registry("selection", "aaplug.core.interfaces:Selection", {})
PIXEL_KERNELS: Registry["PixelKernel"] = Registry(
    "pixel kernel",
    "aaplug.core.interfaces:PixelKernel",
    {
        "point": "aaplug.methods.pixel_kernels.point:POINT",
        "ray": "aaplug.methods.pixel_kernels.ray:RAY",
        "surfel": "aaplug.methods.pixel_kernels.surfel:SURFEL",
    },
)
COMPOSITORS: Registry["Compositor"] = Registry("compositor", "aaplug.core.interfaces:Compositor", {})
RECIPES: Registry["Recipe"] = Registry(
    "recipe",
    "aaplug.methods.recipe:Recipe",
    {
        "auto": "aaplug.methods.presets:AUTO",
        "matched": "aaplug.methods.presets:MATCHED",
        "classic": "aaplug.methods.presets:CLASSIC_RECIPE",
        "ewa": "aaplug.methods.presets:EWA",
        "mip": "aaplug.methods.presets:MIP_RECIPE",
        "mip-splatting": "aaplug.methods.presets:MIP_SPLATTING",
        "2dgs": "aaplug.methods.presets:SURFELS",
        "2dgs-matched": "aaplug.methods.presets:SURFELS_MATCHED",
        "playcanvas": "aaplug.methods.presets:PLAYCANVAS_RECIPE",
        "playcanvas-classic": "aaplug.methods.presets:PLAYCANVAS_CLASSIC_RECIPE",
    },
)

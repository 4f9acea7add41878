"""What can be chosen, in words and numbers: what options and the modules that implement them share.

The command line reads it before anything else, so nothing here may import torch.
"""

from typing import Literal

USER_RECIPES = ("auto", "matched", "classic", "ewa", "mip", "mip-splatting", "2dgs", "2dgs-matched")
NAMES = {  # of aaplug's own entries in the registries that options choose from, by kind; `Registry` holds them to it
    "recipe": (
        *USER_RECIPES,
        *("playcanvas", "playcanvas-classic", "mip-splatting-code", "mip-splatting-balanced"),
        *("mip-splatting-anisotropic", "aaa", "multi-scale", "analytic", "sa-gs", "sa-gs-integral", "sa-gs-samples"),
        *("matched-interval", "matched-sharpest", "matched-samples", "matched-integral", "aa-2dgs"),
        *("gaussian-blending", "matched-blending"),
    ),
    "rasterizer": ("eager", "reference"),
    "metric": ("PSNR", "SSIM", "LPIPS", "FLIP", "consistency", "energy drift", "flicker"),
    "protocol": ("default", "blender", "360-zoom-out", "360-zoom-in", "distance", "fov", "self"),
    "method": ("consistency", "mipmap-gs"),
    "form": ("matched-energy", "mip-splatting"),
    "viewer": (
        *("classic", "antialiased", "mip", "spark", "spark-mip", "spark-classic", "playcanvas", "playcanvas-classic"),
        *("supersplat", "supersplat-classic", "mkkellogg", "mkkellogg-mip", "mkkellogg-classic"),
        *("gsplat", "gsplat-mip", "gsplat-classic", "brush", "brush-classic"),
    ),
}

# Relative rate that each quality samples a pixel at.  A small image costs per Gaussian, not per pixel: at 1/8 of the
# training size 2x2 samples take no more splat-pixel evaluations than `classic` with one.
QUALITIES = {"fast": 0.25, "balanced": 0.5, "best": 1.0}

Colour = tuple[float, float, float]  # red, green, blue in [0, 1]
Background = Literal["auto", "white", "black"] | Colour
RateReference = Literal["pose", "global", "sharpest", "interval"]
SpzAxes = Literal["auto", "opengl", "opencv"]
ConventionName = Literal["classic", "antialiased", "mip", "playcanvas", "playcanvas-classic"]
LossName = Literal["l2", "l1-dssim"]
MOST_FPS = 1000  # frames per second of a video
LEVEL_STEPS = 1000  # for a level of 1/4 of the training rate and above; a smaller one takes more, of smaller images
# of fine-tuning: weight of the loss by scale, and of the training size beside them; as they are, and that all
# parameters move, was measured
WEIGHTS = {0.5: 1.0, 0.25: 2.0, 0.125: 1.0}
ANCHOR = 3.0
PARAMETERS = ("means", "quats", "log_scales", "logit_opacities", "dc", "rest")
MIN_SEEN_SHARE = 0.5  # below this share of Gaussians seen, scene and cameras are taken to be in different frames


def metric_option(name: str) -> str:
    """A metric's name as an option's value."""
    return name.casefold().replace(" ", "-")

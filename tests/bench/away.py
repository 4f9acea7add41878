"""PSNR of views nearer, farther, wider and narrower than those of training, by what `matched` divides rates by.

A few test views at the training size, moved nearer and farther and with wider and narrower fields of view.  The truth
is the scene itself with enough samples per pixel to reach training's rate: each sample is then what training rendered.
From nearer there is no such truth.  There, a checkpoint trained at a smaller size is compared with the one trained at
full size.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from statistics import mean

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.camera_paths import moved, zoomed
from aaplug.core.cameras import Camera
from aaplug.core.imaging import quantised
from aaplug.evaluation.protocols import median_depth
from aaplug.methods import RateReference
from aaplug.methods.recipes import find_recipe
from aaplug.rendering.renderer import Renderer
from tests.bench import heading, row
from tests.bench.scenes import TRAINED, decibels, trained

# how finely a view samples against the view that it is made of
DISTANCES = {"2 times nearer": 2.0, "same distance": 1.0, "2 times farther": 0.5, "4 times farther": 0.25}
FIELDS = {"half the field of view": 2.0, "twice the field of view": 0.5}
MATCHED = find_recipe("matched", rate_reference="interval")
RATES: dict[str, RateReference] = {
    "A, global": "global",
    "B, sharpest": "sharpest",
    "C, interval": "interval",
    "pose": "pose",
}


@torch.no_grad()
def main(scenes: Sequence[str] = TRAINED) -> None:
    """Print a table of PSNR in dB for each scene, means of the views."""
    rates = {label: find_recipe("matched", rate_reference=rate) for label, rate in RATES.items()}
    recipes = {"`classic`": find_recipe("classic"), **rates, "`auto`": find_recipe("auto")}
    for name in scenes:
        scene = trained(name)
        finer = None if scene.checkpoint.finer is None else trained(scene.checkpoint.finer).renderer(MATCHED)
        renderers = {label: scene.renderer(recipe) for label, recipe in recipes.items()}
        heading(f"{name}, {len(scene.views())} views, PSNR in dB", "camera", "truth", *recipes)
        for label, factor in {**DISTANCES, **FIELDS}.items():
            cameras = [
                zoomed(view, factor) if label in FIELDS else moved(view, factor, median_depth(scene.scene.means, view))
                for view in scene.views()
            ]
            images = {recipe: [draw(camera).rgb for camera in cameras] for recipe, draw in renderers.items()}
            for truth, renderer in {
                "own look": scene.renderer(MATCHED) if factor < 1 else None,
                "finer": finer,
            }.items():
                if renderer is not None:
                    looks = [_look(renderer, camera) for camera in cameras]
                    row(label, truth, *(mean(map(decibels, drawn, looks)) for drawn in images.values()))


def _look(renderer: Renderer, camera: Camera) -> Float[Tensor, "h w 3"]:
    """The image that training would have rendered there, if its pixels were as small as they were in the scene."""
    rate = renderer.relative_rate(replace(camera, trained_focal=None))
    recipe = replace(renderer.recipe, grid=max(1, math.ceil(1 / rate)))
    return quantised(replace(renderer, recipe=recipe)(camera).rgb)

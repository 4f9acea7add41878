"""The weight of a sample's neighbours in `auto`: PSNR of one and of four samples per pixel by weight."""

from collections.abc import Sequence
from dataclasses import replace
from statistics import mean

import torch

from aaplug.evaluation.results import scale_name
from aaplug.evaluation.truth import Truth, ViewTruth
from aaplug.methods.recipes import find_recipe
from tests.bench import heading, row
from tests.bench.scenes import decibels, trained

FIRST_VIEW = 2  # other tables have the views from the first
WEIGHTS = (0.0, 0.02, 0.03, 0.04, 0.06)
CASES = (("fast", 1 / 2), ("fast", 1 / 4), ("balanced", 1 / 4))


@torch.no_grad()
def main(scenes: Sequence[str] = ("chair", "snowmiku")) -> None:
    """Print a table for each scene: PSNR in dB against photographs and the scene's own look."""
    for name in scenes:
        scene = trained(name)
        look, views = scene.renderer("matched"), scene.views(first=FIRST_VIEW)
        heading(f"{name}, views {', '.join(view.name for view in views)}", "", *(f"{weight:g}" for weight in WEIGHTS))
        for quality, scale in CASES:
            recipe = find_recipe("auto", quality=quality)
            renderers = [replace(look, recipe=replace(recipe, neighbours=weight)) for weight in WEIGHTS]
            images = [[renderer(view.scaled(scale)).rgb for view in views] for renderer in renderers]
            for label, truth in (("photographs", Truth(look, "photographs")), ("own look", Truth(look))):
                wanted = [ViewTruth(truth, view).compared(scale) for view in views]
                cells = [
                    [decibels(i, w) for i, w in zip(drawn, wanted, strict=True) if w is not None] for drawn in images
                ]
                row(f"`{quality}` at {scale_name(scale)}: {label}", *map(mean, cells))

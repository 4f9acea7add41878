"""What cameras are worth: PSNR that is lost where nobody knows how a scene was trained, or only at which size.

Checkpoints with known cameras are rendered from their test views without them.  A row has the assumed training rate
over the true one, PSNR in dB against photographs with cameras, what is lost without them, and what 3DGS's rule loses.
"""

from collections.abc import Sequence
from dataclasses import replace
from statistics import mean
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug import Camera, Colour, Orbit, Renderer, cameras_around, find_recipe
from aaplug.core.imaging import quantised, resampled
from aaplug.core.sampling import median_rates
from aaplug.io.photographs import read_photo
from aaplug.io.scenes import scene_of
from tests.bench import heading, row
from tests.bench.scenes import CHECKPOINTS, decibels, middle, middle_of, trained

MAX_SIDE = 1000  # px: of a larger image, the middle is compared
SCALES = {"1": 1.0, "1/2": 1 / 2, "1/4": 1 / 4, "1/8": 1 / 8, "2": 2.0, "4": 4.0}
STATED = {"chair_eighth": Orbit(train_view="100x100"), "snowmiku_quarter": Orbit(train_view="246x185")}
CASES = (*CHECKPOINTS, *(f"{name}, stated" for name in STATED))


@torch.no_grad()
def main(scenes: Sequence[str] = CASES) -> None:
    """Print the table."""
    heading("with cameras, and lost without", "", "rate", "", *SCALES)
    for name in scenes:
        plain, _, stated = name.partition(", ")
        known = trained(plain)
        bare = replace(known, cameras=cameras_around(scene_of(known.scene), STATED[plain] if stated else Orbit()))
        true, assumed = (median_rates(known.scene.means, each.cameras.train) for each in (known, bare))
        both = (true > 0) & (assumed > 0)
        views = known.views()
        best = _figures(known.renderer(), views)
        lost = {
            "lost without": _figures(bare.renderer(), [replace(view, trained_focal=None) for view in views]),
            "lost by `classic`": _figures(replace(known.renderer(), recipe=find_recipe("classic")), views),
        }
        row(name, float((assumed[both] / true[both]).median()), "with cameras", *best)
        for label, figures in lost.items():
            row("", "", label, *("" if a == "" or b == "" else a - b for a, b in zip(best, figures, strict=True)))


def _figures(renderer: Renderer, views: Sequence[Camera]) -> list[Any]:
    """PSNR against photographs at each scale; "" where a photograph is missing or too small."""
    figures: list[Any] = []
    for scale in SCALES.values():
        photographs = [_photograph(view, scale, renderer.background) for view in views]
        images = [renderer(middle(view.scaled(scale), MAX_SIDE)).rgb for view in views]
        pairs = [(i, p) for i, p in zip(images, photographs, strict=True) if p is not None]
        figures.append(mean(decibels(*pair) for pair in pairs) if len(pairs) == len(views) else "")
    return figures


def _photograph(view: Camera, scale: float, background: Colour) -> Float[Tensor, "h w 3"] | None:
    """The middle of a view's photograph at a scale; None without a photograph that large."""
    if view.photo is None:
        return None
    photo = quantised(read_photo(view.photo, background, view.undistortion))
    if (factor := scale * view.width / photo.shape[1]) > 1:
        return None
    return quantised(middle_of(resampled(photo, factor, view.scaled(scale).hw), MAX_SIDE))

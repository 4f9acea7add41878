"""Overlays: one value per pixel that aaplug knows about a picture, with a legend.

h, w: of the picture, in px.  A value that nothing decides, such as the sampling rate of the background, is NaN.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.colours import BLACK
from aaplug.methods.pixel_kernels.raster_rows import TILE
from aaplug.rasterizers.tiled.binning import bands
from aaplug.rendering.renderer import Renderer

VALUE_LEVELS = 254  # of 8 bits, from low to high; level 0 says that there is no value
MIN_SEEN_ALPHA = 0.05  # alpha of the Gaussians that training saw, from which on a pixel has their mean

Map = Float[Tensor, "h w"]


@dataclass(frozen=True)
class Overlay:
    """A value per pixel, and its legend.

    values: called with a renderer, the camera of the picture and the samples along a pixel's side.
    low, high: ends of the scale; high is None where the picture's own largest value is.  log: True for even octaves.
    middle: the value where the colours change sides; None for colours that only grow.
    """

    title: str
    about: str
    values: Callable[[Renderer, Camera, int], Map]
    low: float
    high: float | None
    log: bool = False
    middle: float | None = None

    def __call__(self, renderer: Renderer, camera: Camera, samples: int) -> tuple[Map, dict[str, Any]]:
        """Levels from 0 to 1, of which 0 says that there is no value, and the legend."""
        values = self.values(renderer, camera, samples)
        finite = values[values.isfinite()]
        largest = self.high or float(finite.max() if len(finite) else self.low)
        high = max(largest, self.low * 2 if self.log else self.low + 1e-6)
        scale = torch.log2 if self.log else torch.positive
        low_end, high_end = scale(torch.tensor([self.low, high], dtype=values.dtype))
        shares = ((scale(values) - low_end) / (high_end - low_end)).clamp(0, 1)
        levels = torch.where(values.isfinite(), (1 + VALUE_LEVELS * shares) / (VALUE_LEVELS + 1), 0.0)
        legend = {"low": self.low, "high": high, "log": self.log, "middle": self.middle}
        return levels, legend | {"title": self.title, "about": self.about}


def _rate(renderer: Renderer, camera: Camera, samples: int) -> Map:
    highest = renderer.training.bounds.highest
    return _blended(renderer, camera, lambda depths, places: (camera.focal / depths / highest[places]).log2()).exp2()


def _views(renderer: Renderer, camera: Camera, samples: int) -> Map:
    return _blended(renderer, camera, lambda _, places: renderer.training.bounds.views[places])


def _alpha(renderer: Renderer, camera: Camera, samples: int) -> Map:
    return renderer.paint(renderer.splats(camera), camera.hw).alpha


def _samples(renderer: Renderer, camera: Camera, samples: int) -> Map:
    return torch.full(camera.hw, float(samples**2))


def _cost(renderer: Renderer, camera: Camera, samples: int) -> Map:
    """Splats that the tile of a pixel lists, for each of its samples."""
    fine = camera.resized(camera.width * samples, camera.height * samples)
    splats, rules = renderer.splats(fine, samples), renderer.training.convention.rules
    grid = -(-fine.height // TILE), -(-fine.width // TILE)
    pixel = renderer.recipe_through(splats.camera).pixel
    ellipses = splats.bounds(pixel, rules) or pixel.bounding_ellipses(splats, rules) or splats
    counts = torch.cat([bins.counts for bins in bands(ellipses, grid, renderer.kernels, rules=rules)]).view(grid)
    rows, columns = (((torch.arange(side) + 0.5) * samples / TILE).long() for side in camera.hw)
    return counts[rows][:, columns].float() * samples**2


def _blended(renderer: Renderer, camera: Camera, of_training: Callable[[Tensor, Tensor], Tensor]) -> Map:
    """Mean over the Gaussians that a pixel shows and training saw, with one sample per pixel.

    of_training: called with depths of splats, in world units, and their places in the scene.
    """
    splats = renderer.splats(camera)
    seen = renderer.training.bounds.seen[splats.sources].to(splats.depths)
    values = torch.where(seen > 0, of_training(splats.depths, splats.sources).to(seen), 0.0)
    colours = torch.stack([values, seen, torch.ones_like(seen)], dim=1)
    total, seen_alpha, _ = renderer.paint(splats.with_columns({"rgb": colours}), camera.hw, BLACK).rgb.unbind(dim=2)
    return torch.where(seen_alpha > MIN_SEEN_ALPHA, total / seen_alpha, torch.nan)


def depth_map(renderer: Renderer, camera: Camera) -> Map:
    """Mean depth of what a pixel shows and training saw, in world units."""
    return _blended(renderer, camera, lambda depths, _: depths)


OVERLAYS = {
    "rate": Overlay(
        "sampling rate / training's", "blue: finer than training saw it; red: coarser", _rate, 1 / 8, 8.0, True, 1.0
    ),
    "views": Overlay("training cameras that saw it", "mean over what a pixel shows", _views, 0.0, None),
    "samples": Overlay("samples per pixel", "the same for all pixels of a picture", _samples, 1.0, 64.0, True),
    "cost": Overlay(
        "splat evaluations per pixel", "at most: a pixel that is opaque stops earlier", _cost, 1.0, None, True
    ),
    "alpha": Overlay("alpha", "share of the background that is hidden", _alpha, 0.0, 1.0),
}

"""The whole flow on one page: cameras and scene to bounds, to a filtered scene, to images.

training = learn(scene, cameras)
scene = smooth(scene, training, recipe)
image = render(scene, camera, recipe, training).rgb
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from aaplug.cameras import BLACK, Camera
from aaplug.errors import UsageError
from aaplug.filters import fuse_stored
from aaplug.gaussians import Gaussians
from aaplug.interfaces import Rasterizer, Training
from aaplug.projection import project, shade, tilt
from aaplug.rasterizers import RASTERIZERS, SURFELS, averaged, extents_of
from aaplug.recipes import Recipe
from aaplug.sampling import sampling_bounds
from aaplug.splats import Render, Splats2D, drawn, joined

PART = 1 << 20  # Gaussians projected at once


def learn(scene: Gaussians, cameras: Sequence[Camera], guard: float = math.inf) -> Training:
    """What filters need to know of training: the convention, the cameras and the bounds that they set.

    guard: see `Training`.

    Raises:
        UsageError: there are no cameras.
    """
    return Training(scene.convention, tuple(cameras), sampling_bounds(scene.means, cameras), guard)


def smooth(scene: Gaussians, training: Training, recipe: Recipe) -> Gaussians:
    """Everything that acts on the scene before a view is chosen; a stored 3D filter is part of the scene itself."""
    scene = fuse_stored(scene)
    return scene if recipe.world is None else recipe.world(scene, training)


def render(
    scene: Gaussians,
    camera: Camera,
    recipe: Recipe,
    training: Training,
    rasterizer: Rasterizer = RASTERIZERS["eager"],
    background: tuple[float, float, float] = BLACK,
) -> Render:
    """One image of a smoothed scene, rgb and alpha of `camera.hw`, by the recipe's selection, filter and samples.

    Differentiable in everything that the scene holds and in `camera.cam_from_world`.

    Raises:
        UsageError: a Gaussian in view has a colour that is NaN or infinite, or the scene lacks what the recipe needs.
    """
    fine, samples = sampled(scene, camera, recipe, training)
    splats = splats_of(scene, fine, recipe, training, rasterizer)
    return averaged(rasterizer(splats, fine.hw, background, recipe.pixel), samples)


def sampled(
    scene: Gaussians, camera: Camera, recipe: Recipe, training: Training
) -> tuple[Camera, int]:
    """The larger image whose pixels are a recipe's samples, and how many of those a pixel's side has."""
    samples = recipe.samples_at(rate_of(scene, camera, training))
    return camera.resized(camera.width * samples, camera.height * samples), samples


@torch.no_grad()
def rate_of(scene: Gaussians, camera: Camera, training: Training) -> float:
    """How finely a view samples the scene against training, by which samples a pixel are chosen.

    A pose of the data set has its size against training's.  A free camera may be nearer or farther than any training
    camera: it has the median, over the Gaussians in view, of their rate against the nearest one that training had.
    """
    bounds = training.bounds
    if camera.trained_focal is not None or not bounds.seen.any():
        return training.rate(camera)
    now = sampling_bounds(scene.means, [camera]).highest
    both = (now > 0) & bounds.seen
    if not both.any():
        return training.rate(camera)
    now, lowest, highest = (x[both] for x in (now, bounds.lowest, bounds.highest))
    return float((now / torch.minimum(torch.maximum(now, lowest), highest)).median())


def splats_of(
    scene: Gaussians,
    camera: Camera,
    recipe: Recipe,
    training: Training,
    rasterizer: Rasterizer = RASTERIZERS["eager"],
) -> Splats2D:
    """What a view draws: projected, chosen, filtered, inside the image, coloured.

    Gaussians go through in parts, so that what most of them leave behind never needs memory at once.
    """
    kernels, parts = rasterizer.kernels, []
    for start in range(0, max(1, len(scene)), PART):
        part = scene if len(scene) <= PART else scene[start : start + PART]
        splats = project(part, camera, kernels)
        splats = splats if recipe.selection is None else recipe.selection(splats, part)
        splats = tilt(splats, part, camera) if recipe.pixel in SURFELS else splats
        splats = replace(splats, sources=splats.sources + start)
        splats = recipe.screen(splats, camera, training)
        extents = extents_of(splats, recipe.pixel)
        splats = drawn(splats, camera.hw, training.guard, kernels, extents)
        parts.append(shade(splats, scene, camera, kernels))
    splats = parts[0] if len(parts) == 1 else joined(parts)
    _check_colours(splats)
    return splats


def _check_colours(splats: Splats2D) -> None:
    """One colour that is not a number would spoil every pixel that it touches; bad shapes are not drawn at all."""
    assert splats.rgb is not None
    if not splats.rgb.sum().isfinite():
        bad = ~splats.rgb.isfinite().all(dim=1)
        if bad.any():
            first, count = int(splats.sources[bad].min()), int(bad.sum())
            raise UsageError(f"Gaussian {first}", f"has no finite colour (the first of {count})")

"""The whole flow on one page: cameras and scene to bounds, to a filtered scene, to images.

training = learn(scene, cameras)
scene = smooth(scene, training, recipe)
image = render(scene, camera, recipe, training).rgb
"""

import math
from collections.abc import Sequence

from aaplug.cameras import BLACK, Camera
from aaplug.filters import fuse_stored
from aaplug.gaussians import Gaussians
from aaplug.interfaces import Rasterizer, Training
from aaplug.projection import project, shade
from aaplug.rasterizers import RASTERIZERS, averaged
from aaplug.recipes import Recipe
from aaplug.sampling import sampling_bounds
from aaplug.splats import Render, drawn


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
    """One image of a smoothed scene, rgb and alpha of `camera.hw`, by the recipe's screen filter and samples."""
    rate = training.rate(camera)
    samples = recipe.samples_at(rate)
    fine = camera.resized(camera.width * samples, camera.height * samples)
    splats = recipe.screen_at(rate)(project(scene, fine), fine, training)
    splats = shade(drawn(splats, fine.hw, training.guard), scene, fine)
    return averaged(rasterizer(splats, fine.hw, background), samples)

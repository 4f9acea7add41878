"""Laws of recipes: each promise that one makes holds."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from itertools import product

import torch
from torch import Tensor

from aaplug.core.camera_paths import zoomed
from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import ReadsColumns
from aaplug.methods import RECIPES
from aaplug.methods.recipe import Recipe
from aaplug.rendering.renderer import Renderer

from .base import make_camera, make_scene, require
from .filters import CAMERAS

SIDE, APART = 168, 40  # px
CAMERA = make_camera(size=(SIDE, SIDE))
PIXEL = 4.0 / CAMERA.focal  # world units at the origin
WIDTH, THICKNESS = 2.0 * PIXEL, 0.6 * PIXEL
OPACITY = 0.9
CUTOFF_LOSS = 0.04  # of a splat's light: its tail below 1/255 is not drawn
VANISHING = 1 / 512
OPAQUE = 4.0  # added to logits
EQUAL = 1e-5  # of an image's range


def with_columns(scene: Gaussians, base: Tensor) -> Gaussians:
    """The scene with the columns that recipes read, before learning; base: True where a Gaussian is always drawn."""
    screens = (recipe.screen for recipe in RECIPES.values())
    others = {name: 0.0 for screen in screens if isinstance(screen, ReadsColumns) for name in screen.columns}
    sizes = {"min_pixel_sizes": 4.0, "max_pixel_sizes": 8.0} | others
    columns = {name: torch.full((len(scene),), size) for name, size in sizes.items()}
    return replace(scene, extras={**columns, "base_mask": base.float()})


def lone_splats() -> Gaussians:
    """16 splats far apart that face the camera, at 16 positions within a pixel of 1/8 of the size."""
    places = torch.tensor(list(product(range(4), repeat=2)), dtype=torch.float32)
    at = ((places - 1.5) * (APART + 2)) * PIXEL
    scene = replace(
        make_scene(16),
        means=torch.stack([at[:, 0], torch.zeros(16), at[:, 1]], dim=1),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 16),
        log_scales=torch.tensor([[WIDTH, THICKNESS, WIDTH]] * 16).log(),
        logit_opacities=torch.full((16,), OPACITY).logit(),
    )
    return with_columns(scene, torch.ones(16))


def _alpha(recipe: Recipe, scene: Gaussians, view: Camera) -> Tensor:
    return Renderer.of(scene, [CAMERA], recipe, rasterizer="eager")(view).alpha


def light_drift(recipe: Recipe) -> Mapping[float, float]:
    """Relative change of the light of lone splats, by the size of the image against training."""
    scene = lone_splats()
    trained = _alpha(recipe, scene, CAMERA).sum().item()
    return {
        rate: _alpha(recipe, scene, CAMERA.scaled(rate)).sum().item() / rate**2 / trained - 1
        for rate in (0.125, 0.25, 0.5, 2.0)
    }


def alpha_from_afar(recipe: Recipe) -> float:
    """Alpha of a lone splat that is much smaller than a pixel."""
    far = CAMERA.resized(1, 1)
    far = replace(far, fx=CAMERA.fx * VANISHING, fy=CAMERA.fy * VANISHING)
    return _alpha(recipe, replace(lone_splats()[:1], means=torch.zeros(1, 3)), far).item()


def alpha_from_near(recipe: Recipe) -> float:
    """Alpha at the centre of a lone splat that is much larger than a pixel."""
    near = make_camera(size=(9, 9))
    near = zoomed(near, CAMERA.focal / near.focal / VANISHING)
    return _alpha(recipe, replace(lone_splats()[:1], means=torch.zeros(1, 3)), near)[4, 4].item()


def difference_to_training(recipe: Recipe) -> float:
    """Largest difference to training's images at training views, where some pixels stop at an opaque splat."""
    pairs = zip(_training_images(recipe), _training_images(RECIPES["classic"]), strict=True)
    return max((ours - trained).abs().max().item() for ours, trained in pairs)


@cache
def _training_images(recipe: Recipe) -> list[Tensor]:
    scene = make_scene(60)
    scene = replace(scene, logit_opacities=scene.logit_opacities + OPAQUE)
    renderer = Renderer.of(with_columns(scene, torch.arange(60) % 4 == 0), CAMERAS[:2], recipe, rasterizer="eager")
    return [renderer(camera).rgb for camera in CAMERAS[:2]]


def keeps_energy(recipe: Recipe) -> None:
    """If it promises `keeps_energy`, a lone splat keeps its light at every size."""
    drift = light_drift(recipe) if recipe.promises.keeps_energy else {}
    require(all(abs(change) < CUTOFF_LOSS for change in drift.values()), f"its light changes by {drift}")


def fades_when_small(recipe: Recipe) -> None:
    """If it promises `keeps_energy` and `fades_when_small`, a lone splat fades out where it is very small."""
    promised = recipe.promises.keeps_energy and recipe.promises.fades_when_small
    require(not promised or alpha_from_afar(recipe) < 0.01, "a splat much smaller than a pixel does not fade out")


def opaque_when_near(recipe: Recipe) -> None:
    """If it promises `opaque_when_near`, a lone splat has its opacity where it is very large."""
    alpha = alpha_from_near(recipe) if recipe.promises.opaque_when_near else OPACITY
    require(abs(alpha - OPACITY) < 1e-3 * OPACITY, f"alpha at the centre is {alpha:.4f} instead of {OPACITY}")


def equals_training(recipe: Recipe) -> None:
    """If it promises `equals_training`, its image at the training size is training's."""
    difference = difference_to_training(recipe) if recipe.promises.equals_training else 0.0
    require(difference <= EQUAL, f"they differ by {difference:.1e}")

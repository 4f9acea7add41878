"""Scenes with values that no training makes: every rasterizer leaves such a Gaussian out, or an error names it."""

import math
from dataclasses import replace

import pytest
import torch

from aaplug import RECIPES, Camera, Gaussians, Renderer, TrainingViews, UsageError
from tests.conftest import ALL_RASTERIZERS, make_camera, make_scene

CAMERA = make_camera(size=(40, 30))
SCENE = make_scene(50, seed=3)
VICTIM = 20
TRAINING = TrainingViews.of(SCENE, [CAMERA])
CENTRE = CAMERA.centre.float()
BACK = CAMERA.cam_from_world[2, :3].float()  # the camera's z axis in the world

DRAWN_WITHOUT = {
    "NaN mean": ("means", torch.tensor([math.nan, 0.0, 0.0])),
    "infinite mean": ("means", torch.tensor([math.inf, 0.0, 0.0])),
    "NaN scale": ("log_scales", torch.tensor([math.nan, -2.0, -2.0])),
    "NaN rotation": ("quats", torch.full((4,), math.nan)),
    "NaN opacity": ("logit_opacities", torch.tensor(math.nan)),
    "at the camera's centre": ("means", CENTRE),
    "behind the camera": ("means", CENTRE - BACK),
    "just before the near plane": ("means", CENTRE + 0.1999 * BACK),
    "transparent": ("logit_opacities", torch.tensor(-math.inf)),
}
DRAWN_SOMEHOW = {
    "opaque": ("logit_opacities", torch.tensor(math.inf)),
    "a million px": ("log_scales", torch.full((3,), 12.0)),
    "infinitely large": ("log_scales", torch.full((3,), math.inf)),
    "a point": ("log_scales", torch.full((3,), -math.inf)),
    "denormal rotation": ("quats", torch.tensor([1e-30, 0.0, 0.0, 0.0])),
}


def poisoned(field: str, value: torch.Tensor) -> Gaussians:
    column = getattr(SCENE, field).clone()
    column[VICTIM] = value
    return replace(SCENE, **{field: column})


def draw(scene: Gaussians, name: str, training: TrainingViews = TRAINING) -> torch.Tensor:
    renderer = Renderer(scene, training, RECIPES["matched"], ALL_RASTERIZERS[name])
    with torch.no_grad():
        rgb, alpha = renderer(CAMERA)
    return torch.cat([rgb, alpha[..., None]], dim=2)


@pytest.mark.parametrize("name", ALL_RASTERIZERS)
def test_what_cannot_be_seen_is_left_out(name):
    kept = torch.arange(len(SCENE)) != VICTIM
    training = replace(TRAINING, bounds=TrainingViews.of(SCENE[kept], [CAMERA]).bounds)
    without = draw(SCENE[kept], name, training)[..., :3]
    assert (draw(SCENE, name)[..., :3] - without).abs().max() > 1e-3, "the victim is not in view"
    for poison, (field, value) in DRAWN_WITHOUT.items():
        image = draw(poisoned(field, value), name)[..., :3]
        torch.testing.assert_close(image, without, rtol=0, atol=1e-6, msg=poison)


@pytest.mark.parametrize("name", ALL_RASTERIZERS)
def test_extremes_draw_finite_images(name):
    for poison, (field, value) in DRAWN_SOMEHOW.items():
        image = draw(poisoned(field, value), name)
        assert image.isfinite().all(), poison
        assert image[..., 3].min() >= 0, poison
        assert image[..., 3].max() <= 1, poison


@pytest.mark.parametrize("recipe", ["analytic", "eaa", "gaussian-blending", "aa-2dgs", "2dgs", "2dgs-matched"])
def test_points_and_discs_on_edge_are_drawn(recipe):
    """Their determinants underflow, or the squares of their whitenings overflow."""
    camera = Camera("front", 16, 16, 5.0, 5.0, 8.0, 8.0, torch.eye(4))
    for scales in ((-30.0, -30.0, -30.0), (-math.inf, -math.inf, -1.0), (-30.0, -1.0, -1.0)):
        scene = replace(
            make_scene(1),
            means=torch.tensor([[0.0, 0.0, 4.0]]),
            quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
            log_scales=torch.tensor([scales]),
        )
        for scale in (1.0, 8.0):
            rgb, alpha = Renderer.of(scene, [camera], recipe, rasterizer="eager")(camera.scaled(scale))
            assert rgb.isfinite().all(), scales
            assert 0 <= alpha.min() <= alpha.max() <= 1, scales


@pytest.mark.parametrize("name", ALL_RASTERIZERS)
def test_a_colour_that_is_not_finite_is_refused_by_its_index(name):
    problem = rf"Gaussian {VICTIM}: has no finite colour \(the first of 1\)"
    for value in (math.nan, math.inf):
        with pytest.raises(UsageError, match=problem):
            draw(poisoned("sh", torch.full((4, 3), value)), name)

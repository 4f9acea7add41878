"""Laws over every recipe: what it does to a splat alone as the scale changes, and what it is at the training size."""

import math
from dataclasses import replace
from itertools import product

import pytest
import torch

from aaplug.core.camera_paths import zoomed
from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians
from aaplug.methods.recipes import RECIPES
from aaplug.rendering.renderer import learn, render, smooth
from tests.conftest import make_camera, make_scene, sized

# what each recipe promises of a classic scene
BLOATING = {"classic", "multi-scale", "2dgs"}  # the same px are added, whatever the rate
POINTED = {"sa-gs", "sa-gs-samples"}  # nothing is: a sample may hit or miss what is small
IDENTICAL = {  # training's own renderer at the training size
    *("classic", "sa-gs", "matched", "matched-interval", "matched-integral", "matched-square"),
    *("gaussian-blending", "auto"),
}
WIDENED = {  # in the world, to what the finest training view could tell, and so fainter from near
    *("mip-splatting", "mip-splatting-code", "mip-splatting-balanced"),
    *("mip-splatting-anisotropic", "aaa", "aa-2dgs"),
}

SIDE, APART = 256, 64  # px
CAMERA = make_camera(size=(SIDE, SIDE))
PIXEL = 4.0 / CAMERA.focal  # world units at the origin
WIDTH, THICKNESS = 2.0 * PIXEL, 0.6 * PIXEL
OPACITY = 0.9
CUT_OFF = 0.04  # of a splat's light: its tail below 1/255 is not drawn
VANISHING = 1 / 512


def alone() -> Gaussians:
    """16 splats far apart that face the camera, at 16 places within a pixel of 1/8 of the size."""
    places = torch.tensor(list(product(range(4), repeat=2)), dtype=torch.float32)
    at = ((places - 1.5) * (APART + 2)) * PIXEL
    scene = make_scene(16)
    return replace(
        scene,
        means=torch.stack([at[:, 0], torch.zeros(16), at[:, 1]], dim=1),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 16),
        log_scales=torch.tensor([[WIDTH, THICKNESS, WIDTH]] * 16).log(),
        logit_opacities=torch.full((16,), OPACITY).logit(),
    )


def shown(name: str, scene: Gaussians, view: Camera) -> torch.Tensor:
    recipe, training = RECIPES[name], learn(scene, [CAMERA])
    return render(smooth(scene, training, recipe), view, recipe, training).alpha


@pytest.mark.parametrize("name", RECIPES)
def test_a_splat_alone_keeps_its_light_over_scales_unless_the_recipe_bloats(name):
    scene = sized(alone())
    assert scene.pixel_sizes is not None
    scene = replace(scene, pixel_sizes=replace(scene.pixel_sizes, base=torch.ones(16).bool()))
    trained = shown(name, scene, CAMERA).sum().item()
    drift = {
        rate: shown(name, scene, CAMERA.scaled(rate)).sum().item() / rate**2 / trained - 1
        for rate in (0.125, 0.25, 0.5, 2.0)
    }
    if name in BLOATING:
        assert drift[0.125] > 4
        assert sorted(drift.values(), reverse=True) == list(drift.values())
    else:
        assert all(abs(change) < CUT_OFF for change in drift.values()), drift


@pytest.mark.parametrize("name", RECIPES)
def test_seen_from_very_far_a_splat_alone_vanishes_unless_the_recipe_bloats(name):
    scene = replace(sized(alone()[:1]), means=torch.zeros(1, 3))
    far = CAMERA.resized(1, 1)
    far = replace(far, fx=CAMERA.fx * VANISHING, fy=CAMERA.fy * VANISHING)
    light = shown(name, scene, far).item()
    if name in BLOATING:
        assert light > 0.5 * OPACITY
    elif name in POINTED:  # here a sample hits it
        assert light == pytest.approx(OPACITY / RECIPES[name].grid ** 2)
    else:
        assert light < 0.01


@pytest.mark.parametrize("name", RECIPES)
def test_seen_from_very_near_a_splat_has_its_opacity_unless_it_was_widened_in_the_world(name):
    scene = replace(sized(alone()[:1]), means=torch.zeros(1, 3))
    near = zoomed(
        make_camera(size=(9, 9)), CAMERA.focal / make_camera(size=(9, 9)).focal / VANISHING
    )
    centre = shown(name, scene, near)[4, 4].item()
    if name in WIDENED:
        assert 0.2 * OPACITY < centre < 0.99 * OPACITY
    else:
        approximate = RECIPES[name].pixel == "logistic"
        assert centre == pytest.approx(OPACITY, rel=6e-3 if approximate else 1e-3)


@pytest.mark.parametrize("name", RECIPES)
def test_at_the_training_size_a_recipe_is_the_classic_one_where_it_says_so(name):
    cameras = [make_camera(eye) for eye in ((0.0, -4.0, 0.0), (3.0, -4.0, 1.0), (-2.0, -6.0, 0.5))]
    scene = sized(make_scene(200))
    training = learn(scene, cameras)
    recipe = RECIPES[name]
    difference = max(
        (
            render(smooth(scene, training, recipe), camera, recipe, training).rgb
            - render(scene, camera, RECIPES["classic"], training).rgb
        )
        .abs()
        .max()
        .item()
        for camera in cameras
    )
    assert (difference <= 1e-5) == (name in IDENTICAL), difference
    assert math.isfinite(difference)

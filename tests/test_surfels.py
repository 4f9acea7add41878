"""Scenes of 2D Gaussians: their low-pass filter.  `laws/test_pixel_kernel_laws.py` has their pixel kernels."""

import math
from dataclasses import replace

import pytest
import torch

from aaplug.methods import RECIPES
from aaplug.rendering.renderer import Renderer
from tests.conftest import make_camera, make_scene

F64 = torch.float64


@pytest.mark.parametrize(("name", "factor"), [("2dgs", 1.0), ("2dgs-matched", 0.5)])
def test_the_low_pass_filter_follows_the_rate_where_it_is_matched(name, factor):
    """A disc of no size looks like its filter: √½ px wide, or √½ / 2 px at half the size."""
    scene = replace(
        make_scene(1, dtype=F64),
        means=torch.zeros(1, 3, dtype=F64),
        quats=torch.tensor([[0.7, 0.7, 0.0, 0.0]], dtype=F64),
        log_scales=torch.tensor([[-12.0, -12.0, -30.0]], dtype=F64),
        logit_opacities=torch.tensor([4.0], dtype=F64),
        flat=True,
    )
    camera = make_camera((0.0, -4.0, 0.0), size=(16, 16))
    recipe = replace(RECIPES[name], target_rate=0.0)
    alpha = Renderer.of(scene, [camera], recipe, rasterizer="eager")(camera.scaled(0.5)).alpha
    squared = 2 * 0.5 / factor**2  # the nearest pixel centres are half a px away in x and y
    expected = scene.opacities.item() * math.exp(-squared / 2)
    assert alpha.max().item() == pytest.approx(expected, rel=1e-3)

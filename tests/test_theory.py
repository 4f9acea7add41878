"""The statements of theory.md, held against the program's own filters and levels."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from aaplug import RECIPES, CameraSet, Renderer, Splats2D
from aaplug.core.pyramids import faded
from aaplug.methods.filters.matched import PIXEL_VARIANCE
from tests.bench.theory import CELLS, LARGEST_THIRD, error
from tests.conftest import make_scene, splats_of, straight_camera

F64 = torch.float64
VARIANCE, RATE, KAPPA = 0.1, 1 / 8, 0.3  # px² of training, and training's dilation
CAMERA = straight_camera(200.0, (80, 80), back=4.0).as_trained()


def light(splats: Splats2D) -> Tensor:
    """∫ α of each splat, in px of the view."""
    return 2 * math.pi * splats.opacities * splats.dets.sqrt()


def splats_by(recipe: str, rate: float) -> Splats2D:
    """A round splat of the variance, as a recipe shows it at a rate."""
    sigma = math.log(math.sqrt(VARIANCE) * 4.0 / 200.0)
    columns = {"log_scales": torch.full((1, 3), sigma, dtype=F64), "logit_opacities": torch.tensor([6.0], dtype=F64)}
    scene = replace(make_scene(1, dtype=F64), means=torch.zeros(1, 3, dtype=F64), **columns)
    renderer = Renderer.of(scene, CameraSet((CAMERA,), (CAMERA,)), RECIPES[recipe], rasterizer="reference")
    return renderer.splats(CAMERA.scaled(rate))


@pytest.mark.parametrize(
    ("recipe", "expected"), [("classic", 48.25), ("ewa", 0.25), ("mip", 0.25), ("sa-gs", 1.0), ("matched", 1.0)]
)
def test_light_relative_to_what_training_drew(recipe, expected):
    """The table of section 2; training's own is that of `classic` at its size, and an area has RATE² as many px."""
    training = light(splats_by("classic", 1.0)) * RATE**2
    assert float(light(splats_by(recipe, RATE)) / training) == pytest.approx(expected, rel=1e-6)


def test_matched_adds_what_the_pixel_lacks():
    """Statements 1 to 3: r² (C + κI) and k (1 - r²) I, nothing at r = 1."""
    for rate in (1.0, 1 / 2, RATE):
        [[xx, xy, yy]] = splats_by("matched", rate).covs.tolist()
        wanted = rate**2 * (VARIANCE + KAPPA) + PIXEL_VARIANCE * (1 - rate**2)
        assert (xx, xy, yy) == pytest.approx((wanted, 0.0, wanted), abs=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 1.0])
def test_two_levels_together_keep_the_light_of_one(share):
    """Statement 7."""
    splats = splats_of(((8.0, 8.0), (4.0, 0.0, 4.0), 1.0, 0.8, (1.0, 1.0, 1.0)))
    a, b = (float(faded(splats, torch.tensor([w], dtype=F64)).opacities) for w in (share, 1 - share))
    assert a + b - a * b / 2 == pytest.approx(0.8, abs=1e-12)


def test_merging_by_moments_errs_in_the_third_order():
    """Statement 6: half the cell, an eighth of the error, and the figure's bound."""
    assert error(1 / 8) / error(1 / 16) == pytest.approx(8, rel=0.1)
    assert all(error(cell) < LARGEST_THIRD * cell**3 / 6 for cell in CELLS)

"""All levels in one scene: what Multi-Scale 3DGS' own rule draws of them, and the file that holds them."""

import math
from dataclasses import replace

import pytest
import torch

from aaplug import Gaussians, Renderer, UsageError
from aaplug.core.conventions import MIP
from aaplug.evaluation.metrics import psnr
from aaplug.lab.multi_scale import in_one_scene, pixel_sizes
from tests.conftest import make_camera, make_scene

LEVELS = 4


@pytest.fixture(scope="module")
def fine(sample_scene) -> Gaussians:
    return sample_scene[::3]


@pytest.fixture(scope="module")
def together(fine, sample_cameras) -> Gaussians:
    return in_one_scene(fine, sample_cameras.train, LEVELS)


def test_its_rule_draws_fewer_gaussians_that_look_more_like_the_scene(together, fine, sample_cameras):
    view = sample_cameras.test[0]
    ceiling = Renderer.of(fine, sample_cameras, quality="best")
    by_rule = Renderer.of(together, sample_cameras, "multi-scale")
    classic = Renderer.of(fine, sample_cameras, "classic")
    for scale, gain in ((1 / 4, 0.5), (1 / 8, 1.0), (1 / 16, 2.0)):
        truth = ceiling(view.scaled(scale)).rgb
        ours, plain = (psnr(renderer(view.scaled(scale)).rgb, truth) or 0 for renderer in (by_rule, classic))
        assert ours > plain + gain, scale
    drawn = [len(by_rule.splats(view.scaled(0.5**level))) for level in range(LEVELS + 1)]
    assert drawn == sorted(drawn, reverse=True)
    assert drawn[-1] < 0.3 * drawn[0]
    full = psnr(by_rule(view).rgb, classic(view).rgb)
    assert full is None or full > 40


def test_a_wall_of_small_gaussians_stays_closed_at_every_size():
    """Every one of them is replaced, so a part that neither it nor its level covers would be a hole."""
    side = torch.arange(64) * 0.03 - 0.96
    means = torch.stack([side.repeat(64), torch.zeros(64**2), side.repeat_interleave(64)], dim=1)
    wall = replace(make_scene(1)[torch.zeros(64**2, dtype=torch.int64)], means=means)
    wall.log_scales[:], wall.logit_opacities[:] = math.log(0.02), 3.0
    views = [make_camera((x, -4.0, 0.0), (256, 256), 0.6) for x in (-0.3, 0.0, 0.3)]
    by_rule = Renderer.of(in_one_scene(wall, views, LEVELS), views, "multi-scale")
    for step in range(4 * LEVELS + 1):
        render = by_rule(views[1].scaled(2 ** (-step / 4)))
        middle = slice(render.alpha.shape[0] * 3 // 8, render.alpha.shape[0] * 5 // 8 + 1)
        assert render.alpha[middle, middle].mean() > 0.7, step
    drawn = [len(by_rule.splats(views[1].scaled(0.5**level))) for level in (0, LEVELS)]
    assert drawn[1] < 0.1 * drawn[0]


def test_every_gaussian_of_the_scene_is_there_to_the_bit(together, fine):
    rows = {tuple(row) for row in torch.cat([together.means, together.sh[:, 0]], dim=1).tolist()}
    assert {tuple(row) for row in torch.cat([fine.means, fine.sh[:, 0]], dim=1).tolist()} <= rows


def test_pixel_sizes_are_those_of_all_views():
    scene, views = make_scene(30), [make_camera((0.0, -4.0, 0.0)), make_camera((0.0, -8.0, 0.0))]
    each = [pixel_sizes(scene, [view]) for view in views]
    least, most = pixel_sizes(scene, views)
    shared = torch.stack([most > 0 for _, most in each]).all(dim=0)
    assert shared.any()
    assert torch.equal(least[shared], torch.minimum(each[0][0], each[1][0])[shared])
    assert torch.equal(most[shared], torch.maximum(each[0][1], each[1][1])[shared])


@pytest.mark.parametrize("change", [{"convention": MIP}, {"flat": True}])
def test_a_scene_that_its_rasterizer_shows_otherwise_is_refused(change):
    with pytest.raises(UsageError, match="Multi-Scale 3DGS draws 3D Gaussians by the convention 'classic'"):
        in_one_scene(replace(make_scene(5), **change), [make_camera()], 1)

"""Discs where rays meet them: the intersection is that of a ray and a plane, and nothing shows outside its reach."""

from dataclasses import replace

import pytest
import torch

from aaplug.core.projection import project, rotation_matrices, tilt
from aaplug.core.splats import MIN_ALPHA, whitening
from aaplug.methods.recipes import RECIPES
from aaplug.rasterizers import extents_of
from aaplug.rasterizers.reference import alphas
from aaplug.rendering.renderer import learn, render, smooth
from tests.conftest import make_camera, make_scene

F64 = torch.float64
CAMERA = make_camera((1.0, -3.0, 0.5))


def discs(n: int):
    """2D Gaussians: no thickness along their third axis."""
    scene = make_scene(n, dtype=F64)
    log_scales = scene.log_scales.clone()
    log_scales[:, 2] = -30.0
    return replace(scene, means=0.4 * scene.means, log_scales=log_scales)


def test_a_disc_is_met_where_the_ray_meets_its_plane():
    scene = discs(200)
    splats = tilt(project(scene, CAMERA), scene, CAMERA)
    assert splats.tilts is not None
    rotation, centre = CAMERA.cam_from_world[:3, :3], CAMERA.centre
    axes = rotation_matrices(scene.unit_quats[splats.sources])
    offset = torch.tensor([2.0, -1.5], dtype=F64)
    pixels = splats.means + offset
    x = (pixels[:, 0] - CAMERA.cx) / CAMERA.fx
    y = (pixels[:, 1] - CAMERA.cy) / CAMERA.fy
    rays = torch.stack([x, y, torch.ones_like(x)], dim=1) @ rotation
    from_camera = scene.means[splats.sources] - centre
    normals = axes[:, :, 2]
    along = (normals * from_camera).sum(1) / (normals * rays).sum(1)
    point = along[:, None] * rays - from_camera
    local = torch.einsum("nij,ni->nj", axes, point)[:, :2] / scene.scales[splats.sources, :2]
    e = torch.einsum("nij,j->ni", whitening(splats), offset)
    ahead = 1 - splats.tilts @ offset
    clear = (ahead > 0.05) & (splats.means.abs().amax(dim=1) < 70)
    assert clear.sum() > 150
    torch.testing.assert_close(
        (e / ahead[:, None]).square().sum(1)[clear], local.square().sum(1)[clear], rtol=1e-6, atol=0
    )
    torch.testing.assert_close((1 / ahead)[clear], (along / splats.depths)[clear])


@pytest.mark.parametrize("pixel", ["surfel", "surfel-mip"])
def test_nothing_shows_outside_a_discs_reach(pixel):
    scene = discs(300)
    splats = tilt(project(scene, CAMERA), scene, CAMERA)
    extents = extents_of(splats, pixel)
    assert extents is not None
    drawn = extents.opacities > 0
    assert drawn.sum() > 200
    splats, extents = splats[drawn], extents[drawn]
    ticks = [torch.arange(-20, side + 20, 1.7, dtype=F64) for side in (CAMERA.width, CAMERA.height)]
    points = torch.cartesian_prod(*ticks)
    shown = alphas(splats, points, pixel) >= MIN_ALPHA
    white = torch.einsum("cij,pcj->pci", whitening(extents), points[:, None] - extents.means)
    inside = white.square().sum(dim=2) <= squared_cutoff(extents.opacities) * (1 + 1e-9)
    assert shown.sum() > 1000
    assert not (shown & ~inside).any()


def test_the_low_pass_filter_follows_the_rate_where_it_is_matched():
    """A disc of no size shows as its filter: √½ px wide, at half the size √½ / 2."""
    scene = discs(1)
    scene = replace(
        scene,
        means=torch.zeros(1, 3, dtype=F64),
        quats=torch.tensor([[0.7, 0.7, 0.0, 0.0]], dtype=F64),
        log_scales=torch.tensor([[-12.0, -12.0, -30.0]], dtype=F64),
        logit_opacities=torch.tensor([4.0], dtype=F64),
    )
    camera = make_camera((0.0, -4.0, 0.0), size=(16, 16))
    training, half = learn(scene, [camera]), camera.scaled(0.5)
    for name, factor in (("2dgs", 1.0), ("2dgs-matched", 0.5)):
        recipe = replace(RECIPES[name], samples=0.0)
        alpha = render(smooth(scene, training, recipe), half, recipe, training).alpha
        squared = 2 * 0.5 / factor**2  # the nearest pixel centres are half a px away in x and y
        assert alpha.max().item() == pytest.approx(
            scene.opacities.item() * torch.tensor(-squared / 2).exp().item(), rel=1e-3
        )

"""Pixel kernels against quadratures in float64 and published values; test_registered.py has the laws of every one."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from aaplug import PIXEL_KERNELS, RULES_3DGS, Camera, Gaussians, Limits, Pixels, Renderer, Splats2D
from aaplug.core.projection import project, rotation_matrices, with_depth_slopes
from aaplug.evaluation.laws.drawing import COARSE, require_bounds, some_splats
from aaplug.lab.integral import INTEGRAL
from aaplug.lab.surfel_mip import SURFEL_MIP
from aaplug.methods.pixel_kernels import point
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.methods.pixel_kernels.raster_rows import COLUMNS, OPACITY
from aaplug.methods.pixel_kernels.surfel import SURFEL
from aaplug.rasterizers.tiled import Tiled
from tests.conftest import ALL_RASTERIZERS, each, make_camera, make_scene, splats_of, straight_camera

F64 = torch.float64
BLACK, WHITE, SKY = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.25, 0.5, 1.0)
CAMERA = make_camera((1.0, -3.0, 0.5))


pixel = each(PIXEL_KERNELS)


def discs(n: int) -> Gaussians:
    """2D Gaussians: no thickness along their third axis."""
    scene = make_scene(n, dtype=F64)
    log_scales = scene.log_scales.clone()
    log_scales[:, 2] = -30.0
    return replace(scene, means=0.4 * scene.means, log_scales=log_scales)


def disc_splats(scene: Gaussians) -> Splats2D:
    return with_depth_slopes(project(scene, CAMERA), scene, CAMERA)


@pytest.mark.parametrize("rules", [RULES_3DGS, COARSE], ids=["3dgs", "coarse"])
def test_bounding_ellipses_contain_every_pixel_that_is_drawn_of_discs_at_their_horizons(pixel, rules):
    require_bounds(pixel, disc_splats(discs(100)), rules)


def quadrature(splats: Splats2D, offsets: Tensor) -> Tensor:
    """Mean of each Gaussian over a square of side `window`, turned to its eigenvectors, by Gauss-Legendre."""
    nodes, weights = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(40))
    square = 0.5 * splats.window * torch.cartesian_prod(nodes, nodes)
    xx, xy, yy = splats.covs.unbind(dim=1)
    covs = torch.stack([xx, xy, xy, yy], dim=1).unflatten(1, (2, 2))
    inverses, inside = torch.linalg.inv(covs), torch.einsum("cij,qj->qci", torch.linalg.eigh(covs)[1], square)
    total = torch.zeros_like(offsets[..., 0])
    for step, share in zip(inside, (weights[:, None] * weights / 4).flatten(), strict=True):
        at = offsets + step
        total = total + share * (-0.5 * torch.einsum("...ci,cij,...cj->...c", at, inverses, at)).exp()
    return total


@pytest.mark.parametrize("window", [0.3, 1.0])
def test_the_integral_kernel_is_the_mean_over_the_turned_window(window):
    """At pixels within four standard deviations and two pixels of each splat."""
    splats = replace(some_splats(60, (48, 64), (-1.2, 1.5)), window=window)
    places = 2 * torch.rand(12, 60, 2, generator=torch.Generator().manual_seed(5), dtype=F64) - 1
    offsets = places * (2 * splats.covs[:, [0, 2]].sqrt() + 1)
    torch.testing.assert_close(INTEGRAL.exact(splats, offsets), quadrature(splats, offsets), rtol=1e-9, atol=1e-12)


def on_disc(scene: Gaussians, sources: Tensor, camera: Camera) -> Callable[[Tensor], Tensor]:
    """Where the ray through each pixel (c, 2) meets its disc's plane, in the disc's standard deviations."""
    axes = rotation_matrices(scene.unit_quats[sources])
    from_camera = scene.means[sources] - camera.centre
    normals, scales = axes[:, :, 2], scene.scales[sources, :2]
    rotation = camera.cam_from_world[:3, :3]

    def local(pixels: Tensor) -> Tensor:
        x = (pixels[:, 0] - camera.cx) / camera.fx
        y = (pixels[:, 1] - camera.cy) / camera.fy
        rays = torch.stack([x, y, torch.ones_like(x)], dim=1) @ rotation
        along = (normals * from_camera).sum(1) / (normals * rays).sum(1)
        point = along[:, None] * rays - from_camera
        return torch.einsum("nij,ni->nj", axes, point)[:, :2] / scales

    return local


def test_a_disc_whose_centre_is_far_outside_of_the_image_is_drawn_where_rays_meet_it():
    """2DGS intersects every ray exactly: nothing is linearised at a place that is clamped to the widened image."""
    camera, half = straight_camera(32.0, (24, 18)), math.radians(60) / 2
    disc = replace(
        discs(1),
        means=torch.tensor([[3.0, 0.0, 4.0]], dtype=F64),
        quats=torch.tensor([[math.cos(half), 0.0, math.sin(half), 0.0]], dtype=F64),
        log_scales=torch.tensor([[0.0, 0.0, -30.0]], dtype=F64),
        logit_opacities=torch.tensor([3.0], dtype=F64),
        flat=True,
    )
    y, x = torch.meshgrid(*(torch.arange(side, dtype=F64) + 0.5 for side in camera.hw), indexing="ij")
    met = on_disc(disc, torch.zeros(x.numel(), dtype=torch.long), camera)(torch.stack([x, y], dim=2).flatten(0, 1))
    expected = (disc.opacities * torch.exp(-0.5 * met.square().sum(dim=1))).view_as(x)
    alpha = Renderer.of(disc, [camera], "2dgs", rasterizer="eager", min_seen=0.0)(camera).alpha
    assert expected.max() > 0.05
    torch.testing.assert_close(alpha, torch.where(expected < 1 / 255, 0.0, expected), rtol=0, atol=1e-5)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.4, -0.3), (2.0, -1.5)])
def test_surfel_kernels_are_values_where_rays_meet_the_discs(offset):
    """2DGS's low-passed value, and AA-2DGS's filter by the derivative of the intersection itself."""
    scene = discs(200)
    splats = disc_splats(scene)
    assert splats.depth_slopes is not None
    offsets = torch.tensor(offset, dtype=F64).expand(1, len(splats), 2)
    clear = (1 - splats.depth_slopes @ offsets[0, 0] > 0.05) & (splats.means.abs().amax(1) < 70)
    assert clear.sum() > 150
    local = on_disc(scene, splats.sources, CAMERA)
    pixels = splats.means + offsets[0]
    s = local(pixels)
    squared = torch.minimum(s.square().sum(1), 2 * offsets[0].square().sum(1))
    found = SURFEL.exact(splats, offsets)[0]
    torch.testing.assert_close(found[clear], (-0.5 * squared).exp()[clear], rtol=1e-6, atol=1e-9)

    steps = 1e-5 * torch.eye(2, dtype=F64)
    columns = [(local(pixels + step) - local(pixels - step)) / 2e-5 for step in steps]
    jacobian = torch.stack(columns, dim=2)
    widened = torch.eye(2, dtype=F64) + 0.1 * jacobian @ jacobian.mT
    exponent = torch.einsum("ni,nij,nj->n", s, torch.linalg.inv(widened), s)
    # 1e-8 under the root is AA-2DGS's own
    expected = (1 / torch.linalg.det(widened) + 1e-8).sqrt() * (-0.5 * exponent).exp()
    found = SURFEL_MIP.exact(splats, offsets)[0]
    torch.testing.assert_close(found[clear], expected[clear], rtol=1e-4, atol=1e-7)


# Analytic-Splatting with opacity 0.8: covariance, offset, and alpha exactly and at the centre
ANALYTIC = [
    ((0.36, 0.0, 0.36), (0.0, 0.0), 0.641368, 0.800000),
    ((0.36, 0.0, 0.36), (0.7, 0.2), 0.357462, 0.383178),
    ((1.0, 0.3, 0.5), (0.0, 0.0), 0.690872, 0.800000),
    ((1.0, 0.3, 0.5), (0.7, 0.2), 0.551579, 0.626087),
    ((0.05, 0.0, 0.05), (0.0, 0.0), 0.238748, 0.800000),
    ((0.05, 0.0, 0.05), (0.7, 0.2), 0.042402, 0.003993),
]


@pytest.mark.parametrize("rasterizer", ALL_RASTERIZERS.values(), ids=ALL_RASTERIZERS)
def test_pixel_kernels_have_the_published_values(rasterizer):
    for cov, offset, exact, at_centre in ANALYTIC:
        splats = splats_of(((4.5 - offset[0], 4.5 - offset[1]), cov, 1.0, 0.8, WHITE))
        expected = {INTEGRAL: exact, POINT: at_centre}
        for pixel, value in expected.items():
            alpha = rasterizer(splats, (8, 8), BLACK, pixel).alpha[4, 4].item()
            assert alpha == pytest.approx(value, abs=2e-6), pixel.name


def test_the_integral_of_a_small_splat_is_its_energy():
    splats = splats_of(((4.3, 4.6), (1e-6, 3e-7, 1e-6), 1.0, 0.9, WHITE))
    energy = 0.9 * 2 * math.pi * math.sqrt(1e-12 - 9e-14)
    many = replace(splats, opacities=splats.opacities * 1e5)
    alpha = Tiled()(many, (8, 8), BLACK, INTEGRAL).alpha
    assert alpha.sum().item() == pytest.approx(energy * 1e5, rel=1e-5)


def test_the_polynomial_of_compiled_loops_is_exp2(monkeypatch):
    exponents = torch.linspace(-12, 0, 100_001)[:, None]
    rows = torch.zeros(len(exponents), COLUMNS)
    rows[:, OPACITY] = exponents[:, 0] - point.LOG2_PADDING
    pixels = Pixels(torch.zeros(len(rows), 2), torch.zeros(1), torch.zeros(1))
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    compiled = POINT.alpha(rows, pixels, Limits.by(RULES_3DGS))
    exact = torch.exp2(exponents.double())
    above = exponents >= Limits.by(RULES_3DGS).log2_min_alpha
    assert compiled[~above].eq(0).all()
    relative = compiled[above].double() / exact[above] - 1
    assert relative.abs().max() < 4e-6

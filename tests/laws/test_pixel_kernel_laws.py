"""Laws of every pixel kernel and every compositor, and aaplug's own kernels against quadratures in float64."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.ellipses import squared_cutoff, whitening
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Pixels
from aaplug.core.kernels import EAGER
from aaplug.core.projection import project, rotation_matrices, with_depth_slopes
from aaplug.core.rules import RULES_3DGS, Rules
from aaplug.core.splats import Splats2D
from aaplug.lab.integral import INTEGRAL
from aaplug.lab.surfel_mip import SURFEL_MIP
from aaplug.methods import COMPOSITORS, PIXEL_KERNELS
from aaplug.methods.pixel_kernels import point
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.methods.pixel_kernels.raster_rows import BLUE, COLUMNS, OPACITY, RED, TILE, tile_centres
from aaplug.methods.pixel_kernels.surfel import SURFEL
from aaplug.rasterizers.reference import Reference, alphas
from aaplug.rasterizers.tiled import Tiled
from aaplug.rasterizers.tiled.forward import STEP
from tests.conftest import ALL_RASTERIZERS, each, make_camera, make_scene, make_splats, splats_of

F64 = torch.float64
BLACK, WHITE, SKY = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.25, 0.5, 1.0)
CAMERA = make_camera((1.0, -3.0, 0.5))
COARSE = Rules(max_alpha=0.9, min_alpha=0.02, min_transmittance=1e-2)


pixel = each(PIXEL_KERNELS)
compositor = each(COMPOSITORS)


def some_splats(
    m: int, hw: tuple[int, int], log_sigmas: tuple[float, float] = (-1.5, 2.5), window: float = 1.0
) -> Splats2D:
    """Random splats that every kernel can draw, with depth slopes.

    Their horizons lie outside the image: at a disc's horizon AA-2DGS's filter is not small, and the tiled rasterizer
    does not draw it there.
    """
    splats = make_splats(m, hw, 8, log_sigmas).to(F64)
    xx, xy, yy = splats.covs.unbind(dim=1)
    slopes = 0.07 * torch.randn(m, 2, generator=torch.Generator().manual_seed(3), dtype=F64)
    slopes = (slopes / splats.covs[:, [0, 2]].sqrt()).clamp(-0.012, 0.012)
    return replace(splats, dets=xx * yy - xy * xy, depth_slopes=slopes, window=window)


def discs(n: int) -> Gaussians:
    """2D Gaussians: no thickness along their third axis."""
    scene = make_scene(n, dtype=F64)
    log_scales = scene.log_scales.clone()
    log_scales[:, 2] = -30.0
    return replace(scene, means=0.4 * scene.means, log_scales=log_scales)


def disc_splats(scene: Gaussians) -> Splats2D:
    return with_depth_slopes(project(scene, CAMERA), scene, CAMERA)


def away_from_cutoff(alpha: Tensor, rules: Rules, band: float = 1e-3) -> Tensor:
    return (alpha / rules.min_alpha - 1).abs() > band


# laws of every kernel ---------------------------------------------------------------------------


@pytest.mark.parametrize("compiling", [False, True], ids=["eager code", "code for the compiler"])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("window", [0.0, 0.6, 1.0])
@pytest.mark.parametrize("rules", [RULES_3DGS, COARSE], ids=["3dgs", "coarse"])
def test_alpha_from_raster_rows_is_the_exact_one(pixel, rules, window, dtype, compiling, monkeypatch):
    splats = some_splats(60, (3 * TILE, 4 * TILE), window=window)
    given = splats.to(dtype)
    corners = torch.cartesian_prod(torch.arange(4), torch.arange(3)).to(dtype) * TILE
    centres = torch.stack(tile_centres(corners), dim=1)
    rows = pixel.raster_rows(given, EAGER)[:-1, None].expand(-1, len(corners), -1)
    if compiling:
        monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    alpha = pixel.alpha(rows, Pixels(corners, *centres.unbind(dim=1)), rules)
    points = (corners[:, None] + centres).flatten(0, 1).double()
    exact = pixel.exact(splats, points[:, None] - splats.means) * splats.opacities
    exact = exact.T.unflatten(1, alpha.shape[1:])
    expected = torch.where(exact >= rules.min_alpha, exact, 0.0)
    compared = away_from_cutoff(exact, rules)
    difference = (alpha.double() - expected).abs()[compared].max()
    assert (expected > 0).sum() > 1000
    # the compiler's exp2 is a polynomial with a relative error of 1e-6
    assert difference < (2e-5 if dtype == torch.float32 else 2e-6 if compiling else 1e-9)


def test_the_padding_row_draws_nothing_and_rows_hold_the_colours(pixel):
    splats = some_splats(9, (TILE, TILE))
    assert splats.rgb is not None
    rows = pixel.raster_rows(splats, EAGER)
    assert rows.shape == (10, pixel.columns)
    torch.testing.assert_close(rows[:-1, RED : BLUE + 1], splats.rgb)
    pixels = Pixels(torch.tensor([[0.0, 0.0], [8.0, 800.0]], dtype=F64), *tile_centres(rows))
    assert (pixel.alpha(rows[:-1, None].expand(-1, 2, -1), pixels, RULES_3DGS) > 0).any()
    assert pixel.alpha(rows[-1:].expand(2, -1), pixels, RULES_3DGS).eq(0).all()


@pytest.mark.parametrize("rules", [RULES_3DGS, COARSE], ids=["3dgs", "coarse"])
def test_bounding_ellipses_contain_every_pixel_that_is_drawn(pixel, rules):
    for splats in (some_splats(100, (48, 64)), disc_splats(discs(100))):
        ellipses = pixel.bounding_ellipses(splats, rules) or splats
        ticks = [torch.arange(-20, side + 20, 2.3, dtype=F64) for side in (64, 48)]
        points = torch.cartesian_prod(*ticks)
        meets_horizon = ellipses.opacities == 0  # such discs are not drawn
        drawn = (alphas(splats, points, pixel, rules) >= rules.min_alpha) & ~meets_horizon
        offsets = points[:, None] - ellipses.means
        white = torch.einsum("cij,pcj->pci", whitening(ellipses), offsets)
        cutoff = squared_cutoff(ellipses.opacities, rules.min_alpha)
        inside = white.square().sum(dim=2) <= cutoff * (1 + 1e-9)
        assert drawn.sum() > 1000
        assert not (drawn & ~inside).any()


def test_a_pass_is_whole_steps(pixel):
    assert pixel.splats_per_pass % STEP == 0


@pytest.mark.parametrize("window", [0.0, 1.0])
def test_tiled_equals_the_reference_with_every_kernel(pixel, window):
    hw = (33, 44)
    splats = some_splats(250, hw, (-3.0, 3.0), window)
    tiled, exact = (draw(splats, hw, SKY, pixel) for draw in (Tiled(), Reference()))
    torch.testing.assert_close(tiled.rgb, exact.rgb, rtol=0, atol=1e-9)
    single = Tiled()(splats.to(torch.float32), hw, SKY, pixel)
    difference = (single.rgb - exact.rgb).abs().amax(dim=2)
    assert (difference > 2e-5).double().mean() < 1e-3, "more than flips at a cut-off"
    assert difference.max() < 0.01


def test_gradients_with_every_kernel_are_those_of_the_reference(pixel):
    """With determinants made of the covariances: kernels may read either."""
    hw = (17, 26)
    splats = some_splats(120, hw)
    names = ["means", "covs", "opacities", "rgb"]
    names += ["depth_slopes"] if pixel.needs_depth_slopes else []
    found = []
    for rasterizer in (Tiled(), Reference()):
        values = {name: getattr(splats, name).clone().requires_grad_() for name in names}
        xx, xy, yy = values["covs"].unbind(dim=1)
        given = replace(splats, **values, dets=xx * yy - xy * xy)
        image = rasterizer(given, hw, BLACK, pixel)
        loss = image.rgb.square().sum() + image.alpha.sum()
        found.append(torch.autograd.grad(loss, list(values.values())))
    for tiled, exact in zip(*found, strict=True):
        assert exact.abs().max() > 0
        torch.testing.assert_close(tiled, exact, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("window", [0.0, 0.6, 1.0])
def test_tiled_equals_the_reference_with_every_compositor(compositor, dtype, window):
    hw = (33, 44)
    splats = some_splats(250, hw, (-3.0, 3.0), window).to(dtype)
    tiled, exact = (draw(splats, hw, SKY, INTEGRAL, compositor) for draw in (Tiled(), Reference()))
    difference = (tiled.rgb - exact.rgb).abs().amax(dim=2)
    assert (difference > 2e-5).double().mean() < 1e-3, "more than flips at a cut-off"
    assert difference.max() < 0.01


# the kernels of aaplug against independent integrals --------------------------------------------


def gaussians_at(offsets: Tensor, splats: Splats2D) -> Tensor:
    """exp(-dᵀ C⁻¹ d / 2) at offsets (..., c, 2), by the inverse of the matrix."""
    xx, xy, yy = splats.covs.unbind(dim=1)
    inverse = torch.linalg.inv(torch.stack([xx, xy, xy, yy], dim=1).unflatten(1, (2, 2)))
    return (-0.5 * torch.einsum("...ci,cij,...cj->...c", offsets, inverse, offsets)).exp()


def quadrature(splats: Splats2D, offsets: Tensor, turned: bool, points: int = 40) -> Tensor:
    """Mean of each Gaussian over a square of side `window` by Gauss-Legendre; `turned` to the eigenvectors."""
    nodes, weights = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(points))
    square = 0.5 * splats.window * torch.cartesian_prod(nodes, nodes)
    weight = (weights[:, None] * weights / 4).flatten()
    axes = torch.eye(2, dtype=F64).expand(len(splats), 2, 2)
    if turned:
        xx, xy, yy = splats.covs.unbind(dim=1)
        axes = torch.linalg.eigh(torch.stack([xx, xy, xy, yy], dim=1).unflatten(1, (2, 2)))[1]
    inside = torch.einsum("cij,qj->qci", axes, square)
    total = torch.zeros_like(offsets[..., 0])
    for step, share in zip(inside, weight, strict=True):
        total = total + share * gaussians_at(offsets + step, splats)
    return total


@pytest.fixture
def places() -> tuple[Splats2D, Tensor]:
    """Splats, and offsets of pixels within four standard deviations and two pixels of them."""
    splats = some_splats(60, (48, 64), (-1.2, 1.5))
    g = torch.Generator().manual_seed(5)
    spread = 2 * splats.covs[:, [0, 2]].sqrt() + 1
    return splats, (2 * torch.rand(12, 60, 2, generator=g, dtype=F64) - 1) * spread


def test_the_point_kernel_is_the_value_at_the_centre(places):
    splats, offsets = places
    torch.testing.assert_close(POINT.exact(splats, offsets), gaussians_at(offsets, splats))


@pytest.mark.parametrize("window", [0.3, 1.0])
def test_the_integral_kernel_is_the_mean_over_the_turned_window(places, window):
    splats, offsets = replace(places[0], window=window), places[1]
    expected = quadrature(splats, offsets, turned=True)
    torch.testing.assert_close(INTEGRAL.exact(splats, offsets), expected, rtol=1e-9, atol=1e-12)


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
    compiled = POINT.alpha(rows, pixels, RULES_3DGS)
    exact = torch.exp2(exponents.double())
    above = exponents >= RULES_3DGS.log2_min_alpha
    assert compiled[~above].eq(0).all()
    relative = compiled[above].double() / exact[above] - 1
    assert relative.abs().max() < 4e-6

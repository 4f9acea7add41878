"""Splats: projection, blurring on the screen and smoothing in the world: published values, needles and extremes.

test_golden.py has projection's formulas, test_gsplat.py those of gsplat and of harmonics.
"""

import math
from dataclasses import replace
from decimal import Decimal, localcontext

import pytest
import torch
from scipy.spatial.transform import Rotation

from aaplug import RULES_3DGS, Rules, Splats2D
from aaplug.core import shading
from aaplug.core.convolution import smoothed_by, volume_log_factor
from aaplug.core.ellipses import cull, whitening
from aaplug.core.gaussians import MIN_OPACITY, Gaussians, scale_opacities
from aaplug.core.projection import project, with_ray_slopes
from aaplug.core.shading import shade
from tests.conftest import make_camera, make_scene, make_splats, moved, splats_of, straight_camera

F64 = torch.float64


def splat(xx: float, xy: float, yy: float, opacity: float = 1.0, dtype=F64) -> Splats2D:
    return splats_of(((10.0, 20.0), (xx, xy, yy), 1.0, opacity, (1.0, 1.0, 1.0))).to(dtype)


VECTORS = [
    ((4.0, 0.0, 4.0), 0.975610, 0.930233, 0.930233),
    ((1.0, 0.3, 0.5), 0.848114, 0.656947, 0.656947),
    ((0.05, 0.0, 0.05), 0.333327, 0.142860, 0.142857),
    ((0.5, 0.0, 1e-4), 0.028870, 0.014466, 0.014431),
    ((0.01, 0.0, 0.01), 0.090911, 0.032273, 0.032258),
]


@pytest.mark.parametrize(("covariance", "mip", "mip_wide", "floored"), VECTORS)
def test_compensation_equals_the_published_values(covariance, mip, mip_wide, floored):
    # Mip-Splatting takes √(det₀ / (det₁ + 1e-6) + 1e-6); without both 1e-6 the square is off by no more than this
    for variance, published in ((0.1, mip), (0.3, mip_wide)):
        blurred = splat(*covariance).blurred(variance, compensate=True)
        square = blurred.opacities.item() ** 2
        regularised = 1e-6 * (1 + square / blurred.dets.item())
        rounding = 2 * published * 5e-7
        assert abs(square - published**2) <= regularised + rounding
    factor = splat(*covariance).blurred(0.3, compensate=True).opacities.item()
    assert factor == pytest.approx(floored, abs=5e-7)


def test_compensation_has_a_floor():
    # Mip-Splatting drops this one: its determinant of 1e-6 hits a floor there
    speck = splat(1e-3, 0.0, 1e-3)
    assert speck.blurred(0.3, compensate=True).opacities.item() == 0.005
    assert speck.blurred(0.1, compensate=True).opacities.item() == pytest.approx(1e-3 / 0.101)
    assert speck.blurred(0.3, True, floor=0.0).opacities.item() == pytest.approx(1e-3 / 0.301)


def test_blurring_takes_a_variance_for_each_splat():
    splats = make_splats(4, (32, 32)).to(F64)
    variances = torch.tensor([0.0, 0.1, 2.0, 30.0], dtype=F64)
    together = splats.blurred(variances, compensate=True)
    for i, variance in enumerate(variances.tolist()):
        alone = splats[i : i + 1].blurred(variance, compensate=True)
        for name in ("covs", "dets", "opacities"):
            torch.testing.assert_close(getattr(together, name)[i : i + 1], getattr(alone, name))


@pytest.mark.parametrize(("long", "thin"), [(200.0, 0.1), (200.0, 0.01), (2000.0, 0.01)])
def test_compensation_of_needles_is_exact_in_float32(long, thin):
    dets = (long**2 + 0.3) * (thin**2 + 0.3)
    for angle in torch.linspace(0, math.pi, 181).tolist():
        a = math.cos(angle) * long, -math.sin(angle) * thin
        b = math.sin(angle) * long, math.cos(angle) * thin
        needle = splat(*(p[0] * q[0] + p[1] * q[1] for p, q in ((a, a), (a, b), (b, b))))
        needle = replace(needle, dets=torch.tensor([(long * thin) ** 2], dtype=F64)).to(torch.float32)
        blurred = needle.blurred(0.3, compensate=True)
        assert blurred.dets.item() == pytest.approx(dets, rel=1e-6)
        assert blurred.opacities.item() == pytest.approx(long * thin / math.sqrt(dets), rel=1e-6)


@pytest.mark.parametrize("factor", ["dets", "opacities"])
def test_a_splat_of_no_area_has_finite_gradients_when_blurred(factor):
    point = splat(0.0, 0.0, 0.0)
    inputs = point.covs.requires_grad_(), point.dets.requires_grad_()
    blurred = replace(point, covs=inputs[0], dets=inputs[1]).blurred(0.3, compensate=True)
    gradients = torch.autograd.grad(getattr(blurred, factor).sum(), inputs, allow_unused=True)
    assert all(g.isfinite().all() for g in gradients if g is not None)


def test_whitening_is_a_square_root_of_the_inverse_covariance():
    splats = make_splats(50, (32, 32), log_sigmas=(-2.0, 4.0)).to(F64)
    xx, xy, yy = splats.covs.unbind(dim=1)
    splats = replace(splats, dets=xx * yy - xy * xy)
    inverse = torch.stack([yy, -xy, -xy, xx], dim=1) / splats.dets[:, None]
    white = whitening(splats)
    torch.testing.assert_close((white.mT @ white).flatten(1), inverse, rtol=1e-9, atol=1e-12)
    assert not white[:, 1, 0].any()  # pixel kernels leave that product out


@pytest.mark.parametrize("covariance", [(4.0, 0.0, 0.0), (0.0, 0.0, 4.0), (1e12, 0.0, 1e-12)])
def test_whitening_of_an_ellipse_without_width_is_finite(covariance):
    tiny = torch.finfo(torch.float32).tiny
    edge = splat(*covariance, dtype=torch.float32)
    assert whitening(replace(edge, dets=edge.dets.clamp(min=tiny))).isfinite().all()


@pytest.mark.parametrize(("x", "y"), [(-0.9, 5.0), (40.9, 5.0), (5.0, -0.9), (5.0, 20.9)])
def test_culling_keeps_splats_that_reach_into_the_image(x, y):
    side = 1 / (2 * math.log(255))  # variance of a splat that reaches 1 px
    middle = torch.tensor([20.0, 10.0], dtype=F64)
    for distance, count in ((0.0, 1), (1.0, 1), (1.02, 0)):
        means = middle + distance * (torch.tensor([[x, y]], dtype=F64) - middle)
        assert len(cull(replace(splat(side, 0.0, side), means=means), (20, 40))) == count


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_culling_drops_splats_that_cannot_be_drawn_and_keeps_an_opacity_of_exactly_1_255(dtype):
    faintest, nan = splat(4.0, 0.0, 4.0, opacity=1 / 255, dtype=dtype), math.nan
    assert len(cull(faintest, (40, 40))) == 1
    columns = {"opacities": [[0.0039], [0.0], [nan]], "dets": [[0.0]], "means": [[[nan, 1.0]]]}
    for name, values in (columns | {"covs": [[[nan, 0.0, 1.0]]]}).items():
        for value in values:
            assert not len(cull(replace(faintest, **{name: torch.tensor(value, dtype=dtype)}), (40, 40))), value


@pytest.mark.parametrize("scale", [1e-3, 1e-7, 3e-8, 1e-8, 1e-12, 1e-20, 1e-30])
@pytest.mark.parametrize("ratio", [1e-3, 0.1, 1.0, 2.0, 1e4, 1e30])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_the_volume_factor_is_exact_for_scales_of_any_size_and_so_is_its_gradient(scale, ratio, dtype):
    log_scales = torch.full((1, 3), math.log(scale), dtype=dtype, requires_grad=True)
    factor = volume_log_factor(log_scales, torch.tensor([[math.log(scale * ratio)]], dtype=dtype))
    rounding = 1e-12 if dtype == F64 else 1e-4  # ln 1e-30 is −69, known to 8e-6 in float32
    assert factor.item() == pytest.approx(-1.5 * math.log1p(ratio**2), rel=rounding)
    (gradient,) = torch.autograd.grad(factor.sum(), log_scales)
    torch.testing.assert_close(gradient, torch.full_like(gradient, ratio**2 / (1 + ratio**2)), rtol=rounding, atol=0)


@pytest.mark.parametrize("axes", [[1.0], [1.0, 0.5, 2.0]], ids=["alike", "each its own"])
def test_smoothing_adds_variances(axes):
    scene = make_scene(50, dtype=F64)
    sigma = torch.linspace(0.01, 1, 50, dtype=F64)[:, None] * torch.tensor(axes, dtype=F64)
    smoothed = smoothed_by(scene, sigma.log(), volume=True)
    variances = scene.scales.square() + sigma.square()
    torch.testing.assert_close(smoothed.scales.square(), variances)
    ratio = scene.scales.prod(dim=1) / smoothed.scales.prod(dim=1)
    torch.testing.assert_close(smoothed.opacities, (scene.opacities * ratio).clamp(min=MIN_OPACITY))
    assert smoothed_by(scene, sigma.log(), volume=False).logit_opacities is scene.logit_opacities


@pytest.mark.parametrize("log_scale", [-70.0, -28.0, -5.0, 0.0, 30.0])
@pytest.mark.parametrize("log_sigma", [-70.0, -28.0, -5.0, 0.0, 30.0])
def test_the_smoothed_scale_is_finite_and_the_larger_of_both_where_they_differ(log_scale, log_sigma):
    scene = replace(make_scene(1), log_scales=torch.full((1, 3), log_scale))
    smoothed = smoothed_by(scene, torch.tensor([[log_sigma]]), volume=True)
    expected = max(log_scale, log_sigma) + (0.5 * math.log(2) if log_scale == log_sigma else 0)
    assert smoothed.log_scales[0].tolist() == pytest.approx([expected] * 3, rel=1e-4, abs=1e-4)
    assert smoothed.logit_opacities.isfinite().all()


def scaled_logit(logit: float, factor: float, most: float) -> float:
    """logit(o·c), o·c held in [MIN_OPACITY, most], in decimal numbers of 80 digits."""
    with localcontext(prec=80):
        opacity = Decimal(factor) / (1 + Decimal(-logit).exp())
        opacity = min(max(opacity, Decimal(MIN_OPACITY)), Decimal(most))
        return float((opacity / (1 - opacity)).ln())


@pytest.mark.parametrize("logit", [-100.0, -20.0, -5.5, -1.0, 0.0, 1.0, 5.0, 12.0, 20.0, 100.0])
@pytest.mark.parametrize("factor", [1e-30, 1e-6, 0.005, 0.5, 0.999, 1 - 2**-20, 2])
@pytest.mark.parametrize("most", [1 - MIN_OPACITY, 0.9999])
def test_scaled_opacities_are_exact_near_0_and_near_1(logit, factor, most):
    for dtype, tolerance in ((F64, 1e-8), (torch.float32, 1e-4 if most < 0.99999 else 1e-2)):
        log_factor = torch.tensor([math.log(factor)], dtype=dtype)
        logits = scale_opacities(torch.tensor([logit], dtype=dtype), log_factor, most)
        assert logits.item() == pytest.approx(scaled_logit(logit, factor, most), abs=tolerance, rel=tolerance)


def test_a_factor_of_one_changes_no_bit_of_an_opacity():
    logits = torch.tensor([-math.inf, -100.0, -20.0, -0.3, 0.0, 17.0, 20.0, 100.0, math.inf])
    assert scale_opacities(logits, torch.zeros(9)).equal(logits)


def test_scaled_opacities_are_finite():
    logits = torch.tensor([-math.inf, -100.0, 0.0, 100.0, math.inf])
    for log_factor in (-math.inf, -100.0, -1e-7, 1e-7, 100.0):
        scaled = scale_opacities(logits, torch.full((5,), log_factor))
        assert scaled.isfinite().all()
        assert scaled.sigmoid().min() >= MIN_OPACITY * (1 - 1e-5)
        assert scaled.sigmoid().max() < 1


def test_scaled_opacities_have_the_gradient_of_their_formula():
    logits = torch.linspace(-6, 6, 13, dtype=F64, requires_grad=True)
    log_factor = torch.linspace(-3, -0.01, 13, dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(scale_opacities, (logits, log_factor))


@pytest.mark.parametrize("near", [0.01, RULES_3DGS.near, 2.0])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_what_lies_beyond_the_near_plane_is_drawn_and_the_plane_itself_is_not(dtype, near):
    scene = make_scene(5, dtype=dtype)
    depths = torch.tensor([near, 1.001 * near, -1.0, 0.0, 3.0], dtype=dtype)
    scene = replace(scene, means=torch.nn.functional.pad(depths[:, None], (2, 0)))
    splats = project(scene, straight_camera(), rules=Rules(near=near))
    assert splats.sources.tolist() == [1, 4]
    torch.testing.assert_close(splats.depths, depths[[1, 4]])
    torch.testing.assert_close(splats.opacities, scene.opacities[[1, 4]])


def needles(n: int, long: float, thin: float) -> Gaussians:
    """Needles of `long` × `thin` px, in random orientations but never end-on, near the axis of a straight camera."""
    g = torch.Generator().manual_seed(0)
    turn, tilt = torch.rand(2, n, generator=g, dtype=F64)
    # a tilt about the needle's own y, then a turn about the optical axis
    rotations = Rotation.from_euler("ZY", torch.stack([math.pi * turn, 2 * tilt - 1], dim=1).numpy())
    quats = torch.from_numpy(rotations.as_quat()).roll(1, dims=1)
    means = torch.nn.functional.pad(torch.randn(n, 2, generator=g, dtype=F64), (0, 1), value=5.0)
    scales = torch.tensor([long, thin, thin], dtype=F64) * 5.0 / 100
    return Gaussians(means, quats, scales.log().expand(n, 3), torch.zeros_like(turn), torch.zeros(n, 1, 3, dtype=F64))


@pytest.mark.parametrize(("long", "thin"), [(200.0, 0.1), (200.0, 0.01), (2000.0, 0.01)])
def test_the_determinant_of_a_needle_is_exact_in_float32(long, thin):
    scene, camera = needles(500, long, thin).to(torch.float32), straight_camera()
    single, exact = project(scene, camera), project(scene.to(F64), camera)
    from_covariance = single.covs[:, 0] * single.covs[:, 2] - single.covs[:, 1].square()
    lost = (from_covariance.double() / exact.dets - 1).abs()
    assert lost.median() > 1e-3, "the plain formula should fail for a needle this thin"
    error = (single.dets.double() / exact.dets - 1).abs()
    assert error.max() < 1e-5


def test_the_determinant_of_a_disc_seen_edge_on_is_not_negative():
    columns = {"means": [[0.0, 0.0, 2.0]], "quats": [[1.0, 0.0, 0.0, 0.0]], "log_scales": [[0.0, -46.0, 0.0]]}
    scene = replace(make_scene(1), **{name: torch.tensor(column) for name, column in columns.items()})
    splats = project(scene, straight_camera())
    assert splats.dets.item() >= 0
    assert splats.covs.isfinite().all()


def test_a_scene_far_from_the_origin_projects_as_if_it_were_near():
    offset = torch.tensor([2.0**22, -(2.0**22), 2.0**22], dtype=F64)
    scene, camera = make_scene(50, dtype=F64), make_camera((0.13, -4.07, 0.21))
    scene = replace(scene, means=scene.means.mul(2).round().div(2)).to(torch.float32)
    far = replace(scene, means=(scene.means.double() + offset).float())
    assert (far.means.double() - offset).equal(scene.means.double()), "halves are exact out there"
    away = moved(camera, offset)
    there, here = project(far, away), project(scene, camera)
    torch.testing.assert_close(there.means, here.means, rtol=1e-5, atol=1e-4)
    torch.testing.assert_close(there.covs, here.covs, rtol=1e-4, atol=1e-4)
    shaded = shade(there, far, away), shade(here, scene, camera)
    torch.testing.assert_close(shaded[0].rgb, shaded[1].rgb, rtol=1e-5, atol=1e-5)


def test_shading_in_chunks_gives_the_same_colours(monkeypatch):
    scene, camera = make_scene(50, degree=3), make_camera()
    splats, sh = project(scene, camera), scene.sh.clone().requires_grad_()
    whole = shade(splats, replace(scene, sh=sh), camera).rgb
    [gradient] = torch.autograd.grad(whole.square().sum(), [sh])
    monkeypatch.setattr(shading, "SPLATS_PER_CALL", 7)
    assert len(splats.sources) > 7
    parts = shade(splats, replace(scene, sh=sh), camera).rgb
    assert parts.equal(whole)
    assert torch.autograd.grad(parts.square().sum(), [sh])[0].equal(gradient)


def test_ray_slopes_are_those_of_the_mean_depth_behind_a_pixel():
    """Depth given the pixel, of the Gaussian of the linear projection's pixel and depth, from all its covariances."""
    scene, camera = make_scene(1, seed=3, dtype=F64), straight_camera()
    scene = replace(scene, means=torch.tensor([[0.3, -0.2, 4.0]], dtype=F64))
    x, y, z = scene.means[0].tolist()
    across, down = (camera.fx / z, 0, -camera.fx * x / z**2), (0, camera.fy / z, -camera.fy * y / z**2)
    both = torch.tensor([across, down, (0, 0, 1)], dtype=F64)
    axes = torch.from_numpy(Rotation.from_quat(scene.quats[0].roll(-1)).as_matrix()) * scene.scales[0]
    joint = both @ axes @ axes.T @ both.T
    joint[:2, :2] += 0.3 * torch.eye(2, dtype=F64)
    splats = with_ray_slopes(project(scene, camera).blurred(0.3, compensate=False), scene, camera)
    expected = torch.linalg.solve(joint[:2, :2], joint[:2, 2])
    assert expected.abs().min() > 1e-4
    torch.testing.assert_close(splats.ray_slopes[0], expected, rtol=1e-9, atol=0)

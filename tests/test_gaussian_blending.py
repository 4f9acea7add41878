"""Gaussian Blending: its moments are integrals, its window follows the light that is left, and extremes are sound."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from aaplug import RASTERIZERS, RULES_3DGS, Limits, Rules, Splats2D
from aaplug.lab.gaussian_blending import (
    MAX_POINT_SPAN,
    MIN_WINDOW_VARIANCE,
    GaussianBlending,
    Light,
    behind,
    light_of,
    moments,
)
from aaplug.lab.integral import INTEGRAL
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.rasterizers.reference import Reference
from aaplug.rasterizers.tiled import Tiled
from tests.conftest import ALL_RASTERIZERS, make_splats, splats_of

F64 = torch.float64
NODES = 20_001
BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
BLENDING = GaussianBlending()
WIDE = (1e4, 0.0, 1e4)  # px²: of a splat that is even over a pixel


@pytest.mark.parametrize(("dtype", "near"), [(F64, 2e-4), (torch.float32, 3e-3)])
@pytest.mark.parametrize("half", [0.05, 0.29, 0.31, 1.0, 4.0])
@pytest.mark.parametrize("u", [0.0, 0.7, -2.5, 3.3])
def test_moments_are_integrals(u, half, dtype, near):
    """Squares to `near` of a window's own; further from the splat than 3.3 standard deviations nothing is seen."""
    x = half * torch.linspace(-1, 1, NODES, dtype=F64)
    density = (-0.5 * (u + x) ** 2).exp()
    mass = torch.trapezoid(density, x)
    mean, square = (torch.trapezoid(density * x**power, x) / mass for power in (1, 2))
    found = moments(torch.tensor([u], dtype=dtype), torch.tensor([half], dtype=dtype))
    assert found.value.item() == pytest.approx(mass.item() / (2 * half), rel=near)
    assert found.mean.item() == pytest.approx(mean.item(), abs=near * half)
    assert found.square.item() == pytest.approx(square.item(), abs=near * half**2)
    assert found.centre.item() == pytest.approx(math.exp(-0.5 * u * u), rel=near)


def after(*splats: tuple, window: float = 1.0, dtype: torch.dtype = F64) -> tuple[Light, Tensor]:
    """The light behind splats at the pixel whose centre is the origin, and their raster rows."""
    rows = BLENDING.rows(replace(splats_of(*splats).to(dtype), window=window))
    origin = torch.zeros(1, 1, dtype=dtype)
    light = light_of(origin, window)
    for row in rows[:-1]:
        light = behind(light, row[None], origin, origin, Limits.by(RULES_3DGS))
    return light, rows


@pytest.mark.parametrize("cov", [(0.3, 0.0, 0.05), (0.2, 0.05, 0.4), (0.02, 0.01, 0.03)])
def test_the_window_has_the_moments_of_the_light_that_is_left(cov):
    """Against sums over a fine grid, turned to the splat's axes as the window is."""
    (ux, uy, vx, vy, *_), opacity = after(((0.3, -0.2), cov, 1.0, 0.8, WHITE))[1][0].tolist(), 0.8
    u_px, v_px = math.hypot(ux, uy), math.hypot(vx, vy)
    ticks = (torch.arange(400, dtype=F64) + 0.5) / 400 - 0.5
    p, q = (t.flatten() for t in torch.meshgrid(ticks, ticks, indexing="ij"))
    x, y = (ux * p / u_px + vx * q / v_px), (uy * p / u_px + vy * q / v_px)
    u, v = ux * (x - 0.3) + uy * (y + 0.2), vx * (x - 0.3) + vy * (y + 0.2)
    left = 1 - opacity * (-0.5 * (u * u + v * v)).exp()
    light, _ = after(((0.3, -0.2), cov, 1.0, opacity, WHITE))
    assert light.share.item() == pytest.approx(left.mean().item(), abs=1e-5)
    for centre, side, position, along in ((light.x, light.width, x, p), (light.y, light.height, y, q)):
        middle, mean = (((left * at).mean() / left.mean()).item() for at in (position, along))
        variance = (left * (along - mean) ** 2).mean() / left.mean()
        assert centre.item() == pytest.approx(middle, abs=1e-5)
        assert side.item() == pytest.approx((12 * variance.item()) ** 0.5, abs=1e-5)


def test_a_window_is_no_narrower_than_its_least_variance():
    light, _ = after(((0.0, 0.0), (0.25, 0.0, 0.25), 1.0, 0.5, WHITE), window=0.08)
    assert light.width.item() == pytest.approx((12 * MIN_WINDOW_VARIANCE) ** 0.5)


def test_a_window_that_spans_little_of_a_splat_is_a_point_and_stays():
    sigma = 1 / (0.99 * MAX_POINT_SPAN)
    light, _ = after(((3.0, 0.0), (sigma**2, 0.0, 0.01), 1.0, 0.5, WHITE))
    assert light.share.item() == pytest.approx(1 - 0.5 * math.exp(-0.5 * (3 / sigma) ** 2))
    assert [x.item() for x in light[1:5]] == [0, 0, 1, 1]
    moved, _ = after(((3.0, 0.0), ((0.9 * sigma) ** 2, 0.0, 0.01), 1.0, 0.5, WHITE))
    assert moved.height.item() != 1


def test_a_pixel_stops_behind_the_splat_that_ends_it():
    rules = Rules(min_transmittance=0.05)
    rows = [((4.5, 4.5), WIDE, 1.0 + i, o, WHITE) for i, o in enumerate((0.9, 0.6, 0.4))]
    for rasterizer in (Tiled(), Reference()):
        image = rasterizer(splats_of(*rows), (9, 9), BLACK, INTEGRAL, BLENDING, rules)
        assert image.alpha[4, 4].item() == pytest.approx(0.96, abs=1e-3)  # 3DGS: 0.9


def leak(compositor: GaussianBlending | None) -> float:
    """Transmittance of a pixel whose halves are each covered by a wide opaque splat."""
    covs = (0.02, 0.0, 25.0)
    splats = splats_of(((4.25, 4.5), covs, 1.0, 0.99, WHITE), ((4.75, 4.5), covs, 2.0, 0.99, WHITE))
    render = RASTERIZERS["eager"](replace(splats, window=1.0), (9, 9), BLACK, INTEGRAL, compositor)
    return 1 - render.alpha[4, 4].item()


def test_splats_side_by_side_let_less_light_through_than_independent_ones():
    apart = 1 - 2 * (1 - math.sqrt(leak(None)))  # each hides its own share of the pixel
    assert apart < leak(BLENDING) < 0.96 * leak(None)


def test_a_window_of_no_size_gives_point_samples():
    splats = splats_of(((4.2, 4.6), (0.5, 0.2, 0.4), 1.0, 0.7, WHITE), ((4.4, 3.9), (2.0, 0.0, 1.0), 2.0, 0.9, WHITE))
    draw = RASTERIZERS["eager"]
    point = draw(splats, (9, 9), BLACK, POINT)
    blended = draw(replace(splats, window=0.0), (9, 9), BLACK, INTEGRAL, BLENDING)
    torch.testing.assert_close(blended.alpha, point.alpha, rtol=1e-5, atol=1e-6)


EXTREMES = {
    "tiny": ((20.3, 12.6), (1e-4, 0.0, 1e-4), 1.0, 1.0, WHITE),
    "a needle": ((20.5, 12.5), (900.0, 0.0, 1e-6), 1.0, 1.0, WHITE),
    "a slanted needle": ((20.5, 12.5), (450.0, 449.999, 450.0), 1.0, 1.0, WHITE),
    "huge": ((1e3, -1e3), (1e9, 0.0, 1e9), 1.0, 1.0, WHITE),
    "round": ((20.5, 12.5), (2.0, 0.0, 2.0), 1.0, 1.0, WHITE),
    "off the screen": ((1e30, -1e30), (1.0, 0.0, 1.0), 1.0, 1.0, WHITE),
}


@pytest.mark.parametrize("name", EXTREMES)
@pytest.mark.parametrize("rasterizer", ALL_RASTERIZERS.values(), ids=ALL_RASTERIZERS)
def test_extreme_splats_agree_with_the_reference_among_others(rasterizer, name):
    hw = (29, 43)
    extreme, others = splats_of(EXTREMES[name]).to(torch.float32), make_splats(60, hw, seed=1)
    columns = {n: torch.cat([c.to(others.means), vars(others)[n]]) for n, c in extreme._columns().items()}
    for splats in (extreme, Splats2D(**columns | {"sources": torch.arange(61)})):
        image, exact = (draw(splats, hw, BLACK, INTEGRAL, BLENDING) for draw in (rasterizer, Reference()))
        assert image.alpha.min() >= 0
        assert image.alpha.max() <= 1
        difference = (image.rgb - exact.rgb).abs().amax(dim=2)
        assert difference.isfinite().all()
        assert (difference > 2e-5).double().mean() < 2e-3

"""Window blending: its moments are integrals, and splats side by side in a pixel let little light through."""

import math
from dataclasses import replace

import pytest
import torch

from aaplug.core.rules import RULES_3DGS
from aaplug.methods.compositors import WindowBlending
from aaplug.methods.compositors.window_blending import Window, axes_of, moments, through
from aaplug.methods.pixel_kernels import INTEGRAL, POINT
from aaplug.rasterizers import RASTERIZERS
from tests.conftest import splats_of

F64 = torch.float64
NODES = 20_001
BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
BLENDING = WindowBlending()


@pytest.mark.parametrize("half", [1e-5, 5e-4, 2e-3, 0.3, 4.0])
@pytest.mark.parametrize("u", [0.0, 0.7, -2.5])
def test_moments_are_integrals(u, half):
    x = u + half * torch.linspace(-1, 1, NODES, dtype=F64)
    density = (-0.5 * x * x).exp()
    mass = torch.trapezoid(density, x)
    centre = torch.trapezoid(density * (x - u), x) / mass
    variance = torch.trapezoid(density * (x - u - centre) ** 2, x) / mass
    found = moments(torch.tensor([u], dtype=F64), torch.tensor([half], dtype=F64))
    expected = (mass / (2 * half), centre, variance)
    for a, b in zip(found, expected, strict=True):
        assert a.item() == pytest.approx(b.item(), rel=1e-6, abs=1e-9 * half)


@pytest.mark.parametrize("cov", [(0.3, 0.0, 0.05), (0.2, 0.05, 0.4)])
def test_the_window_has_the_moments_of_the_transmitted_light(cov):
    """Against sums over a fine grid that is turned to the splat's axes, as the pixel is."""
    splats = splats_of(((0.3, -0.2), cov, 1.0, 0.8, WHITE)).to(F64)
    axes = axes_of(splats)
    whole = Window.whole(torch.zeros(1, dtype=F64))
    dx, dy = -splats.means.T
    hidden, after = through(whole, axes, splats.opacities, (dx, dy), 1.0, RULES_3DGS)
    ticks = torch.linspace(-0.5, 0.5, 401, dtype=F64)
    p, q = (t.flatten() for t in torch.meshgrid(ticks, ticks, indexing="ij"))
    cos, sin = axes.ux / torch.hypot(axes.ux, axes.uy), axes.uy / torch.hypot(axes.ux, axes.uy)
    across, up = axes.vx / torch.hypot(axes.vx, axes.vy), axes.vy / torch.hypot(axes.vx, axes.vy)
    x, y = cos * p + across * q, sin * p + up * q
    u, v = axes.ux * (x + dx) + axes.uy * (y + dy), axes.vx * (x + dx) + axes.vy * (y + dy)
    left = 1 - 0.8 * (-0.5 * (u * u + v * v)).exp()
    assert 1 - hidden.item() == pytest.approx(left.mean().item(), abs=2e-3)
    for position, centre, side, turned in (
        (x, after.x, after.width, cos * cos + across * across),
        (y, after.y, after.height, sin * sin + up * up),
    ):
        mean = (left * position).mean() / left.mean()
        variance = (left * (position - mean) ** 2).mean() / left.mean()
        variance = variance + (1 - turned.item()) / 12
        assert centre.item() == pytest.approx(mean.item(), abs=2e-3)
        room = 1 - 2 * abs(mean.item())
        assert side.item() == pytest.approx(min(room, (12 * variance.item()) ** 0.5), abs=5e-3)


def leak(compositor: WindowBlending | None) -> float:
    """Transmittance of a pixel whose halves are each covered by a wide opaque splat."""
    covs = (0.02, 0.0, 25.0)
    splats = splats_of(((4.25, 4.5), covs, 1.0, 0.99, WHITE), ((4.75, 4.5), covs, 2.0, 0.99, WHITE))
    render = RASTERIZERS["eager"](replace(splats, window=1.0), (9, 9), BLACK, INTEGRAL, compositor)
    return 1 - render.alpha[4, 4].item()


def test_splats_side_by_side_let_less_light_through_than_independent_ones():
    at_random = leak(None)
    apart = 1 - 2 * (1 - math.sqrt(at_random))  # each hides its own share of the pixel
    assert apart < leak(BLENDING) < 0.5 * (apart + at_random)


def test_a_window_of_no_size_gives_point_samples():
    splats = splats_of(((4.2, 4.6), (0.5, 0.2, 0.4), 1.0, 0.7, WHITE), ((4.4, 3.9), (2.0, 0.0, 1.0), 2.0, 0.9, WHITE))
    draw = RASTERIZERS["eager"]
    point = draw(splats, (9, 9), BLACK, POINT)
    blended = draw(replace(splats, window=0.0), (9, 9), BLACK, INTEGRAL, BLENDING)
    torch.testing.assert_close(blended.alpha, point.alpha, rtol=1e-5, atol=1e-6)

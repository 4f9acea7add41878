"""How Gaussians sit against their sampling bounds; spectra of splats, whose closed forms are sums over fine grids."""

import math
from dataclasses import replace

import pytest
import torch

from aaplug import Renderer, TrainingViews
from aaplug.core.conventions import CLASSIC
from aaplug.core.spectra import energies, frequency_response
from aaplug.evaluation.coverage import above_nyquist, coverage, log_multiples
from aaplug.methods.pixel_kernels.point import POINT
from tests.conftest import make_camera, make_scene, splats_of


def at_bound(multiple: float, n: int = 10):
    """Round Gaussians at the origin whose extent is that multiple of their bound."""
    view = make_camera((0.0, -4.0, 0.0))
    sigma = multiple * 0.2**0.5 / (view.focal / 4.0)
    scene = replace(make_scene(n), means=torch.zeros(n, 3), log_scales=torch.full((n, 3), sigma).log())
    return scene, TrainingViews.of(scene, [view])


@pytest.mark.parametrize("multiple", [0.5, 1.01, 3.0])
def test_the_multiple_is_the_extent_over_the_bound(multiple):
    scene, training = at_bound(multiple)
    found = log_multiples(scene, training.bounds).exp()
    assert found == pytest.approx([multiple] * 10, rel=1e-4)
    assert coverage(scene, training, ()).under == (multiple < 1)


def test_aliasing_begins_where_what_training_drew_meets_the_bound():
    scene, training = at_bound(2.0)
    assert scene.convention == CLASSIC
    found = coverage(scene, training, (1.0, 0.5, 0.4, 0.25))
    # σ²ν² = 4·0.2 px², and 0.3 px² of dilation: r²·1.1 = 0.2
    assert found.begins == pytest.approx((0.2 / 1.1) ** 0.5, rel=1e-4)
    assert dict(found.aliased) == {1.0: 0.0, 0.5: 0.0, 0.4: 1.0, 0.25: 1.0}


@pytest.mark.parametrize(("shift", "seen"), [(0.0, True), (1e6, False)])
def test_every_seen_gaussian_is_in_the_histogram(shift, seen):
    scene = make_scene(400)
    scene = replace(scene, means=scene.means + shift, log_scales=scene.log_scales * 6)  # far into both ends
    training = TrainingViews.of(scene, [make_camera()])
    found = coverage(scene, training, (1.0,))
    assert sum(found.counts) == found.seen == int(training.bounds.seen.sum())
    assert (found.gaussians, found.seen > 0) == (400, seen)
    if not seen:
        assert (found.under, found.begins, found.aliased) == (None, None, ())


F64 = torch.float64
STEP, SIDE = 0.1, 200  # px; of a grid that holds both splats whole
ROWS = ((0.7, (0.3, 0.1, 0.2)), (0.4, (4.0, -1.5, 1.0)))
SPLATS = splats_of(*(((0.0, 0.0), cov, 1.0, opacity, (1.0, 1.0, 1.0)) for opacity, cov in ROWS))
LINE = (torch.arange(SIDE, dtype=F64) - SIDE / 2) * STEP
GRID = torch.cartesian_prod(LINE, LINE)
ALPHA = (SPLATS.opacities * POINT.exact(SPLATS, GRID[:, None].expand(-1, 2, -1))).T


def test_the_response_is_the_fourier_transform_of_alpha():
    omega = torch.tensor([[0.0, 0.0], [1.0, 0.5], [-2.0, 3.0], [math.pi, 0.0]], dtype=F64)
    expected = ALPHA @ (GRID @ omega.T).cos() * STEP**2
    torch.testing.assert_close(frequency_response(SPLATS, omega), expected, rtol=1e-6, atol=1e-5)


def test_the_share_above_nyquist_is_that_of_the_squared_response_outside_the_band():
    step = math.pi / 50
    line = (torch.arange(-250, 250, dtype=F64) + 0.5) * step
    omega = torch.cartesian_prod(line, line)
    for i, (xx, xy, yy) in enumerate(SPLATS.covs.tolist()):
        squared = frequency_response(SPLATS, omega)[i].square()
        angle = 0.5 * math.atan2(2 * xy, xx - yy)
        axes = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]], dtype=F64)
        outside = ((omega @ axes.T).abs() > math.pi).any(dim=1)
        share = squared[outside].sum() / squared.sum()
        assert energies(SPLATS)[1][i].item() == pytest.approx(share.item(), abs=2e-3)
        assert squared.sum() * step**2 / (4 * math.pi**2) == pytest.approx(energies(SPLATS)[0][i].item(), rel=1e-6)


def test_smaller_images_have_more_energy_above_nyquist_unless_samples_keep_up():
    scene, view = make_scene(60), make_camera()
    found = {name: Renderer.of(scene, [view], name) for name in ("matched", "auto", "analytic")}
    shares = {name: [above_nyquist(r, [view], s) for s in (1.0, 0.25, 0.125)] for name, r in found.items()}
    assert 0 < shares["matched"][0] < shares["matched"][1] < shares["matched"][2] < 1
    assert shares["auto"][2] < shares["matched"][2]
    assert shares["analytic"] == [None] * 3
    assert above_nyquist(replace(found["matched"], scene=scene[:0]), [view], 1.0) is None

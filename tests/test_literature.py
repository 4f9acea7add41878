"""Methods that papers name: elliptical adaptive anti-aliasing, and opacity-balanced band limiting."""

from dataclasses import replace

import pytest
import torch

from aaplug import RASTERIZERS, TrainingViews
from aaplug.lab.elliptical import MOST_NODES, Elliptical
from aaplug.lab.integral import INTEGRAL
from aaplug.lab.obbl import BoundedBandLimit, Renormalized
from aaplug.methods.filters.smoothing import Smoothing3D
from aaplug.methods.pixel_kernels.point import POINT
from tests.conftest import make_camera, make_scene, make_splats

F64 = torch.float64
SKY = (0.1, 0.5, 0.9)
OFFSETS = torch.tensor([[0.0, 0.0], [0.4, -0.3], [1.2, 0.7]], dtype=F64)[:, None]


def elongated(kappas: list[float], shorter: float = 0.3):
    """Splats with these ratios of variances, along x."""
    splats = make_splats(len(kappas), (8, 8)).to(F64)
    thin = torch.full((len(kappas),), shorter, dtype=F64)
    wide = thin * torch.tensor(kappas, dtype=F64)
    return replace(splats, covs=torch.stack([wide, 0 * thin, thin], dim=1), dets=wide * thin)


def test_longer_ellipses_have_more_nodes():
    nodes, kappa = Elliptical().nodes(elongated([1.0, 20.0, 1e6]))
    assert nodes.tolist() == [4, 7, MOST_NODES]  # 3 + ⌈ln 2⌉ and 3 + ⌈ln 21⌉
    assert kappa.tolist() == pytest.approx([1.0, 20.0, 1e6])


def test_nodes_alike_sum_to_the_integral_and_gamma_counts_only_where_the_sum_is_not_normalized():
    splats = elongated([1.0, 3.0, 40.0])
    offsets = OFFSETS.expand(-1, 3, -1)
    alike = Elliptical(beta=0.0).exact(splats, offsets)
    torch.testing.assert_close(alike, INTEGRAL.exact(splats, offsets), rtol=0.02, atol=1e-3)
    plain, heavy = (Elliptical(gamma=gamma).exact(splats, offsets) for gamma in (0.5, 2.0))
    assert torch.equal(plain, heavy)
    assert not torch.allclose(plain, alike, rtol=0.01)
    plain, heavy = (Elliptical(gamma=gamma, normalized=False).exact(splats, offsets) for gamma in (0.0, 1.0))
    ratios = 1 + torch.tensor([1.0, 3.0, 40.0], dtype=F64).log()
    torch.testing.assert_close(heavy, plain * ratios)


def test_the_band_limit_widens_as_smoothing_does_and_bounds_opacities():
    scene, views = make_scene(30), [make_camera()]
    training = TrainingViews.of(scene, views)
    bounded = BoundedBandLimit(0.5)(scene, training)
    assert torch.equal(bounded.log_scales, Smoothing3D(opacity="kept")(scene, training).log_scales)
    torch.testing.assert_close(bounded.opacities, scene.opacities.clamp(max=0.5))
    assert (scene.opacities > 0.5).any()


def test_covered_pixels_become_opaque_in_their_own_colour():
    splats, hw = make_splats(200, (24, 32)), (24, 32)
    plain, filled = (RASTERIZERS["eager"](splats, hw, SKY, POINT, c) for c in (None, Renormalized()))
    covered = plain.alpha > 0.5
    assert covered.any()
    assert not covered.all()
    assert (filled.alpha[covered] - 1).abs().max() < 1e-5
    colours = (plain.rgb - (1 - plain.alpha[..., None]) * torch.tensor(SKY)) / plain.alpha[..., None]
    torch.testing.assert_close(filled.rgb[covered], colours[covered], rtol=0, atol=1e-5)
    torch.testing.assert_close(filled.rgb[~covered], plain.rgb[~covered], rtol=0, atol=1e-5)

"""What single filters are, beyond the laws that every one keeps (test_registered.py)."""

import math
from dataclasses import replace
from itertools import pairwise, product

import pytest
import torch
from torch import Tensor

from aaplug import SCREEN_FILTERS, WORLD_FILTERS, TrainingViews
from aaplug.core.conventions import CONVENTIONS, MIP
from aaplug.core.convolution import fuse_stored
from aaplug.core.projection import project
from aaplug.evaluation.laws.filters import CAMERAS, F64, SCENE, SITUATIONS, spheres, trained_with, world_scene
from aaplug.lab.filters import AnisotropicSmoothing, FlatSmoothing
from aaplug.methods.filters.energy import MatchedEnergy
from aaplug.methods.filters.matched import FULL_RISE_AT, MAX_RISE, PIXEL_VARIANCE, Matched
from aaplug.methods.filters.smoothing import Smoothing3D
from tests.conftest import each, make_camera, make_scene, make_splats

situation = each(SITUATIONS)
convention = each(CONVENTIONS)
# one Gaussian at the origin, trained from 4 and from 8 away
ONE = replace(make_scene(1, dtype=F64), means=torch.zeros(1, 3, dtype=F64))
TWICE = TrainingViews.of(ONE, [make_camera((0.0, -4.0, 0.0)), make_camera((8.0, 0.0, 0.0))])


@pytest.mark.parametrize(
    ("name", "variance", "compensated"), [("classic", 0.3, False), ("ewa", 0.3, True), ("mip", 0.1, True)]
)
def test_a_dilation_has_its_published_constant_at_every_rate(name, variance, compensated, situation):
    view, training = situation
    splats = project(SCENE, view)
    expected = splats.blurred(variance, compensated)
    filtered = SCREEN_FILTERS[name](splats, view, training)
    torch.testing.assert_close(filtered.covs, expected.covs)
    torch.testing.assert_close(filtered.opacities, expected.opacities)


@pytest.mark.parametrize("pixel", [0.0, PIXEL_VARIANCE])
def test_matching_restores_the_dilation_of_training_and_keeps_its_energy(pixel, convention):
    matched = Matched("global", pixel_variance=pixel)
    for rate, sigma in product((0.125, 0.5, 1.0, 2.0), (0.05, 0.5, 5.0)):
        splats = spheres(sigma)
        filtered = matched(splats, CAMERAS[0].scaled(rate), trained_with(convention))
        trained = sigma**2 + convention.kernel * rate**2
        whole = trained + pixel * max(0.0, 1 - rate**2)
        in_training = max(sigma**2 / trained, 0.005) if convention.compensated else 1.0
        torch.testing.assert_close(filtered.covs[:, 0], torch.full((5,), whole, dtype=F64))
        expected = splats.opacities * in_training * max(trained / whole, 0.005)
        torch.testing.assert_close(filtered.opacities, expected)


def test_matching_the_sharpest_rate_is_thinner_where_another_view_sampled_more_finely(convention):
    view, training = CAMERAS[2], trained_with(convention)
    splats = project(SCENE, view)
    outdone = training.bounds.highest[splats.sources] > view.focal / splats.depths * (1 + 1e-9)
    assert 0 < (~outdone).sum() < outdone.sum()
    sharpest = Matched("sharpest", pixel_variance=0.0)(splats, view, training)
    trained = splats.blurred(convention.kernel, convention.compensated)
    thinner = trained.covs[:, 0] - sharpest.covs[:, 0]
    if convention.kernel:  # else there is nothing to make thinner
        assert thinner[outdone].min() > 1e-3
    torch.testing.assert_close(thinner[~outdone], torch.zeros_like(thinner[~outdone]))


@pytest.mark.parametrize(
    ("depth", "in_sharpest", "in_interval", "in_pose"),
    [
        (2.0, 2.0, 2.0, 2.0),
        (4.0, 1.0, 1.0, 1.0),
        (6.0, 4 / 6, 1.0, 1.0),
        (8.0, 0.5, 1.0, 1.0),
        (8.8, 4 / 8.8, 8 / 8.8, (8 / 8.8) ** 2),  # compared with the rate at 8 · 8/8.8
        (16.0, 0.25, 0.5, 0.5 / MAX_RISE),
    ],
)
def test_rates_of_a_free_camera_are_compared_with_the_range_of_training(depth, in_sharpest, in_interval, in_pose):
    free = replace(make_camera((0.0, -depth, 0.0)), trained_focal=None)
    references = ("global", "sharpest", "interval", "pose")
    rates = [Matched(name).rates(project(ONE, free), free, TWICE).item() for name in references]
    assert rates == pytest.approx([1.0, in_sharpest, in_interval, in_pose])


@pytest.mark.parametrize("scale", [4.0, 1.0, 0.95, 0.5, 0.1])
@pytest.mark.parametrize(("pose", "highest"), [(4.0, 1.0), (4.3, 4.3 / 4), (8.0, 2.0)])
def test_rates_at_a_pose_are_its_own_and_the_reference_rises_where_it_is_small(scale, pose, highest):
    """Seen from a held-out pose of the data set."""
    view = make_camera((0.0, -pose, 0.0))
    view = replace(view, fx=view.fx * scale, fy=view.fy * scale)
    rate = Matched("pose").rates(project(ONE, view), view, TWICE).item()
    octaves = -math.log2(scale) / -math.log2(FULL_RISE_AT)  # of those that the rate rises over
    against = min(highest, MAX_RISE ** min(1.0, octaves)) if scale < 1 else 1.0
    assert rate == pytest.approx(scale / against)


@pytest.mark.parametrize("reference", ["pose", "sharpest", "interval"])
def test_gaussians_that_no_camera_saw_are_matched_at_the_rate_of_the_view(reference):
    training = TrainingViews.of(ONE, [replace(CAMERAS[0], cx=1e4)])
    assert not training.bounds.seen.any()
    view = CAMERAS[0].scaled(0.5)
    assert Matched(reference).rates(project(ONE, view), view, training).tolist() == [0.5]


@pytest.mark.parametrize("compensate", [False, True])
@pytest.mark.parametrize("floor", [0.0, 0.005])
def test_the_gradient_of_a_blur_is_that_of_its_formula(compensate, floor):
    splats = make_splats(5, (48, 64), log_sigmas=(-1.0, 1.0)).to(F64)
    variances = torch.tensor([0.05, 0.1, 0.3, 1.0, 9.0], dtype=F64)

    def blur(covs: Tensor, dets: Tensor, opacities: Tensor, variance: Tensor):
        given = replace(splats, covs=covs, dets=dets, opacities=opacities)
        blurred = given.blurred(variance, compensate, floor)
        return blurred.covs, blurred.dets, blurred.opacities

    inputs = splats.covs, splats.dets, splats.opacities, variances
    assert torch.autograd.gradcheck(blur, [x.clone().requires_grad_() for x in inputs])


VARIED = {name: world for name, world in WORLD_FILTERS.items() if hasattr(world, "variance")}


@pytest.mark.parametrize("name", [*VARIED, "stored"])
def test_a_stronger_world_filter_widens_more_and_is_fainter(name):
    scene, training = world_scene(), TrainingViews.of(world_scene(), CAMERAS)
    assert scene.filter_3d is not None
    results = []
    for factor in (0.25, 1.0, 4.0):
        if name in VARIED:
            world = replace(VARIED[name], variance=VARIED[name].variance * factor)
            results.append(world(scene, training))
            assert float(results[-1].fused[0].settings["variance"]) == pytest.approx(world.variance)
        else:
            given = replace(scene, filter_3d=scene.filter_3d * factor**0.5)
            results.append(fuse_stored(given))
    for weak, strong in pairwise(results):
        wider = strong.log_scales > weak.log_scales
        assert (strong.log_scales >= weak.log_scales).all()
        assert (wider.sum(dim=1) >= 2).all(), "a disc widens in its plane only"
        # energy may ask for more than the bound on opacity, of the weak and the strong alike
        fainter = strong.logit_opacities < weak.logit_opacities
        assert (fainter | (weak.opacities >= 0.9999 - 1e-9)).all()
        assert fainter.double().mean() > 0.5


@pytest.mark.parametrize(
    "world",
    [
        *(Smoothing3D(0.0, opacity) for opacity in ("volume", "balanced", "kept")),
        *(AnisotropicSmoothing(0.0), FlatSmoothing(0.0)),
    ],
)
def test_smoothing_by_zero_changes_no_bit(world):
    scene = replace(world_scene(torch.float32), filter_3d=torch.zeros(40))
    same = world(scene, TrainingViews.of(scene, CAMERAS))
    assert same.log_scales.equal(scene.log_scales)
    assert same.logit_opacities.equal(scene.logit_opacities)


def test_a_gaussian_whose_stored_filter_is_0_does_not_change_a_bit():
    scene = world_scene(torch.float32)
    assert scene.filter_3d is not None
    still = torch.arange(40) % 3 == 0
    scene = replace(scene, filter_3d=scene.filter_3d.masked_fill(still, 0.0))
    fused = fuse_stored(scene)
    for name in ("log_scales", "logit_opacities"):
        moved = getattr(fused, name) != getattr(scene, name)
        assert not moved[still].any()
        assert moved[~still].any()


def test_a_stored_filter_is_fused_and_removed():
    scene = world_scene()
    fused = fuse_stored(scene)
    assert scene.filter_3d is not None
    assert fused.filter_3d is None
    variances = scene.scales.square() + scene.filter_3d.square()[:, None]
    torch.testing.assert_close(fused.scales.square(), variances)
    factor = (scene.scales.prod(dim=1) / fused.scales.prod(dim=1)).clamp(min=1e-7)
    torch.testing.assert_close(fused.opacities, scene.opacities * factor)
    assert fuse_stored(fused) is fused


def test_gaussians_that_no_camera_saw_are_smoothed_at_the_coarsest_rate_and_not_matched():
    scene = world_scene()
    scene.means[7] = torch.tensor([0.0, -500.0, 0.0])
    training = TrainingViews.of(scene, CAMERAS)
    assert (~training.bounds.seen).nonzero().tolist() == [[7]]
    smoothed = WORLD_FILTERS["smoothing3d"](scene, training)
    added = (smoothed.scales.square() - scene.scales.square())[:, 0]
    torch.testing.assert_close(
        added[7],
        added[training.bounds.highest.masked_fill(~training.bounds.seen, math.inf).argmin()],
        rtol=1e-8,
        atol=0,
    )
    matched = WORLD_FILTERS["matched-energy"](scene, training)
    assert matched.log_scales[7].equal(scene.log_scales[7])
    assert matched.logit_opacities[7].equal(scene.logit_opacities[7])


def test_matched_energy_shows_in_a_compensating_viewer_what_training_showed(convention):
    # with one camera there is no mean over views, and the energy is the trained one
    scene = world_scene(convention=convention)
    scene = replace(scene, logit_opacities=scene.logit_opacities - 6)
    training = TrainingViews.of(scene, CAMERAS[:1])
    fused = MatchedEnergy()(scene, training)
    raw = project(scene, CAMERAS[0])
    trained = raw.blurred(convention.kernel, convention.compensated)
    shown = project(fused, CAMERAS[0]).blurred(0.1, compensate=True, floor=0.0)
    seen = training.bounds.seen & (fused.opacities < 0.9998) & (fused.opacities > 1.1e-7)
    assert seen.sum() > 30
    energy = shown.opacities * shown.dets.sqrt()
    torch.testing.assert_close(energy[seen], (trained.opacities * trained.dets.sqrt())[seen])
    assert fused.convention == MIP


def test_matched_energy_keeps_an_opacity_of_0():
    scene = make_scene(3)
    scene.logit_opacities[1] = -200.0
    fused = MatchedEnergy()(scene, TrainingViews.of(scene, CAMERAS))
    assert scene.opacities[1] == 0
    assert fused.logit_opacities[1] == -200
    assert fused.logit_opacities.isfinite().all()

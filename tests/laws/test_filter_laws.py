"""What every filter must hold to, whatever its method."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import CONVENTIONS, MIP, Convention, Gaussians
from aaplug.core.interfaces import ScreenFilter, TrainingViews, WorldFilter
from aaplug.core.projection import project, shade
from aaplug.core.splats import Splats2D
from aaplug.methods.filters import (
    PIXEL_VARIANCE,
    SCREEN_FILTERS,
    WORLD_FILTERS,
    Dilation,
    Matched,
    MatchedEnergy,
    StoredSmoothing,
)
from aaplug.methods.filters.matched import SHARPER, SHARPEST_AT
from aaplug.rasterizers.reference import rasterize
from aaplug.rendering.renderer import learn
from tests.conftest import make_camera, make_scene, make_splats

F64 = torch.float64
EYES = [(0.0, -4.0, 0.0), (3.0, -4.0, 1.0), (-2.0, -6.0, 0.5)]
CAMERAS = [make_camera(eye) for eye in EYES]
WANDERER = replace(make_camera((0.3, -2.0, 0.2)), trained_focal=None)
VIEWS = {
    "training": CAMERAS[0],
    "half": CAMERAS[0].scaled(0.5),
    "threefold": CAMERAS[0].scaled(3.0),
    "free, near and small": WANDERER.scaled(0.3),
}
SCENE = make_scene(40, dtype=F64)


@cache
def trained_with(convention: Convention) -> TrainingViews:
    """What is known of the training of `SCENE`, had it been trained in that convention."""
    return learn(replace(SCENE, convention=convention), CAMERAS)


@pytest.fixture(params=SCREEN_FILTERS.values(), ids=SCREEN_FILTERS)
def screen(request: pytest.FixtureRequest) -> ScreenFilter:
    return request.param


@pytest.fixture(params=WORLD_FILTERS.values(), ids=WORLD_FILTERS)
def world(request: pytest.FixtureRequest) -> WorldFilter:
    return request.param


@pytest.fixture(params=VIEWS.values(), ids=VIEWS)
def view(request: pytest.FixtureRequest) -> Camera:
    return request.param


@pytest.fixture(params=CONVENTIONS.values(), ids=CONVENTIONS)
def convention(request: pytest.FixtureRequest) -> Convention:
    return request.param


def tensors_of(thing: Splats2D | Gaussians) -> dict[str, Tensor]:
    return {name: value for name, value in vars(thing).items() if isinstance(value, Tensor)}


def copies_of(thing: Splats2D | Gaussians) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in tensors_of(thing).items()}


def spheres(sigma: float, opacities: tuple[float, ...] = (0.0, 0.1, 0.5, 0.9, 1.0)) -> Splats2D:
    """Round splats of `sigma` px."""
    m = len(opacities)
    splats = make_splats(m, (48, 64)).to(F64)
    return replace(
        splats,
        covs=torch.tensor([[sigma**2, 0.0, sigma**2]], dtype=F64).expand(m, 3),
        dets=torch.full((m,), sigma**4, dtype=F64),
        opacities=torch.tensor(opacities, dtype=F64),
        depths=torch.linspace(2, 6, m, dtype=F64),
    )


# screen filters ---------------------------------------------------------------------------------


def test_a_screen_filter_keeps_its_input_and_all_but_covariance_and_opacity(
    screen, view, convention
):
    splats = shade(project(SCENE, view), SCENE, view)
    before = copies_of(splats)
    filtered = screen(splats, view, trained_with(convention))
    assert all(getattr(splats, name).equal(kept) for name, kept in before.items())
    assert len(filtered) == len(splats) > 0
    for name in ("means", "depths", "sources", "rgb"):
        assert getattr(filtered, name).equal(before[name]), name


def test_covariances_never_shrink(screen, view, convention):
    splats = project(SCENE, view)
    filtered = screen(splats, view, trained_with(convention))
    xx, xy, yy = (filtered.covs - splats.covs).unbind(dim=1)
    assert xx.min() >= 0
    assert yy.min() >= 0
    assert (xx * yy - xy * xy).min() >= -1e-12
    assert (filtered.dets >= splats.dets).all()


def test_determinants_stay_those_of_the_covariances(screen, view, convention):
    filtered = screen(project(SCENE, view), view, trained_with(convention))
    xx, xy, yy = filtered.covs.unbind(dim=1)
    torch.testing.assert_close(filtered.dets, xx * yy - xy * xy, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_opacities_stay_between_0_and_1(screen, view, convention, dtype):
    for sigma in (1e-6, 1e-3, 0.1, 1.0, 30.0, 1e6):
        splats = spheres(sigma).to(dtype)
        opacities = screen(splats, view, trained_with(convention)).opacities
        assert opacities.isfinite().all()
        assert opacities.min() >= 0
        assert opacities.max() <= 1
        assert opacities[0] == 0


def test_a_huge_splat_keeps_its_opacity_and_shape(screen, view, convention):
    splats = spheres(1e4)
    filtered = screen(splats, view, trained_with(convention))
    torch.testing.assert_close(filtered.opacities, splats.opacities, rtol=1e-6, atol=0)
    scale = splats.covs[:, :1]
    torch.testing.assert_close(filtered.covs / scale, splats.covs / scale, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "variance", "compensated"),
    [("classic", 0.3, False), ("ewa", 0.3, True), ("mip", 0.1, True)],
)
def test_a_dilation_has_the_constant_of_its_name_at_every_rate(
    name, variance, compensated, view, convention
):
    splats = project(SCENE, view)
    expected = splats.blurred(variance, compensated)
    filtered = SCREEN_FILTERS[name](splats, view, trained_with(convention))
    torch.testing.assert_close(filtered.covs, expected.covs)
    torch.testing.assert_close(filtered.opacities, expected.opacities)


@pytest.mark.parametrize("sigma", [0.03, 0.1, 0.5, 2.0])
@pytest.mark.parametrize(
    "name", [n for n in SCREEN_FILTERS if getattr(SCREEN_FILTERS[n], "compensated", False)]
)
def test_a_compensated_dilation_keeps_energy_down_to_its_floor(name, sigma, convention):
    dilation, splats = SCREEN_FILTERS[name], spheres(sigma)
    filtered = dilation(splats, CAMERAS[0], trained_with(convention))
    assert isinstance(dilation, Dilation)
    factor = max(sigma**2 / (sigma**2 + dilation.variance), 0.005)
    torch.testing.assert_close(filtered.opacities, splats.opacities * factor)


@pytest.mark.parametrize("rate", [0.125, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("sigma", [0.05, 0.5, 5.0])
@pytest.mark.parametrize("pixel", [0.0, PIXEL_VARIANCE])
def test_matching_restores_the_trained_look_and_keeps_its_energy(rate, sigma, pixel, convention):
    matched = Matched("global", pixel_variance=pixel)
    splats = spheres(sigma)
    filtered = matched(splats, CAMERAS[0].scaled(rate), trained_with(convention))
    trained = sigma**2 + convention.kernel * rate**2
    whole = trained + pixel * max(0.0, 1 - rate**2)
    seen_in_training = max(sigma**2 / trained, 0.005) if convention.compensated else 1.0
    torch.testing.assert_close(filtered.covs[:, 0], torch.full((5,), whole, dtype=F64))
    expected = splats.opacities * seen_in_training * max(trained / whole, 0.005)
    torch.testing.assert_close(filtered.opacities, expected)


@pytest.mark.parametrize("rate", ["pose", "global", "interval"])
@pytest.mark.parametrize("index", range(len(CAMERAS)))
def test_at_a_training_view_matching_is_the_trainings_own_rule(rate, index, convention):
    view = CAMERAS[index]
    splats = project(SCENE, view)
    filtered = Matched(rate)(splats, view, trained_with(convention))
    trained = splats.blurred(convention.kernel, convention.compensated)
    torch.testing.assert_close(filtered.covs, trained.covs)
    torch.testing.assert_close(filtered.dets, trained.dets)
    torch.testing.assert_close(filtered.opacities, trained.opacities)


def test_matching_the_sharpest_rate_is_thinner_than_the_trainings_own_rule_where_another_saw_more(
    convention,
):
    view, training = CAMERAS[2], trained_with(convention)
    splats = project(SCENE, view)
    outdone = training.bounds.highest[splats.sources] > view.focal / splats.depths * (1 + 1e-9)
    assert 0 < (~outdone).sum() < outdone.sum()
    sharpest = Matched("sharpest", pixel_variance=0.0)(splats, view, training)
    trained = splats.blurred(convention.kernel, convention.compensated)
    thinner = trained.covs[:, 0] - sharpest.covs[:, 0]
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
        (16.0, 0.25, 0.5, 0.5 / SHARPER),
    ],
)
def test_rates_of_a_free_camera_are_compared_with_the_trained_interval(
    depth, in_sharpest, in_interval, in_pose
):
    # one Gaussian at the origin, trained from 4 and from 8 away
    scene = replace(make_scene(1, dtype=F64), means=torch.zeros(1, 3, dtype=F64))
    training = learn(scene, [make_camera((0.0, -4.0, 0.0)), make_camera((8.0, 0.0, 0.0))])
    free = replace(make_camera((0.0, -depth, 0.0)), trained_focal=None)
    splats = project(scene, free)
    rates = {
        name: Matched(name).rates(splats, free, training).item()
        for name in ("global", "sharpest", "interval", "pose")
    }
    assert rates["global"] == pytest.approx(1.0)
    assert rates["sharpest"] == pytest.approx(in_sharpest)
    assert rates["interval"] == pytest.approx(in_interval)
    assert rates["pose"] == pytest.approx(in_pose)


@pytest.mark.parametrize("scale", [4.0, 1.0, 0.95, 0.5, 0.1])
@pytest.mark.parametrize(("pose", "highest"), [(4.0, 1.0), (4.3, 4.3 / 4), (8.0, 2.0)])
def test_rates_at_a_pose_are_its_own_and_sharper_where_it_is_small(scale, pose, highest):
    """One Gaussian trained from 4 and from 8 away, seen from a held-out pose of the data set."""
    scene = replace(make_scene(1, dtype=F64), means=torch.zeros(1, 3, dtype=F64))
    training = learn(scene, [make_camera((0.0, -4.0, 0.0)), make_camera((8.0, 0.0, 0.0))])
    view = make_camera((0.0, -pose, 0.0))
    view = replace(view, fx=view.fx * scale, fy=view.fy * scale)
    rate = Matched("pose").rates(project(scene, view), view, training).item()
    octaves = -math.log2(scale) / -math.log2(SHARPEST_AT)  # of those that the rate rises over
    against = min(highest, SHARPER ** min(1.0, octaves)) if scale < 1 else 1.0
    assert rate == pytest.approx(scale / against)


@pytest.mark.parametrize("rate", ["pose", "sharpest", "interval"])
def test_gaussians_no_camera_saw_are_matched_at_the_views_own_rate(rate):
    scene = replace(make_scene(1, dtype=F64), means=torch.zeros(1, 3, dtype=F64))
    elsewhere = replace(CAMERAS[0], cx=1e4)
    training = learn(scene, [elsewhere])
    assert not training.bounds.seen.any()
    view = CAMERAS[0].scaled(0.5)
    splats = project(scene, view)
    assert Matched(rate).rates(splats, view, training).tolist() == [0.5]


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


@pytest.mark.parametrize("view_name", ["half", "threefold", "free, near and small"])
def test_the_gradient_of_a_screen_filter_is_that_of_its_formula(screen, view_name, convention):
    view, training = VIEWS[view_name], trained_with(convention)
    splats = make_splats(6, (48, 64), log_sigmas=(-1.0, 1.0)).to(F64)

    def filtered(covs: Tensor, dets: Tensor, depths: Tensor, opacities: Tensor):
        given = replace(splats, covs=covs, dets=dets, depths=depths, opacities=opacities)
        out = screen(given, view, training)
        return out.covs, out.dets, out.opacities

    inputs = splats.covs, splats.dets, splats.depths, splats.opacities
    assert torch.autograd.gradcheck(filtered, [x.clone().requires_grad_() for x in inputs])


def small_scene() -> Gaussians:
    """Three Gaussians in half a dozen pixels, away from every cut-off, limit and clamp."""
    scene = make_scene(3, seed=4, dtype=F64, degree=1)
    return replace(
        scene,
        means=scene.means * 0.3,
        log_scales=scene.log_scales * 0.2 + 0.2,
        logit_opacities=torch.tensor([-0.5, 0.3, 0.8], dtype=F64),
        sh=scene.sh * 0.3,
    )


@pytest.mark.parametrize("name", SCREEN_FILTERS)
def test_the_gradient_of_an_image_reaches_every_parameter_of_the_scene(name):
    scene = small_scene()
    view = replace(make_camera((0.4, -5.0, 0.3), size=(3, 2)), trained_focal=7.0)
    training = learn(scene, [make_camera(size=(3, 2))])
    fields = ("means", "quats", "log_scales", "logit_opacities", "sh")

    def image(*parameters: Tensor) -> tuple[Tensor, Tensor]:
        given = replace(scene, **dict(zip(fields, parameters, strict=True)))
        splats = SCREEN_FILTERS[name](project(given, view), view, training)
        return rasterize(shade(splats, given, view), view.hw, (0.2, 0.4, 0.9))

    inputs = [getattr(scene, field).clone().requires_grad_() for field in fields]
    rgb, alpha = image(*inputs)
    assert rgb.min() > 0.02
    assert 0.1 < alpha.min() < alpha.max() < 0.95
    gradients = torch.autograd.grad(rgb.square().sum(), inputs)
    assert all(gradient.abs().max() > 1e-6 for gradient in gradients)
    assert torch.autograd.gradcheck(lambda *p: tuple(image(*p)), inputs)


# world filters ----------------------------------------------------------------------------------


def world_scene(dtype: torch.dtype = F64) -> Gaussians:
    """A scene that every world filter has something to do for."""
    scene = make_scene(40, dtype=dtype)
    return replace(scene, filter_3d=torch.linspace(0.01, 0.2, 40, dtype=dtype))


def stronger(world: WorldFilter, scene: Gaussians, factor: float) -> tuple[WorldFilter, Gaussians]:
    """The filter with `factor` times the variance, be it its own or stored with the scene."""
    if hasattr(world, "variance"):
        return replace(world, variance=world.variance * factor), scene
    assert scene.filter_3d is not None
    return world, replace(scene, filter_3d=scene.filter_3d * factor**0.5)


def test_a_world_filter_keeps_its_input_and_all_but_scales_and_opacities(world):
    scene = world_scene()
    before, training = copies_of(scene), learn(scene, CAMERAS)
    filtered = world(scene, training)
    assert all(getattr(scene, name).equal(kept) for name, kept in before.items())
    assert scene.fused == ()
    assert len(filtered) == len(scene)
    for name in ("means", "quats", "sh"):
        assert getattr(filtered, name).equal(before[name]), name
    assert filtered.log_scales.shape == scene.log_scales.shape
    assert not filtered.log_scales.equal(scene.log_scales)


def test_a_world_filter_acts_on_each_gaussian_alone(world, convention):
    scene = replace(world_scene(), convention=convention)
    training = learn(scene, CAMERAS)
    assert training.bounds.seen.all()
    order = torch.randperm(40, generator=torch.Generator().manual_seed(0))[:25]
    part = world(scene[order], learn(scene[order], CAMERAS))
    whole = world(scene, training)[order]
    for name in ("log_scales", "logit_opacities"):
        torch.testing.assert_close(getattr(part, name), getattr(whole, name))


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_world_scales_never_shrink_and_opacities_stay_inside_0_and_1(world, dtype, convention):
    scene = replace(world_scene(dtype), convention=convention)
    scene.logit_opacities[:2] = torch.tensor([-30.0, 100.0])
    filtered = world(scene, learn(scene, CAMERAS))
    assert filtered.log_scales.dtype == filtered.logit_opacities.dtype == dtype
    assert (filtered.log_scales >= scene.log_scales).all()
    assert filtered.log_scales.isfinite().all()
    assert filtered.logit_opacities.isfinite().all()
    assert filtered.opacities.min() > 0
    assert filtered.opacities.max() < 1


@pytest.mark.parametrize("name", [n for n in WORLD_FILTERS if "anisotropic" not in n])
def test_the_axis_that_was_longest_stays_longest(name):
    world = WORLD_FILTERS[name]
    scene = world_scene()
    filtered = world(scene, learn(scene, CAMERAS))
    assert filtered.log_scales.argsort(dim=1).equal(scene.log_scales.argsort(dim=1))


def test_a_stronger_world_filter_widens_more_and_is_fainter(world):
    scene, training = world_scene(), learn(world_scene(), CAMERAS)
    results = [
        filter_(given, training)
        for filter_, given in (stronger(world, scene, factor) for factor in (0.25, 1.0, 4.0))
    ]
    for weak, strong in pairwise(results):
        wider = strong.log_scales > weak.log_scales
        assert (strong.log_scales >= weak.log_scales).all()
        assert (wider.sum(dim=1) >= 2).all(), "a disc widens in its plane alone"
        # energy may ask for more than an opacity's limit, of the weak and the strong alike
        fainter = strong.logit_opacities < weak.logit_opacities
        assert (fainter | (weak.opacities >= 0.9999 - 1e-9)).all()
        assert fainter.double().mean() > 0.5


def test_a_world_filter_writes_down_what_it_did(world):
    scene = world_scene()
    once = world(scene, learn(scene, CAMERAS))
    assert len(once.fused) == 1
    assert once.fused[0].method
    twice = world(replace(once, filter_3d=scene.filter_3d), learn(scene, CAMERAS))
    assert twice.fused[0] == once.fused[0]
    assert len(twice.fused) == 2


@pytest.mark.parametrize(
    "name", [n for n in WORLD_FILTERS if hasattr(WORLD_FILTERS[n], "variance")]
)
def test_a_world_filter_writes_its_variance_down(name):
    scene = world_scene()
    changed = replace(WORLD_FILTERS[name], variance=0.125)(scene, learn(scene, CAMERAS))
    assert changed.fused[0].settings["variance"] == "0.125"


@pytest.mark.parametrize("name", [n for n in WORLD_FILTERS if n != "matched-energy"])
def test_smoothing_by_nothing_is_the_identity_to_the_bit(name):
    scene = replace(world_scene(torch.float32), filter_3d=torch.zeros(40))
    world, training = WORLD_FILTERS[name], learn(scene, CAMERAS)
    world = replace(world, variance=0.0) if hasattr(world, "variance") else world
    same = world(scene, training)
    assert same.log_scales.equal(scene.log_scales)
    assert same.logit_opacities.equal(scene.logit_opacities)


def test_a_gaussian_whose_stored_filter_is_0_stays_to_the_bit_among_others():
    scene = world_scene(torch.float32)
    assert scene.filter_3d is not None
    still = torch.arange(40) % 3 == 0
    scene = replace(scene, filter_3d=scene.filter_3d.masked_fill(still, 0.0))
    fused = StoredSmoothing()(scene, learn(scene, CAMERAS))
    for name in ("log_scales", "logit_opacities"):
        moved = getattr(fused, name) != getattr(scene, name)
        assert not moved[still].any()
        assert moved[~still].any()


def test_a_scene_without_a_stored_filter_stays_itself():
    scene = make_scene(3)
    assert StoredSmoothing()(scene, learn(scene, CAMERAS)) is scene


def test_a_stored_filter_is_fused_once_and_forgotten():
    scene = world_scene()
    fused = StoredSmoothing()(scene, learn(scene, CAMERAS))
    assert scene.filter_3d is not None
    assert fused.filter_3d is None
    variances = scene.scales.square() + scene.filter_3d.square()[:, None]
    torch.testing.assert_close(fused.scales.square(), variances)
    factor = (scene.scales.prod(dim=1) / fused.scales.prod(dim=1)).clamp(min=1e-7)
    torch.testing.assert_close(fused.opacities, scene.opacities * factor)
    assert StoredSmoothing()(fused, learn(scene, CAMERAS)) is fused


def test_smoothing_has_the_nyquist_variance_at_the_highest_rate():
    scene = world_scene()
    training = learn(scene, CAMERAS)
    smoothed = WORLD_FILTERS["smoothing3d"](scene, training)
    variances = smoothed.scales.square() - scene.scales.square()
    expected = 0.2 / training.bounds.highest.square()
    torch.testing.assert_close(variances, expected[:, None].expand(40, 3), rtol=1e-8, atol=1e-14)


def test_gaussians_no_camera_saw_are_smoothed_at_the_coarsest_rate_and_not_matched():
    scene = world_scene()
    scene.means[7] = torch.tensor([0.0, -500.0, 0.0])
    training = learn(scene, CAMERAS)
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
    scene = replace(world_scene(), convention=convention)
    scene = replace(scene, logit_opacities=scene.logit_opacities - 6)
    training = learn(scene, CAMERAS[:1])
    fused = MatchedEnergy()(scene, training)
    raw = project(scene, CAMERAS[0])
    trained = raw.blurred(convention.kernel, convention.compensated)
    shown = project(fused, CAMERAS[0]).blurred(0.1, compensate=True, floor=0.0)
    seen = training.bounds.seen & (fused.opacities < 0.9998) & (fused.opacities > 1.1e-7)
    assert seen.sum() > 30
    energy = shown.opacities * shown.dets.sqrt()
    torch.testing.assert_close(energy[seen], (trained.opacities * trained.dets.sqrt())[seen])
    assert fused.convention == MIP


def test_matched_energy_asks_only_the_cameras_that_see_a_gaussian():
    scene = make_scene(10, dtype=F64)
    blind = replace(CAMERAS[1], cx=1e5)
    alone = MatchedEnergy()(scene, learn(scene, CAMERAS[:1]))
    beside = MatchedEnergy()(scene, learn(scene, [CAMERAS[0], blind, blind]))
    torch.testing.assert_close(beside.log_scales, alone.log_scales)
    torch.testing.assert_close(beside.logit_opacities, alone.logit_opacities)


def test_matched_energy_leaves_an_opacity_of_0_alone():
    scene = make_scene(3)
    scene.logit_opacities[1] = -200.0
    fused = MatchedEnergy()(scene, learn(scene, CAMERAS))
    assert scene.opacities[1] == 0
    assert fused.logit_opacities[1] == -200
    assert fused.logit_opacities.isfinite().all()


def test_matched_energy_gives_a_mip_viewer_the_classic_look_of_a_sphere():
    scene = replace(
        make_scene(1, dtype=F64),
        means=torch.zeros(1, 3, dtype=F64),
        log_scales=torch.full((1, 3), -4.0, dtype=F64),
        logit_opacities=torch.full((1,), -3.0, dtype=F64),
    )
    training = learn(scene, CAMERAS[:1])
    fused = MatchedEnergy()(scene, training)
    shown = project(fused, CAMERAS[0]).blurred(0.1, compensate=True)
    trained = project(scene, CAMERAS[0]).blurred(0.3, compensate=False)
    torch.testing.assert_close(shown.covs, trained.covs, rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(shown.opacities, trained.opacities, rtol=1e-7, atol=0)


def test_the_gradient_of_a_world_filter_is_that_of_its_formula(world, convention):
    scene = replace(world_scene()[torch.arange(4)], convention=convention)
    training = learn(scene, CAMERAS)

    def filtered(log_scales: Tensor, logit_opacities: Tensor, filter_3d: Tensor):
        given = replace(
            scene, log_scales=log_scales, logit_opacities=logit_opacities, filter_3d=filter_3d
        )
        out = world(given, training)
        return out.log_scales, out.logit_opacities

    assert scene.filter_3d is not None
    inputs = scene.log_scales, scene.logit_opacities - 2, scene.filter_3d
    assert torch.autograd.gradcheck(filtered, [x.clone().requires_grad_() for x in inputs])


FLATS: dict[str, Callable[[Gaussians], Gaussians]] = {
    "points": lambda scene: replace(scene, log_scales=torch.full((40, 3), -80.0)),
    "needles": lambda scene: replace(scene, log_scales=torch.tensor([[0.0, -30.0, -30.0]] * 40)),
    "sheets": lambda scene: replace(scene, log_scales=torch.tensor([[0.0, 0.0, -80.0]] * 40)),
    "giants": lambda scene: replace(scene, log_scales=torch.full((40, 3), 12.0)),
}


@pytest.mark.parametrize("shape", FLATS)
def test_extreme_scales_are_filtered_without_nan(world, shape, convention):
    scene = FLATS[shape](replace(world_scene(torch.float32), convention=convention))
    filtered = world(scene, learn(scene, CAMERAS))
    assert filtered.log_scales.isfinite().all()
    assert filtered.logit_opacities.isfinite().all()
    assert (filtered.log_scales >= scene.log_scales).all()


@pytest.mark.parametrize("shape", FLATS)
def test_extreme_scales_pass_screen_filters_without_nan(screen, view, shape):
    splats = project(FLATS[shape](SCENE.to(torch.float32)), view)
    assert len(splats) == len(SCENE)
    for convention in CONVENTIONS.values():
        filtered = screen(splats, view, trained_with(convention))
        for name, value in tensors_of(filtered).items():
            assert value.isfinite().all(), name

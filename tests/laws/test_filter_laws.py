"""What single filters are, beyond the laws that every one keeps (test_registered.py)."""

import math
from dataclasses import replace
from itertools import pairwise, product

import pytest
import torch
from torch import Tensor

from aaplug import RECIPES, SCREEN_FILTERS, WORLD_FILTERS, Renderer, TrainingViews, UsageError
from aaplug.core.conventions import CONVENTIONS, MIP
from aaplug.core.convolution import fuse_stored
from aaplug.core.lenses import EQUIDISTANT, EQUIRECT, ORTHO, PINHOLE, Lens
from aaplug.core.projection import project, rotation_matrices
from aaplug.core.sights import sights
from aaplug.evaluation.laws.filters import CAMERAS, F64, SCENE, SITUATIONS, spheres, trained_with, world_scene
from aaplug.lab.filters import ADAPTIVE_VARIANCE, LEAST_SHARE, Adaptive, AnisotropicSmoothing, FlatSmoothing
from aaplug.lab.pixel_size import ByPixelSize, PixelSizes, pixel_size
from aaplug.methods.filters.dilation import Dilation
from aaplug.methods.filters.energy import MatchedEnergy
from aaplug.methods.filters.matched import FULL_RISE_AT, MAX_RISE, PIXEL_VARIANCE, Matched
from aaplug.methods.filters.smoothing import BALANCE_FLOOR, Smoothing3D
from aaplug.methods.presets import suited
from tests.conftest import each, make_camera, make_scene, make_splats, sized, splats_of

WIDE = make_scene(60, dtype=F64)
CLOSE = replace(WIDE, means=0.2 * WIDE.means)  # every camera sees all of it
NEAR, FAR = make_camera((0.0, -4.0, 0.0)), make_camera((3.0, -6.0, 1.0))
LONG = replace(FAR, fx=2 * FAR.fx, fy=2 * FAR.fy)


def widened_in_the_world(scene, training, camera):
    """AAA-Gaussians as the paper has it: a variance in the world, of each Gaussian in this view."""
    here = ADAPTIVE_VARIANCE / sights(scene.means, camera).rates ** 2
    added = torch.maximum(ADAPTIVE_VARIANCE / training.bounds.highest**2, here)
    return replace(scene, log_scales=0.5 * (scene.scales**2 + added[:, None]).log())


BENT = Lens("pinhole", radial=(0.1,))


@pytest.mark.parametrize("lens", [PINHOLE, ORTHO, EQUIRECT, EQUIDISTANT, BENT], ids=lambda lens: lens.kind)
@pytest.mark.parametrize("scale", [0.2, 1.0, 3.0])
def test_the_adaptive_filter_equals_a_variance_in_the_world(scale, lens):
    training, camera = TrainingViews.of(CLOSE, [NEAR, FAR]), replace(NEAR, lens=lens).scaled(scale)
    raw = project(CLOSE, camera)
    assert len(raw) == len(CLOSE), "the test needs all of them"
    assert training.bounds.seen.all()
    wide = project(widened_in_the_world(CLOSE, training, camera), camera)
    filtered = Adaptive()(raw, camera, training)
    torch.testing.assert_close(filtered.covs, wide.covs, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(filtered.dets, wide.dets, rtol=1e-6, atol=1e-9)


def test_the_adaptive_filters_factor_is_the_change_of_area_across_the_ray():
    """The published form: r · (s_y² s_z², s_z² s_x², s_x² s_y²), r the squared direction in the Gaussian's axes."""
    training = TrainingViews.of(CLOSE, [NEAR, FAR])
    wide = widened_in_the_world(CLOSE, training, NEAR)
    rotations = rotation_matrices(CLOSE.unit_quats)
    towards = CLOSE.means - NEAR.centre
    towards = towards / towards.norm(dim=1, keepdim=True)
    shares = torch.einsum("nij,ni->nj", rotations, towards) ** 2

    def area(scene):
        x, y, z = (scene.scales**2).unbind(dim=1)
        return (shares * torch.stack([y * z, z * x, x * y], dim=1)).sum(dim=1)

    factor = (area(CLOSE) / area(wide)).sqrt()
    raw = project(CLOSE, NEAR)
    filtered = Adaptive()(raw, NEAR, training)
    expected = raw.opacities * factor.clamp(min=0.005)
    torch.testing.assert_close(filtered.opacities, expected, rtol=1e-5, atol=1e-9)


def test_the_largest_focal_length_is_paired_with_every_depth():
    """Mip-Splatting's code takes max f / min z, its paper max f/z: they differ where focal lengths do."""
    training = TrainingViews.of(CLOSE, [NEAR, LONG])
    depths = torch.stack([project(CLOSE, camera).depths for camera in (NEAR, LONG)])
    filtered = Smoothing3D(focal="largest")(CLOSE, training)
    sigma = math.sqrt(0.2) * depths.amin(dim=0) / LONG.focal
    expected = 0.5 * (CLOSE.scales**2 + sigma[:, None] ** 2).log()
    torch.testing.assert_close(filtered.log_scales, expected)
    own = Smoothing3D()(CLOSE, training)
    assert (own.log_scales - filtered.log_scales).max() > 0.01
    alike = TrainingViews.of(CLOSE, [NEAR, FAR])
    same = [Smoothing3D(focal=focal)(CLOSE, alike).log_scales for focal in ("own", "largest")]
    torch.testing.assert_close(*same)


def added_variances(filter_, scene, cameras):
    """The variance that a filter adds to each axis, relative to the isotropic one."""
    training = TrainingViews.of(scene, cameras)
    added = filter_(scene, training).scales.square() - scene.scales.square()
    return added * training.bounds.highest.square()[:, None] / filter_.variance


def test_anisotropic_smoothing_is_wide_along_the_ray_of_a_single_view():
    """The camera looks along y; axes turned by half a right angle have half of what is across the ray."""
    scene = replace(CLOSE[:2], means=torch.zeros(2, 3, dtype=F64))
    turn = [[1.0, 0.0, 0.0, 0.0], [math.cos(math.pi / 8), 0.0, 0.0, math.sin(math.pi / 8)]]
    scene = replace(scene, quats=torch.tensor(turn, dtype=F64))
    ahead = make_camera((0.0, -4.0, 0.0))
    added = added_variances(AnisotropicSmoothing(), scene, [ahead])
    expected = torch.tensor([[1.0, 1 / LEAST_SHARE, 1.0], [2.0, 2.0, 1.0]], dtype=F64)
    torch.testing.assert_close(added, expected, rtol=1e-6, atol=0)


def test_anisotropic_smoothing_is_isotropic_where_views_come_from_all_sides():
    eyes = [(-4.0, 0.0, 1e-9), (0.0, -4.0, 0.0), (1e-9, 0.0, 4.0)]
    scene = replace(CLOSE, means=0 * CLOSE.means)
    added = added_variances(AnisotropicSmoothing(), scene, [make_camera(eye) for eye in eyes])
    torch.testing.assert_close(added, torch.full_like(added, 1.5), rtol=1e-5, atol=0)


@pytest.mark.parametrize(("thickness", "expected"), [((2.0, 2.0, 1e-3), 4 / 5), ((0.1, 0.1, 0.1), BALANCE_FLOOR)])
def test_balanced_opacity_follows_the_broadest_face_down_to_its_floor(thickness, expected):
    """Scales relative to the smoothing: a disc twice as wide keeps 4/5 of its opacity."""
    scene = CLOSE[:1]
    training = TrainingViews.of(scene, [NEAR])
    sigma = math.sqrt(0.2) / training.bounds.highest
    scene = replace(scene, log_scales=(sigma[:, None] * torch.tensor([thickness], dtype=F64)).log())
    balanced = Smoothing3D(opacity="balanced")(scene, training)
    assert (balanced.opacities / scene.opacities).item() == pytest.approx(expected, rel=1e-6)


CUTOFF = math.sqrt(2 * math.log(255))  # size of an opaque splat over a cross-section


def test_pixel_sizes_are_those_of_the_published_form():
    """min(√(L/A), √(L/C)) with the diagonal of the inverse, by a matrix's own inverse."""
    splats = make_splats(200, (40, 60)).to(F64)
    xx, xy, yy = splats.covs.unbind(dim=1)
    splats = replace(splats, dets=xx * yy - xy * xy)
    splats.opacities[:9] = 0.003  # too faint to have a size
    inverse = torch.linalg.inv(torch.stack([xx, xy, xy, yy], dim=1).view(-1, 2, 2))
    level = (-2 * (1 / (255 * splats.opacities)).log()).clamp(min=0)
    expected = (level[:, None] / inverse.diagonal(dim1=1, dim2=2)).sqrt().amin(dim=1)
    torch.testing.assert_close(pixel_size(splats), expected, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize(
    ("size", "smallest", "largest", "base", "drawn"),
    [
        (1.0, 1.9, 5.0, False, True),
        (1.0, 2.1, 5.0, False, False),  # below half of the smallest
        (1.0, 2.1, 5.0, True, True),  # but of the coarsest level
        (2.1, 9.0, 9.0, False, True),  # never too small from 2 px on
        (1.9, 9.0, 9.0, False, False),
        (9.9, 1.0, 5.0, False, True),
        (10.1, 1.0, 5.0, False, False),  # above twice the largest
        (10.1, 1.0, 5.0, True, True),
        (0.01, 0.0, 5.0, False, True),  # unknown
        (99.0, 1.0, 0.0, False, True),
        (0.01, -1.0, -1.0, False, True),
        (0.01, math.nan, math.nan, False, True),
    ],
)
def test_multi_scale_draws_gaussians_at_the_sizes_of_training(size, smallest, largest, base, drawn):
    variance = (size / CUTOFF) ** 2
    splats = splats_of(*[((0.0, 0.0), (variance, 0.0, variance), 1.0, 1.0, (1.0, 1.0, 1.0))] * 2)
    always = PixelSizes(torch.ones(2) * smallest, torch.ones(2) * largest, torch.tensor([base, True]))
    chosen = ByPixelSize()(splats, replace(make_scene(2), extras=always.extras))
    assert chosen.sources.tolist() == [0, 1][not drawn :]


def test_multi_scale_selects_by_the_size_in_the_view_before_dilation():
    """A scene with a fine and a coarse copy of a blob: near views draw the fine one, far ones the coarse one."""
    scene = replace(
        make_scene(2),
        means=torch.zeros(2, 3),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2),
        log_scales=torch.tensor([[0.05] * 3, [0.2] * 3]).log(),
        logit_opacities=torch.full((2,), 10.0),
    )
    camera = make_camera(size=(200, 200))
    sizes = pixel_size(project(scene, camera))
    level = PixelSizes(sizes / 2, torch.tensor([99.0, 0.25 * sizes[1]]), torch.tensor([False, False]))
    scene = replace(scene, extras=level.extras)
    drawn = {scale: ByPixelSize()(project(scene, camera.scaled(scale)), scene).sources.tolist() for scale in (1.0, 0.1)}
    assert drawn == {1.0: [0], 0.1: [1]}
    training = TrainingViews.of(scene, [camera])
    for scale, kept in drawn.items():
        view, alone = camera.scaled(scale), scene[kept[0] :][:1]
        image = Renderer(scene, training, RECIPES["multi-scale"])(view).rgb
        alone = Renderer(alone, training, RECIPES["classic"])(view).rgb
        torch.testing.assert_close(image, alone)


def test_a_scene_without_pixel_sizes_is_refused():
    scene = make_scene(3)
    training, recipe = TrainingViews.of(scene, [NEAR]), RECIPES["multi-scale"]
    unprepared = Renderer(scene, training, recipe)
    for refused in (lambda: unprepared(NEAR), lambda: suited(recipe, scene)):
        with pytest.raises(UsageError, match=r"multi-scale: the scene lacks .*min_pixel_sizes"):
            refused()
    assert RECIPES["classic"].lacks(scene) is None
    assert suited(recipe, sized(scene)) is recipe


@pytest.mark.parametrize(("name", "factor"), [("2dgs", 1.0), ("2dgs-matched", 0.5)])
def test_the_low_pass_filter_follows_the_rate_where_it_is_matched(name, factor):
    """A disc of no size looks like its filter: √½ px wide, or √½ / 2 px at half the size."""
    scene = replace(
        make_scene(1, dtype=F64),
        means=torch.zeros(1, 3, dtype=F64),
        quats=torch.tensor([[0.7, 0.7, 0.0, 0.0]], dtype=F64),
        log_scales=torch.tensor([[-12.0, -12.0, -30.0]], dtype=F64),
        logit_opacities=torch.tensor([4.0], dtype=F64),
        flat=True,
    )
    camera = make_camera((0.0, -4.0, 0.0), size=(16, 16))
    recipe = replace(RECIPES[name], target_rate=0.0)
    alpha = Renderer.of(scene, [camera], recipe, rasterizer="eager")(camera.scaled(0.5)).alpha
    squared = 2 * 0.5 / factor**2  # the nearest pixel centres are half a px away in x and y
    expected = scene.opacities.item() * math.exp(-squared / 2)
    assert alpha.max().item() == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("apart", [0.0, 0.1**0.5])
def test_a_viewers_clamps_are_those_of_its_shader(apart):
    """Splat by splat: the axes as the vertex shaders of PlayCanvas and GaussianSplats3D take them, variances in px²."""
    splats, smallest = project(CLOSE, NEAR.scaled(0.2)), 0.5
    raw = splats.blurred(0.1, compensate=True)
    shown = Dilation(0.1, True, smallest, apart)(splats, NEAR, TrainingViews.of(CLOSE, [NEAR]))
    kept = 0
    for (xx, xy, yy), opacity, after, covariance in zip(
        raw.covs.tolist(), raw.opacities.tolist(), shown.opacities.tolist(), shown.covs.tolist(), strict=True
    ):
        mean, radius = (xx + yy) / 2, max(math.hypot((xx - yy) / 2, xy), apart)
        longer, shorter = mean + radius, mean - radius
        if longer < smallest or shorter <= 0:
            assert after == 0
            continue
        kept += 1
        u, v = xy, longer - xx
        norm = math.hypot(u, v)
        u, v = u / norm, v / norm
        expected = longer * u * u + shorter * v * v, (longer - shorter) * u * v, longer * v * v + shorter * u * u
        assert after == opacity
        assert covariance == pytest.approx(expected, abs=1e-9)
    assert 0 < kept < len(splats)


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


@pytest.mark.parametrize("dtype", [torch.float32, F64], ids=str)
def test_a_stored_filter_is_fused_and_removed_and_one_of_0_changes_no_bit(dtype):
    scene = world_scene(dtype)
    assert scene.filter_3d is not None
    still = torch.arange(40) % 3 == 0
    scene = replace(scene, filter_3d=scene.filter_3d.masked_fill(still, 0.0))
    fused = fuse_stored(scene)
    for name in ("log_scales", "logit_opacities"):
        moved = getattr(fused, name) != getattr(scene, name)
        assert not moved[still].any()
        assert moved[~still].any()
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
    coarsest = training.bounds.highest.masked_fill(~training.bounds.seen, math.inf).argmin()
    torch.testing.assert_close(added[7], added[coarsest], rtol=1e-8, atol=0)
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

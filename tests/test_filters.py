"""Single filters beyond the laws that hold for all of them."""

import math
from dataclasses import replace

import pytest
import torch

from aaplug import RECIPES, Renderer, TrainingViews, UsageError
from aaplug.core.lenses import EQUIDISTANT, EQUIRECT, ORTHO, PINHOLE, Lens
from aaplug.core.projection import project, rotation_matrices
from aaplug.core.sights import sights
from aaplug.lab.filters import ADAPTIVE_VARIANCE, LEAST_SHARE, Adaptive, AnisotropicSmoothing
from aaplug.lab.pixel_size import ByPixelSize, PixelSizes, pixel_size
from aaplug.methods.filters.dilation import Dilation
from aaplug.methods.filters.smoothing import BALANCE_FLOOR, Smoothing3D
from aaplug.methods.presets import suited
from tests.conftest import make_camera, make_scene, make_splats, sized, splats_of

F64 = torch.float64
WIDE = make_scene(60, dtype=F64)
SCENE = replace(WIDE, means=0.2 * WIDE.means)  # every camera sees all of it
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
    training, camera = TrainingViews.of(SCENE, [NEAR, FAR]), replace(NEAR, lens=lens).scaled(scale)
    raw = project(SCENE, camera)
    assert len(raw) == len(SCENE), "the test needs all of them"
    assert training.bounds.seen.all()
    wide = project(widened_in_the_world(SCENE, training, camera), camera)
    filtered = Adaptive()(raw, camera, training)
    torch.testing.assert_close(filtered.covs, wide.covs, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(filtered.dets, wide.dets, rtol=1e-6, atol=1e-9)


def test_the_adaptive_filters_factor_is_the_change_of_area_across_the_ray():
    """The published form: r · (s_y² s_z², s_z² s_x², s_x² s_y²), r the squared direction in the Gaussian's axes."""
    training = TrainingViews.of(SCENE, [NEAR, FAR])
    wide = widened_in_the_world(SCENE, training, NEAR)
    rotations = rotation_matrices(SCENE.unit_quats)
    towards = SCENE.means - NEAR.centre
    towards = towards / towards.norm(dim=1, keepdim=True)
    shares = torch.einsum("nij,ni->nj", rotations, towards) ** 2

    def area(scene):
        x, y, z = (scene.scales**2).unbind(dim=1)
        return (shares * torch.stack([y * z, z * x, x * y], dim=1)).sum(dim=1)

    factor = (area(SCENE) / area(wide)).sqrt()
    raw = project(SCENE, NEAR)
    filtered = Adaptive()(raw, NEAR, training)
    expected = raw.opacities * factor.clamp(min=0.005)
    torch.testing.assert_close(filtered.opacities, expected, rtol=1e-5, atol=1e-9)


def test_the_largest_focal_length_is_paired_with_every_depth():
    """Mip-Splatting's code takes max f / min z, its paper max f/z: they differ where focal lengths do."""
    training = TrainingViews.of(SCENE, [NEAR, LONG])
    depths = torch.stack([project(SCENE, camera).depths for camera in (NEAR, LONG)])
    filtered = Smoothing3D(focal="largest")(SCENE, training)
    sigma = math.sqrt(0.2) * depths.amin(dim=0) / LONG.focal
    expected = 0.5 * (SCENE.scales**2 + sigma[:, None] ** 2).log()
    torch.testing.assert_close(filtered.log_scales, expected)
    own = Smoothing3D()(SCENE, training)
    assert (own.log_scales - filtered.log_scales).max() > 0.01
    alike = TrainingViews.of(SCENE, [NEAR, FAR])
    same = [Smoothing3D(focal=focal)(SCENE, alike).log_scales for focal in ("own", "largest")]
    torch.testing.assert_close(*same)


def added_variances(filter_, scene, cameras):
    """The variance that a filter adds to each axis, relative to the isotropic one."""
    training = TrainingViews.of(scene, cameras)
    added = filter_(scene, training).scales.square() - scene.scales.square()
    return added * training.bounds.highest.square()[:, None] / filter_.variance


def test_anisotropic_smoothing_is_wide_along_the_ray_of_a_single_view():
    """The camera looks along y; axes turned by half a right angle have half of what is across the ray."""
    scene = replace(SCENE[:2], means=torch.zeros(2, 3, dtype=F64))
    turn = [[1.0, 0.0, 0.0, 0.0], [math.cos(math.pi / 8), 0.0, 0.0, math.sin(math.pi / 8)]]
    scene = replace(scene, quats=torch.tensor(turn, dtype=F64))
    ahead = make_camera((0.0, -4.0, 0.0))
    added = added_variances(AnisotropicSmoothing(), scene, [ahead])
    expected = torch.tensor([[1.0, 1 / LEAST_SHARE, 1.0], [2.0, 2.0, 1.0]], dtype=F64)
    torch.testing.assert_close(added, expected, rtol=1e-6, atol=0)


def test_anisotropic_smoothing_is_isotropic_where_views_come_from_all_sides():
    eyes = [(-4.0, 0.0, 1e-9), (0.0, -4.0, 0.0), (1e-9, 0.0, 4.0)]
    scene = replace(SCENE, means=0 * SCENE.means)
    added = added_variances(AnisotropicSmoothing(), scene, [make_camera(eye) for eye in eyes])
    torch.testing.assert_close(added, torch.full_like(added, 1.5), rtol=1e-5, atol=0)


@pytest.mark.parametrize(("thickness", "expected"), [((2.0, 2.0, 1e-3), 4 / 5), ((0.1, 0.1, 0.1), BALANCE_FLOOR)])
def test_balanced_opacity_follows_the_broadest_face_down_to_its_floor(thickness, expected):
    """Scales relative to the smoothing: a disc twice as wide keeps 4/5 of its opacity."""
    scene = SCENE[:1]
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
    splats, smallest = project(SCENE, NEAR.scaled(0.2)), 0.5
    raw = splats.blurred(0.1, compensate=True)
    shown = Dilation(0.1, True, smallest, apart)(splats, NEAR, TrainingViews.of(SCENE, [NEAR]))
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

"""The flow as a whole: what recipes promise about the training size, energy, samples and fusing."""

from dataclasses import replace

import pytest
import torch

from aaplug.core.cameras import WHITE, Camera
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import ANTIALIASED, CLASSIC, CONVENTIONS, MIP, Gaussians
from aaplug.core.projection import project
from aaplug.core.sampling import median_rates
from aaplug.io.scenes import read_scene, write_scene
from aaplug.methods.filters import StoredSmoothing
from aaplug.methods.recipes import RECIPES, find_recipe, suited
from aaplug.methods.viewers import FITTED_VARIANCE, FORMS, VIEWERS, convert, convert_for
from aaplug.rasterizers import RASTERIZERS
from aaplug.rendering.renderer import learn, rate_of, render, smooth
from tests.conftest import make_camera, make_scene

REFERENCE = RASTERIZERS["reference"]
TRAINED_WITH = {
    "classic": "classic",
    "antialiased": "ewa",
    "mip": "mip",
}  # convention: its own recipe
EYES = [(0.0, -4.0, 0.0), (3.0, -3.5, 1.0), (-1.0, -2.5, 1.5), (0.5, 5.0, -1.0)]


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    return [make_camera(eye, name=f"view_{i}") for i, eye in enumerate(EYES)]


@pytest.mark.parametrize("convention", CONVENTIONS.values(), ids=lambda c: c.name)
@pytest.mark.parametrize("name", ["matched", "auto"])
@pytest.mark.parametrize("rate", ["pose", "global", "interval"])
def test_matched_is_training_itself_at_every_view_of_the_training_size(
    convention, name, rate, cameras
):
    scene = replace(make_scene(200), convention=convention)
    training = learn(scene, cameras[1:])  # the first view is held out
    recipe, trained = find_recipe(name, rate=rate), RECIPES[TRAINED_WITH[convention.name]]
    for camera in cameras:
        ours = render(scene, camera, recipe, training, background=WHITE)
        theirs = render(scene, camera, trained, training, background=WHITE)
        assert (ours.rgb - theirs.rgb).abs().max() <= 1e-5


def test_matched_to_the_sharpest_view_is_thinner_at_the_others(cameras):
    scene = make_scene(200)
    training = learn(scene, cameras)
    sharpest = find_recipe("matched", rate="sharpest")
    differs = [
        (
            render(scene, camera, sharpest, training).rgb
            - render(scene, camera, RECIPES["classic"], training).rgb
        )
        .abs()
        .max()
        for camera in cameras
    ]
    assert max(differs) > 1e-3


@pytest.mark.parametrize("rate", [0.5, 0.25, 0.125, 2.0, 4.0])
def test_matched_keeps_the_light_of_an_isolated_splat_at_every_rate(rate):
    """Integrated alpha in units of the training pixel (reference: the trained covariance's 2πo√det)."""
    scene = one_gaussian(sigma=0.05, opacity=0.6)
    camera = make_camera(size=(64, 64))
    training = learn(scene, [camera])
    recipe = find_recipe("matched")
    trained = render(scene, camera, recipe, training, REFERENCE).alpha.sum()
    # dense pixels stand for the integral: a scaled view seen by a camera of the same rate, shifted by half pixels
    total = 0.0
    view = camera.scaled(rate)
    shifts = [0.125, 0.375, 0.625, 0.875]
    for dx in shifts:
        for dy in shifts:
            moved = replace(view, cx=view.cx + dx, cy=view.cy + dy)
            total += (
                render(scene, moved, recipe, training, REFERENCE).alpha.sum() / len(shifts) ** 2
            )
    assert total / rate**2 == pytest.approx(trained.item(), rel=0.03)


def test_classic_bloats_an_isolated_splat_when_zoomed_out():
    scene = one_gaussian(sigma=0.002, opacity=0.6)
    camera = make_camera(size=(512, 512))
    training = learn(scene, [camera])
    small = camera.scaled(1 / 8)
    classic, ours = (
        render(scene, small, find_recipe(name), training, REFERENCE).alpha.sum().item()
        for name in ("classic", "matched")
    )
    assert classic > 10 * ours  # algorithms: (v r² + 0.3) / (v r² + 0.3 r²) approaches 1/r² = 64


@pytest.mark.parametrize(
    ("rate", "fast", "balanced", "best"),
    [
        (1.0, 1, 1, 1),
        (2.0, 1, 1, 1),
        (0.5, 1, 1, 2),
        (0.25, 1, 2, 4),
        (0.125, 2, 4, 8),
        (0.3, 1, 2, 4),
    ],
)
def test_quality_takes_the_fewest_samples_that_reach_its_rate(rate, fast, balanced, best):
    counts = [
        find_recipe("auto", quality=quality).samples_at(rate)
        for quality in ("fast", "balanced", "best")
    ]
    assert counts == [fast, balanced, best]


def test_best_is_the_training_size_render_averaged():
    scene = make_scene(200)
    camera = make_camera(size=(64, 64))
    training = learn(scene, [camera])
    full = render(scene, camera, RECIPES["classic"], training).rgb
    boxes = full.unflatten(1, (-1, 4)).unflatten(0, (-1, 4)).mean(dim=(1, 3))
    best = render(scene, camera.scaled(1 / 4), find_recipe("auto", quality="best"), training).rgb
    torch.testing.assert_close(best, boxes, atol=1e-6, rtol=0)


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS.keys())
def test_converted_scene_renders_the_same_from_its_file(form, tmp_path, cameras):
    scene = make_scene(200)
    training = learn(scene, cameras)
    converted = convert(scene, training, form)
    write_scene(tmp_path / "converted.ply", converted)
    again = read_scene(tmp_path / "converted.ply")
    assert (again.convention, again.fused) == (MIP, converted.fused)
    images = [render(s, cameras[0], RECIPES["mip"], training).rgb for s in (converted, again)]
    assert torch.equal(*images)


def test_stored_3d_filter_renders_the_same_fused_and_unfused(cameras):
    scene = replace(make_scene(200), filter_3d=torch.full((200,), 0.05), convention=MIP)
    training = learn(scene, cameras)
    recipe = find_recipe("auto")
    fused = convert(scene, None, FORMS["mip-splatting"])
    assert fused.filter_3d is None
    images = [
        render(smooth(s, training, recipe), cameras[0], recipe, training).rgb
        for s in (scene, fused)
    ]
    assert torch.equal(*images)
    assert torch.equal(StoredSmoothing()(scene, training).log_scales, fused.log_scales)


def test_stored_3d_filter_is_never_left_out(cameras):
    scene = replace(make_scene(200), filter_3d=torch.full((200,), 0.2), convention=MIP)
    training = learn(scene, cameras)
    for recipe in RECIPES.values():
        assert smooth(scene, training, recipe).filter_3d is None


def test_converting_twice_is_refused(cameras):
    scene = make_scene(50)
    training = learn(scene, cameras)
    converted = convert(scene, training, FORMS["matched-energy"])
    for form in FORMS.values():
        with pytest.raises(UsageError, match="already has matched-energy"):
            convert(converted, training, form)


def test_converting_a_classic_scene_needs_cameras():
    with pytest.raises(UsageError, match="--cameras"):
        convert(make_scene(3), None, FORMS["matched-energy"])


def test_a_mip_scene_without_stored_filter_has_nothing_to_fuse(cameras):
    scene = replace(make_scene(3), convention=MIP)
    with pytest.raises(UsageError, match="nothing to fuse"):
        convert(scene, learn(scene, cameras), FORMS["matched-energy"])


@pytest.mark.parametrize("convention", [CLASSIC, ANTIALIASED], ids=lambda c: c.name)
def test_converted_splats_show_the_energy_that_training_showed(convention):
    """One camera, so that nothing is averaged: the Mip viewer's o√det equals training's to rounding."""
    scene = replace(make_scene(100, dtype=torch.float64), convention=convention)
    scene = replace(
        scene, logit_opacities=scene.logit_opacities - 4
    )  # far from the bound on opacity
    camera = make_camera()
    training = learn(scene, [camera])
    converted = convert(scene, training, FORMS["matched-energy"])
    trained = project(scene, camera).blurred(convention.kernel, convention.compensated)
    shown = project(converted, camera)
    seen = training.bounds.seen[shown.sources]
    energy = (shown.opacities * shown.dets.sqrt())[seen]
    torch.testing.assert_close(
        energy, (trained.opacities * trained.dets.sqrt())[seen], rtol=1e-6, atol=0
    )


@pytest.mark.parametrize("viewer", VIEWERS.values(), ids=VIEWERS)
@pytest.mark.parametrize("trained", CONVENTIONS.values(), ids=CONVENTIONS)
def test_converted_for_a_viewer_shows_the_energy_that_training_showed(viewer, trained):
    """One camera, and splats as wide as they need be: the viewer's o√det equals training's, and so does the width."""
    scene = replace(make_scene(100, dtype=torch.float64), convention=trained)
    scene = replace(
        scene,
        logit_opacities=scene.logit_opacities - 4,
        log_scales=scene.log_scales[:, :1].repeat(1, 3).clamp(min=-2.5),
        means=scene.means * 0.1,
    )
    camera = make_camera()
    training = learn(scene, [camera])
    converted = convert_for(scene, training, viewer)
    assert converted.convention == viewer.convention
    assert (converted is scene) == (trained == viewer.convention)
    rules = (scene, trained), (converted, viewer.convention)
    then, now = (project(s, camera).blurred(c.kernel, c.compensated) for s, c in rules)
    energies = [splats.opacities * splats.dets.sqrt() for splats in (then, now)]
    torch.testing.assert_close(*energies, rtol=1e-6, atol=0)
    fitted = viewer.convention.compensated and not trained.compensated
    missing = FITTED_VARIANCE + viewer.convention.kernel - trained.kernel if fitted else 0.0
    trace = [splats.covs[:, 0] + splats.covs[:, 2] for splats in (then, now)]
    torch.testing.assert_close(trace[0] + 2 * missing, trace[1], rtol=0.01, atol=0)


def test_a_scene_too_thin_for_a_viewers_blur_keeps_some_area(cameras):
    scene = replace(make_scene(40), convention=MIP)
    scene = replace(scene, log_scales=scene.log_scales - 4)
    converted = convert_for(scene, learn(scene, cameras), VIEWERS["antialiased-viewer"])
    assert (converted.log_scales <= scene.log_scales).all()
    assert converted.log_scales.isfinite().all()
    px = converted.scales * median_rates(scene.means, cameras)[:, None]
    least = (scene.scales * median_rates(scene.means, cameras)[:, None]).clamp(max=0.1)
    assert (px >= 0.999 * least).all()
    assert (px < 0.999 * scene.scales * median_rates(scene.means, cameras)[:, None]).any()


def test_a_free_camera_is_compared_with_the_training_cameras_focal():
    training = learn(make_scene(10), [make_camera(), make_camera(fov=1.4)])
    focals = sorted(camera.focal for camera in training.cameras)
    free = replace(make_camera(), trained_focal=None)
    assert training.relative_rate(free) == pytest.approx(free.focal / (sum(focals) / 2))
    assert training.relative_rate(make_camera(fov=1.4).scaled(0.5)) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("words", "culprit"),
    [
        ({"name": "mipp"}, "mipp"),
        ({"name": "auto", "quality": "great"}, "great"),
        ({"name": "classic", "rate": "global"}, "classic"),
    ],
)
def test_unknown_recipe_words_are_named(words, culprit):
    with pytest.raises(UsageError, match=culprit):
        find_recipe(**words)


def one_gaussian(sigma: float, opacity: float) -> Gaussians:
    return Gaussians(
        means=torch.zeros(1, 3),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        log_scales=torch.full((1, 3), sigma).log(),
        logit_opacities=torch.logit(torch.tensor([opacity])),
        sh=torch.zeros(1, 1, 3),
    )


@pytest.mark.parametrize(("distance", "rate"), [(4.0, 1.0), (2.0, 2.0), (16.0, 0.25)])
def test_a_free_camera_has_the_rate_of_its_distance(distance, rate):
    scene = make_scene(50, dtype=torch.float64)
    scene = replace(scene, means=0.01 * scene.means)
    trained = make_camera((0.0, -4.0, 0.0))
    training = learn(scene, [trained])
    free = replace(make_camera((0.0, -distance, 0.0)), trained_focal=None)
    assert rate_of(scene, free, training) == pytest.approx(rate, rel=0.05)
    assert rate_of(scene, trained.scaled(0.25), training) == 0.25
    unseeing = replace(make_camera((0.0, -9.0, 0.0)), trained_focal=None, cx=1e6)
    assert rate_of(scene, unseeing, training) == training.relative_rate(unseeing)


@pytest.mark.parametrize(("free", "like"), [(True, "interval"), (False, "global")])
def test_matched_takes_the_interval_for_free_cameras_alone(free, like):
    """From near; from afar both give way to a sharper rate."""
    scene, cameras = make_scene(50), [make_camera((0.0, -4.0, 0.0)), make_camera((2.0, -3.0, 1.0))]
    training = learn(scene, cameras)
    view = make_camera((0.0, -8.0, 0.0)).scaled(2.5)
    if free:
        view = replace(view, trained_focal=None)
    found = RECIPES["matched"].screen(project(scene, view), view, training)
    expected = find_recipe("matched", rate=like).screen(project(scene, view), view, training)
    other = find_recipe("matched", rate="sharpest").screen(project(scene, view), view, training)
    torch.testing.assert_close(found.covs, expected.covs)
    assert (found.covs - other.covs).abs().max() > 0.01


def test_auto_draws_discs_for_a_scene_of_them_alone():
    scene = make_scene(3)
    assert suited(RECIPES["auto"], scene) is RECIPES["auto"]
    flat = replace(scene, flat=True)
    best = find_recipe("auto", quality="best")
    assert suited(best, flat).pixel == "surfel"
    assert suited(best, flat).samples_at(0.25) == best.samples_at(0.25) == 4
    assert suited(RECIPES["matched"], flat) is RECIPES["matched"]

"""Conversion in closed form, merging, and how a scene is placed: files, the energy of viewers, what is refused."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation

import aaplug
from aaplug import CameraSet, Fusion, Rules, TrainingViews, UsageError, read_scene, write_scene
from aaplug.core.conventions import ANTIALIASED, CLASSIC, CONVENTIONS, MIP
from aaplug.core.placing import mirrored, placed
from aaplug.core.projection import project, rotation_matrices
from aaplug.core.sampling import median_rates
from aaplug.core.spherical_harmonics import sh_colour
from aaplug.methods.conversion import FITTED_VARIANCE, FORMS, carried, fuse, fuse_for
from aaplug.methods.filters.dilation import Dilation
from aaplug.methods.filters.energy import MatchedEnergy
from aaplug.methods.presets import recipe_of
from aaplug.methods.viewers import DISC_VIEWER, VIEWERS
from aaplug.rendering.agreement import photo_of
from aaplug.rendering.renderer import own_look
from tests.conftest import make_camera, make_scene, moved
from tests.scene_files import oracle


def test_what_cannot_be_fused_is_refused(cameras):
    scene = make_scene(50)
    training = TrainingViews.of(scene, cameras)
    with pytest.raises(UsageError, match="needs the training cameras"):
        fuse(scene, None, FORMS["matched-energy"])
    with pytest.raises(UsageError, match="nothing to fuse; `aaplug merge` of it alone changes the format"):
        fuse(replace(scene, convention=MIP), training, FORMS["matched-energy"])  # without a stored filter
    converted = fuse(scene, training, FORMS["matched-energy"])
    for form in FORMS.values():
        cure = "; convert the scene that it was made of, or `aaplug merge` of it alone"
        with pytest.raises(UsageError, match=f"already has matched-energy.*{cure}"):
            fuse(converted, training, form)


@pytest.mark.parametrize(
    "viewer", {viewer.convention: viewer for viewer in VIEWERS.values()}.values(), ids=lambda v: v.name
)
@pytest.mark.parametrize("trained", CONVENTIONS.values(), ids=CONVENTIONS)
def test_converted_for_a_viewer_shows_the_energy_that_training_showed(viewer, trained):
    """With one camera and splats wide enough, the viewer's o√det and width are those of training."""
    scene = replace(make_scene(100, dtype=torch.float64), convention=trained)
    scene = replace(
        scene,
        logit_opacities=scene.logit_opacities - 4,
        log_scales=scene.log_scales[:, :1].repeat(1, 3).clamp(min=-2.5),
        means=scene.means * 0.1,
    )
    camera = make_camera()
    training = TrainingViews.of(scene, [camera])
    converted = fuse_for(scene, training, viewer)
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


def test_harmonics_that_a_viewer_does_not_draw_are_not_written(tmp_path, cameras):
    scene = replace(make_scene(50), sh=torch.randn(50, 16, 3, generator=torch.Generator().manual_seed(0)))
    write_scene(tmp_path / "scene.ply", scene)
    scene = read_scene(tmp_path / "scene.ply").gaussians()
    training = TrainingViews.of(scene, cameras)
    for name, degree in (("mkkellogg", 2), ("mkkellogg-classic", 2), ("spark", 3), ("classic", 3)):
        write_scene(tmp_path / f"{name}.ply", fuse_for(scene, training, VIEWERS[name]))
        again = read_scene(tmp_path / f"{name}.ply").gaussians()
        assert again.sh_degree == degree
        assert torch.equal(again.sh, scene.sh[:, : (degree + 1) ** 2])


def test_playcanvas_adds_a_quarter_of_what_its_number_says():
    """Its 0.3 is in half pixels: measured, its pictures agree with 0.075 px² to 41 dB, with 0.3 px² to 37 and less."""
    for name, compensated in (("playcanvas", True), ("supersplat", True), ("playcanvas-classic", False)):
        viewer = VIEWERS[name]
        assert recipe_of(viewer).screen == Dilation(0.075, compensated, smallest=0.125)
        assert viewer.switched == compensated


@pytest.mark.parametrize("viewer", VIEWERS.values(), ids=VIEWERS)
def test_a_viewers_recipe_draws_by_its_rule(viewer):
    rule = viewer.convention
    assert recipe_of(viewer).screen == Dilation(rule.kernel, rule.compensated, viewer.smallest, viewer.apart)


def test_a_scene_thinner_than_a_viewers_blur_keeps_some_area(cameras):
    scene = replace(make_scene(40), convention=MIP)
    scene = replace(scene, log_scales=scene.log_scales - 4)
    converted = fuse_for(scene, TrainingViews.of(scene, cameras), VIEWERS["antialiased"])
    assert (converted.log_scales <= scene.log_scales).all()
    assert converted.log_scales.isfinite().all()
    rates = median_rates(scene.means, cameras)[:, None]
    px, before = converted.scales * rates, scene.scales * rates
    assert (px >= 0.999 * before.clamp(max=0.1)).all()
    assert (px < 0.999 * before).any()


OTHERS = {"near": make_camera((0.0, -3.0, 0.0)), "blind": replace(make_camera((0.0, -12.0, 0.0)), cx=1e5)}


@pytest.mark.parametrize("other", OTHERS.values(), ids=OTHERS)
def test_a_view_in_which_training_drew_a_gaussian_not_does_not_count(other):
    """Its rules have the near plane between the two cameras' depths; the median of two rates is the lower one."""
    scene, far = make_scene(1), make_camera((0.0, -9.0, 0.0))
    scene = replace(scene, means=torch.zeros(1, 3), convention=replace(CONVENTIONS["classic"], rules=Rules(near=5.0)))
    both, alone = (MatchedEnergy()(scene, TrainingViews.of(scene, views)) for views in ([other, far], [far]))
    for name in ("log_scales", "logit_opacities"):
        torch.testing.assert_close(getattr(both, name), getattr(alone, name))


def test_discs_are_smoothed_within_their_planes_and_stay_discs(cameras, tmp_path):
    """Variances grow by 0.2 / rate² along two axes, and the integral over the disc stays (AA-2DGS's flat kernel)."""
    scene = make_scene(20, seed=2)
    scene = replace(scene, log_scales=scene.log_scales.index_fill(1, torch.tensor(2), -30.0), flat=True)
    aaplug.convert(scene, CameraSet(tuple(cameras), ()), tmp_path / "discs.ply", min_seen=0.0)
    fused = read_scene(tmp_path / "discs.ply").gaussians()
    added = 0.2 / TrainingViews.of(scene, cameras, min_seen=0.0).bounds.highest_or_coarsest.square()
    torch.testing.assert_close(fused.scales[:, :2].square(), scene.scales[:, :2].square() + added[:, None])
    before, after = (s.opacities * s.scales[:, :2].prod(dim=1) for s in (scene, fused))
    torch.testing.assert_close(after, before, rtol=1e-4, atol=0)
    assert fused.flat
    assert fused.convention == scene.convention
    for options in ({"form": "matched-energy"}, {"viewer": "spark"}):
        with pytest.raises(UsageError, match=r"2D Gaussians.*form mip-splatting smooths them"):
            aaplug.convert(scene, CameraSet(tuple(cameras), ()), None, min_seen=0.0, **options)
    with pytest.raises(UsageError, match=r"2D Gaussians"):  # `matched`, the usual rule of fine-tuning, draws no discs
        aaplug.finetune(scene, CameraSet(tuple(cameras), ()), None, min_seen=0.0, views="train", steps=0)


def test_a_format_that_no_viewer_opens_is_told():
    assert VIEWERS["mip"].caveat("balls", "scene.balls") == "no viewer is known to open scene.balls"
    assert DISC_VIEWER.caveat("sog", "discs.sog") == "no viewer is known to open discs.sog"  # as discs


WHITE = (1.0, 1.0, 1.0)


def covariances(scene):
    axes = rotation_matrices(scene.unit_quats) * scene.scales[:, None]
    return axes @ axes.transpose(1, 2)


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (90.0, 0.0, 0.0), (20.0, -70.0, 130.0)])
def test_a_placed_scene_is_seen_turned_and_as_large(angles):
    """Its points, its covariances and its colours go where a rigid motion and a scale take them."""
    scene, turn = oracle().to(torch.float64), torch.tensor(Rotation.from_euler("xyz", angles, degrees=True).as_matrix())
    moved = placed(scene, turn, 3.0, (1.0, -2.0, 5.0))
    ways = torch.nn.functional.normalize(torch.randn(40, 3, dtype=torch.float64), dim=1)
    shift = torch.tensor([1.0, -2, 5], dtype=torch.float64)
    torch.testing.assert_close(moved.means, 3 * scene.means @ turn.T + shift)
    torch.testing.assert_close(covariances(moved), 9 * turn @ covariances(scene) @ turn.T)
    torch.testing.assert_close(sh_colour(moved.sh, ways @ turn.T), sh_colour(scene.sh, ways))
    again = placed(moved, turn.T, 1 / 3, (-turn.T @ shift / 3).tolist())
    for name in ("means", "log_scales", "sh"):
        torch.testing.assert_close(getattr(again, name), getattr(scene, name))


@pytest.mark.parametrize("signs", [(1.0, -1.0, -1.0), (-1.0, -1.0, 1.0), (-1.0, 1.0, 1.0)])
def test_a_mirrored_scene_is_seen_mirrored(signs):
    scene, ways = oracle(), torch.nn.functional.normalize(torch.randn(40, 3), dim=1)
    other, factors = mirrored(scene, signs), torch.tensor(signs)
    torch.testing.assert_close(sh_colour(other.sh, ways * factors), sh_colour(scene.sh, ways))
    torch.testing.assert_close(covariances(other), covariances(scene) * factors[:, None] * factors)
    again = mirrored(other, signs)
    assert all(torch.equal(getattr(again, name), getattr(scene, name)) for name in scene.columns)


def test_a_mixed_scene_looks_like_its_parts(sample_scene, sample_cameras):
    """A classic, a Mip-Splatting and an antialiased scene, merged, are within 0.5 dB of each drawn alone."""
    few = sample_scene[::4]
    training = TrainingViews.of(few, sample_cameras)
    parts = [carried(few, training, convention) for convention in (CLASSIC, MIP, ANTIALIASED)]
    moves = [(0.0, 0.0, 0.0), (300.0, 0.0, 700.0), (600.0, 0.0, 1400.0)]  # no view of one shows another
    merged = aaplug.merge(parts, sample_cameras, move=sum(moves, ()))
    assert (merged.convention, len(merged)) == (MIP, 3 * len(few))
    for part, move in zip(parts, moves, strict=True):
        there = CameraSet(
            *(tuple(moved(v, move) for v in views) for views in (sample_cameras.train, sample_cameras.test))
        )
        alone = own_look(part, TrainingViews.of(part, sample_cameras), background=WHITE)
        whole = own_look(merged, TrainingViews.of(merged, there), background=WHITE)
        view, same = (cameras.test[0].scaled(0.25) for cameras in (sample_cameras, there))
        truth = photo_of(sample_cameras.test[0], WHITE)(view)
        images = alone(view).rgb.clamp(0, 1), whole(same).rgb.clamp(0, 1)
        errors = torch.stack([(image - truth).square().mean().log10() * 10 for image in images])
        assert errors.diff() < 0.5, part.convention.name


def test_degrees_records_and_places_are_brought_together():
    first = replace(oracle(), sh=oracle().sh[:, :4], fused=(Fusion("merge", {"rate": "0.5"}),))
    second = replace(oracle(), filter_3d=torch.full((40,), 0.01), extras={"more": torch.zeros(40)})
    turns = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    merged = aaplug.merge([first, second], move=(0.0, 0.0, 0.0, 1.0, 2.0, 3.0), turn=turns, scale=(1.0, 2.0))
    assert (len(merged), merged.sh_degree, merged.convention) == (80, 3, MIP)
    assert [fusion.method for fusion in merged.fused] == ["merge", "filter_3D"]
    assert merged.filter_3d is None
    assert not merged.extras
    torch.testing.assert_close(merged.means[:40], first.means)
    torch.testing.assert_close(merged.sh[:40], torch.nn.functional.pad(first.sh, (0, 0, 0, 12)))
    half_turn = second.means * torch.tensor([-2.0, -2, 2]) + torch.tensor([1.0, 2, 3])
    torch.testing.assert_close(merged.means[40:], half_turn)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"move": (1.0, 2.0, 3.0)}, "move: expected 6 numbers for 2 scenes, got 3"),
        ({"turn": (0.0,) * 7}, "turn: expected 6 or 8 numbers for 2 scenes, got 7"),
        ({"turn": (0.0,) * 8}, "a quaternion, got one of length 0"),
        ({"scale": (1.0, 0.0)}, "scale: takes"),
        ({"into": "nothing"}, "into: 'nothing' is not one of"),
    ],
)
def test_places_that_do_not_fit_are_refused(options, problem):
    with pytest.raises(UsageError, match=problem):
        aaplug.merge([oracle(), oracle()], **options)


def test_all_scenes_together_should_fit_into_memory(monkeypatch):
    scene = make_scene(1000)
    monkeypatch.setattr("aaplug.io.limits.usable_memory", lambda: (3e5, "this machine's 0.0 GB"))
    assert len(aaplug.merge([scene])) == 1000
    with pytest.raises(UsageError, match=r"scenes: their 2,000 Gaussians take .* more than 50% of this machine's"):
        aaplug.merge([scene, scene])


def test_discs_and_ellipsoids_do_not_mix():
    flat = replace(oracle(), flat=True)
    with pytest.raises(UsageError, match="2D Gaussians"):
        aaplug.merge([oracle(), flat])
    with pytest.raises(UsageError, match="2D Gaussians"):
        aaplug.merge([flat], into="classic")
    with pytest.raises(UsageError, match="needs at least one, got none"):
        aaplug.merge([])


def test_the_command_merges_files_of_several_formats(cli):
    scene = read_scene("scene.ply").gaussians()
    aaplug.write_scene("b.glb", replace(scene, convention=MIP, origin=None))
    words = "merge scene.ply b.glb --cameras . -o c.sog --move 0,0,0 4,0,0 --turn 0,0,0 0,90,0 --json"
    out, err = cli.done(words)
    assert json.loads(out) == {"output": "c.sog", "gaussians": 2 * len(scene), "convention": "mip"}
    assert "converted from classic to mip, by" in err
    merged = read_scene("c.sog")
    assert (merged.count, merged.convention) == (2 * len(scene), MIP)
    assert [fusion.method for fusion in merged.fused] == ["matched-energy"]
    cli.refused("merge scene.ply b.glb -o scene.ply --overwrite", "is also the input")
    assert not list(Path().glob("*.tmp"))

"""Refined poses: back at the truth from far and from near, and none that moves without a gain."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch

import aaplug
from aaplug import Camera, CameraSet, Renderer, write_png
from aaplug.evaluation.metrics import PSNR
from aaplug.evaluation.results import figure_of, mean
from aaplug.finetuning.poses import moved_by, refine_pose
from tests.conftest import make_camera, make_scene, with_photographs

CHANGE = torch.tensor([0.006, -0.008, 0.005, 0.004, -0.005, 0.006], dtype=torch.float64)  # radians, shares of the depth
DEPTH = 4.0


@pytest.fixture(scope="module")
def photographed(tmp_path_factory):
    """A scene and two views with photographs, which the scene itself made."""
    scene, eyes = make_scene(200, seed=3), [(0.5, -4.0, 0.4), (2.6, -3.0, 1.0)]
    views = [make_camera(eye, size=(128, 96), name=f"view{i}") for i, eye in enumerate(eyes)]
    return scene, with_photographs(Renderer.of(scene, views, min_seen=0.0), views, tmp_path_factory.mktemp("photos"))


def apart(a: Camera, b: Camera) -> tuple[float, float]:
    """Angle in degrees and distance in world units between two cameras."""
    cosine = ((a.cam_from_world[:3, :3] * b.cam_from_world[:3, :3]).sum() - 1) / 2
    return math.degrees(math.acos(min(1.0, float(cosine)))), float((a.centre - b.centre).norm())


def test_a_change_turns_about_the_point_ahead_and_shifts_by_shares_of_its_depth():
    camera = make_camera((0.0, -4.0, 0.0))
    ahead = camera.centre + DEPTH * camera.cam_from_world[2, :3]
    turned = moved_by(camera, torch.cat([CHANGE[:3], torch.zeros(3)]), DEPTH)
    place, depth = turned.project(ahead[None])
    assert torch.allclose(place, camera.project(ahead[None])[0], atol=1e-9)
    assert float(depth) == pytest.approx(DEPTH)
    assert apart(turned, camera)[0] == pytest.approx(math.degrees(float(CHANGE[:3].norm())))
    shifted = moved_by(camera, torch.cat([torch.zeros(3), CHANGE[3:]]), DEPTH)
    assert apart(shifted, camera) == (pytest.approx(0, abs=1e-5), pytest.approx(DEPTH * float(CHANGE[3:].norm())))


def test_the_gradient_of_a_change_equals_finite_differences():
    camera, places = make_camera((0.5, -4.0, 0.4)), make_scene(20, dtype=torch.float64).means
    for at in (CHANGE, torch.zeros(6, dtype=torch.float64)):
        start = at.clone().requires_grad_()
        assert torch.autograd.gradcheck(lambda change: moved_by(camera, change, DEPTH).project(places), start)


def test_poses_that_are_off_come_back_and_right_ones_stay(photographed):
    scene, cameras = photographed
    off = CameraSet((moved_by(cameras.train[0], CHANGE, DEPTH), cameras.train[1]), ())
    found, poses = aaplug.refine_poses(scene, off, min_seen=0.0)
    degrees, distance = apart(off.train[0], cameras.train[0])
    left, right = found.train
    assert apart(left, cameras.train[0])[0] < degrees / 5
    assert apart(left, cameras.train[0])[1] < distance / 5
    assert right == cameras.train[1]
    first, second = poses
    assert first.after < first.before / 5
    assert (first.degrees, first.distance) == pytest.approx(apart(left, off.train[0]))
    assert (second.degrees, second.distance, second.after) == (0.0, 0.0, second.before)


def test_coarse_scales_lead_farther_than_fine_ones(photographed):
    scene, cameras = photographed
    renderer = Renderer.of(scene, cameras, min_seen=0.0)
    off = moved_by(cameras.train[0], 14 * CHANGE, DEPTH)
    coarse_to_fine, fine = (refine_pose(renderer, off, scales).camera for scales in ((1 / 8, 1 / 4, 1 / 2), (1 / 2,)))
    assert apart(coarse_to_fine, cameras.train[0])[0] < apart(fine, cameras.train[0])[0] / 2


def test_a_move_that_makes_up_for_aliasing_is_no_gain(tmp_path):
    """At the training size, a square wall of small Gaussians has a sharp edge, which a smaller render misplaces."""
    side = torch.linspace(-0.6, 0.6, 20)
    x, z = torch.meshgrid(side, side, indexing="ij")
    scene, view = make_scene(x.numel(), degree=0), make_camera((0.5, -4.0, 0.4), size=(16, 16))
    scene = replace(
        scene,
        means=torch.stack([x, torch.zeros_like(x), z], dim=2).flatten(0, 1),
        log_scales=torch.full_like(scene.log_scales, -2.8),
        logit_opacities=torch.full_like(scene.logit_opacities, 6.0),
        sh=torch.full_like(scene.sh, 1.5),
    )
    renderer = Renderer.of(scene, [view], min_seen=0.0)
    write_png(tmp_path / "wall.png", renderer(view).rgb.clamp(0, 1))
    found = refine_pose(renderer, replace(view, photo=tmp_path / "wall.png"), (1 / 2,))
    assert (found.degrees, found.distance) == (0.0, 0.0)


def test_a_view_without_a_photograph_is_named(photographed):
    scene, cameras = photographed
    bare = CameraSet((replace(cameras.train[0], photo=None),), ())
    tune = partial(aaplug.finetune, poses=True, truth="self", steps=1, rasterizer="eager")
    for refines in (aaplug.refine_poses, tune):
        with pytest.raises(aaplug.UsageError, match=r"^view0: has no photograph, on which its pose is refined$"):
            refines(scene, bare, min_seen=0.0)


def test_evaluate_tells_errors_of_poses_from_others(photographed):
    scene, cameras = photographed
    off = CameraSet(*[tuple(moved_by(view, CHANGE, DEPTH) for view in cameras.train)] * 2)
    how = {"min_seen": 0.0, "recipe": "classic", "scale": (1.0,), "metric": "psnr", "rasterizer": "eager"}
    before, after = (aaplug.evaluate(scene, off, None, poses=poses, **how) for poses in (False, True))
    gained = mean(after.select("classic", 1.0), "PSNR") - mean(before.select("classic", 1.0), "PSNR")
    assert gained > 6
    [note] = [note for note in after.protocol["cameras"]["notes"] if "poses" in note]
    assert note.startswith("2 of 2 poses moved")
    with pytest.raises(aaplug.UsageError, match="poses: are refined on photographs"):
        aaplug.evaluate(scene, off, None, poses=True, truth="self", **how)


def test_finetune_refines_poses_first(photographed, monkeypatch):
    scene, cameras = photographed
    found = cameras, ()  # the search itself is tried above
    monkeypatch.setattr("aaplug.verbs.finetune.refined", lambda look, cameras, views, monitor: found)
    off = tuple(moved_by(view, CHANGE, DEPTH) for view in cameras.train)
    how = {"min_seen": 0.0, "steps": 1, "scale": (0.5,), "rasterizer": "eager"}
    errors = []
    for poses in (False, True):
        tuned = aaplug.finetune(scene, CameraSet(off, off), None, poses=poses, **how)
        errors.append(figure_of(PSNR, tuned.report.select("before", 1.0)))
    assert errors[1] > errors[0] + 6

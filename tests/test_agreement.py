"""Scene and cameras of different captures are told apart, and a .spz of either axes is read as fits the cameras."""

import logging
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import aaplug
from aaplug import CameraSet, Gaussians, Scene, TrainingViews, cameras_around, read_scene, write_png, write_scene
from aaplug.core.colours import WHITE
from aaplug.io.photographs import read_photo
from aaplug.options.verbs import Orbit, ViewOptions
from aaplug.rendering.agreement import Agreement, agreement, contradictions, settled
from aaplug.rendering.job import Job
from aaplug.rendering.renderer import own_look
from aaplug.system.errors import FrameError
from tests.conftest import SAMPLE, make_camera, make_scene, moved, write_model
from tests.scene_files import half_turn_about_x


def fit_of(scene, cameras) -> Agreement:
    return agreement(own_look(scene, TrainingViews.of(scene, cameras), "eager", WHITE), cameras)


@pytest.fixture(scope="module")
def few(sample_scene) -> Gaussians:
    """Every fourth Gaussian of the sample."""
    return sample_scene[::4]


def test_photographs_tell_a_scene_from_one_turned_over(few, sample_cameras):
    right, wrong = (fit_of(scene, sample_cameras) for scene in (few, half_turn_about_x(few)))
    assert right.doubt is None
    assert right.gain > 10
    assert wrong.gain < 0
    assert "farther from the photographs than one flat colour" in wrong.doubt
    assert str(right).endswith(f"{right.gain:.1f} dB closer to photographs than a flat colour")
    assert str(wrong).endswith(f"{-wrong.gain:.1f} dB farther from photographs than a flat colour")


def test_without_photographs_cameras_should_look_at_the_scenes_middle():
    scene = make_scene(200)
    towards = [make_camera((0.3 * i - 1, -4.0, 0.0)) for i in range(5)]
    found = fit_of(scene, CameraSet(tuple(towards), tuple(towards)))
    assert (found.gain, found.doubt) == (None, None)
    assert found.seen > 0.9
    aside = [replace(camera, cx=camera.cx + 0.6 * camera.width) for camera in towards]
    found = fit_of(scene, CameraSet(tuple(aside), tuple(aside)))
    assert "the middle of the scene lies outside of the image" in found.doubt
    hundredth = torch.ones(4, 4)
    hundredth[:3, 3] = 0.01  # of the world's size
    near = [replace(camera, cam_from_world=camera.cam_from_world * hundredth) for camera in towards]
    found = fit_of(replace(scene, means=scene.means / 100), CameraSet(tuple(near), tuple(near)))
    assert "no Gaussian lies farther ahead than 0.2 units" in found.doubt


def test_without_photographs_cameras_over_a_wide_scene_may_each_show_a_part_of_it():
    scene, sides = make_scene(4000), torch.tensor([60.0, 1.0, 60.0])
    scene = replace(scene, means=(torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) - 0.5) * sides)
    above = [moved(make_camera(), (x, 0.0, z)) for x in range(-24, 25, 8) for z in range(-24, 25, 8)]
    found = fit_of(scene, CameraSet(tuple(above), tuple(above)))
    assert (found.gain, found.doubt) == (None, None)
    aside = [replace(camera, cx=camera.cx + 0.9 * camera.width) for camera in above]
    found = fit_of(scene, CameraSet(tuple(aside), tuple(aside)))
    assert "the middle of the scene lies outside of the image" in found.doubt


def test_a_photograph_of_one_colour_tells_nothing(few, sample_cameras, tmp_path: Path):
    view = sample_cameras.train[0]
    write_png(tmp_path / "flat.png", torch.full((*view.hw, 3), 0.3))
    flat = replace(view, photo=tmp_path / "flat.png")
    assert fit_of(few, CameraSet((flat,), (flat,))).gain is None
    both = fit_of(few, CameraSet((view, flat), (flat,)))
    assert both.gain == fit_of(few, CameraSet((view,), (view,))).gain


@pytest.mark.parametrize("photographs", [True, False])
def test_cameras_of_another_capture_are_refused_unless_min_seen_is_0(few, sample_cameras, photographs, caplog):
    scene, cameras = half_turn_about_x(few), sample_cameras
    if not photographs:
        aside = tuple(replace(view, cx=view.cx + 0.6 * view.width, photo=None) for view in cameras.train)
        scene, cameras = few, replace(cameras, train=aside, test=aside)
    job = Job.of(scene, cameras, ViewOptions())
    for verb in (
        lambda: job.look(1),
        lambda: aaplug.convert(scene, cameras),
        lambda: aaplug.merge([scene], cameras, into="mip"),
    ):
        with pytest.raises(FrameError, match=r"or frames: .*; gsplat and .*; if they are right, pass `min_seen` 0"):
            verb()
    replace(job, options=ViewOptions(min_seen=0.0)).look(1)
    assert "seem to be of different captures or frames" in caplog.text


@pytest.mark.parametrize("background", ["auto", "black", (0.0, 0.5, 0.0)])
def test_cameras_of_the_same_capture_are_not_doubted_whatever_the_background(
    few, sample_cameras, background, tmp_path, caplog
):
    views = [replace(view, photo=tmp_path / f"{view.name}.png") for view in sample_cameras.test]
    for opaque, view in zip(views, sample_cameras.test, strict=True):
        write_png(opaque.photo, read_photo(view.photo, WHITE))
    job = Job.of(few, replace(sample_cameras, test=tuple(views)), ViewOptions(background=background))
    job.look(1)
    assert caplog.text == ""


@pytest.mark.parametrize("axes", ["opengl", "opencv"])
def test_a_spz_is_read_as_fits_the_cameras(few, sample_cameras, tmp_path: Path, axes):
    write_scene(tmp_path / "a.spz", few, spz_axes=axes)
    chosen = settled(read_scene(tmp_path / "a.spz"), sample_cameras)
    expected = read_scene(tmp_path / "a.spz", spz_axes=axes).gaussians()
    assert torch.equal(chosen.gaussians().means, expected.means)
    assert torch.equal(chosen.gaussians().sh, expected.sh)


def test_of_two_readings_each_is_decoded_once_and_what_is_left_out_is_said_once(sample_scene, sample_cameras, caplog):
    scene = replace(sample_scene[torch.arange(3000)], origin=None)  # a copy: the sample is shared
    scene.means[0] = torch.nan
    decoded = []

    def reading(turned: bool, **other) -> Scene:
        def load(start: int, stop: int) -> Gaussians:
            decoded.append(turned)
            return (half_turn_about_x(scene) if turned else scene)[start:stop]

        notes = ("turned" if turned else "stored",)
        return Scene(Path("a.spz"), "spz", len(scene), 3, load, "", notes=notes, drop_bad=True, **other)

    with caplog.at_level(logging.WARNING, "aaplug"):
        chosen = settled(reading(True, other=reading(False)), sample_cameras)
        assert caplog.messages == []
        assert torch.equal(chosen.gaussians().means, scene.means[1:])
    assert sorted(decoded) == [False, True]
    assert ["left out" in said for said in caplog.messages] == [True]
    assert chosen.other is None


def test_a_reading_that_the_cameras_may_change_is_told_as_such(sample_scene, program):
    write_scene("a.spz", sample_scene[:100], spz_axes="opencv", spz_version=3)
    for axes, provisional in (("auto", True), ("opencv", False)):
        _, err = program.done(f"info a.spz --spz-axes {axes}")
        told = [line for line in err.splitlines() if line.startswith("scene: ") and "axes" in line]
        assert [line.startswith("scene: unless the cameras tell otherwise, ") for line in told] == [provisional]


def test_without_evidence_a_spz_follows_its_specification(sample_scene, sample_cameras, tmp_path: Path):
    write_scene(tmp_path / "a.spz", sample_scene[:100], spz_axes="opencv", spz_version=3)
    opened = read_scene(tmp_path / "a.spz")
    assert opened.other is not None
    assert settled(opened, cameras_around(opened, Orbit())) is opened  # assumed cameras decide nothing
    bare = tuple(replace(view, photo=None) for view in sample_cameras.train)
    chosen = settled(opened, replace(sample_cameras, train=bare, test=bare))
    assert torch.equal(chosen.gaussians().means, read_scene(tmp_path / "a.spz", spz_axes="opengl").gaussians().means)


def test_what_a_models_own_files_say_otherwise_than_the_cameras_is_told(few, sample_cameras, tmp_path: Path):
    views = [*sample_cameras.train[:2], *sample_cameras.test[:1]]
    given = replace(sample_cameras, train=tuple(views[:2]), test=tuple(views[2:]), background=None)
    model = write_model(tmp_path / "model", views, "eval=False, resolution=2, white_background=True", few, 7)
    half, whole = (f"{round(s * views[0].width)}×{round(s * views[0].height)} px" for s in (0.5, 1))
    assert contradictions(read_scene(model), given) == [
        f"trained at {half}, and these cameras say {whole}; --images or --train-scale sets it",
        "trained on 1 of the 1 test view of these cameras",
        "trained on white",
    ]
    (model / "cfg_args").write_text("Namespace(eval=False, resolution=1)")
    assert contradictions(read_scene(model), replace(given, test=given.train)) == []
    (model / "cfg_args").write_text("Namespace(")
    assert contradictions(read_scene(model), given) == []
    assert contradictions(read_scene(SAMPLE / "chair.ply"), given) == []

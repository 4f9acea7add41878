"""A scene in time: a folder of numbered files, drawn with sampling bounds over all frames."""

from dataclasses import replace

import pytest
import torch

import aaplug
from aaplug import CameraSet, FormatError, Renderer, UsageError, read_image, read_scene, write_scene
from aaplug.core.conventions import MIP
from aaplug.core.sampling import sampling_bounds
from aaplug.evaluation.results import tables
from tests.bench.sequences import turning, write_sequence
from tests.conftest import make_camera, make_scene

FAR = make_camera((0.0, -4.0, 0.3), (24, 18), name="far")
NEAR = replace(make_camera((0.0, -1.5, 0.0), (24, 18), name="near"), fx=90.0, fy=90.0)  # sees but a part
CAMERAS = CameraSet((FAR, NEAR), (FAR,))
COUNT = 3


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "in").mkdir()
    return write_sequence(tmp_path / "in", make_scene(40), COUNT)


def test_each_frame_is_drawn_as_its_file_alone_at_the_training_size(folder):
    renderer = Renderer.of(folder, CAMERAS, "auto", rasterizer="eager")
    for k, frame in enumerate(turning(make_scene(40), COUNT)):
        alone = Renderer.of(frame, CAMERAS, "auto", rasterizer="eager")
        assert renderer(replace(FAR, frame=k)).rgb.equal(alone(FAR).rgb)
        assert renderer.passes(replace(FAR, frame=k), ["depth"])["depth"].equal(alone.passes(FAR, ["depth"])["depth"])
    with pytest.raises(UsageError, match="expected one of 0 to 2, got 3"):
        renderer(replace(FAR, frame=3))
    with pytest.raises(UsageError, match="frame: expected an integer from 0, got -1"):
        renderer.at(-1)


def test_threads_may_ask_for_different_frames(folder):
    class Shared(dict):
        def __setitem__(self, frame, renderer):
            super().__setitem__(frame, renderer)
            self.clear()  # by another thread, which opens its own

    renderer = Renderer.of(folder, CAMERAS, "auto", rasterizer="eager")
    object.__setattr__(renderer, "_open", Shared())
    assert len(renderer.at(1).scene) == 40


def test_a_frame_can_be_drawn_as_of_another_training(folder):
    frame = Renderer.of(folder, CAMERAS, "classic", rasterizer="eager").at(1)
    finer = replace(frame, training=frame.training.finer(2.0))
    assert frame.trained_at(2.0)(CAMERAS.test[0]).rgb.equal(finer(CAMERAS.test[0]).rgb)


def test_rates_are_those_over_all_frames_unless_they_were_trained_apart(folder):
    together, apart = (
        Renderer.of(read_scene(folder, frames_apart=flag), CAMERAS, "mip-splatting", rasterizer="eager")
        for flag in (False, True)
    )
    rates = [sampling_bounds(frame.means, CAMERAS.train) for frame in turning(make_scene(40), COUNT)]
    bounds = together.training.bounds
    assert bounds.highest.allclose(torch.stack([r.highest for r in rates]).amax(dim=0))
    lowest = torch.stack([torch.where(r.seen, r.lowest, torch.inf) for r in rates]).amin(dim=0)
    assert bounds.lowest.allclose(torch.where(bounds.seen, lowest, 0.0))
    assert bounds.views.equal(torch.stack([r.views for r in rates]).sum(dim=0).int())
    assert together.at(2).training is together.training
    assert apart.at(2).training.bounds.highest.allclose(rates[2].highest)
    growth = [r.at(2).scene.scales / r.scene.scales for r in (together, apart)]
    assert growth[0].std() < growth[1].std()  # a close-up no longer pumps the filter


def test_every_verb_that_takes_a_scene_in_time_takes_all_frames(folder, tmp_path):
    write_scene(folder / "other.ply", make_scene(40))
    write_scene(folder / "frame_0004.splat", make_scene(40))
    for hidden in ("._frame_0001.ply", "._frame_0002.ply", "._other.ply"):  # macOS's, on other systems' drives
        (folder / hidden).write_bytes(b"extended attributes")
    scene = read_scene(folder)
    assert scene.notes[-1] == "no frames, and left out: frame_0004.splat, other.ply"
    assert scene.cameras is None
    assert scene.title == "in"
    assert len(scene.files) == COUNT
    written = aaplug.render(folder, CAMERAS, tmp_path / "images", rasterizer="eager")
    assert [image.file.name for image in written] == ["far-0001.png", "far-0002.png", "far-0003.png"]
    images = [read_image(image.file, None) for image in written]
    assert not images[0].equal(images[2])
    how = {"path": "orbit", "seconds": 0.2, "rasterizer": "eager", "recipe": "classic"}
    clip = aaplug.video(folder, CAMERAS, tmp_path / "clip" / "f.#.png", **how)
    assert clip.frames == 6
    path = [tmp_path / "clip" / f"f.{number}.png" for number in range(1, 7)]
    still = aaplug.video(next(iter(turning(make_scene(40), 1))), CAMERAS, tmp_path / "still" / "f.#.png", **how)
    same = [file.read_bytes() == (still.file.parent / file.name).read_bytes() for file in path]
    assert same == [True, True, False, False, False, False]
    report = aaplug.evaluate(folder, CAMERAS, recipe="matched", scale=[0.5], metric=("psnr", "flicker"))
    assert [m.view for m in report.measurements if m.recipe == "matched"] == ["far-0001", "far-0002", "far-0003"]
    converted = aaplug.convert(folder, CAMERAS, tmp_path / "out")
    assert converted.gaussians == COUNT * 40
    again = read_scene(tmp_path / "out")
    assert again.convention.name == "mip"
    assert len(again.frames or ()) == COUNT
    assert scene.digest != again.digest


def test_flicker_of_a_still_scene_in_time_is_undefined(tmp_path):
    for number in (1, 2):
        write_scene(tmp_path / f"{number}.ply", make_scene(40))
    report = aaplug.evaluate(tmp_path, CAMERAS, recipe="matched", scale=[0.5], metric="flicker", views="far")
    assert {m.values["flicker"] for m in report.measurements} == {None}
    assert tables(report)[0] == "no flicker at 1/2: it needs frames that differ"


LAST = "frame_0003.ply"
SPOILED = [
    ((), {}, "in: expected frame 2 after frame_0001.ply, got frame_0003.ply; or name one"),
    (["frame_002.ply"], {}, "expected frame 3 after frame_0002.ply, got frame_002.ply"),
    (["other1.ply", "other2.ply"], {}, "holds frames of 2 sequences (frame_####.ply, other####.ply)"),
    ([LAST], {"sh": make_scene(40).sh[:, :1]}, f"{LAST}: expected the degree of harmonics of frame_0001.ply, "),
    ([LAST], {"convention": MIP}, f"{LAST}: expected the convention of frame_0001.ply, classic, got mip"),
]


@pytest.mark.parametrize(("names", "changes", "message"), SPOILED, ids=range(len(SPOILED)))
def test_what_is_no_sequence_is_refused(folder, names, changes, message):
    for name in names:
        write_scene(folder / name, replace(make_scene(40), **changes), overwrite=True)
    if not names:
        (folder / "frame_0002.ply").unlink()
    with pytest.raises(FormatError) as caught:
        read_scene(folder)
    assert message in str(caught.value)


def test_a_frame_of_fewer_gaussians_is_one_that_was_trained_apart(folder):
    write_scene(folder / "frame_0002.ply", make_scene(39), overwrite=True)
    said = r"frame_0002.ply: expected the number of Gaussians of frame_0001.ply, 40, got 39; pass `frames_apart`"
    with pytest.raises(FormatError, match=said):
        read_scene(folder)
    apart = Renderer.of(read_scene(folder, frames_apart=True), CAMERAS, "auto")
    assert apart(replace(FAR, frame=1)).rgb.isfinite().all()


def test_levels_of_detail_for_a_viewer_are_no_frames(tmp_path):
    for number in range(12):
        write_scene(tmp_path / f"scene_lod{number}.ply", make_scene(2))
    with pytest.raises(FormatError, match="name the scene's file"):
        read_scene(tmp_path)


@pytest.mark.parametrize(
    "verb", [aaplug.lod, aaplug.finetune, aaplug.info, lambda *inputs: aaplug.merge([*inputs[:1]])]
)
def test_other_verbs_refuse_a_scene_in_time(folder, verb):
    with pytest.raises(UsageError, match="is a scene in time, of 3 frames: render, video, evaluate and convert"):
        verb(folder, CAMERAS)


def test_conversion_of_frames_needs_a_folder_and_no_fit(folder, tmp_path):
    for output in (None, tmp_path / "out.ply"):
        with pytest.raises(UsageError, match="output: of frames is a folder"):
            aaplug.convert(folder, CAMERAS, output)
    with pytest.raises(UsageError, match="viewer: fits each frame alone, which flickers"):
        aaplug.convert(folder, CAMERAS, tmp_path / "out", viewer="spark")

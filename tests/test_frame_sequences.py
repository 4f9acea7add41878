"""Frame sequences: numbered files that a run continues, to the bytes of a run that nothing stopped."""

import os
import signal
import sys
from importlib.util import find_spec
from itertools import count, product
from pathlib import Path

import pytest
from aaplug_cli.main import main

from aaplug.io.cameras.camera_path import CameraPath
from aaplug.io.image_files import FrameSequence, file_names
from aaplug.rendering.renderer import Renderer
from aaplug.system.errors import OutputError
from tests.conftest import exit_code, make_camera

WORDS = "video scene.ply --cameras . --scale 0.5 --seconds 0.2 -o"
FORMAT = "exr" if find_spec("OpenEXR") else "npz"


def bytes_of(folder: str) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())}


def test_a_name_with_places_or_a_folder_with_a_format_is_a_sequence(cli):
    assert cli.facts(f"{WORDS} a/shot_###.{FORMAT} --passes rgb,alpha,depth")["frames"] == 6
    names = [f"shot_{i:03d}.{FORMAT}" for i in range(1, 7)]
    assert sorted(bytes_of("a")) == sorted([*names, "shot.json"])
    cli.done(f"{WORDS} b --format jpg --threads 2")
    assert sorted(bytes_of("b")) == [*(f"frame.{i:04d}.jpg" for i in range(1, 7)), "frame.json"]


def test_a_sequence_begins_at_the_number_of_its_plate(cli):
    words = f"{WORDS} out/f.####.png --first-frame"
    assert "6 frames of 32x24 px, 30 per second" in cli.done(f"{words} 1001")[1]
    assert [*bytes_of("out")] == [*(f"f.{i}.png" for i in range(1001, 1007)), "f.json"]
    cli.refused(f"{words} 1003 --resume", "holds f.1001.png, f.1002.png beside the 6 frames; remove them")
    cli.refused(f"{words} -1", "--first-frame: takes a whole number 0..")


@pytest.mark.parametrize(
    ("names", "files"),
    [
        (["a:b?", "sub/c.d", "..e.", ""], ["a_b_", "sub_c.d", "e", "view"]),
        (["CON", "nul.left", "com1.", "console"], ["_CON", "_nul.left", "_com1", "console"]),  # Windows' devices
        (["A", "a"], ["00000_A", "00001_a"]),
        (["h\u00e9", "he\u0301"], ["00000_h\u00e9", "00001_h\u00e9"]),  # macOS takes both spellings for one
    ],
)
def test_names_of_files_are_names_on_every_system(names: list[str], files: list[str]):
    assert file_names(names, "view", 5) == files


def test_a_sequence_goes_on_where_it_was_stopped(cli, monkeypatch):
    words = f"{WORDS} out/f.####.png --transparent"
    cli.done(words)
    whole, times = bytes_of("out"), {p.name: p.stat().st_mtime_ns for p in Path("out").iterdir()}
    for number in (2, 5):
        Path(f"out/f.{number:04d}.png").unlink()
    cli.refused(words, "already holds f.0001.png", "or --resume to go on")
    assert "resumed with 4 of 6 frames" in cli.done(f"{words} --resume")[1]
    assert bytes_of("out") == whole
    again = {path.name for path in Path("out").iterdir() if path.stat().st_mtime_ns != times[path.name]}
    assert again == {"f.0002.png", "f.0005.png"}
    monkeypatch.setattr(Renderer, "passes", None)
    assert cli(f"{words} --resume")[0] == 0  # nothing is left to draw


def test_frames_of_another_request_are_not_continued(cli):
    words = f"{WORDS} out/f.####.png"
    cli.done(words)
    before = bytes_of("out")
    changes = {
        "--transparent": "passes", "--bit-depth 16": "--bit-depth", "--scale 0.25": "size, views",
        "--recipe classic": "recipe", "--fps 31": "fps",
    }  # fmt: skip
    for change, said in changes.items():
        cli.refused(
            f"{words} --resume {change}".replace("--scale 0.5 ", "" if "scale" in change else "--scale 0.5 "),
            f"is of another request or another aaplug ({said} changed since)",
        )
    Path("out/f.json").rename("f.json")
    cli.refused(f"{words} --resume", "f.json: does not exist, which says what the frames show")
    Path("out/f.json").write_text("[1]")
    cli.refused(f"{words} --resume", "f.json: is damaged; start again with --overwrite")
    cli.refused(f"{words} --resume --overwrite", "--resume: continues a run, and --overwrite starts anew; give one")
    Path("f.json").replace("out/f.json")
    assert bytes_of("out") == before


def test_a_new_sequence_leaves_no_frame_of_the_old_one(cli, monkeypatch):
    words = f"{WORDS} out/f.####.png"
    cli.done(words)
    cli.refused(
        f"{words} --overwrite --seconds 0.1".replace("--seconds 0.2 ", ""),
        "holds f.0004.png, f.0005.png, f.0006.png beside the 3 frames",
    )
    with monkeypatch.context() as patch:  # stopped before its first frame
        patch.setattr("aaplug.verbs.video.write_frames", lambda *args, **how: sys.exit(3))
        assert cli(f"{words} --overwrite --recipe classic")[0] == 3
    assert sorted(bytes_of("out")) == ["f.json"]


VIDEO = "a video is one file of 8-bit sRGB colours, which is not resumed"
REFUSED = {
    "v.%04d.exr": "name a .webm or .mp4 file, or frames such as name.####.png",
    "v.webm --transparent": f"--transparent: {VIDEO}; name a sequence, such as frames/frame.####.exr",
    "v.webm --resume": f"--resume: {VIDEO}",
    "v.mp4 --colour linear": f"--colour: {VIDEO}",
    "v.mp4 --passes rgb,depth": f"--passes: {VIDEO}",
    "v.mp4 --bit-depth 16": f"--bit-depth: {VIDEO}",
    "v.mp4 --first-frame 1001": f"--first-frame: {VIDEO}",
    "v.mp4 --format exr": f"--format: {VIDEO}",
    "v.mp4 --lens fisheye": "--lens: fisheye sets its own angle, which zoom would change; give --path dolly or orbit",
    "v.png": "name a .webm or .mp4 file, or frames such as name.####.png",
    "##/a.png": "##/a.png: name a .webm or .mp4 file, or frames such as name.####.png",
    "a.####/b.####.png": "b.####.png: has a frame's number in a folder's name",
    "a.##.##.png": "a.##.##.png: has places for two numbers; name a sequence such as frame.####.exr",
    "a.##.png --beside mip": "--beside: is for videos of one eye; a frame sequence and vr180 show --recipe alone",
    "a.##.png --passes depth": "--passes: a .png cannot hold depth",
    "a.##.gif --format png": "a.##.gif: name frames of one of .png, .jpg",
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_is_no_sequence_is_refused_before_anything_is_drawn(cli, monkeypatch, words):
    monkeypatch.setattr(Renderer, "draw", None)
    cli.refused(f"{WORDS} {words}", REFUSED[words])


def test_frames_of_different_sizes_and_sequences_of_render_are_refused(cli, monkeypatch):
    for views, name in product(("r_1", "test"), ("f.####.png", "####")):
        said = f"{name}: names a frame sequence, which `video` writes; name a folder, or one image"
        cli.refused(f"render scene.ply --cameras . --views {views} -o {name}", said)
    path = CameraPath(tuple(make_camera(size=size) for size in ((40, 30), (30, 40))), 24.0)
    monkeypatch.setattr("aaplug.verbs.video.read_camera_path", lambda _, fps: path)
    Path("path.json").touch()
    cli.refused(
        f"{WORDS.replace('--seconds 0.2 ', '')} out/a.##.png --path path.json",
        "--path: has frames of different sizes (15x20, 20x15 px)",
    )
    assert not Path("out").exists()


def test_a_kill_loses_no_finished_frame_and_the_rest_ends_the_same(cli, monkeypatch):
    words = f"{WORDS} out/f.####.{FORMAT} --resume"
    replaced, calls = os.replace, count()

    def killed(*paths):
        if next(calls) == 4:  # before the frame has its name
            os.kill(os.getpid(), signal.SIGKILL)
        replaced(*paths)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", killed)
        assert exit_code(lambda: main(words.split())) == -signal.SIGKILL
    found = {path: path.stat().st_mtime_ns for path in Path("out").glob(f"f.*.{FORMAT}")}
    assert 0 < len(found) < 6
    cli.done(words)
    assert all(path.stat().st_mtime_ns == then for path, then in found.items())
    resumed = bytes_of("out")
    cli.done(words.replace("out/", "whole/"))
    assert resumed == bytes_of("whole")
    assert len(resumed) == 7


def test_places_for_a_number_in_a_folders_name_are_of_a_sequence_that_would_make_it(tmp_path):
    (tmp_path / "q##").mkdir()
    assert FrameSequence.of(tmp_path / "q##" / "v.webm", None) is None
    assert FrameSequence.of(tmp_path / "q##" / "f.####.png", None) is not None
    with pytest.raises(OutputError, match="has a frame's number in a folder's name"):
        FrameSequence.of(tmp_path / "new##" / "f.####.png", None)

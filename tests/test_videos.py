"""Videos: every frame, padded and never resampled, whole or not at all."""

import json
import math
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch

from aaplug import read_cameras
from aaplug.evaluation.report.contact_sheet import side_by_side
from aaplug.io.video import write_video
from aaplug.system.errors import OutputError, UsageError
from tests.test_camera_paths import document


def read(path: Path) -> tuple[np.ndarray, float]:
    """RGB frames and their rate."""
    video = cv2.VideoCapture(str(path))
    frames = []
    while True:
        some, frame = video.read()
        if not some:
            break
        frames.append(frame[..., ::-1])
    return np.stack(frames), video.get(cv2.CAP_PROP_FPS)


def ramp(count: int, height: int, width: int):
    """Frames of a smooth ramp that brightens."""
    x = torch.linspace(0, 1, width).expand(height, width)
    return [torch.stack([x, x * (i + 1) / count, 0 * x], dim=2) for i in range(count)]


@pytest.mark.parametrize("suffix", [".webm", ".mp4"])
def test_odd_sides_are_padded_and_no_pixel_moves(tmp_path, suffix):
    frames = ramp(5, 97, 131)
    write_video(tmp_path / f"v{suffix}", frames, 25.0)
    found, fps = read(tmp_path / f"v{suffix}")
    assert found.shape == (5, 98, 132, 3)
    assert fps == pytest.approx(25)
    errors = [np.abs(f[:97, :131] / 255.0 - t.numpy()).mean() for f, t in zip(found, frames, strict=True)]  # fmt: skip
    assert max(errors) < 0.03
    with av.open(str(tmp_path / f"v{suffix}")) as video:  # players learn how colours were converted
        context = video.streams.video[0].codec_context
        assert (int(context.color_range), int(context.colorspace)) == (1, 1)  # limited range, BT.709
        assert (int(context.color_primaries), int(context.color_trc)) == (1, 1)


@pytest.mark.parametrize("suffix", [".webm", ".mp4"])
def test_the_same_frames_make_the_same_file(tmp_path, suffix):
    for _ in range(4):
        frames = torch.rand(4, 48, 64, 3)  # x264's estimates need several of its blocks, of 16x16 px
        for name in "abc":
            write_video(tmp_path / (name + suffix), frames, 24.0, overwrite=True)
        assert len({(tmp_path / (name + suffix)).read_bytes() for name in "abc"}) == 1


def test_what_is_no_film_or_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "there.webm").write_bytes(b"mine")
    black, wide = (torch.zeros(8, side, 3) for side in (8, 12))
    for name, frames, fps, error, said in (
        ("v.webm", [], 25.0, UsageError, r"^frames: "),
        ("v.webm", [black + torch.nan], 25.0, UsageError, r"^(frames|image): "),
        ("v.webm", [black, wide], 25.0, UsageError, r"^(frames|image): "),
        ("v.webm", [black], 0.0, UsageError, "fps"),
        ("v.avi", [black], 25.0, OutputError, r"\.webm or \.mp4"),
        ("there.webm", [black], 25.0, OutputError, "overwrite"),
    ):
        with pytest.raises(error, match=said):
            write_video(tmp_path / name, frames, fps)
        assert [path.name for path in tmp_path.iterdir()] == ["there.webm"]


@pytest.mark.parametrize("suffix", [".webm", ".mp4"])
def test_white_stays_white_and_gray_gray(tmp_path, suffix):
    frames = ramp(6, 192, 256)
    for frame in frames:
        frame[:96, :128], frame[:96, 128:], frame[96:, 192:] = 1.0, 0.5, 0.0
    write_video(tmp_path / f"v{suffix}", frames, 25.0)
    found, _ = read(tmp_path / f"v{suffix}")
    white, gray, black = found[:, :80, :112], found[:, :80, 144:], found[:, 112:, 208:]  # a block away from edges
    assert white.min() >= 254
    assert np.abs(gray.astype(int) - 128).max() <= 2
    assert black.max() <= 1


@pytest.mark.parametrize(("height", "width"), [(400, 600), (240, 320), (200, 300)])
def test_what_becomes_small_is_also_shown_enlarged(height, width):
    image = torch.ones(height, width, 3)
    y, x = (slice(side // 2 - 10, side // 2 + 10) for side in (height, width))
    image[y, x] = torch.rand(20, 20, 3)  # a thing of 20 px in the middle
    for rate, times in ((1 / 8, 7), (1 / 4, 3)):
        [left, right] = side_by_side([image, image], ["a", "b"], rate).split([width, width + 4], dim=1)
        side = int((1 - rate) / 2 * height - 2) // times
        for pane in (left, right[:, 4:]):
            inset = pane[height - side * times :, width - side * times :]
            top, across = (height - side) // 2, (width - side) // 2
            middle = image[top : top + side, across : across + side]
            expected = middle.repeat_interleave(times, dim=0).repeat_interleave(times, dim=1)
            assert torch.allclose(inset, expected, atol=0.5 / 255)
            assert side >= rate * height / 2 - 1  # half of what the data set's view shows
            assert torch.allclose(pane[y, x], image[y, x], atol=0.5 / 255)
    near = side_by_side([image, image], ["a", "b"], 1.0)
    assert torch.allclose(near[40:, :width], image[40:], atol=0.5 / 255)
    third = slice(height // 3 + 1, 2 * height // 3), slice(width // 3 + 1, 2 * width // 3)
    assert torch.allclose(side_by_side([image, image], ["a", "b"], 1 / 3)[third], image[third], atol=0.5 / 255)


@pytest.mark.parametrize("lens", ["pinhole", "equirect"])
def test_a_video_tells_the_sampling_rate_of_its_pixels(cli, monkeypatch, lens):
    told = []
    monkeypatch.setattr("aaplug.verbs.video.side_by_side", lambda images, *how: (told.append(how[-1]), images[0])[1])
    size = (320, 160) if lens == "equirect" else (320, 240)
    words = f"--lens {lens} --resolution {size[0]}x{size[1]} --path dolly --seconds 0.2 --fps 20"
    cli.done(f"video scene.ply --cameras . -o v.webm {words}")
    training = read_cameras(".").train[0]
    focal = size[0] / (2 * math.pi) if lens == "equirect" else training.resized(*size).focal
    assert told[2] == pytest.approx(focal / training.focal / 8, rel=0.15)  # eight times as far away


def test_the_programs_video_of_a_zoom_holds_the_enlarged_middle(cli):
    _, err = cli.done("video scene.ply --cameras . -o v.webm --resolution 320x240 --seconds 0.2 --fps 20")
    assert "4 frames of 320x240 px per pane, 20 per second" in err
    found, _ = read(Path("v.webm"))
    far = found[2, :, -320:].astype(int)  # the turning point: 1/8, with an inset of 100 px
    assert np.abs(far[-100:, -100:] - far[:1, :1]).max() > 60
    assert np.abs(found[0, -100:, -100:].astype(int) - far[-100:, -100:]).mean() > 5


@pytest.mark.parametrize("path", ["zoom", "dolly", "orbit"])
def test_the_program_makes_a_video_side_by_side(cli, path):
    words = f"video scene.ply --cameras . -o v.webm --path {path} --rasterizer eager --seconds 0.2 --fps 20 --json"
    code, out, err = cli(words)
    assert (code, json.loads(out)["frames"]) == (0, 4)
    assert "OpenCV" not in err
    found, fps = read(Path("v.webm"))
    assert (found.shape, fps) == ((4, 48, 132, 3), 20)  # two panes of 64, and a gap of 4
    cli.refused(words)
    changes = np.abs(np.diff(found[..., -64:, :].astype(int), axis=0)).mean(axis=(1, 2, 3))
    assert changes.min() > 0.1  # the camera moves


def test_the_program_follows_a_camera_path(cli):
    Path("path.json").write_text(json.dumps(document()))
    cli.done("video scene.ply --cameras . -o v.webm --path path.json --beside none")
    found, fps = read(Path("v.webm"))
    assert (found.shape, fps) == ((1, 40, 60, 3), 24)
    cli.refused("video scene.ply --cameras . -o w.webm --path gone.json")


VR = "--cameras . --lens vr180 --eye-distance 0.4 --resolution 24x24 --rasterizer eager"


def test_both_eyes_are_side_by_side_in_a_video(cli):
    cli.done(f"video scene.ply {VR} -o v.webm --path orbit --seconds 0.1")
    frames, _ = read(Path("v.webm"))
    assert frames.shape[2] == 2 * frames.shape[1] == 48
    left, right = np.split(frames.astype(float), 2, axis=2)
    assert np.abs(left - right).max() > 20
    cli.refused(f"video scene.ply {VR} -o a/b.####.png --path orbit --seconds 0.1", "`render --path` writes both")


def test_the_shutter_of_an_eye_follows_that_eye(cli, monkeypatch):
    shown = []
    monkeypatch.setattr("aaplug.verbs.render.write_frames", lambda renderer, views, *_, **__: shown.extend(views))
    frames = [json.loads(json.dumps(document()["camera_path"][0])) for _ in range(3)]
    for place, frame in enumerate(frames):
        frame["camera_to_world"][7] = 0.01 * place
    Path("path.json").write_text(json.dumps(document(camera_path=frames)))
    cli.done(f"render scene.ply {VR} -o out --path path.json --shutter 0.5 --samples 2")
    assert [view.name.rpartition("-")[2] for view in shown] == ["left", "right"] * (len(shown) // 2)
    for view, other in zip(shown[::2], shown[1::2], strict=True):
        opens, closes = view.exposure.motion
        middle = (opens.centre + closes.centre) / 2
        assert (middle - view.centre).norm() < 0.2 * (other.centre - view.centre).norm()

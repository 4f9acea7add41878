"""Videos: every frame, padded and never resampled, whole or not at all."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from aaplug.core.errors import OutputError, UsageError
from aaplug.io.video import write_video
from tests.test_camera_paths import document
from tests.test_cli import cli, dataset  # noqa: F401  (fixtures)


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
    if suffix == ".mp4":
        pytest.importorskip("av")
    frames = ramp(5, 97, 131)
    write_video(tmp_path / f"v{suffix}", frames, 25.0)
    found, fps = read(tmp_path / f"v{suffix}")
    assert found.shape == (5, 98, 132, 3)
    assert fps == pytest.approx(25)
    errors = [np.abs(f[:97, :131] / 255.0 - t.numpy()).mean() for f, t in zip(found, frames, strict=True)]  # fmt: skip
    assert max(errors) < 0.03


def test_a_video_that_fails_leaves_nothing(tmp_path):
    def frames():
        yield torch.zeros(8, 8, 3)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "v.webm", frames(), 25.0)
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_written_is_refused(tmp_path, monkeypatch):
    (tmp_path / "there.webm").write_bytes(b"mine")
    frames = ramp(1, 8, 8)
    with pytest.raises(OutputError, match="overwrite"):
        write_video(tmp_path / "there.webm", frames, 25.0)
    with pytest.raises(OutputError, match=r"\.webm or \.mp4"):
        write_video(tmp_path / "v.avi", frames, 25.0)
    with pytest.raises(UsageError, match="fps"):
        write_video(tmp_path / "v.webm", frames, 0.0)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"aaplug\[mp4\]"):
        write_video(tmp_path / "v.mp4", frames, 25.0)


@pytest.mark.parametrize("path", ["zoom", "dolly", "orbit"])
def test_the_program_makes_a_video_side_by_side(cli, path):  # noqa: F811
    words = f"video scene.ply --cameras . -o v.webm --path {path} --rasterizer eager --seconds 0.2 --fps 20 --json"
    code, out, err = cli(words)
    assert (code, json.loads(out)["frames"]) == (0, 4)
    assert "OpenCV" not in err
    found, fps = read(Path("v.webm"))
    assert (found.shape, fps) == ((4, 48, 132, 3), 20)  # two panes of 64, and a gap of 4
    assert cli(words)[0] == 2
    changes = np.abs(np.diff(found[..., -64:, :].astype(int), axis=0)).mean(axis=(1, 2, 3))
    assert changes.min() > 0.1  # the camera moves


def test_the_program_follows_a_camera_path(cli):  # noqa: F811
    Path("path.json").write_text(json.dumps(document()))
    code, _, err = cli("video scene.ply --cameras . -o v.webm --path path.json --beside none")
    assert code == 0, err
    found, fps = read(Path("v.webm"))
    assert (found.shape, fps) == ((1, 40, 60, 3), 24)
    assert cli("video scene.ply --cameras . -o w.webm --path gone.json")[0] == 2

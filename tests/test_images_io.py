"""Images come in as stored and go out rounded to the nearest code."""

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

import aaplug
from aaplug.core.errors import FormatError
from aaplug.core.imaging import quantised
from aaplug.io.images import image_size, read_image, read_rgba, write_png
from aaplug.io.photographs import read_photo

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the real scenes are not here")
WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)


def random_image(height: int = 5, width: int = 7) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))


def save(path: Path, pixels: np.ndarray) -> Path:
    """Write samples in OpenCV's channel order."""
    path.write_bytes(cv2.imencode(path.suffix, pixels)[1].tobytes())
    return path


def png_chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


@pytest.mark.parametrize("bit_depth", [8, 16])
def test_reading_a_written_png_gives_the_quantised_image(tmp_path: Path, bit_depth: int):
    rgb = random_image() * 1.4 - 0.2
    write_png(tmp_path / "a.png", rgb, bit_depth)
    assert torch.equal(read_image(tmp_path / "a.png", None), quantised(rgb, bit_depth))
    assert image_size(tmp_path / "a.png") == (7, 5)


@pytest.mark.parametrize("bit_depth", [8, 16])
def test_every_code_survives(tmp_path: Path, bit_depth: int):
    codes = torch.arange(2**bit_depth).reshape(-1, 256, 1).expand(-1, -1, 3)
    rgb = codes.float() / (2**bit_depth - 1)
    write_png(tmp_path / "a.png", rgb, bit_depth)
    assert torch.equal(read_image(tmp_path / "a.png", None), rgb)


def test_colours_are_rgb_and_rows_run_down(tmp_path: Path):
    rgb = torch.zeros(2, 3, 3)
    rgb[0, 2] = torch.tensor([1.0, 0.5, 0.0])
    write_png(tmp_path / "a.png", rgb)
    assert Image.open(tmp_path / "a.png").getpixel((2, 0)) == (255, 128, 0)


def test_alpha_is_composited_in_float(tmp_path: Path):
    path = save(tmp_path / "a.png", np.array([[[30, 20, 10, 51]]], np.uint8))  # BGRA
    got = read_image(path, (0.5, 0.25, 1.0))[0, 0]
    expected = [(10 / 255) * 0.2 + 0.4, (20 / 255) * 0.2 + 0.2, (30 / 255) * 0.2 + 0.8]
    assert got.tolist() == pytest.approx(expected, abs=1e-7)


def test_a_transparent_image_needs_a_background(tmp_path: Path):
    path = save(tmp_path / "a.png", np.full((2, 2, 4), 255, np.uint8))
    with pytest.raises(FormatError, match=r"a\.png: is transparent.*pass `background`"):
        read_image(path, None)


@pytest.mark.parametrize(("suffix", "dtype"), [(".png", np.uint8), (".tiff", np.uint16)])
def test_gray_becomes_three_equal_channels(tmp_path: Path, suffix: str, dtype: type):
    top = np.iinfo(dtype).max
    path = save(tmp_path / f"a{suffix}", np.array([[0, top // 5, top]], dtype))
    got = read_image(path, WHITE)
    assert got.shape == (1, 3, 3)
    assert torch.allclose(got[0], torch.tensor([0, 0.2, 1])[:, None].expand(3, 3))


def test_an_orientation_tag_moves_no_pixel(tmp_path: Path):
    pixels = np.zeros((16, 32, 3), np.uint8)
    pixels[:, :16] = 255
    exif = Image.Exif()
    exif[0x0112] = 6  # orientation: to be turned by 90 degrees
    Image.fromarray(pixels).save(tmp_path / "a.jpg", exif=exif)
    got = read_image(tmp_path / "a.jpg", None)
    assert got.shape == (16, 32, 3)
    assert image_size(tmp_path / "a.jpg") == (32, 16)
    assert (got[:, :12] > 0.9).all()


@pytest.mark.parametrize(("mode", "suffix"), [("CMYK", "tiff"), ("LA", "tiff"), ("F", "tiff")])
def test_samples_that_would_be_misread_are_refused(tmp_path: Path, mode: str, suffix: str):
    Image.new(mode, (4, 4)).save(tmp_path / f"a.{suffix}")
    with pytest.raises(FormatError, match="save it"):
        read_image(tmp_path / f"a.{suffix}", WHITE)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_damaged_image_is_one_silent_error(tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]):
    whole = save(tmp_path / f"a{suffix}", (random_image(64, 64).numpy() * 255).astype(np.uint8))
    content = whole.read_bytes()
    for cut in [*range(0, 40, 3), len(content) // 2, len(content) - 30]:
        whole.write_bytes(content[:cut])
        with pytest.raises(FormatError, match=f"a{suffix}"):
            read_image(whole, None)
    assert capfd.readouterr() == ("", "")


def test_a_jpeg_with_lost_pixels_is_said_to_be_damaged(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
):
    pixels = (random_image(64, 64).numpy() * 255).astype(np.uint8)
    path = save(tmp_path / "a.jpg", pixels)
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 2] = b"\xff\xd9"  # an end marker amid the scan
    path.write_bytes(content)
    try:
        read_image(path, None)
    except FormatError:
        return  # this build of libjpeg refuses
    assert "a.jpg: is damaged (" in caplog.text
    assert capfd.readouterr() == ("", "")


def test_junk_and_missing_files_are_named(tmp_path: Path):
    (tmp_path / "junk.png").write_bytes(b"not an image at all")
    (tmp_path / "empty.png").touch()
    for name in ("junk.png", "empty.png", "missing.png", "."):
        for read in (image_size, lambda path: read_image(path, None)):
            with pytest.raises(FormatError, match=name):
                read(tmp_path / name)


def test_a_huge_image_is_refused_by_its_header(tmp_path: Path):
    header = struct.pack(">IIBBBBB", 16385, 16384, 8, 2, 0, 0, 0)
    bomb = b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", header)
    bomb += png_chunk(b"IDAT", zlib.compress(bytes(100))) + png_chunk(b"IEND", b"")
    (tmp_path / "bomb.png").write_bytes(bomb)
    with pytest.raises(FormatError, match="16385x16384"):
        read_image(tmp_path / "bomb.png", None)


def test_between_pillows_limit_and_ours_a_size_is_just_a_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    Image.new("1", (16384, 4096)).save(tmp_path / "large.png")
    assert image_size(tmp_path / "large.png") == (16384, 4096)
    assert Image.MAX_IMAGE_PIXELS == 1000


@settings(max_examples=40, deadline=None)
@given(st.binary(max_size=200), st.sampled_from(["PNG", "JPEG", "TIFF", "WEBP", "BMP"]))
def test_noise_in_an_image_never_escapes(tmp_path_factory, noise: bytes, kind: str):
    content = io.BytesIO()
    Image.new("RGB", (9, 7), (200, 100, 50)).save(content, kind)
    content.seek(20)
    content.write(noise)
    path = tmp_path_factory.getbasetemp() / "noise"
    path.write_bytes(content.getvalue())
    try:
        assert read_image(path, WHITE).shape[2] == 3
    except FormatError:
        return  # and nothing else


def test_paths_are_text_too(tmp_path: Path):
    path, rgb = str(tmp_path / "a.png"), quantised(random_image())
    aaplug.write_png(path, rgb)
    assert image_size(path) == (7, 5)
    assert torch.equal(aaplug.read_image(path), rgb)
    assert torch.equal(read_photo(path, WHITE), rgb)
    assert torch.equal(read_rgba(path)[..., :3], rgb)


@needs_data
@pytest.mark.data
def test_real_photographs_are_read():
    chair = read_image(DATA / "chair" / "test" / "r_0.png", WHITE)
    assert chair.shape == (800, 800, 3)
    assert chair[0, 0].tolist() == [1, 1, 1]
    photograph = next((DATA / "snowmiku" / "images").iterdir())
    assert image_size(photograph) == (984, 740)
    assert read_image(photograph, None).shape == (740, 984, 3)

"""Images come in as stored and go out rounded to the nearest code."""

import os
import re
import struct
import tempfile
import threading
import time
import zlib
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

import aaplug
from aaplug.core.imaging import levels
from aaplug.io.images import captured_stderr, checked_image, image_size, read_image, read_rgba, write_png
from aaplug.io.photographs import read_photo
from aaplug.system.errors import FormatError, OutputError, UsageError
from tests.conftest import memory_taken, needs_peak_memory

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)


def random_image(height: int = 5, width: int = 7) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))


NOT_IMAGES = [
    (torch.zeros(4, 4, 3, dtype=torch.uint8), {}, "torch.uint8 [4, 4, 3]"),
    (np.zeros((4, 4, 3), np.float32), {}, "not ndarray"),
    (torch.zeros(3, 4, 4), {}, "[3, 4, 4]"),
    (torch.zeros(4, 4), {}, "[4, 4]"),
    (torch.zeros(0, 4, 3), {}, "[0, 4, 3]"),
    (torch.full((4, 4, 3), torch.nan), {}, "NaN or infinite"),
    (torch.zeros(4, 4, 3), {"bit_depth": 7}, "'7' is not one of 8, 16"),
]


@pytest.mark.parametrize(("image", "options", "said"), NOT_IMAGES, ids=range(len(NOT_IMAGES)))
def test_what_is_no_image_is_not_written(tmp_path, image, options, said):
    # tests type-check `write_png` itself
    write = partial(write_png, tmp_path / "image.png") if options else checked_image
    with pytest.raises(UsageError, match=re.escape(said)):
        write(image, **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_any_floats_are_written_also_with_gradients(tmp_path, kind):
    image = torch.full((2, 2, 3), 0.2, dtype=kind, requires_grad=True)
    write_png(tmp_path / "image.PNG", image)
    assert torch.equal(read_image(tmp_path / "image.PNG"), torch.full((2, 2, 3), 51 / 255))
    with pytest.raises(OutputError, match=r"image\.jpg: is no name of a PNG"):
        write_png(tmp_path / "image.jpg", image)


def save(path: Path, pixels: np.ndarray) -> Path:
    """Write samples in OpenCV's channel order."""
    path.write_bytes(cv2.imencode(path.suffix, pixels)[1].tobytes())
    return path


def png_chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


@pytest.mark.parametrize("bit_depth", [8, 16])
def test_reading_a_written_png_gives_the_quantised_image(tmp_path: Path, bit_depth: int):
    path, rgb = str(tmp_path / "a.png"), random_image() * 1.4 - 0.2
    aaplug.write_png(path, rgb, bit_depth)
    written = levels(rgb, bit_depth) / (2**bit_depth - 1)
    assert torch.equal(aaplug.read_image(path), written)
    for eight_bits in (read_photo(path, WHITE), read_rgba(path)[..., :3]):
        assert bit_depth == 16 or torch.equal(eight_bits, written)
    assert image_size(path) == (7, 5)
    codes = torch.arange(2**bit_depth).reshape(-1, 256, 1).expand(-1, -1, 3)
    rgb = codes.float() / (2**bit_depth - 1)
    write_png(tmp_path / "codes.png", rgb, bit_depth)
    assert torch.equal(read_image(tmp_path / "codes.png", None), rgb), "every code survives"


def test_alpha_is_composited_in_float(tmp_path: Path):
    path = save(tmp_path / "a.png", np.array([[[30, 20, 10, 51]]], np.uint8))  # BGRA
    got = read_image(path, (0.5, 0.25, 1.0))[0, 0]
    expected = [(10 / 255) * 0.2 + 0.4, (20 / 255) * 0.2 + 0.2, (30 / 255) * 0.2 + 0.8]
    assert got.tolist() == pytest.approx(expected, abs=1e-7)
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


@pytest.mark.parametrize(
    ("suffix", "mode", "orientation"),
    [("tiff", mode, 1) for mode in ("CMYK", "LA", "RGBA", "F", "LAB")]
    + [("tiff", "RGB", 3), ("tiff", "L", 6), ("jpg", "CMYK", 1)],
)
def test_samples_that_would_be_misread_are_refused(tmp_path: Path, suffix: str, mode: str, orientation: int):
    tags = {"tiffinfo": {0x0112: orientation}} if suffix == "tiff" else {}
    Image.new(mode, (4, 4)).save(tmp_path / f"a.{suffix}", **tags)
    with pytest.raises(FormatError, match="save it"):
        read_image(tmp_path / f"a.{suffix}", WHITE)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp", ".tiff", ".bmp"])
def test_a_damaged_image_is_one_silent_error(tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]):
    whole = save(tmp_path / f"a{suffix}", (random_image(64, 64).numpy() * 255).astype(np.uint8))
    content = whole.read_bytes()
    middle = len(content) // 2
    lost = content[:middle] + b"\xff\xd9" + content[middle + 2 :]  # an end marker amid the scan of a JPEG
    spoiled = [lost] if suffix == ".jpg" else []
    for data in [*spoiled, *(content[:cut] for cut in [*range(0, 40, 3), middle, len(content) - 30])]:
        whole.write_bytes(data)
        with pytest.raises(FormatError, match=rf"a\{suffix}: is (damaged|not an image)"):
            read_image(whole, None)
    assert capfd.readouterr() == ("", "")


def test_threads_that_capture_stderr_leave_it_as_it_was():
    before, (both, first_left) = os.fstat(2), (threading.Event() for _ in range(2))

    def first():
        with captured_stderr():
            other.start()
            both.wait(0.1)  # the other waits for this one to leave
        first_left.set()

    def second():
        with captured_stderr():
            both.set()
            first_left.wait()

    other = threading.Thread(target=second)
    first()
    other.join()
    assert os.path.samestat(os.fstat(2), before)


@pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="this system has no files in memory")
def test_images_are_read_without_a_folder_of_temporary_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_png(tmp_path / "a.png", random_image())
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "nowhere"))
    assert read_image(tmp_path / "a.png", None).shape == (5, 7, 3)


def test_a_jpeg_with_bytes_between_its_markers_is_read_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    path = save(tmp_path / "a.jpg", (random_image(64, 64).numpy() * 255).astype(np.uint8))
    whole, content = read_image(path, None), path.read_bytes()
    tables = content.index(b"\xff\xdb")
    path.write_bytes(content[:tables] + b"\0\0\0" + content[tables:])
    assert torch.equal(read_image(path, None), whole)
    assert "a.jpg: is damaged (Corrupt JPEG data: 3 extraneous bytes" in caplog.text


def test_junk_missing_files_and_other_containers_are_named(tmp_path: Path):
    (tmp_path / "junk.png").write_bytes(b"not an image at all")
    (tmp_path / "empty.png").touch()
    (tmp_path / "folder.png").mkdir()
    kinds = ("GIF", "PPM", "JPEG2000", "ICO")
    for kind in kinds:
        Image.new("RGB", (16, 16)).save(tmp_path / f"{kind}.png", kind)
    not_an_image = r"is not an image that can be read \(PNG, JPEG, WEBP, TIFF, BMP\)"
    problems = {f"{name}.png": not_an_image for name in ("junk", "empty", *kinds)}
    problems |= {"missing.png": "does not exist", "folder.png": "cannot be read: is a directory"}
    for name, problem in problems.items():
        for read in (image_size, lambda path: read_image(path, None)):
            with pytest.raises(FormatError, match=f"{name}: {problem}"):
                read(tmp_path / name)


SHORT = zlib.compress(bytes(100))  # of the pixels


def animated(size: tuple[int, int], frame: tuple[int, int], pixels: bytes, count: int = 2) -> bytes:
    """A PNG of some frames: the first is the still picture, the second as large as it claims to be."""
    ihdr = struct.pack(">IIBBBBB", *size, 8, 2, 0, 0, 0)

    def control(number: int, of: tuple[int, int]) -> bytes:
        return png_chunk(b"fcTL", struct.pack(">IIIIIHHBB", number, *of, 0, 0, 1, 10, 0, 0))

    chunks = png_chunk(b"IHDR", ihdr) + png_chunk(b"acTL", struct.pack(">II", count, 0))
    chunks += control(0, size) + png_chunk(b"IDAT", pixels)
    chunks += control(1, frame) + png_chunk(b"fdAT", struct.pack(">I", 2) + SHORT)
    return b"\x89PNG\r\n\x1a\n" + chunks + png_chunk(b"IEND", b"")


def test_an_animation_is_its_still_picture(tmp_path: Path):
    rows = b"".join(b"\0" + bytes([10 * y, 20, 30] * 7) for y in range(5))
    (tmp_path / "a.png").write_bytes(animated((7, 5), (16000, 12800), zlib.compress(rows)))
    expected = torch.tensor([[10.0 * y, 20, 30] for y in range(5)])[:, None].expand(-1, 7, -1) / 255
    assert torch.equal(read_image(tmp_path / "a.png"), expected)


@pytest.mark.parametrize(
    ("size", "count", "problem"),
    [((16385, 16384), 2, "16385x16384"), *(((300, 200), n, "is damaged or cut short") for n in (0, 1, 2, 1000, 2**31))],
)
def test_a_huge_image_and_an_animation_without_its_pixels_are_refused(tmp_path: Path, size, count: int, problem: str):
    (tmp_path / "a.png").write_bytes(animated(size, size, SHORT, count))
    with pytest.raises(FormatError, match=rf"a\.png: .*{problem}"):
        read_image(tmp_path / "a.png")


def test_a_file_that_does_not_have_the_pixels_of_its_header_is_refused(tmp_path: Path, monkeypatch):
    path = save(tmp_path / "a.png", np.zeros((5, 7, 3), np.uint8))
    os.truncate(path, 2**26 + 5 * 7 * 8)
    assert read_image(path).shape == (5, 7, 3)
    os.truncate(path, 2**26 + 5 * 7 * 8 + 1)
    with pytest.raises(FormatError, match=r"a\.png: has 67,109,145 bytes, which 7x5 px do not need"):
        read_image(path)
    os.truncate(path, 2**26)
    monkeypatch.setattr("aaplug.io.images.cv2.imdecode", lambda data, flags: np.zeros((7, 5, 3), np.uint8))
    with pytest.raises(FormatError, match=r"a\.png: has 5x7 px where its header says 7x5"):
        read_image(path)


SIDE, CLAIMED = 2000, 8000  # px
SLACK = 48 * 2**20  # bytes: bands of rows at work, the file
RESULT = 3 * 4  # bytes a pixel
BYTES = {("RGB", "PNG"): 3 + RESULT, ("RGBA", "PNG"): 4 + RESULT, ("RGB", "WEBP"): 3 + RESULT}  # a pixel
BOMB = """
from pathlib import Path
from PIL import Image
from aaplug.system.errors import FormatError
from aaplug.io.images import read_image
def attempt(path):
    try:
        read_image(path, (1.0, 1.0, 1.0))
    except FormatError:
        pass
path = Path({folder!r})
Image.new("RGBA", (9, 9)).save(path / "small.png")
"""
SMALL = "attempt(path / 'small.png')"


@needs_peak_memory
def test_memory_is_the_samples_and_the_result(tmp_path: Path):
    """Converting the whole image at once took three times the result; an animation that claims much takes little."""
    for mode, kind in BYTES:
        Image.new(mode, (SIDE, SIDE)).save(tmp_path / (mode + kind), kind)
    (tmp_path / "animation").write_bytes(animated((CLAIMED, CLAIMED), (CLAIMED, CLAIMED), SHORT))
    works = [f"attempt(path / {name!r})" for name in (*map("".join, BYTES), "animation")]
    taken = memory_taken(BOMB.format(folder=str(tmp_path)), *works, warm=SMALL)
    for given, bytes_a_pixel in zip(taken, (*BYTES.values(), 0), strict=True):
        assert given < SLACK + bytes_a_pixel * SIDE**2


def test_between_pillows_limit_and_ours_a_size_is_just_a_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    Image.new("1", (16384, 4096)).save(tmp_path / "large.png")
    assert image_size(tmp_path / "large.png") == (16384, 4096)
    assert Image.MAX_IMAGE_PIXELS == 1000


def test_a_chunk_longer_than_its_file_is_refused_at_once(tmp_path: Path):
    write_png(tmp_path / "a.png", torch.zeros(12, 16, 3))
    data = bytearray((tmp_path / "a.png").read_bytes())
    at = data.index(b"IDAT")
    data[at - 4 : at] = b"\xff\xff\xff\xff"
    (tmp_path / "a.png").write_bytes(data)
    started = time.process_time()
    with pytest.raises(FormatError, match="is damaged or cut short"):
        read_image(tmp_path / "a.png")
    assert time.process_time() - started < 1.0  # OpenCV made room for 4 GB: 7 s and more

"""Photographs made smaller in each of the field's ways; upsamplers, which stand in for them above the training size."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from aaplug import FormatError, UsageError, read_image
from aaplug.core.imaging import box_average, quantised, resampled, stretched
from aaplug.evaluation.upsamplers import UPSAMPLERS, find_upsampler
from aaplug.io.photographs import DOWNSCALES, Photograph, photo_of
from tests.conftest import make_camera

WHITE = (1.0, 1.0, 1.0)


@pytest.fixture
def rgba(tmp_path):
    """A file of random colours and transparencies, 24×16 px."""
    pixels = np.random.default_rng(0).integers(0, 256, (16, 24, 4), dtype=np.uint8)
    path = tmp_path / "photo.png"
    cv2.imwrite(str(path), pixels)
    return path


@pytest.mark.parametrize("name", DOWNSCALES)
def test_every_way_keeps_size_and_range(rgba, name):
    photo = DOWNSCALES[name].read(rgba, WHITE)
    assert photo.hw == (16, 24)
    for factor, hw in ((1.0, (16, 24)), (0.5, (8, 12)), (0.25, (4, 6))):
        image = photo.at(hw, (factor, factor))
        assert image.shape == (*hw, 3)
        assert 0 <= image.min() <= image.max() <= 1


def test_box_composites_rounds_and_averages(rgba):
    expected = box_average(quantised(read_image(rgba, WHITE)), 4)
    assert DOWNSCALES["box"].read(rgba, WHITE).at((4, 6), (0.25, 0.25)).equal(expected)


def test_rgba_box_averages_straight_alpha_cuts_twice_and_refuses_what_is_not_halved(rgba):
    bgra = cv2.imread(str(rgba), cv2.IMREAD_UNCHANGED)[..., [2, 1, 0, 3]].astype(np.float64) / 255
    small = bgra.reshape(4, 4, 6, 4, 4).mean(axis=(1, 3))
    saved = np.floor(small * 255 + 1e-6) / 255
    composited = saved[..., :3] * saved[..., 3:] + 1 - saved[..., 3:]
    found = DOWNSCALES["rgba-box"].read(rgba, WHITE).at((4, 6), (0.25, 0.25))
    levels = np.floor(composited * 255 + 1e-3)
    assert np.abs((found * 255).round().numpy() - levels).max() == 0
    with pytest.raises(UsageError, match="power of 1/2"):
        DOWNSCALES["rgba-box"].read(rgba, WHITE).at((5, 8), (1 / 3, 1 / 3))


def test_pil_bicubic_is_pillows(rgba):
    pixels = (quantised(read_image(rgba, WHITE)) * 255).round().byte().numpy()
    small = np.array(Image.fromarray(pixels).resize((6, 4), Image.Resampling.BICUBIC))
    found = DOWNSCALES["pil-bicubic"].read(rgba, WHITE).at((4, 6), (0.25, 0.25))
    assert torch.allclose(found, torch.from_numpy(small).float() / 255)
    assert not torch.allclose(found, DOWNSCALES["box"].read(rgba, WHITE).at((4, 6), (0.25, 0.25)))


@pytest.mark.parametrize("width", [12, 24, 48])
def test_a_photograph_shows_the_whole_view_whatever_size_the_view_was_trained_at(rgba, width):
    """A photograph of another width than its view's is resampled, not cropped."""
    view = replace(make_camera(size=(width, width * 2 // 3)), photo=rgba)
    expected = box_average(quantised(read_image(rgba, WHITE)), 4)
    assert photo_of(view, WHITE)(view.scaled(6 / width)).equal(expected)


def test_a_view_trained_at_a_rounded_size_is_compared_with_the_whole_photograph(rgba):
    """3DGS stretches the photograph to that size, and its cameras keep their field of view."""
    view = replace(make_camera(size=(10, 6)), photo=rgba)  # 6.67 rows, cut
    whole = quantised(read_image(rgba, WHITE))
    assert torch.allclose(photo_of(view, WHITE)(view), stretched(whole, (6, 10)), atol=1e-6)
    assert torch.allclose(photo_of(view, WHITE)(view.scaled(1 / 2)), stretched(whole, (3, 5)), atol=1e-6)


@pytest.mark.parametrize(
    ("view", "photograph"), [((618, 411), (4946, 3286)), ((50, 38), (202, 150)), ((1237, 822), (618, 411))]
)
def test_the_shape_of_a_photograph_may_differ_by_the_rounding_of_either_size(view, photograph):
    """Those of Mip-NeRF 360's bicycle at 1/8 and 1/4 among them; one turned on its side is of another shape."""
    factors = Photograph(photograph[::-1], lambda hw, factors: torch.empty(0)).factors
    assert factors(make_camera(size=view), 1.0) == (view[1] / photograph[1], view[0] / photograph[0])
    with pytest.raises(FormatError, match=f"is {photograph[0]}x{photograph[1]} px, of another shape"):
        factors(make_camera(size=view[::-1]), 1.0)


@pytest.mark.parametrize("factor", [0.35, 2 / 3 + 1e-3, 1.7])
def test_a_partial_pixel_that_is_cropped_moves_no_other(factor):
    """Of a ramp, each pixel is the average over its own part, or about the value at its centre if it is smaller."""
    edges = np.arange(int(11 * factor) + 1) / factor
    averages = np.diff(np.interp(edges, np.arange(12), np.cumsum([0, *range(11)]))) * factor
    expected = averages if factor < 1 else ((edges[:-1] + edges[1:]) / 2 - 0.5).clip(0, 10)
    ramp = torch.arange(11.0)[:, None, None].expand(11, 11, 3)
    for found in (resampled(ramp, factor)[:, 2, 1], resampled(ramp.transpose(0, 1), factor)[2, :, 1]):
        assert np.abs(found.numpy() - expected).max() < (1e-5 if factor < 1 else 0.12)


@pytest.mark.parametrize("name", UPSAMPLERS)
def test_upsamplers_keep_what_is_smooth(name):
    x = torch.linspace(0.2, 0.8, 16)
    image = x[None, :, None].repeat(12, 1, 3)
    larger = find_upsampler(name)(image, (24, 32))
    assert larger.shape == (24, 32, 3)
    torch.testing.assert_close(box_average(larger, 2)[2:-2, 2:-2], image[2:-2, 2:-2], atol=2e-3, rtol=0)


class Doubling(torch.nn.Module):
    def forward(self, x):
        return torch.nn.functional.interpolate(x, scale_factor=2.0, mode="nearest")


def test_a_torch_program_upsamples(tmp_path):
    path = tmp_path / "network.pt2"
    sides = {2: torch.export.Dim("h", min=2), 3: torch.export.Dim("w", min=2)}
    program = torch.export.export(Doubling(), (torch.rand(1, 3, 6, 5),), dynamic_shapes=(sides,))
    torch.export.save(program, path)
    image = torch.rand(8, 9, 3)
    doubled = image.repeat_interleave(2, dim=0).repeat_interleave(2, dim=1)
    upsample = find_upsampler(str(path))
    torch.testing.assert_close(upsample(image, (16, 18)), doubled)
    torch.testing.assert_close(upsample(image, (8, 9)), image, atol=1e-6, rtol=0)  # brought back


def test_an_onnx_network_upsamples():
    """tests/data/doubling.onnx is one node, which repeats pixels."""
    upsample, image = find_upsampler(str(Path(__file__).parent / "data" / "doubling.onnx")), torch.rand(8, 9, 3)
    doubled = image.repeat_interleave(2, dim=0).repeat_interleave(2, dim=1)
    for size in (image, image[:6], image):
        torch.testing.assert_close(upsample(size, (2 * len(size), 18)), doubled[: 2 * len(size)])


class OneChannel(Doubling):
    def forward(self, x):
        return super().forward(x[:, :1])


def test_a_program_whose_images_have_one_channel_is_refused(tmp_path):
    torch.export.save(torch.export.export(OneChannel(), (torch.rand(1, 3, 6, 5),)), tmp_path / "grey.pt2")
    with pytest.raises(FormatError, match=r"should give .*gives \[1, 1, 12, 10\]"):
        find_upsampler(str(tmp_path / "grey.pt2"))(torch.rand(6, 5, 3), (12, 10))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nearest", "expected bicubic, lanczos"),
        ("missing.pb", "does not exist"),
        ("ESPCN_x4.pb", "not a network"),
        ("other.pb", "needs a name such as"),
        ("network.pt2", "not a program"),
        ("network.onnx", "not an ONNX network"),
    ],
)
def test_what_is_no_upsampler_is_refused(name, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if not name.startswith("missing"):
        Path(name).write_bytes(b"nonsense")
    with pytest.raises((FormatError, UsageError), match=words):
        find_upsampler(name)

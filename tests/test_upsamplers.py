"""Upsamplers, which stand in for the truth above the training size."""

from pathlib import Path

import pytest
import torch

from aaplug.core.imaging import box_average
from aaplug.evaluation.upsamplers import UPSAMPLERS, find_upsampler
from aaplug.system.errors import FormatError, UsageError


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

"""LPIPS from weights that the user gives: the published formula, and files that are not what they should be."""

import pickle
from pathlib import Path

import pytest
import torch
from torch.nn.functional import conv2d, max_pool2d, relu

from aaplug.evaluation.lpips import NETS, lpips_metric
from aaplug.system.errors import FormatError

CHANNELS = (4, 5, 6, 7, 8)


@pytest.fixture
def weights(tmp_path):
    return lpips_weights(tmp_path)


def lpips_weights(folder: Path) -> dict[str, tuple[Path, Path]]:
    """Files of random weights of few channels, in the layout of torchvision and of the lpips package, by net."""
    files = {}
    for name, net in NETS.items():
        g = torch.Generator().manual_seed(3)
        trunk, before, size = {}, 3, {"vgg": 3, "alex": 3}[name]
        for (_, convolutions), channels in zip(net, CHANNELS, strict=True):
            for number, *_ in convolutions:
                trunk[f"features.{number}.weight"] = torch.randn(channels, before, size, size, generator=g)
                trunk[f"features.{number}.bias"] = torch.randn(channels, generator=g)
                before = channels
        heads = {f"lin{i}.model.1.weight": torch.rand(1, c, 1, 1, generator=g) for i, c in enumerate(CHANNELS)}
        files[name] = folder / f"{name}.pth", folder / f"{name}-heads.pth"
        torch.save(trunk, files[name][0])
        torch.save(heads, files[name][1])
    return files


@pytest.mark.parametrize(("flavour", "low"), [("vgg", -1), ("3dgs", 0)])
def test_lpips_is_the_published_formula(weights, flavour, low):
    """VGG16's five stages written out, for both images at once; the net is fed [low, 1]."""
    both, trunk = torch.rand(2, 40, 48, 3, generator=torch.Generator().manual_seed(0)), torch.load(weights["vgg"][0])
    heads, expected = torch.load(weights["vgg"][1]), 0.0
    mean, std = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    x = ((low + (1 - low) * both - mean) / std).permute(0, 3, 1, 2)
    for stage, numbers in enumerate(((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))):
        x = max_pool2d(x, 2) if stage else x
        for number in numbers:
            x = relu(conv2d(x, trunk[f"features.{number}.weight"], trunk[f"features.{number}.bias"], padding=1))
        a, b = x / (x.norm(dim=1, keepdim=True) + 1e-10)
        expected += ((a - b) ** 2 * heads[f"lin{stage}.model.1.weight"][0]).sum(dim=0).mean().item()
    metric = lpips_metric(flavour, *weights["vgg"])
    assert metric.measure(*both) == pytest.approx(expected, rel=1e-5)
    assert pickle.loads(pickle.dumps(metric)).measure(*both) == metric.measure(*both)  # for other processes
    assert metric.protocol.startswith(f"{flavour}:")


def test_other_files_are_refused(weights, tmp_path):
    (trunk, heads), other = weights["vgg"], weights["alex"]
    (tmp_path / "text").write_text("not weights")
    for files, words in (
        ((other[0], heads), r"alex\.pth: holds no features\.2"),
        ((trunk, trunk), "lin0"),
        ((tmp_path / "text", heads), "torch weights"),
        ((tmp_path / "gone", heads), "no such file"),
    ):
        with pytest.raises(FormatError, match=words):
            lpips_metric("vgg", *files)

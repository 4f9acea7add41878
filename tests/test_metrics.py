"""Metrics against their definitions; LPIPS from weights that the user gives, in files that may be other ones."""

import importlib.util
import math
import pickle
from functools import partial
from pathlib import Path

import pytest
import torch
from torch.nn.functional import conv2d, max_pool2d, pad, relu

from aaplug import METRICS, PROTOCOLS, FormatError, Metric, UsageError
from aaplug.evaluation.lpips import NETS, lpips_metric
from aaplug.evaluation.metrics import SSIM, default_metrics, energy_drift, find_metrics, flicker, psnr, ssim
from aaplug.system.registry import spelt


@pytest.mark.parametrize("hw", [(11, 11), (40, 32), (97, 130)])
@pytest.mark.parametrize(("flavour", "border"), [("wang", 0), ("3dgs", 5)])
def test_ssim_is_the_one_of_wang_with_the_border_cropped_or_padded(hw, flavour, border):
    """Wang et al. 2004, eq. 13, at every place where the 11×11 window fits."""
    a, b = torch.rand(2, *hw, 3, generator=torch.Generator().manual_seed(0))
    line = torch.exp(-0.5 * ((torch.arange(11.0).double() - 5) / 1.5) ** 2)
    window = torch.outer(line, line) / line.sum() ** 2
    x, y = (pad(image.permute(2, 0, 1).double(), (border,) * 4) for image in (a, b))
    mx, my, xx, yy, xy = (
        (image.unfold(1, 11, 1).unfold(2, 11, 1) * window).sum(dim=(3, 4)) for image in (x, y, x * x, y * y, x * y)
    )
    vx, vy, cov, c1, c2 = xx - mx**2, yy - my**2, xy - mx * my, 0.01**2, 0.03**2
    expected = ((2 * mx * my + c1) * (2 * cov + c2)) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    assert ssim(a, b, flavour) == pytest.approx(expected.mean().item(), abs=1e-9)


def test_metrics_worked_by_hand():
    """PSNR of a constant error, energy drift as the share of light gained, flicker of motion alone and of twice it."""
    image, black = torch.rand(8, 8, 3), torch.zeros(8, 8, 3)
    assert psnr(black + 0.1, black) == pytest.approx(20.0, abs=1e-5)
    assert energy_drift(1.25 * image, image) == pytest.approx(0.25)
    assert (psnr(black, black), energy_drift(image, black)) == (None, None)
    frames = [torch.full((4, 4, 3), value) for value in (0.1, 0.2, 0.15)]
    assert flicker(frames, frames) == pytest.approx(1.0)
    assert flicker([2 * frame for frame in frames], frames) == pytest.approx(2.0)
    assert flicker(frames, [frames[0]] * 3) is None


@pytest.mark.parametrize("metric", METRICS.values(), ids=lambda metric: metric.name)
def test_a_metrics_loss_is_least_at_its_ideal(metric):
    ideal = 1e9 if math.isinf(metric.ideal) else metric.ideal
    assert metric.loss(ideal) < metric.loss(ideal - 0.5)


@pytest.fixture(scope="module")
def comparing(weights):
    """Every metric that compares with a truth, by name; LPIPS with random weights."""
    return {metric.name: metric for metric in find_metrics(COMPARING, PROTOCOLS["default"], weights["vgg"])}


LEAST_SIDES = {"SSIM": 11, "LPIPS": 32}  # px
COMPARING = [m.name for m in METRICS.values() if m.measure is not None]
if importlib.util.find_spec("flip_evaluator") is None:
    COMPARING.remove("FLIP")


@pytest.mark.parametrize("hw", [(1, 1), (3, 2), (10, 40), (11, 40), (64, 48)])
@pytest.mark.parametrize("name", COMPARING)
def test_a_metric_is_ideal_or_undefined_for_equal_images(comparing, name, hw):
    metric, image = comparing[name], torch.rand(*hw, 3, generator=torch.Generator().manual_seed(1))
    value = metric.compare(image, image)
    undefined = math.isinf(metric.ideal) or min(hw) < LEAST_SIDES.get(name, 1)
    assert value == (None if undefined else pytest.approx(metric.ideal, abs=1e-6))


def test_a_metric_gives_one_number_of_any_type_and_is_of_one_kind():
    square, image = partial(Metric, "square", "", 0.0, 2, ""), torch.full((4, 4, 3), 0.5)
    assert type(square(measure=lambda a, b: (a * b).mean()).compare(image, image)) is float
    with pytest.raises(UsageError, match="metric square: gives no number but Tensor"):
        square(measure=lambda a, b: a * b).compare(image, image)
    with pytest.raises(UsageError, match="needs either `measure` or `figure`"):
        Metric("nothing", "", 1.0, 2, "neither")
    with pytest.raises(UsageError, match="digits: expected an integer from 0, got -1"):
        Metric("mean", "", 1.0, -1, "of both", lambda image, truth: 0.0)


def test_metrics_are_found_by_name_in_the_flavour_of_the_protocol():
    blender = PROTOCOLS["blender"]
    found = find_metrics(["psnr", "SSIM", "energy-drift"], blender)
    assert [m.name for m in found] == ["PSNR", "SSIM", "energy drift"]
    assert found[1] is SSIM["3dgs"]
    assert default_metrics(blender) == ("psnr", "ssim", "consistency", "energy-drift")
    assert default_metrics(PROTOCOLS["fov"]) == ("psnr", "ssim")
    assert all(spelt(name) == name for name in default_metrics(blender))


@pytest.mark.parametrize(
    ("names", "words"),
    [(["vmaf"], "'vmaf' is not one of psnr, ssim, lpips"), (["psnr", "PSNR"], "twice"), (["lpips"], "needs weights")],
)
def test_metrics_that_cannot_be_had_are_refused(names, words):
    with pytest.raises(UsageError, match=words):
        find_metrics(names, PROTOCOLS["default"])


CHANNELS = (4, 5, 6, 7, 8)


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> dict[str, tuple[Path, Path]]:
    """Files of random weights of few channels, in the layout of torchvision and of the lpips package, by net."""
    folder, files = tmp_path_factory.mktemp("weights"), {}
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

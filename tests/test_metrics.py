"""Metrics against their definitions."""

import importlib.util
import math
from functools import partial

import pytest
import torch
from torch.nn.functional import pad

from aaplug import METRICS, PROTOCOLS, Metric, UsageError
from aaplug.evaluation.metrics import SSIM, default_metrics, energy_drift, find_metrics, flicker, psnr, ssim
from aaplug.system.registry import spelt
from tests.test_lpips import lpips_weights


def test_psnr_of_a_constant_error_and_of_none():
    truth = torch.zeros(4, 4, 3)
    assert psnr(truth + 0.1, truth) == pytest.approx(20.0, abs=1e-5)
    assert psnr(truth, truth) is None


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


def test_energy_drift_is_the_share_of_light_gained():
    image = torch.rand(8, 8, 3)
    assert energy_drift(1.25 * image, image) == pytest.approx(0.25)
    assert energy_drift(image, torch.zeros(8, 8, 3)) is None


def test_flicker_of_motion_alone_is_one_and_of_twice_the_change_two():
    frames = [torch.full((4, 4, 3), value) for value in (0.1, 0.2, 0.15)]
    assert flicker(frames, frames) == pytest.approx(1.0)
    assert flicker([2 * frame for frame in frames], frames) == pytest.approx(2.0)
    assert flicker(frames, [frames[0]] * 3) is None


@pytest.mark.parametrize("metric", METRICS.values(), ids=lambda metric: metric.name)
def test_a_metrics_loss_is_least_at_its_ideal(metric):
    ideal = 1e9 if math.isinf(metric.ideal) else metric.ideal
    assert metric.loss(ideal) < metric.loss(ideal - 0.5)


@pytest.fixture(scope="module")
def comparing(tmp_path_factory):
    """Every metric that compares with a truth, by name; LPIPS with random weights."""
    weights = lpips_weights(tmp_path_factory.mktemp("weights"))["vgg"]
    return {metric.name: metric for metric in find_metrics(COMPARING, PROTOCOLS["default"], weights)}


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


def test_a_metric_gives_one_number_of_any_type():
    square, image = partial(Metric, "square", "", 0.0, 2, ""), torch.full((4, 4, 3), 0.5)
    assert type(square(measure=lambda a, b: (a * b).mean()).compare(image, image)) is float
    with pytest.raises(UsageError, match="metric square: gives no number but Tensor"):
        square(measure=lambda a, b: a * b).compare(image, image)


def test_a_metric_of_neither_kind_is_refused():
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

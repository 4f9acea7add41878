"""Metrics against their definitions."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from skimage.data import astronaut
from skimage.metrics import structural_similarity
from torch.nn.functional import conv2d, pad

from aaplug.evaluation.metrics import METRICS, energy_drift, flicker, flip, psnr, ssim
from aaplug.core.imaging import box_average


def test_psnr_of_a_constant_error():
    truth = torch.zeros(4, 4, 3)
    assert psnr(truth + 0.1, truth) == pytest.approx(20.0, abs=1e-5)


def test_psnr_of_equal_images_is_undefined():
    assert psnr(torch.ones(4, 4, 3), torch.ones(4, 4, 3)) is None


def test_ssim_is_the_one_of_wang_with_cropped_border():
    g = torch.Generator().manual_seed(0)
    a, b = torch.rand(40, 32, 3, generator=g), torch.rand(40, 32, 3, generator=g)
    channels = [brute_force_ssim(a[..., c].double(), b[..., c].double()) for c in range(3)]
    assert ssim(a, b) == pytest.approx(np.mean(channels), abs=1e-6)


@pytest.mark.parametrize("hw", [(11, 11), (40, 32), (97, 130)])
def test_ssim_wang_is_scikit_images_with_gaussian_weights(hw):
    g = torch.Generator().manual_seed(1)
    a, b = (torch.rand(*hw, 3, generator=g) for _ in "ab")
    b = (a + 0.2 * (b - 0.5)).clamp(0, 1)
    expected = structural_similarity(
        a.double().numpy(),
        b.double().numpy(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
    )
    assert ssim(a, b, "wang") == pytest.approx(expected, abs=1e-9)


def test_ssim_3dgs_is_the_zero_padded_convolution():
    g = torch.Generator().manual_seed(2)
    a, b = torch.rand(30, 41, 3, generator=g), torch.rand(30, 41, 3, generator=g)
    x = torch.arange(11, dtype=torch.float64) - 5
    line = torch.exp(-0.5 * (x / 1.5) ** 2)
    window = (torch.outer(line, line) / line.sum() ** 2)[None, None]

    def windowed(image):
        planes = image.double().permute(2, 0, 1)[:, None]
        return conv2d(pad(planes, (5, 5, 5, 5)), window)

    ma, mb = windowed(a), windowed(b)
    ad, bd = a.double(), b.double()
    va, vb = windowed(ad * ad) - ma**2, windowed(bd * bd) - mb**2
    cov = windowed(ad * bd) - ma * mb
    c1, c2 = 0.01**2, 0.03**2
    map_ = ((2 * ma * mb + c1) * (2 * cov + c2)) / ((ma**2 + mb**2 + c1) * (va + vb + c2))
    assert ssim(a, b, "3dgs") == pytest.approx(map_.mean().item(), abs=1e-9)


# image side in px, SSIM zero-padded and cropped: published with the 3DGS family's border effect
BORDER = [
    (512, 0.7997, 0.7965),
    (256, 0.8336, 0.8291),
    (128, 0.8611, 0.8547),
    (64, 0.8877, 0.8792),
]


def test_the_border_reads_higher_the_smaller_the_image():
    photo, noise = torch.from_numpy(astronaut() / 255), np.random.default_rng(0)
    for side, padded, cropped in BORDER:
        truth = box_average(photo, 512 // side)
        blurred = gaussian_filter(truth.numpy(), (0.7, 0.7, 0))
        image = torch.from_numpy(np.clip(blurred + noise.normal(0, 0.02, truth.shape), 0, 1))
        assert ssim(image, truth, "3dgs") == pytest.approx(padded, abs=6e-5)
        assert ssim(image, truth, "wang") == pytest.approx(cropped, abs=6e-5)


def test_flip_is_nothing_for_equal_images_and_grows_with_the_error():
    pytest.importorskip("flip_evaluator")
    image = torch.rand(40, 40, 3, generator=torch.Generator().manual_seed(0))
    assert flip(image, image) == pytest.approx(0.0, abs=1e-6)
    near, far = flip(image * 0.95, image), flip(image * 0.5, image)
    assert 0 < near < far < 1


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


def test_ssim_is_not_scikit_images_default():
    g = torch.Generator().manual_seed(0)
    a, b = torch.rand(40, 32, 3, generator=g), torch.rand(40, 32, 3, generator=g)
    default = structural_similarity(a.numpy(), b.numpy(), data_range=1.0, channel_axis=2)
    assert abs(ssim(a, b) - default) > 1e-3


def test_ssim_is_undefined_below_its_window():
    assert ssim(torch.zeros(10, 40, 3), torch.zeros(10, 40, 3)) is None
    assert ssim(torch.zeros(11, 40, 3), torch.zeros(11, 40, 3)) == pytest.approx(1.0)


def brute_force_ssim(a: torch.Tensor, b: torch.Tensor) -> float:
    """Wang et al. 2004, eq. 13, at every place where the 11×11 window fits."""
    x = torch.arange(11, dtype=torch.float64) - 5
    line = torch.exp(-0.5 * (x / 1.5) ** 2)
    window = torch.outer(line, line) / line.sum() ** 2

    def windowed(image: torch.Tensor) -> torch.Tensor:
        return (image.unfold(0, 11, 1).unfold(1, 11, 1) * window).sum(dim=(2, 3))

    ma, mb = windowed(a), windowed(b)
    va, vb, cov = windowed(a * a) - ma**2, windowed(b * b) - mb**2, windowed(a * b) - ma * mb
    c1, c2 = 0.01**2, 0.03**2
    return (
        (((2 * ma * mb + c1) * (2 * cov + c2)) / ((ma**2 + mb**2 + c1) * (va + vb + c2)))
        .mean()
        .item()
    )

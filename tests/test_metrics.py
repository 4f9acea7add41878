"""Metrics against their definitions."""

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from aaplug.metrics import psnr, ssim


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

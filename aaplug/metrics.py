"""Image metrics: arrays to numbers.

Images are [h, w, 3] in [0, 1], already rounded to 8 bits by whoever compares files.  A metric that is not defined for
a pair (images too small) or infinite (equal images) is None, never a number that stands for it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from skimage.metrics import structural_similarity
from torch import Tensor

SSIM_WINDOW = 11  # px: a Gaussian window of sigma 1.5 cut there (Wang et al. 2004)
SSIM_SIGMA = 1.5  # px


@dataclass(frozen=True)
class Metric:
    """A named measurement; `protocol` says which of the field's variants it is."""

    name: str
    unit: str
    higher_is_better: bool
    protocol: str
    measure: Callable[[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]], float | None]


def psnr(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float | None:
    """Peak signal-to-noise ratio over all channels, in dB, for a peak of 1; None for equal images."""
    error = (image.double() - truth.double()).square().mean()
    return None if error == 0 else -10 * torch.log10(error).item()


def ssim(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float | None:
    """Structural similarity as Wang et al. 2004 define it; None for images smaller than the window."""
    if min(image.shape[:2]) < SSIM_WINDOW:
        return None
    value: Any = structural_similarity(
        image.double().numpy(),
        truth.double().numpy(),
        gaussian_weights=True,
        sigma=SSIM_SIGMA,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
    )
    return float(value)


METRICS = {
    metric.name: metric
    for metric in (
        Metric("PSNR", "dB", True, "peak 1, over all channels, mean of per-view values", psnr),
        Metric(
            "SSIM", "", True, "wang: 11×11 Gaussian, sigma 1.5, border cropped, channel mean", ssim
        ),
    )
}

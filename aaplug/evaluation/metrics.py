"""Image metrics: arrays to numbers.

Images are [h, w, 3] in [0, 1], already rounded to 8 bits by whoever compares files.  A metric that is not defined for
a pair (images too small) or infinite (equal images) is None, never a number that stands for it.

SSIM comes in the two flavours that the field's tables mix: "wang" crops the border that the window overhangs, as
scikit-image with Gaussian weights and torchmetrics do; "3dgs" pads with zeros and keeps it, as 3DGS's own script does,
and so reads higher the smaller the image (by 0.003 at 512 px, 0.0085 at 64 px).
"""

import importlib.util
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float
from torch import Tensor

from aaplug.core.errors import UsageError

SsimFlavour = Literal["wang", "3dgs"]
LpipsFlavour = Literal["3dgs", "vgg", "alex"]

SSIM_WINDOW = 11  # px: a Gaussian window of sigma 1.5 cut there (Wang et al. 2004)
SSIM_SIGMA = 1.5  # px
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2  # for a range of 1 (Wang et al. 2004)
FLIP_DEGREE = 67  # px a degree: FLIP's default, a 0.7 m wide 4K screen seen from 0.7 m
LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709, on the values as stored


@dataclass(frozen=True)
class Metric:
    """A named measurement; `protocol` says which of the field's variants it is.

    ideal: the value of a perfect image, infinite where more is always better.  digits: behind the point, in tables.
    measure: image and truth to the value; None for the figures that need more than the two, or no truth.
    """

    name: str
    unit: str
    ideal: float
    digits: int
    protocol: str
    measure: Callable[[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]], float | None] | None = None

    def loss(self, value: float) -> float:
        """What is smallest for the best value."""
        return -value if math.isinf(self.ideal) else abs(value - self.ideal)


def psnr(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float | None:
    """Peak signal-to-noise ratio over all channels, in dB, for a peak of 1; None for equal images."""
    a, b = image.cpu().numpy(), truth.to(image.dtype).cpu().numpy()
    error = cv2.norm(a, b, cv2.NORM_L2SQR) / a.size  # summed in float64
    return None if error == 0 else -10 * math.log10(error)


def ssim(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], flavour: SsimFlavour = "wang"
) -> float | None:
    """Structural similarity (Wang et al. 2004, eq. 13), the channels' mean; None for images smaller than the window."""
    if min(image.shape[:2]) < SSIM_WINDOW:
        return None
    a, b = image.double().cpu().numpy(), truth.double().cpu().numpy()
    mean_a, mean_b = _windowed(a, flavour), _windowed(b, flavour)
    covariance = _windowed(a * b, flavour)
    # only the variances' sum counts, so that their windows are one
    variances = _windowed(a * a + b * b, flavour)
    product, squares = mean_a * mean_b, mean_a * mean_a + mean_b * mean_b
    alike = (2 * product + SSIM_C1) * (2 * (covariance - product) + SSIM_C2)
    size = (squares + SSIM_C1) * (variances - squares + SSIM_C2)
    return float((alike / size).mean())


def _windowed(image: np.ndarray, flavour: SsimFlavour) -> np.ndarray:
    """Gaussian-weighted means around each pixel: all of them over zeros outside, or those that need nothing outside."""
    line = cv2.getGaussianKernel(SSIM_WINDOW, SSIM_SIGMA, cv2.CV_64F)
    means = cv2.sepFilter2D(image, cv2.CV_64F, line, line, borderType=cv2.BORDER_CONSTANT)
    border = SSIM_WINDOW // 2
    if flavour == "3dgs":
        return means
    return np.ascontiguousarray(means[border:-border, border:-border])


def flip(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float | None:
    """Mean of the LDR-FLIP map (Andersson et al. 2020) at the default viewing distance; 0 for equal images.

    Raises:
        UsageError: the package that computes it is not installed.
    """
    if importlib.util.find_spec("flip_evaluator") is None:
        raise UsageError("FLIP", "needs the package flip-evaluator: pip install 'aaplug[flip]'")
    import flip_evaluator  # pyright: ignore[reportMissingImports]

    a, b = (np.ascontiguousarray(x.float().cpu().numpy()) for x in (truth, image))
    settings = {"ppd": FLIP_DEGREE}
    _, value, _ = flip_evaluator.evaluate(a, b, "LDR", True, False, True, settings)
    return float(value)


def energy(rgb: Float[Tensor, "h w 3"]) -> float:
    """Mean luminance (Rec. 709)."""
    means = cv2.mean(rgb.cpu().numpy())  # summed in float64
    return sum(weight * mean for weight, mean in zip(LUMINANCE, means, strict=False))


def energy_drift(drawn: Float[Tensor, "h w 3"], expected: Float[Tensor, "H W 3"]) -> float | None:
    """How much more light an image has than it should, as a share; None where it should have none."""
    before = energy(expected)
    return None if before == 0 else energy(drawn) / before - 1


def flicker(
    frames: Sequence[Float[Tensor, "h w 3"]], motion: Sequence[Float[Tensor, "h w 3"]]
) -> float | None:
    """Frame-to-frame change over the change that motion alone makes, RMS over RMS; None where nothing moves.

    Above 1 an image shimmers, below 1 it is blurred.
    """
    own, expected = (
        sum(float((b - a).double().square().mean()) for a, b in pairwise(x))
        for x in (frames, motion)
    )
    return None if expected == 0 else math.sqrt(own / expected)


PSNR = Metric("PSNR", "dB", math.inf, 2, "peak 1, over all channels, mean of per-view values", psnr)
SSIM: dict[SsimFlavour, Metric] = {
    "wang": Metric(
        "SSIM",
        "",
        1.0,
        4,
        "wang: 11×11 Gaussian, sigma 1.5, border cropped, channel mean",
        ssim,
    ),
    "3dgs": Metric(
        "SSIM",
        "",
        1.0,
        4,
        "3dgs: 11×11 Gaussian, sigma 1.5, zero-padded, border kept, channel mean",
        lambda image, truth: ssim(image, truth, "3dgs"),
    ),
}
LPIPS = Metric("LPIPS", "", 0.0, 4, "version 0.1")
FLIP = Metric("FLIP", "", 0.0, 4, f"LDR-FLIP, mean, {FLIP_DEGREE} px a degree", flip)
CONSISTENCY = Metric(
    "consistency",
    "dB",
    math.inf,
    2,
    "PSNR of the image against the recipe's own training-size image, box-averaged; null at and above that size, where "
    "the two are equal, and where scale 1 is not measured",
)
ENERGY = Metric(
    "energy drift",
    "",
    0.0,
    4,
    "luminance of what is drawn, without the background, over the recipe's own at the training size, minus 1; "
    "null where scale 1 is not measured",
)
FLICKER = Metric(
    "flicker",
    "",
    1.0,
    3,
    "frame-to-frame change over three steps of 1/4 px, over that of the training-size image, averaged down: 1 is "
    "motion alone; null at and above the training size",
)
METRICS = {
    metric.name: metric
    for metric in (PSNR, SSIM["wang"], LPIPS, FLIP, CONSISTENCY, ENERGY, FLICKER)
}

"""How alike two images are: PSNR, SSIM, FLIP.

Images are [h, w, 3] in [0, 1].  A value that is not defined (images too small) or infinite (equal images) is None.

SSIM comes in the two flavours that the field's tables mix: "wang" crops the border that the window overhangs, as
scikit-image with Gaussian weights and torchmetrics do; "3dgs" pads with zeros and keeps the border, as 3DGS's own
script does, and so reads higher the smaller the image (by 0.003 at 512 px, 0.0085 at 64 px).
"""

import importlib.util
import math
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from torch import Tensor

from aaplug.core.errors import UsageError
from aaplug.evaluation.metric import SsimFlavour

SSIM_WINDOW = 11  # px: the Gaussian of SSIM_SIGMA, cut at 3.5 sigma (Wang et al. 2004)
SSIM_SIGMA = 1.5  # px
FLIP_DEGREE = 67  # px per degree: FLIP's default, a 0.7 m wide 4K screen seen from 0.7 m


def psnr(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float | None:
    """Peak signal-to-noise ratio over all channels, in dB, for a peak of 1; None for equal images."""
    a, b = image.cpu().numpy(), truth.to(image.dtype).cpu().numpy()
    error = cv2.norm(a, b, cv2.NORM_L2SQR) / a.size  # summed in float64
    return None if error == 0 else -10 * math.log10(error)


def ssim(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], flavour: SsimFlavour = "wang") -> float | None:
    """Structural similarity (Wang et al. 2004, eq. 13), the channels' mean; None for images smaller than the window."""
    if min(image.shape[:2]) < SSIM_WINDOW:
        return None
    from skimage.metrics import structural_similarity  # takes half a second to import

    a, b = (x.double().cpu().numpy() for x in (image, truth))
    if flavour == "3dgs":  # scikit-image crops the border that is added here, and nothing else
        border = SSIM_WINDOW // 2
        a, b = (np.pad(x, ((border, border), (border, border), (0, 0))) for x in (a, b))
    value: Any = structural_similarity(
        a, b, channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=SSIM_SIGMA, use_sample_covariance=False
    )
    return float(value)


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

"""3DGS's training loss (Kerbl et al. 2023, eq. 7): the mean absolute error, and structural similarity."""

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.evaluation.metrics import SSIM_SIGMA, SSIM_WINDOW

SSIM_SHARE = 0.2  # weight of D-SSIM against L1 (3DGS, eq. 7)
SSIM_K = (0.01, 0.03)  # for values in [0, 1]; squared in the formula (Wang et al. 2004)


def l1_dssim(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """3DGS's training loss (eq. 7): 0.8 mean absolute error + 0.2 (1 - SSIM)."""
    absolute = (image - truth).abs().mean()
    return (1 - SSIM_SHARE) * absolute + SSIM_SHARE * (1 - structural_similarity(image, truth))


def structural_similarity(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """Mean SSIM over the windows that lie inside the image; the window shrinks to fit a smaller image."""
    a, b = (x.permute(2, 0, 1)[:, None] for x in (image, truth))

    def window(side: int) -> Tensor:
        size = min(SSIM_WINDOW, side)
        x = torch.arange(size, dtype=torch.float64) - (size - 1) / 2
        weights = torch.exp(-0.5 * (x / SSIM_SIGMA) ** 2)
        return (weights / weights.sum()).to(image)

    rows, columns = map(window, a.shape[2:])

    def blurred(x: Tensor) -> Tensor:
        down = torch.nn.functional.conv2d(x, rows[None, None, :, None])
        return torch.nn.functional.conv2d(down, columns[None, None, None, :])

    mean_a, mean_b = blurred(a), blurred(b)
    var_a, var_b = blurred(a * a) - mean_a**2, blurred(b * b) - mean_b**2
    cov = blurred(a * b) - mean_a * mean_b
    c1, c2 = (k * k for k in SSIM_K)
    alike = (2 * mean_a * mean_b + c1) * (2 * cov + c2)
    return (alike / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))).mean()

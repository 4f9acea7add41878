"""Training's sampling rate of each Gaussian, from the cameras or from the scene alone."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians
from aaplug.core.sampling import median_rates

ASSUMED_SIGMA = 1.0  # px: the median Gaussian's middle standard deviation, where no cameras tell its sampling rate


def rates_of(scene: Gaussians, cameras: Sequence[Camera]) -> Float[Tensor, " n"]:
    """Median rate over the cameras that see a Gaussian, px per world unit; the lowest of these for one that none sees.

    Without cameras all have one rate, by which the median Gaussian has a standard deviation of `ASSUMED_SIGMA`.
    """
    rates = median_rates(scene.means, cameras) if cameras else torch.zeros_like(scene.logit_opacities)
    known = rates[rates > 0]
    if len(known):
        return torch.where(rates > 0, rates, known.min())
    middle = scene.scales.median(dim=1).values
    return torch.full_like(rates, ASSUMED_SIGMA) / (middle.median() if len(scene) else 1.0)

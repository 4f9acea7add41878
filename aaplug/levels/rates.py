"""Training's sampling rate of each Gaussian."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.errors import FrameError
from aaplug.core.gaussians import Gaussians
from aaplug.core.sampling import median_rates


def rates_of(scene: Gaussians, cameras: Sequence[Camera]) -> Float[Tensor, " n"]:
    """Median rate over the cameras that see a Gaussian, px per world unit; the lowest of these for one that none sees.

    Raises:
        FrameError: no camera sees any.
    """
    rates = median_rates(scene.means, cameras)
    known = rates[rates > 0]
    if not len(known):
        raise FrameError(scene.name, f"none of its Gaussians is seen by any of the {len(cameras)} cameras")
    return torch.where(rates > 0, rates, known.min())

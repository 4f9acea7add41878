"""Mean of a Gaussian over an interval.

u: position along an axis; h: half the interval; both in standard deviations.
"""

import math

import torch
from torch import Tensor

# half widths below which a difference of two distributions loses digits, and its series does not
SMALL = {torch.float32: 0.1, torch.float64: 1e-3}


def mean_gaussian(u: Tensor, h: Tensor) -> Tensor:
    """Mean of exp(-x²/2) over u ± h.

    For small h its series is e^(-u²/2) (1 + h²(u² - 1)/6 + h⁴(u⁴ - 6u² + 3)/120).
    """
    small = SMALL[u.dtype]
    wide = h.clamp(min=small)
    ends = [((u + side * wide) * math.sqrt(0.5)).erf() for side in (1, -1)]
    mean = (ends[0] - ends[1]) * math.sqrt(math.pi / 8) / wide
    uu, hh = u * u, h * h
    series = 1 + hh * (uu - 1) / 6 + hh * hh * (uu * uu - 6 * uu + 3) / 120
    return torch.where(h < small, series * (-0.5 * uu).exp(), mean)

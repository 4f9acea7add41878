"""Mean of a Gaussian over an interval, exact and by Analytic-Splatting's logistic approximation.

u: position along an axis; h: half the interval; both in standard deviations.
"""

import math

import torch
from torch import Tensor
from torch.special import ndtr

# half widths below which a difference of two distributions loses digits, and its series does not
SMALL = {torch.float32: 0.1, torch.float64: 1e-3}
SMALL_LOGISTIC = {torch.float32: 0.01, torch.float64: 1e-4}
LOGISTIC = (1.6, 0.07)  # S(x) = 1/(1 + exp(-1.6 x - 0.07 x³)) (Analytic-Splatting, eq. 9)


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


def mean_logistic(u: Tensor, h: Tensor) -> Tensor:
    """The same with Analytic-Splatting's S for the normal distribution; for small h, S's derivative."""
    small = SMALL_LOGISTIC[u.dtype]
    wide = h.clamp(min=small)
    mean = (logistic(u + wide) - logistic(u - wide)) * math.sqrt(math.pi / 2) / wide
    s = logistic(u)
    slope = (LOGISTIC[0] + 3 * LOGISTIC[1] * u * u) * s * (1 - s)
    return torch.where(h < small, slope * math.sqrt(2 * math.pi), mean)


def logistic(x: Tensor) -> Tensor:
    """Analytic-Splatting's approximation of the normal distribution (its eq. 9); the error is at most 4e-4."""
    return (LOGISTIC[0] * x + LOGISTIC[1] * x**3).sigmoid()


def normal(x: Tensor) -> Tensor:
    """The standard normal distribution."""
    return ndtr(x)

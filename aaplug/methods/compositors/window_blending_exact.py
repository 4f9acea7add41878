"""The slow float64 twin of window blending: one splat at a time, with windows in px as vectors and matrices."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.special import ndtr

from aaplug.core.ellipses import principal_columns
from aaplug.core.rules import Rules
from aaplug.core.splats import Splats2D

NARROWEST = 1e-5  # px: a narrower window shows the value at a point, to ten digits
LEAST_VARIANCE = 1e-8  # of a window against the first one's: rounding never makes it vanish
FARTHEST_CENTRE = 0.499  # of a window from the first one's: some of it is always inside
FARTHEST = 6.0  # standard deviations from a window's edge, beyond which 2e-8 of a Gaussian is in it


def exact_strip(
    splats: Splats2D, centres: Float[Tensor, "p 2"], rules: Rules
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, " p"]]:
    """Premultiplied colour and transmittance of pixels; windows are vectors in px.  splats: sorted by depth."""
    assert splats.rgb is not None
    first = max(splats.window, NARROWEST)
    rgb, hidden_so_far = centres.new_zeros(len(centres), 3), centres.new_zeros(len(centres))
    mass = torch.ones_like(hidden_so_far)
    middle, sides = torch.zeros_like(centres), torch.full_like(centres, first)
    for i, forms in enumerate(_turned(splats)):
        lengths = forms.norm(dim=1)
        axes = forms / lengths[:, None]
        u = (centres + middle - splats.means[i]) @ forms.T
        half = 0.5 * sides * lengths
        value, mean, square = _moments(u, half)
        alpha = (splats.opacities[i] * value.prod(dim=1)).clamp(max=rules.max_alpha)
        alpha = torch.where(alpha >= rules.min_alpha, alpha, 0.0)
        left = mass * (1 - alpha)
        going = left >= rules.min_transmittance
        weight = torch.where(going, mass * alpha, 0.0)
        rgb, hidden_so_far = rgb + weight[:, None] * splats.rgb[i], hidden_so_far + weight
        mass = torch.where(going, left, 0.0)
        hidden = (mean / lengths) @ axes
        hidden_square = (square / lengths**2) @ axes**2 + hidden**2
        share = (alpha / (1 - alpha))[:, None]
        moved = -share * hidden
        variance = sides**2 / 12 + share * (sides**2 / 12 - hidden_square) - moved**2
        moved = (middle + moved).clamp(-FARTHEST_CENTRE * first, FARTHEST_CENTRE * first)
        new = (12 * variance.clamp(min=LEAST_VARIANCE * first**2)).sqrt()
        new = torch.minimum(new, first - 2 * moved.abs())
        grow = (left * first**2 / new.prod(dim=1)).clamp(min=1.0).sqrt()
        new = (new * grow[:, None]).clamp(max=first)
        room = (first - new) / 2
        hides = (alpha > 0)[:, None]
        middle = torch.where(hides, torch.maximum(torch.minimum(moved, room), -room), middle)
        sides = torch.where(hides, new, sides)
    return rgb, 1 - hidden_so_far


def _turned(splats: Splats2D) -> Float[Tensor, "m 2 2"]:
    """The whitening along each splat's own axes, the one nearer to x first."""
    rows = torch.stack(principal_columns(splats.covs, splats.dets), dim=1).unflatten(1, (2, 2))
    nearness = rows[..., 0].abs() / rows.norm(dim=2)
    return torch.where((nearness[:, 0] < nearness[:, 1])[:, None, None], rows.flip(1), rows)


def _moments(
    u: Float[Tensor, "p 2"], half: Float[Tensor, "p 2"]
) -> tuple[Float[Tensor, "p 2"], Float[Tensor, "p 2"], Float[Tensor, "p 2"]]:
    """Mean value of exp(−x²/2) on u ± half; mean from u, and variance, of x weighted by it."""
    near = u.abs() - half < FARTHEST
    u = torch.where(near, u, 0.0)  # gradients of 0 / 0 would be felt even where nothing is taken
    ends = (u - half, u + half)
    low, high = ((-0.5 * end * end).exp() for end in ends)
    total = math.sqrt(2 * math.pi) * (ndtr(ends[1]) - ndtr(ends[0]))
    mean = (low - high) / total
    variance = 1 + (ends[0] * low - ends[1] * high) / total - mean**2
    return near * total / (2 * half), mean - u, variance.clamp(min=0.0)

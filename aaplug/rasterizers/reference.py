"""The judge: every splat at every pixel, in float64, in the order and with the stopping rule of 3DGS.

h, w: the image; p: pixels of a strip; c: splats of a chunk.  No tiles, no extents, no cleverness: memory is bounded
by strips and chunks alone.  Differentiable through autograd.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor
from torch.special import ndtr

from aaplug.interfaces import PixelKernel
from aaplug.kernels import EAGER, Kernels
from aaplug.rasterizers import surfels
from aaplug.rasterizers.blending import FARTHEST, FARTHEST_CENTRE, LEAST_VARIANCE
from aaplug.rasterizers.extents import SURFELS
from aaplug.rasterizers.pixels import CELLS, logistic
from aaplug.rasterizers.rules import MAX_ALPHA, MIN_TRANSMITTANCE, over
from aaplug.rasterizers.surfels import DISC_VARIANCE, LEAST_FACTOR, LOW_PASS
from aaplug.splats import MIN_ALPHA, Render, Splats2D, principal_columns, whitening

STRIP_PIXELS = 4096
CHUNK_SPLATS = 512
NARROWEST = 1e-5  # px: a window as narrow as this shows the value at a point, to ten digits


@dataclass(frozen=True)
class Reference:
    """`rasterize`, as a rasterizer."""

    kernels: Kernels = EAGER

    def __call__(
        self,
        splats: Splats2D,
        hw: tuple[int, int],
        background: tuple[float, float, float],
        pixel: PixelKernel = "point",
    ) -> Render:
        """Draw the splats in float64."""
        return rasterize(splats, hw, background, pixel)


def rasterize(
    splats: Splats2D,
    hw: tuple[int, int],
    background: tuple[float, float, float],
    pixel: PixelKernel = "point",
) -> Render:
    """Draw the splats in float64; the image comes back in float64."""
    splats = splats.to(torch.float64)
    splats = splats[torch.sort(splats.depths, stable=True).indices]
    centres = _pixel_centres(hw).to(splats.means.device)
    draw = _blended_strip if pixel == "blending" else partial(_strip, pixel=pixel)
    strips = [draw(splats, strip) for strip in centres.split(STRIP_PIXELS)]
    rgb = torch.cat([rgb for rgb, _ in strips]).reshape(*hw, 3)
    transmittance = torch.cat([t for _, t in strips]).reshape(hw)
    return over(rgb, 1 - transmittance, background)


def _pixel_centres(hw: tuple[int, int]) -> Float[Tensor, "p 2"]:
    y, x = (torch.arange(side, dtype=torch.float64) + 0.5 for side in hw)
    return torch.cartesian_prod(y, x).flip(1)


def _strip(
    splats: Splats2D, centres: Float[Tensor, "p 2"], pixel: PixelKernel
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, " p"]]:
    rgb = centres.new_zeros(len(centres), 3)
    transmittance = centres.new_ones(len(centres))
    going = torch.ones_like(transmittance, dtype=torch.bool)
    for start in range(0, len(splats), CHUNK_SPLATS):
        chunk = splats[start : start + CHUNK_SPLATS]
        alpha = alphas(chunk, centres, pixel)
        after = transmittance[:, None] * (1 - alpha).cumprod(dim=1)
        before = torch.cat([transmittance[:, None], after[:, :-1]], dim=1)
        kept = (after >= MIN_TRANSMITTANCE) & going[
            :, None
        ]  # `after` only falls: the first miss ends the pixel
        assert chunk.rgb is not None
        rgb = rgb + (torch.where(kept, alpha * before, 0.0)) @ chunk.rgb
        transmittance = torch.minimum(transmittance, torch.where(kept, after, 1.0).amin(dim=1))
        going = going & kept[:, -1]
    return rgb, transmittance


def alphas(
    splats: Splats2D, centres: Float[Tensor, "p 2"], pixel: PixelKernel = "point"
) -> Float[Tensor, "p c"]:
    """Alpha of each splat at each pixel: min(0.99, o·g), 0 below 1/255 (3DGS, eq. 4).

    g: exp(−dᵀ C⁻¹ d / 2) at the centre, or its mean over the pixel (Analytic-Splatting, eq. 11).
    """
    offsets = centres[:, None] - splats.means
    if pixel == "point":
        white = torch.einsum("cij,pcj->pci", whitening(splats), offsets)
        values = torch.exp(-0.5 * white.square().sum(dim=2))
    elif pixel in SURFELS:
        values = _on_discs(splats, offsets, smoothed=pixel == "surfel-mip")
    elif pixel == "square":
        values = _over_squares(splats, offsets)
    else:
        values = _over_pixels(splats, offsets, logistic if pixel == "logistic" else ndtr)
    alpha = (splats.opacities * values).clamp(max=MAX_ALPHA)
    return torch.where(alpha >= MIN_ALPHA, alpha, 0.0)


def _over_pixels(
    splats: Splats2D, offsets: Float[Tensor, "p c 2"], distribution: Callable[[Tensor], Tensor]
) -> Float[Tensor, "p c"]:
    """2π σ₁ σ₂ times the probabilities of a pixel's width along each axis."""
    values = torch.ones_like(offsets[..., 0])
    rows = principal_columns(splats.covs, splats.dets)
    for x, y in (rows[:2], rows[2:]):
        per_px = max(splats.window, NARROWEST) * torch.hypot(
            x, y
        )  # standard deviations in the window
        u = x * offsets[..., 0] + y * offsets[..., 1]
        probability = distribution(u + per_px / 2) - distribution(u - per_px / 2)
        values = values * probability * math.sqrt(2 * math.pi) / per_px
    return values


def _on_discs(
    splats: Splats2D, offsets: Float[Tensor, "p c 2"], smoothed: bool
) -> Float[Tensor, "p c"]:
    """2DGS's intersection of homogeneous planes (its eqs. 8 to 10), and AA-2DGS's filter as its paper expands it.

    T_u, T_v, T_w: the disc's coordinates to the screen's, from any root of its covariance there and from its tilt.
    """
    assert splats.tilts is not None
    xx, xy, _ = splats.covs.unbind(dim=1)
    a = xx.sqrt()
    zero, one = torch.zeros_like(a), torch.ones_like(a)
    root = torch.stack([a, zero, xy / a, (splats.dets / xx).sqrt()], dim=1).unflatten(1, (2, 2))
    tilt = torch.einsum("cij,ci->cj", root, splats.tilts)
    t_u, t_v = (torch.cat([root[:, i], zero[:, None]], dim=1) for i in (0, 1))
    t_w = torch.cat([tilt, one[:, None]], dim=1)
    x, y = offsets[..., :1], offsets[..., 1:]
    by_row, by_column = x * t_w - t_u, y * t_w - t_v
    p = torch.linalg.cross(by_row, by_column)
    in_front = p[..., 2] > 1e-12
    depth = torch.where(in_front, p[..., 2], 1.0)
    s, t = p[..., 0] / depth, p[..., 1] / depth
    if not smoothed:
        low_pass = (
            LOW_PASS * offsets.square().sum(dim=2) / max(splats.window, surfels.NARROWEST) ** 2
        )
        values = torch.exp(-0.5 * torch.minimum(s * s + t * t, low_pass))
        return torch.where(in_front, values, torch.exp(-0.5 * low_pass))
    by_x = torch.linalg.cross(t_w.expand_as(by_column), by_column)
    by_y = torch.linalg.cross(by_row, t_w.expand_as(by_row))
    columns = []
    for change in (by_x, by_y):
        columns += [
            (change[..., i] * depth - p[..., i] * change[..., 2]) / depth**2 for i in (0, 1)
        ]
    a, b, c, d = columns
    kappa = DISC_VARIANCE
    area, size = a * d - b * c, a * a + b * b + c * c + d * d
    det = kappa**2 * area**2 + kappa * size + 1
    rho = (s * s + t * t + kappa * ((d * s - c * t) ** 2 + (a * t - b * s) ** 2)) / det
    values = (1 / det + LEAST_FACTOR).sqrt() * torch.exp(-0.5 * rho)
    return torch.where(in_front, values, 0.0)


def _over_squares(splats: Splats2D, offsets: Float[Tensor, "p c 2"]) -> Float[Tensor, "p c"]:
    """Means over the pixels' squares: a marginal of the Gaussian in strips, and what is across given each's middle."""
    side = max(splats.window, NARROWEST)
    xx, xy, yy = splats.covs.unbind(dim=1)
    wide = xx >= yy
    long = torch.where(wide, xx, yy)
    along, across = (torch.where(wide, offsets[..., i], offsets[..., 1 - i]) for i in (0, 1))
    values = torch.zeros_like(along)
    for cell in range(CELLS):
        middle = along + side * ((cell + 0.5) / CELLS - 0.5)
        given = across - xy / long * middle
        values = values + _mean(middle, long.sqrt(), side / CELLS) * _mean(
            given, (splats.dets / long).sqrt(), side
        )
    return values / CELLS


def _mean(
    at: Float[Tensor, "p c"], sigma: Float[Tensor, " c"], side: float
) -> Float[Tensor, "p c"]:
    """Mean of exp(−x²/2σ²) over at ± side/2."""
    probability = ndtr((at + side / 2) / sigma) - ndtr((at - side / 2) / sigma)
    return probability * sigma * math.sqrt(2 * math.pi) / side


def _blended_strip(
    splats: Splats2D, centres: Float[Tensor, "p 2"]
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, " p"]]:
    """The rule of `blending`, a splat at a time, with windows in px as vectors and matrices."""
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
        alpha = (splats.opacities[i] * value.prod(dim=1)).clamp(max=MAX_ALPHA)
        alpha = torch.where(alpha >= MIN_ALPHA, alpha, 0.0)
        left = mass * (1 - alpha)
        going = left >= MIN_TRANSMITTANCE
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

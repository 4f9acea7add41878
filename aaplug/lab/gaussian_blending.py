"""Gaussian Blending (arXiv 2511.15102): light passes a pixel through a window that moves and shrinks behind each splat.

The update is that of the published method.  Light T is spread evenly over a window of centre c and sides w, h.  At
first the window is the square that alpha is averaged over, `Splats2D.window` wide.

1. Turned to the splat's axes, the side nearest to each of them along it, the window has the mean alpha
   p = min(max_alpha, o · mean of g), and what is hidden has a mean d and a mean square s along each axis.
2. The splat takes p T.  The light that is left has the mean -p d / (1 - p) about the window's centre, and the mean
   square (l²/12 - p s) / (1 - p) along a side l.
3. The next window has this mean and this variance, which is at least `MIN_WINDOW_VARIANCE`.  Its sides belong to the
   image axes again: the variance is not turned back, and neither the pixel nor T bounds the window.
4. Where the window spans less than `MAX_POINT_SPAN` standard deviations of the splat along an axis, alpha is the value
   at the window's centre, and the window stays.
5. A pixel stops behind the splat that brings T below `min_transmittance`; 3DGS stops before it.

The cut-off is that of the rules, 1/255 in 3DGS; the published one is 1/256.

A window may leave its pixel and reach splats that its tile does not draw, because their cut-off ellipses, grown by
half a pixel's diagonal, end before.  On the chair at 1/16 this changes 1 % of the pixels; the root mean square of all
is 7e-5.

t: tiles; P: pixels per tile; m: splats; p: pixels, or entries of `order`.  u, v: position along a splat's axes, and
h: half a window, in the splat's standard deviations.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.special import ndtr

from aaplug.core.interfaces import Limits
from aaplug.core.kernels import Kernel, Kernels
from aaplug.core.rules import RULES_3DGS, Rules
from aaplug.core.splats import Splats2D
from aaplug.lab.integral import principal_columns
from aaplug.methods.pixel_kernels.raster_rows import COLUMNS, PIXELS, next_rows, rows_of
from aaplug.rasterizers.tiled.forward import EXAMPLE_TILES, MIN_TILES

MIN_WINDOW_VARIANCE = 1e-3  # px²: of a window along one side
MAX_POINT_SPAN = 0.1  # standard deviations: a window that spans less is taken as a point
MAX_SERIES_HALF = 0.3  # standard deviations: half windows below which a series keeps more digits than a difference
MAX_DISTANCE = 4.0  # standard deviations from a window's edge, beyond which the mean is below every cut-off
SPLATS_PER_PASS = 4  # more compile slowly
GATHERED = 2 * SPLATS_PER_PASS  # raster rows that a tile gathers at once
COMPACT_BELOW = 7 / 8  # tiles that are done are dropped once the share of the others is below this


class Light(NamedTuple):
    """The light that passes each pixel: its share, its window's centre from the pixel's and sides in px; the colour."""

    share: Tensor
    x: Tensor
    y: Tensor
    width: Tensor
    height: Tensor
    red: Tensor
    green: Tensor
    blue: Tensor


def light_of(pixels: Tensor, window: float) -> Light:
    """Nothing is hidden yet."""
    none, side = torch.zeros_like(pixels), torch.full_like(pixels, window)
    return Light(torch.ones_like(pixels), none, none, side, side, none, none, none)


class Moments(NamedTuple):
    """Of exp(−x²/2) on a window, per axis: mean value; mean and mean square about the window's centre; value there."""

    value: Tensor
    mean: Tensor
    square: Tensor
    centre: Tensor


def moments(u: Tensor, h: Tensor) -> Moments:
    """Moments on u ± h, series in h below `MAX_SERIES_HALF`.  Out of the Gaussian's reach the values are 0."""
    reached = u.abs() - h < MAX_DISTANCE
    u = torch.where(reached, u, 0.0)  # keeps 0 / 0 out, in gradients too
    uu, hh = u * u, h * h
    wide = h.clamp(min=MAX_SERIES_HALF)
    low, high = u - wide, u + wide
    at_low, at_high = (-0.5 * low * low).exp(), (-0.5 * high * high).exp()
    mass = math.sqrt(math.pi / 2) * ((high * math.sqrt(0.5)).erf() - (low * math.sqrt(0.5)).erf())
    mean = (at_low - at_high) / mass - u
    square = 1 - wide * (at_low + at_high) / mass - u * mean
    centre = (-0.5 * uu).exp()
    second, fourth = uu - 1, uu * uu - 6 * uu + 3  # Hermite polynomials: derivatives of the Gaussian, over its value
    value = 1 + hh * (second / 6 + hh * fourth / 120)
    narrow = h < MAX_SERIES_HALF
    return Moments(
        torch.where(narrow, value * centre, mass / (2 * wide)) * reached,
        torch.where(narrow, -u * hh * (1 / 3 + hh * (uu - 3) / 30) / value, mean),
        torch.where(narrow, hh * (1 / 3 + hh * (second / 10 + hh * fourth / 168)) / value, square),
        centre * reached,
    )


def behind(light: Light, row: Float[Tensor, "t 14"], x: Tensor, y: Tensor, limits: Limits) -> Light:
    """The light behind one splat of each tile.  x, y: of the pixels' centres, in px."""
    ux, uy, vx, vy, mean_x, mean_y, opacity, red, green, blue, *more = (c[:, None] for c in row.unbind(1))
    dx, dy = x - mean_x + light.x, y - mean_y + light.y
    half_u, half_v = more[0] * light.width, more[1] * light.height
    along_u, along_v = moments(ux * dx + uy * dy, half_u), moments(vx * dx + vy * dy, half_v)
    plain = (half_u < 0.5 * MAX_POINT_SPAN) | (half_v < 0.5 * MAX_POINT_SPAN)
    value = torch.where(plain, along_u.centre * along_v.centre, along_u.value * along_v.value)
    capped = opacity * value
    alpha = torch.where(capped < limits.max_alpha, capped, limits.max_alpha)
    hides = (alpha > limits.below_min_alpha) & (light.share > limits.below_min_transmittance)
    weight = torch.where(hides, alpha * light.share, 0.0)
    moves = hides & ~plain
    by_u, width = _rest(along_u, half_u, more[2], alpha)
    by_v, height = _rest(along_v, half_v, more[3], alpha)
    return Light(
        light.share - weight,
        torch.where(moves, light.x + by_u * ux + by_v * vx, light.x),
        torch.where(moves, light.y + by_u * uy + by_v * vy, light.y),
        torch.where(moves, width, light.width),
        torch.where(moves, height, light.height),
        light.red + weight * red,
        light.green + weight * green,
        light.blue + weight * blue,
    )


def _rest(along: Moments, half: Tensor, variance: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Of the light that is left, along one axis: its mean, to be multiplied by the form (ux, uy), and its side in px.

    variance: of the splat along the axis, in px².
    """
    hides = alpha / (1 - alpha)
    mean = hides * along.mean
    uniform = half * half * (1 / 3)
    rest = uniform + hides * (uniform - along.square) - mean * mean
    return -mean * variance, (12 * (rest * variance).clamp(min=MIN_WINDOW_VARIANCE)).sqrt()


@dataclass(frozen=True)
class GaussianBlending:
    """Front-to-back compositing through a window per pixel, by the published update."""

    name: str = "gaussian-blending"

    def kernels(self) -> tuple[Kernel, ...]:
        """A pass."""
        return (PASS,)

    def rows(self, splats: Splats2D) -> Float[Tensor, "m_and_1 14"]:
        """Principal axes, that which runs nearer to x first; half a pixel along them; their variances in px²."""
        ux, uy, vx, vy = principal_columns(splats.covs, splats.dets)
        per_u, per_v = torch.hypot(ux, uy), torch.hypot(vx, vy)
        swap = ux.abs() * per_v < vx.abs() * per_u
        pairs = ((ux, vx), (uy, vy), (vx, ux), (vy, uy), (per_u, per_v), (per_v, per_u))
        *forms, per_u, per_v = (torch.where(swap, b, a) for a, b in pairs)
        return rows_of(splats, forms, [0.5 * per_u, 0.5 * per_v, per_u**-2, per_v**-2])

    def tiles(
        self,
        rows: Float[Tensor, "m_and_1 14"],
        window: float,
        order: Int[Tensor, " p"],
        first: Int[Tensor, " t"],
        counts: Int[Tensor, " t"],
        centres: tuple[Float[Tensor, "t P"], Float[Tensor, "t P"]],
        kernels: Kernels,
        rules: Rules,
    ) -> Float[Tensor, "4 t P"]:
        """Premultiplied colour and alpha; `SPLATS_PER_PASS` splats per tile and pass."""
        x, y = centres
        image = x.new_zeros(4, *x.shape)
        tiles, light = torch.arange(len(counts), device=x.device), light_of(x, window)
        at, ends, limits = first, first + counts, x.new_tensor(Limits.by(rules))
        while len(tiles):
            for nearest in next_rows(rows, order, at, ends, GATHERED).split(SPLATS_PER_PASS, dim=1):
                light = Light(*kernels.run(PASS, nearest, x, y, *light, limits))
            at = torch.minimum(at + GATHERED, ends)
            alive = (at < ends) & (light.share.amax(dim=1) >= rules.min_transmittance)
            count = int(alive.sum())
            if count >= COMPACT_BELOW * len(tiles):
                continue
            if count == 0 or len(tiles) > MIN_TILES:
                image.index_copy_(1, tiles, torch.stack([light.red, light.green, light.blue, 1 - light.share]))
                alive[:MIN_TILES] |= 0 < count < MIN_TILES
                left = alive.nonzero().squeeze(1)
                tiles, at, ends, x, y, *light = (c.index_select(0, left) for c in (tiles, at, ends, x, y, *light))
                light = Light(*light)
        return image

    def exact(
        self, splats: Splats2D, centres: Float[Tensor, "p 2"], rules: Rules
    ) -> tuple[Float[Tensor, "p 3"], Float[Tensor, " p"]]:
        """Premultiplied colour and transmittance, by the same rule with vectors and matrices, one splat at a time."""
        assert splats.rgb is not None
        rgb, passed = centres.new_zeros(len(centres), 3), centres.new_ones(len(centres))
        middles, sides = centres, torch.full_like(centres, splats.window)
        forms = torch.stack(principal_columns(splats.covs, splats.dets), dim=1).unflatten(1, (2, 2))
        nearness = forms[..., 0].abs() / forms.norm(dim=2)
        forms = torch.where((nearness[:, 0] < nearness[:, 1])[:, None, None], forms.flip(1), forms)
        for i, whitening in enumerate(forms):
            per_px = whitening.norm(dim=1)
            u, spans = (middles - splats.means[i]) @ whitening.T, sides * per_px
            plain = (spans < MAX_POINT_SPAN).any(dim=1)
            value, mean, square = _exact_moments(u, torch.where(plain[:, None], MAX_POINT_SPAN, spans) / 2)
            value = torch.where(plain, (-0.5 * u.square().sum(dim=1)).exp(), value.prod(dim=1))
            alpha = (splats.opacities[i] * value).clamp(max=rules.max_alpha)
            alpha = torch.where((alpha >= rules.min_alpha) & (passed >= rules.min_transmittance), alpha, 0.0)
            rgb = rgb + (passed * alpha)[:, None] * splats.rgb[i]
            passed = passed * (1 - alpha)
            moves, share = ((alpha > 0) & ~plain)[:, None], alpha[:, None]
            left = -share * mean / (1 - share)
            variance = (spans.square() / 12 - share * square) / (1 - share) - left.square()
            middles = torch.where(moves, middles + (left / per_px**2) @ whitening, middles)
            sides = torch.where(moves, (12 * (variance / per_px**2).clamp(min=MIN_WINDOW_VARIANCE)).sqrt(), sides)
        return rgb, passed


def _exact_moments(
    u: Float[Tensor, "p 2"], half: Float[Tensor, "p 2"]
) -> tuple[Float[Tensor, "p 2"], Float[Tensor, "p 2"], Float[Tensor, "p 2"]]:
    """Mean value of exp(−x²/2) on u ± half; mean and mean square about u, by the moments of a truncated normal."""
    near = u.abs() - half < MAX_DISTANCE
    u = torch.where(near, u, 0.0)
    ends = (u - half, u + half)
    low, high = ((-0.5 * end * end).exp() for end in ends)
    total = math.sqrt(2 * math.pi) * (ndtr(ends[1]) - ndtr(ends[0]))
    mean = (low - high) / total
    variance = 1 + (ends[0] * low - ends[1] * high) / total - mean**2
    return near * total / (2 * half), mean - u, variance + (mean - u) ** 2


def _pass(
    nearest: Float[Tensor, "t K 14"], x: Float[Tensor, "t P"], y: Float[Tensor, "t P"], *light_and_limits: Tensor
) -> tuple[Float[Tensor, "t P"], ...]:
    """The light behind the next splats of each tile."""
    *light, values = light_and_limits
    here, limits = Light(*light), Limits.of(values)
    for row in nearest.unbind(1):
        here = behind(here, row, x, y, limits)
    return tuple(here)


def _pass_example() -> tuple[Tensor, ...]:
    rows = torch.linspace(0.1, 1.0, EXAMPLE_TILES * SPLATS_PER_PASS * (COLUMNS + 4))
    x = torch.linspace(0.0, 1.0, EXAMPLE_TILES * PIXELS).view(EXAMPLE_TILES, PIXELS)
    light = [c.clone() for c in light_of(x, 1.0)]
    return rows.view(EXAMPLE_TILES, SPLATS_PER_PASS, -1), x, x.flip(0), *light, torch.tensor(Limits.by(RULES_3DGS))


SIZES = (*11 * ("t",), None)
PASS = Kernel("gaussian-blending", _pass, _pass_example, SIZES, chained=True, evaluations=SPLATS_PER_PASS)
GAUSSIAN_BLENDING = GaussianBlending()

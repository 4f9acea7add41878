"""Window blending: transmittance kept as a window inside the pixel, so that splats side by side leak no light.

Gaussian Blending (arXiv 2511.15102) keeps a level on a rectangle inside the pixel instead of one transmittance, and
takes from it what each splat hides there.  This update of the rectangle is aaplug's own:

1. Light passes the pixel on a window of sides l and centre c with transmittance T(x) = level, and nowhere else.  At
   first the window is the square that alpha is averaged over, `Splats2D.window` wide, and the level is 1.
2. A splat hides p = mean of min(max_alpha, o g(x)) over the window, taken as min(max_alpha, o · mean of g).  On the
   window turned to the splat's axes (by at most 45°, as Analytic-Splatting turns its pixel) g factors, and so do the
   moments of what it hides: mass p, mean d and variance s about the window's centre.
3. The remaining light T (1 - o g) has the mass M' = M (1 - p), and about the window's centre the mean -p d / (1 - p)
and
   the second moments (l²/12 - p (s + d²)) / (1 - p).
4. The next window is the rectangle along the pixel's axes with that mean and variance, cut symmetrically where it
leaves
   the first one, and no smaller than M' (a level is at most 1).  Its level follows from M'.  Keeping the mean rather
   than the size is worth 2 dB at 1/8.

With a first window of no size this is 3DGS's rule.  Steps run in float64, because the variance of the remaining light
is a small difference.

u, v: position along a splat's axes; h: half a window; both in the splat's standard deviations.
"""

import math
from dataclasses import dataclass
from functools import cache, partial
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.special import ndtr

from aaplug.core.ellipses import principal_columns
from aaplug.core.kernels import Kernel, Kernels
from aaplug.core.rules import RULES_3DGS, Rules
from aaplug.core.splats import Splats2D
from aaplug.methods.pixel_kernels.averages import SMALL
from aaplug.methods.pixel_kernels.integral import NARROWEST

LEAST_VARIANCE = 1e-8  # of a window against the first one's: rounding never makes it vanish
FARTHEST_CENTRE = 0.499  # of a window from the first one's: some of it is always inside
FARTHEST = 6.0  # standard deviations from a window's edge, beyond which 2e-8 of a Gaussian is in it
THINNEST = 1e-6  # standard deviations: of half the first window, which is divided by
CHECK_EVERY = 16  # turns between looks at whether every pixel is done


class Window(NamedTuple):
    """Where light passes: its mass, and the window's centre and sides in units of the first window."""

    mass: Tensor
    x: Tensor
    y: Tensor
    width: Tensor
    height: Tensor

    @staticmethod
    def whole(like: Tensor) -> "Window":
        """Nothing is hidden yet."""
        none, one = torch.zeros_like(like), torch.ones_like(like)
        return Window(one, none, none, one, one)


class Axes(NamedTuple):
    """A splat's whitening forms, the one that runs nearer to x first, and half the first window along them."""

    ux: Tensor
    uy: Tensor
    vx: Tensor
    vy: Tensor
    half_u: Tensor
    half_v: Tensor


def axes_of(splats: Splats2D) -> Axes:
    """The axes of each splat, in its standard deviations a px."""
    ux, uy, vx, vy = principal_columns(splats.covs, splats.dets)
    swap = ux.abs() * torch.hypot(vx, vy) < vx.abs() * torch.hypot(ux, uy)
    ux, vx = torch.where(swap, vx, ux), torch.where(swap, ux, vx)
    uy, vy = torch.where(swap, vy, uy), torch.where(swap, uy, vy)
    halves = [0.5 * splats.window * torch.hypot(x, y) for x, y in ((ux, uy), (vx, vy))]
    return Axes(ux, uy, vx, vy, *(half.clamp(min=THINNEST) for half in halves))


def through(
    window: Window, axes: Axes, opacity: Tensor, offset: tuple[Tensor, Tensor], side: float | Tensor, rules: Rules
) -> tuple[Tensor, Window]:
    """What a splat hides of the light that passes a pixel, and the window after it.

    All broadcast together.  offset: of the pixel's centre from the splat's, in px.  side: of the first window, in px.
    """
    dx, dy = offset[0] + side * window.x, offset[1] + side * window.y
    u, v = axes.ux * dx + axes.uy * dy, axes.vx * dx + axes.vy * dy
    along_u = moments(u, axes.half_u * window.width)
    along_v = moments(v, axes.half_v * window.height)
    alpha = (opacity * along_u[0] * along_v[0]).clamp(max=rules.max_alpha)
    alpha = torch.where(alpha >= rules.min_alpha, alpha, 0.0)
    left = window.mass * (1 - alpha)
    going = left >= rules.min_transmittance
    hidden = torch.where(going, window.mass - left, 0.0)
    after = _rest(window, axes, along_u, along_v, alpha)
    after = [torch.where(alpha > 0, new, old) for new, old in zip(after, window[1:], strict=True)]
    return hidden, Window(torch.where(going, left, 0.0), *after)


def moments(u: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Moments of exp(−x²/2) on u ± h: its mean value; then the mean, from u, and the variance of x weighted by it.

    For small h these are series in h.  A window out of the Gaussian's reach holds nothing of it.
    """
    reached = u.abs() - h < FARTHEST
    u = torch.where(reached, u, 0.0)  # keeps 0 / 0 out, in gradients too
    small = SMALL[u.dtype]
    wide = h.clamp(min=small)
    low, high = u - wide, u + wide
    at_low, at_high = (-0.5 * low * low).exp(), (-0.5 * high * high).exp()
    root = math.sqrt(0.5)
    mass = math.sqrt(math.pi / 2) * ((high * root).erf() - (low * root).erf())
    centre = (at_low - at_high) / mass
    variance = 1 + (low * at_low - high * at_high) / mass - centre * centre
    uu, hh = u * u, h * h
    values = (1 + hh * (uu - 1) / 6) * (-0.5 * uu).exp()
    near = h < small
    return (
        torch.where(near, values, mass / (2 * wide)) * reached,
        torch.where(near, -u * hh / 3, centre - u),
        torch.where(near, hh / 3 * (1 - hh * 2 / 15 * (1 + uu * 1.5)), variance.clamp(min=0.0)),
    )


def _rest(
    window: Window,
    axes: Axes,
    along_u: tuple[Tensor, Tensor, Tensor],
    along_v: tuple[Tensor, Tensor, Tensor],
    alpha: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Centre and sides of the window that is left, in units of the first one."""
    cos, sin = _unit(axes.ux, axes.uy)
    across, up = _unit(axes.vx, axes.vy)
    mean_u, mean_v = along_u[1] / (2 * axes.half_u), along_v[1] / (2 * axes.half_v)
    square_u = along_u[2] / (2 * axes.half_u) ** 2
    square_v = along_v[2] / (2 * axes.half_v) ** 2
    sides = []
    for i, j, centre, side in ((cos, across, window.x, window.width), (sin, up, window.y, window.height)):
        hidden_mean = i * mean_u + j * mean_v
        hidden_square = i * i * square_u + j * j * square_v + hidden_mean * hidden_mean
        mean = -alpha * hidden_mean / (1 - alpha)
        square = (side * side / 12 - alpha * hidden_square) / (1 - alpha)
        variance = (square - mean * mean).clamp(min=LEAST_VARIANCE)
        moved = (centre + mean).clamp(-FARTHEST_CENTRE, FARTHEST_CENTRE)
        sides.append((moved, torch.minimum((12 * variance).sqrt(), 1 - 2 * moved.abs())))
    (x, width), (y, height) = sides
    grown = (window.mass * (1 - alpha) / (width * height)).clamp(min=1.0).sqrt()
    width, height = (width * grown).clamp(max=1.0), (height * grown).clamp(max=1.0)
    return _held(x, width), _held(y, height), width, height


def _held(centre: Tensor, side: Tensor) -> Tensor:
    """The centre that keeps a window inside the first one."""
    room = (1 - side) / 2
    return torch.minimum(torch.maximum(centre, -room), room)


def _unit(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    length = torch.hypot(x, y)
    return x / length, y / length


@dataclass(frozen=True)
class WindowBlending:
    """Front-to-back compositing that keeps a window of light per pixel."""

    name: str = "window-blending"

    def rows(self, splats: Splats2D) -> Float[Tensor, "m 12"]:
        """Axes, opacity, centre and colour of each splat, in float64."""
        exact = splats.to(torch.float64)
        assert exact.rgb is not None
        columns = [*axes_of(exact), exact.opacities, *exact.means.unbind(1), *exact.rgb.unbind(1)]
        return torch.stack(columns, dim=1)

    def tiles(
        self,
        rows: Float[Tensor, "m 12"],
        window: float,
        order: Int[Tensor, " p"],
        first: Int[Tensor, " t"],
        counts: Int[Tensor, " t"],
        centres: tuple[Float[Tensor, "t P"], Float[Tensor, "t P"]],
        kernels: Kernels,
        rules: Rules,
    ) -> Float[Tensor, "4 t P"]:
        """Premultiplied colour and alpha; one splat per tile and turn."""
        x, y = centres
        light, side = Window.whole(x), x.new_tensor(window)
        image = x.new_zeros(4, *x.shape)
        for turn in range(int(counts.max())):
            if turn % CHECK_EVERY == 0 and not light.mass.any():
                break
            present = (turn < counts).to(rows)
            drawn = rows[order[(first + turn).clamp(max=len(order) - 1)].long()]
            *shape, red, green, blue = (column[:, None] for column in drawn.unbind(1))
            args = (present[:, None], x, y, side, *shape, *light)
            hidden, *left = kernels.run(turn_kernel(rules), *args)
            light = Window(*left)
            image = image + hidden * torch.stack([red, green, blue, torch.ones_like(red)])
        return image

    def exact(
        self, splats: Splats2D, centres: Float[Tensor, "p 2"], rules: Rules
    ) -> tuple[Float[Tensor, "p 3"], Float[Tensor, " p"]]:
        """The same rule with vectors and matrices, one splat at a time."""
        return exact_strip(splats, centres, rules)


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


def _turn(
    rules: Rules,
    present: Float[Tensor, "t 1"],
    x: Float[Tensor, "t P"],
    y: Float[Tensor, "t P"],
    side: Float[Tensor, ""],
    *rest: Tensor,
) -> tuple[Tensor, ...]:
    """What the next splat of each tile hides at its pixels, and the windows after it.

    present: 0 where a tile has no more splats.  rest: the splat's axes, opacity and centre, then the windows.
    """
    axes, (opacity, mean_x, mean_y), window = rest[:6], rest[6:9], Window(*rest[9:])
    offset = x - mean_x, y - mean_y
    hidden, window = through(window, Axes(*axes), opacity * present, offset, side, rules)
    return hidden, *window


def _turn_example() -> tuple[Tensor, ...]:
    x, column = torch.full((64, 64), 0.5, dtype=torch.float64), torch.ones(64, 1).double()
    return column, x, x, torch.ones(()).double(), *[0.5 * column] * 9, *Window.whole(x)


@cache
def turn_kernel(rules: Rules = RULES_3DGS) -> Kernel:
    """One turn by the given rules."""
    sizes = ("t", "t", "t", None, *14 * ("t",))
    name, function = f"window-blending{rules.tag}", partial(_turn, rules)
    return Kernel(name, function, _turn_example, sizes, evaluations=1)

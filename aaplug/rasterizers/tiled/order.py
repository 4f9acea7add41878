"""The order of splats along a ray: a compositor that finds the first, the middle and the heaviest one.

t: tiles; P: pixels per tile; m: raster rows; p: pixels, or entries of `order`.
w_i = alpha_i T_i: weight of the i-th splat of a pixel, in front of which the transmittance is T_i.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from aaplug.core.interfaces import Limits, PixelKernel, Pixels, ReadsRays
from aaplug.core.kernels import EAGER, Kernel, Kernels
from aaplug.core.rules import RULES_3DGS, Rules
from aaplug.core.splats import Splats2D
from aaplug.methods.pixel_kernels.raster_rows import GREEN, RED, next_rows, tile_centres
from aaplug.rasterizers.tiled import forward

HALF = 0.5  # transmittance at the median
SPLATS = 4  # of each tile in a pass: with 8 it takes 0.9 of the time, and compiles for twice as long
EXAMPLE_LIGHT = 0.6  # that passes before; a few splats of the example bring it below a half
EXAMPLE_CUT_OFF = 0.05  # alpha; opacities of the example go from 0.1 to 0.2
EXAMPLE_FAR = 2.0  # twice the largest depth of the example
Rays = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
Shown = tuple[str, str, str, str]
# statistics, and what they are of no splats
NOTHING = {"nearest": math.inf, "median": math.inf, "number": -1.0, "weight": 0.0, "count": 0.0, "last": -1.0}


@dataclass(frozen=True)
class Order:
    """A compositor of splats whose red is their depth and whose green their number.

    shown: its red, green, blue and alpha.  nearest is the least depth; median that of the first splat behind which the
        transmittance is below a half; number and weight are of the splat of largest weight; count says how many splats
        are drawn; last is the number of the last one in front of which the transmittance is above a half.
    rays: of places in px, if the pixel kernel reads them.
    """

    pixel: PixelKernel
    shown: Shown
    rays: Rays | None = None
    name: str = "order"

    @classmethod
    def of(cls, pixel: PixelKernel, shown: Shown, splats: Splats2D) -> "Order":
        """The compositor of these splats, which may be seen through a lens."""
        return cls(pixel, shown, partial(pixel.rays, splats) if isinstance(pixel, ReadsRays) else None)

    def rows(self, splats: Splats2D) -> Float[Tensor, "m c"]:
        """The pixel kernel's raster rows."""
        return self.pixel.raster_rows(splats, EAGER)

    def tiles(
        self,
        rows: Float[Tensor, "m c"],
        window: float,
        order: Int[Tensor, " p"],
        first: Int[Tensor, " t"],
        counts: Int[Tensor, " t"],
        centres: tuple[Float[Tensor, "t P"], Float[Tensor, "t P"]],
        kernels: Kernels,
        rules: Rules,
    ) -> Float[Tensor, "4 t P"]:
        """The statistics; tiles end where no pixel's can change."""
        (x, y), local = centres, tile_centres(rows)
        corners = torch.stack([x[:, 0] - local[0][0], y[:, 0] - local[1][0]], dim=1)
        corners, lists = functional.pad(corners, (0, 1), value=1.0), torch.stack([first, first + counts], dim=1)
        left, rays, limits = torch.ones_like(x), (), rows.new_tensor(Limits.by(rules))
        if self.rays is not None:
            rays = self.rays(x, y)
            left, local = (torch.stack(rays) != 0).any(dim=0).to(x), ()  # without a ray nothing is seen
        found = {name: torch.full_like(x, nothing) for name, nothing in NOTHING.items()}
        enough = HALF if {*self.shown} == {"last"} else 0.0  # light at which a pixel's statistics stand
        part, going = [lists, corners, left, *found.values(), *rays], forward.tiles_left(counts, SPLATS)
        for n, ahead in zip(going, forward.shifts_of(len(going), SPLATS, rows), strict=True):
            part = [each.narrow(0, 0, n) for each in part]
            kernels.run(pass_kernel(self.pixel), rows, order, *part, *local, limits, ahead)
            if part[2].amax() <= enough:
                break
        return torch.stack([found[name] for name in self.shown])

    def exact(
        self, splats: Splats2D, centres: Float[Tensor, "p 2"], rules: Rules
    ) -> tuple[Float[Tensor, "p 3"], Float[Tensor, " p"]]:
        """The same by the definition, of all splats at once."""
        assert splats.rgb is not None
        values = self.pixel.exact(splats, centres[:, None] - splats.means)
        alpha = (splats.opacities * values).clamp(max=rules.max_alpha)
        alpha = torch.where(alpha >= rules.min_alpha, alpha, 0.0)
        behind = (1 - alpha).cumprod(dim=1)
        weight = torch.where(behind >= rules.min_transmittance, alpha * behind / (1 - alpha), 0.0)
        depth, number = (column.expand_as(weight) for column in splats.rgb[:, :2].T)
        heaviest = weight.argmax(dim=1, keepdim=True)
        in_half = (weight > 0) & (torch.cat([torch.ones_like(behind[:, :1]), behind[:, :-1]], dim=1) > HALF)
        last = in_half.cumsum(dim=1).argmax(dim=1, keepdim=True)
        most = weight.gather(1, heaviest).squeeze(1)
        found = {
            "nearest": torch.where(weight > 0, depth, torch.inf).amin(dim=1),
            "median": torch.where((weight > 0) & (behind < HALF), depth, torch.inf).amin(dim=1),
            "number": torch.where(most > 0, number.gather(1, heaviest).squeeze(1), -1.0),
            "weight": most,
            "count": (weight > 0).sum(dim=1).to(most),
            "last": torch.where(in_half.any(dim=1), number.gather(1, last).squeeze(1), -1.0),
        }
        *colours, alpha = (found[name] for name in self.shown)
        return torch.stack(colours, dim=1), 1 - alpha


def _pass(
    pixel: PixelKernel,
    rows: Float[Tensor, "m c"],
    ids: Int[Tensor, " p"],
    lists: Int[Tensor, "t 2"],
    corners: Float[Tensor, "t 3"],
    T: Float[Tensor, "t P"],
    *found_and_rest: Tensor,
) -> tuple[()]:
    """Take the next `SPLATS` splats of each tile into the statistics, and what light is left into T, in place.

    Arguments: see `forward._pass`, with the statistics in place of colours and alpha.
    """
    *planes, values, ahead = found_and_rest
    coordinates = forward.coordinates_of(pixel)
    found, limits, one = planes[:-coordinates], Limits.of(values), corners[:, 2:]
    nearest, median, number, weight, count, last = found
    x, y, *z = planes[-coordinates:]
    pixels, before = Pixels(corners, x, y, z[0] if z else None), T
    rows_in_turn = next_rows(rows, ids, lists[:, 0] + ahead, lists[:, 1], SPLATS)
    for row, _, alpha in forward.in_turn(pixel, limits, rows_in_turn, pixels):
        behind = before * forward.transmitted(alpha, one, limits)
        share = forward.where_above(limits.below_min_transmittance, behind, forward.less(before, behind, one))
        depth, own = (row[:, column, None] for column in (RED, GREEN))
        nearest = torch.where((share > 0) & (depth < nearest), depth, nearest)
        median = torch.where((share > 0) & (behind < HALF) & (depth < median), depth, median)
        number, weight = (torch.where(share > weight, new, old) for new, old in ((own, number), (share, weight)))
        count = torch.where(share > 0, count + one, count)
        last = torch.where((share > 0) & (before > HALF), own, last)
        before = behind
    for plane, value in zip(found, (nearest, median, number, weight, count, last), strict=True):
        plane.copy_(value)
    T.copy_(forward.where_above(limits.below_min_transmittance, one * before, before))
    return ()


def _example(pixel: PixelKernel, planes: int) -> tuple[Tensor, ...]:
    """Arguments to compile for: little light is hidden yet, and some pixels are beyond the splats' cut-off.

    Every tile has the same splats: where few are near a threshold, rounding is not taken for a broken package.
    """
    rows, ids, lists, corners, T, *rest, _, ahead = forward.tiles_example(pixel, 3, planes)
    ids = ids % forward.EXAMPLE_LIST * (forward.EXAMPLE_SPLATS // forward.EXAMPLE_LIST)
    for plane, nothing in zip(rest, NOTHING.values(), strict=False):
        plane.fill_(min(nothing, EXAMPLE_FAR))
    limits = torch.tensor(Limits.by(replace(RULES_3DGS, min_alpha=EXAMPLE_CUT_OFF)))
    return rows, ids, lists, corners, T.fill_(EXAMPLE_LIGHT), *rest, limits, ahead


@cache
def pass_kernel(pixel: PixelKernel) -> Kernel:
    """A pass of one pixel kernel."""
    planes = range(4, 5 + len(NOTHING))  # transmittance and statistics
    return Kernel(
        f"order-{pixel.name}",
        partial(_pass, pixel),
        partial(_example, pixel, len(planes)),
        ("m", "p", "t", "t", *("t" for _ in planes), *forward.coordinate_sizes(pixel), None, None),
        updates=tuple(planes),
        evaluations=SPLATS,
    )

"""The order of splats along a ray: a compositor that finds the first, the middle and the heaviest one.

t: tiles; K: splats of a tile in turn; P: pixels per tile; p: pixels.
w_i = alpha_i T_i: weight of the i-th splat of a pixel, in front of which the transmittance is T_i.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.interfaces import Limits, PixelKernel, Pixels, ReadsRays
from aaplug.core.kernels import EAGER, Kernels
from aaplug.core.rules import Rules
from aaplug.core.splats import Splats2D
from aaplug.methods.pixel_kernels.raster_rows import GREEN, RED, next_rows, tile_centres

HALF = 0.5  # transmittance at the median
SPLATS = 16  # whose alphas are computed at once
Rays = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
Shown = tuple[str, str, str, str]
# of no splats
NOTHING = {"nearest": math.inf, "median": math.inf, "number": -1.0, "weight": 0.0, "count": 0.0, "last": -1.0}


@dataclass(frozen=True)
class Order:
    """A compositor of splats whose red is their depth and whose green their number.

    shown: its red, green, blue and alpha.  nearest is the least depth; median that of the first splat behind which the
        transmittance is below a half; number and weight are of the splat of largest weight, and only together; count
        says how many splats are drawn; last is the number of the last one in front of which the transmittance is above
        a half.
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
        """The statistics, of `SPLATS` splats at a time; tiles end where no pixel's statistics can change."""
        (x, y), local, limits = centres, tile_centres(rows), Limits.by(rules)
        corners = torch.stack([x[:, 0] - local[0][0], y[:, 0] - local[1][0]], dim=1)
        pixels, left = Pixels(corners, *local), torch.ones_like(x)
        if self.rays is not None:
            rays = self.rays(x, y)
            pixels = Pixels(corners, *rays)
            left = (torch.stack(rays) != 0).any(dim=0).to(x)  # without a ray nothing is seen
        found = {name: torch.full_like(x, NOTHING[name]) for name in dict.fromkeys(self.shown)}
        enough = HALF if [*found] == ["last"] else 0.0  # light at which a pixel's statistics stand
        for start in range(0, int(counts.max()), SPLATS):
            nearest = next_rows(rows, order, first + start, first + counts, SPLATS).transpose(0, 1)
            left = _add(found, left, self.pixel.alpha(nearest, pixels, limits), nearest[..., RED : GREEN + 1], rules)
            if (left <= enough).all():
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


def _add(
    found: dict[str, Float[Tensor, "t P"]],
    left: Float[Tensor, "t P"],
    alpha: Float[Tensor, "K t P"],
    colours: Float[Tensor, "K t 2"],
    rules: Rules,
) -> Float[Tensor, "t P"]:
    """Take the next splats into the statistics, in place; returns what light they leave, 0 where a pixel stops."""
    behind = left * (1 - alpha.clamp(max=rules.max_alpha)).cumprod(dim=0)
    drawn = (alpha > 0) & (behind >= rules.min_transmittance)
    before = torch.cat([left[None], behind[:-1]])
    depth, number = colours.unbind(dim=2)
    for name, here in (("nearest", drawn), ("median", drawn & (behind < HALF))):
        if name in found:
            found[name] = torch.minimum(found[name], torch.where(here, depth[..., None], torch.inf).amin(dim=0))
    if "number" in found:
        weight = torch.where(drawn, before - behind, 0.0)
        most, heaviest = weight.max(dim=0)
        heavier = most > found["weight"]
        found["number"] = torch.where(heavier, number.T.gather(1, heaviest), found["number"])
        found["weight"] = torch.where(heavier, most, found["weight"])
    if "count" in found:
        found["count"] += drawn.sum(dim=0)
    if "last" in found:
        for here, each in zip(drawn & (before > HALF), number, strict=True):
            found["last"] = torch.where(here, each[:, None], found["last"])
    return torch.where(behind[-1] >= rules.min_transmittance, behind[-1], 0.0)

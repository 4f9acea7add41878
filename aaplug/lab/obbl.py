"""Opacity-balanced band limiting after AA-Splat (Suh et al. 2026, arXiv 2603.29394), for pixel-aligned Gaussians.

A feed-forward network makes one Gaussian per pixel of each view, often far smaller than the pixel, and relies on the
dilation of its own image size.  AA-Splat instead widens every Gaussian in the world to the finest rate at which any
view samples it, as Mip-Splatting does, and balances opacities, because the wider Gaussians overlap.  The abstract and
project page name both parts and give no formula for the second.  Here it is a bound on opacity, and colours divided by
alpha: both are aaplug's reading.

t: tiles; P: pixels per tile; p: pixels, or entries of `order`; m: splats.
"""

from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.gaussians import Fusion, Gaussians
from aaplug.core.interfaces import Limits, Pixels
from aaplug.core.kernels import EAGER, Kernel, Kernels
from aaplug.core.rules import Rules
from aaplug.core.splats import Splats2D
from aaplug.core.training import TrainingViews
from aaplug.methods.filters.smoothing import Smoothing3D
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.methods.pixel_kernels.raster_rows import next_rows, tile_centres
from aaplug.rasterizers.reference import composited

MAX_OPACITY = 0.4  # of a band-limited Gaussian; measured (examples/guides/methods.md)
OPAQUE_ABOVE = 0.5  # alpha of a pixel, from which it is taken as covered
SPLATS_PER_PASS = 32
SIZES = ("t", "t", None, None, "t")  # of a pass, which only runs eagerly
BAND_LIMIT = Smoothing3D(opacity="kept")


@dataclass(frozen=True)
class BoundedBandLimit:
    """Smooth by Mip-Splatting's 3D filter, keep opacities, and bound them from above by `max_opacity`."""

    max_opacity: float = MAX_OPACITY

    def __call__(self, scene: Gaussians, training: TrainingViews) -> Gaussians:
        """Fuse the smoothing into scales, and the bound into opacities."""
        bound = torch.tensor(self.max_opacity).logit()
        limited = BAND_LIMIT(replace(scene, logit_opacities=scene.logit_opacities.clamp(max=float(bound))), training)
        settings = {"variance": f"{BAND_LIMIT.variance:g}", "max opacity": f"{self.max_opacity:g}"}
        return replace(limited, fused=(*scene.fused, Fusion("bounded band limit", settings)))


@dataclass(frozen=True)
class Renormalized:
    """3DGS's compositing; then pixels of an alpha above `opaque_above` are opaque, their colours divided by alpha."""

    opaque_above: float = OPAQUE_ABOVE
    name: str = "renormalized"

    def rows(self, splats: Splats2D) -> Float[Tensor, "m c"]:
        """Raster rows of kernel `point`."""
        return POINT.raster_rows(splats, EAGER)

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
        """Premultiplied colour and alpha."""
        x, y = tile_centres(rows)
        corners = torch.stack([centres[0][:, 0] - x[0], centres[1][:, 0] - y[0]], dim=1)
        planes, light = rows.new_zeros(4, *centres[0].shape), rows.new_ones(centres[0].shape)
        one = Kernel("renormalized", partial(_pass, rules), tuple, SIZES, evaluations=SPLATS_PER_PASS)
        for start in range(0, int(counts.amax()), SPLATS_PER_PASS):
            nearest = next_rows(rows, order, first + start, first + counts, SPLATS_PER_PASS)
            more, light = kernels.run(one, nearest, corners, x, y, light)
            planes = planes + more
        return self.renormalized(planes)

    def exact(
        self, splats: Splats2D, centres: Float[Tensor, "p 2"], rules: Rules
    ) -> tuple[Float[Tensor, "p 3"], Float[Tensor, " p"]]:
        """Premultiplied colour and transmittance, from those of the reference."""
        rgb, left = composited(splats, centres, POINT, rules)
        planes = self.renormalized(torch.cat([rgb.T, 1 - left[None]]))
        return planes[:3].T, 1 - planes[3]

    def renormalized(self, planes: Float[Tensor, "4 *pixels"]) -> Float[Tensor, "4 *pixels"]:
        """Colour and alpha over alpha, where that exceeds the bound."""
        covered = planes[3] > self.opaque_above
        return planes / torch.where(covered, planes[3], 1.0)


def _pass(
    rules: Rules,
    nearest: Float[Tensor, "t K c"],
    corners: Float[Tensor, "t 2"],
    x: Float[Tensor, " P"],
    y: Float[Tensor, " P"],
    light: Float[Tensor, "t P"],
) -> tuple[Float[Tensor, "4 t P"], Float[Tensor, "t P"]]:
    """Premultiplied colour and alpha of the next splats of each tile, and the light behind them.

    A pixel stops before the splat that would bring the light below `rules.min_transmittance`; it then has none.
    """
    nearest = nearest.transpose(0, 1)
    alpha = POINT.alpha(nearest, Pixels(corners, x, y), Limits.by(rules)).clamp(max=rules.max_alpha)
    after = light * (1 - alpha).cumprod(dim=0)
    going = after >= rules.min_transmittance
    weights = torch.where(going, alpha * torch.cat([light[None], after[:-1]]), 0.0)
    colours = nearest[..., -3:].permute(2, 0, 1)[..., None]
    planes = torch.cat([(weights * colours).sum(dim=1), weights.sum(dim=0)[None]])
    return planes, torch.where(going[-1], after[-1], 0.0)


BOUNDED_BAND_LIMIT, RENORMALIZED = BoundedBandLimit(), Renormalized()

"""Screen-space Gaussians and images.

m: visible Gaussians.  Pixel (0, 0) covers [0, 1) × [0, 1); its centre is (0.5, 0.5).  Covariances are packed
(xx, xy, yy), in px².  The determinant travels beside the covariance, because xx·yy − xy² of a needle has no correct
digit in float32 while the determinant from factors has all of them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.kernels import EAGER, Kernel, Kernels

MIN_ALPHA = 1 / 255  # a contribution below it is skipped (3DGS)
MIN_COMPENSATION = (
    0.005  # floor of an opacity factor: rounding makes no splat vanish (3DGS, gsplat)
)


@dataclass(frozen=True)
class Splats2D:
    """What the rasterizer draws, in no particular order.

    window: side, in px, of the square that alpha is averaged over, where the pixel kernel averages at all; of the
        screen's low-pass filter in training's pixels, where the pixel kernel is a disc's.
    tilts: of a disc, by which share of its centre's the inverse of depth falls a px right, and a px down.
    """

    means: Float[Tensor, "m 2"]
    covs: Float[Tensor, "m 3"]  # xx, xy, yy in px²
    dets: Float[Tensor, " m"]  # px⁴
    depths: Float[Tensor, " m"]
    opacities: Float[Tensor, " m"]
    sources: Int[Tensor, " m"]  # index in the scene
    rgb: Float[Tensor, "m 3"] | None = None
    tilts: Float[Tensor, "m 2"] | None = None
    window: float = 1.0

    def __len__(self) -> int:
        return self.means.shape[0]

    def __getitem__(self, index: Tensor | slice) -> "Splats2D":
        """The splats at `index` (a mask, indices or a slice), in that order."""
        if isinstance(index, Tensor) and index.dtype == torch.bool:
            index = index.nonzero().squeeze(1)

        def at(column: Tensor) -> Tensor:  # index_select is several times faster than [index]
            return column[index] if isinstance(index, slice) else column.index_select(0, index)

        return Splats2D(
            means=at(self.means),
            covs=at(self.covs),
            dets=at(self.dets),
            depths=at(self.depths),
            opacities=at(self.opacities),
            sources=at(self.sources),
            rgb=None if self.rgb is None else at(self.rgb),
            tilts=None if self.tilts is None else at(self.tilts),
            window=self.window,
        )

    def to(self, dtype: torch.dtype) -> "Splats2D":
        """The same splats in another precision."""
        return replace(
            self,
            means=self.means.to(dtype),
            covs=self.covs.to(dtype),
            dets=self.dets.to(dtype),
            depths=self.depths.to(dtype),
            opacities=self.opacities.to(dtype),
            rgb=None if self.rgb is None else self.rgb.to(dtype),
            tilts=None if self.tilts is None else self.tilts.to(dtype),
        )

    def blurred(
        self,
        variance: float | Float[Tensor, " m"],
        compensate: bool,
        floor: float = MIN_COMPENSATION,
    ) -> "Splats2D":
        """Convolve with an isotropic Gaussian of `variance` px², the one home of that formula.

        det(C + vI) = det C + v·tr C + v², a sum of non-negative terms.  With `compensate`, opacity is multiplied by
        √(det C / det(C + vI)), at least `floor`, which keeps the splat's energy (EWA splatting, Zwicker et al. 2001;
        Mip-Splatting, eq. 10).
        """
        trace = self.covs[:, 0] + self.covs[:, 2]
        dets = self.dets + variance * trace + variance * variance
        diagonal = self.covs.new_tensor([1.0, 0.0, 1.0])
        added = variance[:, None] if isinstance(variance, Tensor) else variance
        return self._widened(self.covs + added * diagonal, dets, compensate, floor)

    def convolved(
        self, added: Float[Tensor, "m 3"], compensate: bool, floor: float = MIN_COMPENSATION
    ) -> "Splats2D":
        """The same for any covariance, packed and in px²: det(A + B) = det A + det B + A's part across B."""
        a, b, c = added.unbind(dim=1)
        xx, xy, yy = self.covs.unbind(dim=1)
        dets = self.dets + (a * c - b * b) + (xx * c + yy * a - 2 * xy * b).clamp(min=0.0)
        return self._widened(self.covs + added, dets, compensate, floor)

    def _widened(
        self, covs: Float[Tensor, "m 3"], dets: Float[Tensor, " m"], compensate: bool, floor: float
    ) -> "Splats2D":
        opacities = self.opacities
        if compensate:
            opacities = opacities * (self.dets / dets).clamp(min=floor * floor).sqrt()
        return replace(self, covs=covs, dets=dets, opacities=opacities)


def joined(parts: Sequence[Splats2D]) -> Splats2D:
    """Splats of several parts as one; all have colours or none."""
    columns = {
        name: torch.cat([getattr(part, name) for part in parts])
        for name in ("means", "covs", "dets", "depths", "opacities", "sources")
    }
    colours = [part.rgb for part in parts if part.rgb is not None]
    rgb = torch.cat(colours) if colours else None
    slopes = [part.tilts for part in parts if part.tilts is not None]
    tilts = torch.cat(slopes) if slopes else None
    return Splats2D(**columns, rgb=rgb, tilts=tilts, window=parts[0].window)


class Render(NamedTuple):
    """An image: rgb not clamped above, over its background; alpha is the share of the background that is hidden."""

    rgb: Float[Tensor, "h w 3"]
    alpha: Float[Tensor, "h w"]


def whitening(splats: Splats2D) -> Float[Tensor, "m 2 2"]:
    """W of each splat with |W d|² = dᵀ C⁻¹ d, for d = (dx, dy) in px."""
    return torch.stack(whitening_columns(splats.covs, splats.dets), dim=1).unflatten(1, (2, 2))


def whitening_columns(
    covs: Float[Tensor, "m 3"], dets: Float[Tensor, " m"]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The four entries of each splat's whitening.

    The row without slope runs along the axis of larger variance, so that the other's slope is at most one; with the
    determinant given, no digits are lost for needles, as they are in yy·dx² − 2xy·dx·dy + xx·dy².
    """
    xx, xy, yy = covs.unbind(dim=1)
    wide = xx >= yy
    pivot = torch.where(wide, xx, yy)
    along, across = pivot.rsqrt(), (pivot / dets).sqrt()
    slope, zero = -xy / pivot * across, torch.zeros_like(along)
    return (
        torch.where(wide, slope, across),
        torch.where(wide, across, slope),
        torch.where(wide, along, zero),
        torch.where(wide, zero, along),
    )


def principal_columns(
    covs: Float[Tensor, "m 3"], dets: Float[Tensor, " m"]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The four entries of the whitening whose rows run along each splat's own axes, the longer first."""
    xx, xy, yy = covs.unbind(dim=1)
    across, along = 2 * xy, xx - yy
    round_ = (across == 0) & (along == 0)  # any axes will do, but there the angle has no gradient
    angle = 0.5 * torch.atan2(across.where(~round_, 0.0), along.where(~round_, 1.0))
    half = 0.5 * (xx + yy)
    root = torch.hypot(0.5 * along.where(~round_, 1.0), xy)
    longer = half + torch.where(round_, 0.0, root)
    wide, thin = longer.rsqrt(), (longer / dets).sqrt()
    cos, sin = angle.cos(), angle.sin()
    return cos * wide, sin * wide, -sin * thin, cos * thin


def reach(opacities: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Squared Mahalanobis distance at which alpha falls to 1/255; below zero for a splat that never reaches it."""
    return 2 * torch.log(opacities / MIN_ALPHA)


def half_sizes(splats: Splats2D) -> Float[Tensor, "m 2"]:
    """Half width and height of the box outside of which a splat's alpha is below 1/255, in px."""
    return (reach(splats.opacities).clamp(min=0.0)[:, None] * splats.covs[:, [0, 2]]).sqrt()


def drawn(
    splats: Splats2D,
    hw: tuple[int, int],
    guard: float = math.inf,
    kernels: Kernels = EAGER,
    extents: Splats2D | None = None,
) -> Splats2D:
    """The splats that can change an image of height and width `hw`; a splat of no area cannot.

    guard: leave out splats whose centre lies farther outside the image than this share of its longer side.
    extents: the same splats, as wide as a pixel's centre may be from what it shows.
    """
    size = splats.means.new_tensor([hw[1], hw[0], guard * max(hw)])
    of = splats if extents is None else extents
    (inside,) = kernels.run(INSIDE, of.means, of.covs, of.dets, of.opacities, size)
    return splats[inside]


def _inside(
    means: Float[Tensor, "m 2"],
    covs: Float[Tensor, "m 3"],
    dets: Float[Tensor, " m"],
    opacities: Float[Tensor, " m"],
    size: Float[Tensor, " 3"],
) -> tuple[Tensor]:
    *sides, band = size.unbind()
    inside = (opacities >= MIN_ALPHA) & (dets > 0)
    reached = reach(opacities).clamp(min=0.0)
    for mean, variance, side in zip(
        means.unbind(dim=1), (covs[:, 0], covs[:, 2]), sides, strict=True
    ):
        half = (reached * variance).sqrt()
        inside = inside & (mean + half > 0) & (mean - half < side)
        inside = inside & (mean >= -band) & (mean <= side + band)
    return (inside,)


def _inside_example() -> tuple[Tensor, ...]:
    m = 100_000
    means = torch.linspace(-9.0, 9.0, 2 * m).view(m, 2)
    return means, torch.ones(m, 3), torch.ones(m), torch.ones(m), torch.tensor([4.0, 4.0, 2.0])


INSIDE = Kernel("inside", _inside, _inside_example, ("m", "m", "m", "m", None), gathers=True)

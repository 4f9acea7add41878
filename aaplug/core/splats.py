"""Screen-space Gaussians (splats) and rendered images.

m: splats of one view.  Pixel (0, 0) covers [0, 1) × [0, 1); its centre is (0.5, 0.5).  Covariances are packed
(xx, xy, yy), in px².  The determinant is stored beside the covariance: computed in float32 as xx·yy - xy² it has no
correct digit for a needle, computed from the factors of the projection it has all of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.system.contracts import Range, check_fields, contract, described
from aaplug.system.errors import UsageError

MIN_COMPENSATION = 0.005  # floor of the opacity factor, so that rounding erases no splat (3DGS)
NEARER, FARTHER = 0.25, 0.12  # shares of the change of depth along a ray that count where it is negative, or positive
SHAPE = frozenset(("covs", "dets", "opacities", "depth_slopes", "planes"))  # columns that decide what bounds a splat
Floor = Annotated[float, Range(0, 1)]


@dataclass(frozen=True, eq=False)
class Splats2D:
    """Splats of one view, in no particular order.

    window: px.  For a pixel kernel that averages alpha, the side of the square it averages over; for a disc kernel, the
        size of training's pixel, which sets its screen-space low-pass filter.
    depth_slopes: for discs, the relative decrease of inverse depth per px to the right and per px down.
    ray_slopes: change of depth along a pixel's ray, in world units per px to the right and per px down; each tile of
        a rasterizer that `SortsTiles` then sorts its splats by their `ordering_depths` on the ray of its middle.
    camera: whose lens the splats are seen through; None for a pinhole's.  Then
    planes: of the plane in which each splat is a Gaussian of covariance `covs`: axes in the camera's frame that point
        right, down and ahead.  A ray d meets the plane right·d / ahead·d and down·d / ahead·d px from the centre.
    rates: at which the view samples each splat, in px per world unit.
    reach: x and y of the centre from the splat's own, packed covariance, determinant and opacity of the ellipse that
        bounds it for a pixel kernel and rules, `bounded_for`; see `bounds`.
    """

    means: Float[Tensor, "m 2"]
    covs: Float[Tensor, "m 3"]  # xx, xy, yy in px²
    dets: Float[Tensor, " m"]  # px⁴
    depths: Float[Tensor, " m"]  # world units; through a lens that is not flat, distances
    opacities: Float[Tensor, " m"]
    sources: Int[Tensor, " m"]  # index in the scene
    rgb: Float[Tensor, "m channels"] | None = None
    depth_slopes: Float[Tensor, "m 2"] | None = None
    ray_slopes: Float[Tensor, "m 2"] | None = None
    window: float = 1.0
    planes: Float[Tensor, "m 3 3"] | None = None
    rates: Float[Tensor, " m"] | None = None
    camera: Camera | None = None
    reach: Float[Tensor, "m 7"] | None = field(default=None, init=False)  # which `replace` forgets
    bounded_for: tuple[object, ...] | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        check_fields(self)

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def are_copies(self) -> Bool[Tensor, " m"]:
        """True for copies of splats that cross a panorama's edge: they lie more than half a turn from its middle."""
        if self.camera is None or not self.camera.lens.period:
            return torch.zeros_like(self.sources, dtype=torch.bool)
        return (self.means[:, 0] - self.camera.cx).abs() > self.camera.fx * self.camera.lens.period / 2

    def bounded_by(self, ellipses: "Splats2D | None", *bounded_for: object) -> "Splats2D":
        """The same splats, which know their bounding ellipses for a pixel kernel and rules."""
        if ellipses is None:
            return self
        reach = ellipses.means - self.means, ellipses.covs, ellipses.dets[:, None], ellipses.opacities[:, None]
        known = self.with_columns({"reach": torch.cat(reach, dim=1).detach()})
        vars(known)["bounded_for"] = bounded_for
        return known

    def bounds(self, *bounded_for: object) -> "Splats2D | None":
        """The bounding ellipses for a pixel kernel and rules, if they are known and the splats have not changed."""
        if self.reach is None or self.bounded_for != bounded_for:
            return None
        means, covs, (dets, opacities) = self.reach[:, :2], self.reach[:, 2:5], self.reach[:, 5:].unbind(dim=1)
        return self.with_columns({"means": self.means + means, "covs": covs, "dets": dets, "opacities": opacities})

    @contract
    def __getitem__(self, index: Tensor | slice) -> "Splats2D":
        """The splats at `index` (a mask, indices or a slice), in that order."""
        try:
            if isinstance(index, slice):
                return self.with_columns({name: column[index] for name, column in self._columns().items()})
            if index.dtype == torch.bool and index.shape == self.dets.shape:
                return self.selected(index.nonzero().squeeze(1))
            # index_select is several times faster than [index]
            return self.with_columns({name: x.index_select(0, index) for name, x in self._columns().items()})
        except (IndexError, RuntimeError, TypeError, ValueError) as error:
            raise UsageError("index", f"expected places of {len(self)} splats, got {described(index)}") from error

    def selected(self, rows: Int[Tensor, " k"]) -> "Splats2D":
        """The splats at `rows`, each at most once."""
        return self.with_columns({name: picked(column, rows) for name, column in self._columns().items()})

    @contract
    def to(self, dtype: torch.dtype) -> "Splats2D":
        """The same splats in another precision."""
        columns = self._columns().items()
        return self.with_columns({n: c.to(dtype) for n, c in columns if c.is_floating_point()})

    @contract
    def blurred(
        self, variance: float | Float[Tensor, " m"], compensate: bool, floor: Floor = MIN_COMPENSATION
    ) -> "Splats2D":
        """Convolve with an isotropic Gaussian of `variance` px².

        det(C + vI) = det C + v·tr C + v², a sum of non-negative terms.  With `compensate`, opacity is multiplied by
        √(det C / det(C + vI)), at least `floor`, which preserves the splat's energy (EWA splatting, Zwicker et al.
        2002; Mip-Splatting, eq. 10).
        """
        if isinstance(variance, Tensor) and variance.shape != self.dets.shape:
            raise UsageError("variance", f"expected [{len(self)}] numbers, got {[*variance.shape]}")
        trace = self.covs[:, 0] + self.covs[:, 2]
        dets = self.dets + variance * trace + variance * variance
        diagonal = self.covs.new_tensor([1.0, 0.0, 1.0])
        added = variance[:, None] if isinstance(variance, Tensor) else variance
        return self._widened(self.covs + added * diagonal, dets, compensate, floor)

    @contract
    def convolved(self, added: Float[Tensor, "m 3"], compensate: bool, floor: Floor = MIN_COMPENSATION) -> "Splats2D":
        """Convolve with a Gaussian of any covariance, packed, in px²."""
        if added.shape != self.covs.shape:
            raise UsageError("added", f"expected {[*self.covs.shape]} numbers, got {[*added.shape]}")
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
        return self.with_columns({"covs": covs, "dets": dets, "opacities": opacities})

    def with_columns(self, columns: dict[str, Tensor]) -> "Splats2D":
        """The same with other columns, which come from columns that were checked and so are not checked again."""
        other, known = object.__new__(type(self)), SHAPE.isdisjoint(columns) or "reach" in columns
        vars(other).update(vars(self), **({} if known else {"reach": None}), **columns)
        return other

    def _columns(self) -> dict[str, Tensor]:
        """Every per-splat tensor that is present."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}


def ordering_depths(depths: Float[Tensor, " m"], ahead: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Keys that sort splats on a ray, where they lie `ahead` deeper than at their centres, in world units.

    Scenes are trained by the order of centres, so only a share of the change counts: more of it pops less and costs
    more dB.  Where a splat is nearer than its centre, twice as much pays.
    """
    return (depths + FARTHER * ahead + (NEARER - FARTHER) * ahead.clamp(max=0.0)).clamp(min=0.0)


def concatenated(parts: Sequence[Splats2D]) -> Splats2D:
    """The splats of several parts as one; every part has the same columns."""
    if len(parts) == 1:
        return parts[0]
    if any(part.reach is None for part in parts):
        parts = [replace(part) for part in parts]
    return parts[0].with_columns({n: torch.cat([getattr(part, n) for part in parts]) for n in parts[0]._columns()})


class Render(NamedTuple):
    """An image.

    rgb: composited over its background, not clamped to 1.  alpha: the share of the background that is hidden.
    """

    rgb: Float[Tensor, "h w channels"]
    alpha: Float[Tensor, "h w"]
    __eq__, __ne__, __hash__ = object.__eq__, object.__ne__, object.__hash__  # as `==` of tensors is a tensor


def picked(x: Shaped[Tensor, "n *c"], rows: Int[Tensor, " m"]) -> Shaped[Tensor, "m *c"]:
    """Select rows, each at most once."""
    return _Picked.apply(x, rows) if x.requires_grad else x.index_select(0, rows)  # pyright: ignore[reportReturnType]


class _Picked(torch.autograd.Function):
    """Copies gradients to their rows; `index_select` would add them atomically, although no row repeats."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, rows: Tensor) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.shape = x.shape
        return x.index_select(0, rows)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (rows,) = ctx.saved_tensors
        return grads[0].new_zeros(ctx.shape).index_copy_(0, rows, grads[0]), None

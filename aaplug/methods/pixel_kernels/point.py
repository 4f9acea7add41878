"""The value at the pixel's centre: 3DGS's own pixel kernel (Kerbl et al. 2023, eq. 4).

u and v are the raster row's linear forms, scaled so that u² + v² = log2(e)/2 · dᵀ C⁻¹ d.  Opacity o is stored as
log2 o - LOG2_PADDING, at least 0 where it can be seen: alpha is 2^(LOG2_PADDING + h) with h = log2 o - LOG2_PADDING -
u² - v².

The backward pass reduces over a tile's pixels inside the compiled loop: six sums of the gradient of log alpha and
three of the colour gradient per splat.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from aaplug.core.ellipses import whitening, whitening_columns
from aaplug.core.interfaces import Limits, Pixels
from aaplug.core.kernels import Kernel, Kernels, backward_of, where_signed
from aaplug.core.projection import sum_of
from aaplug.core.rules import Rules
from aaplug.core.splats import Splats2D
from aaplug.methods.pixel_kernels.gradients import Move, stacked
from aaplug.methods.pixel_kernels.raster_rows import COLUMNS, OPACITY, TILE, forms_at, splat_example

HALF_LOG2_E = 0.5 * math.log2(math.e)
LN_2 = math.log(2)
LOG2_PADDING = -9.0  # log2 alpha of the padding row, below every cut-off
SQUARINGS = 3  # 2^x is computed as p(x)^(2^SQUARINGS), p of degree DEGREE: relative error 3e-6 in float32
DEGREE = 5
ALPHA_SUMS = 6  # of the gradient of log alpha
COMMON_SUMS = ALPHA_SUMS + 3  # with those of three channels; those of further channels follow


@dataclass(frozen=True)
class Point:
    """Alpha is opacity times the Gaussian's value at the pixel's centre."""

    name: str = "point"
    columns: int = COLUMNS
    needs_depth_slopes: bool = False
    splats_per_pass: int = 16
    gradient_sums: int = ALPHA_SUMS

    def bounding_ellipses(self, splats: Splats2D, rules: Rules) -> Splats2D | None:
        """The splats themselves."""
        return None

    def raster_rows(self, splats: Splats2D, kernels: Kernels) -> Float[Tensor, "m c"]:
        """Scaled forms, and opacity as its log2."""
        assert splats.rgb is not None
        columns = (splats.means, splats.covs, splats.dets, splats.opacities, splats.rgb[:, :3])
        rows, more = kernels.run(POINT_ROWS, *columns)[0], splats.rgb[:, 3:]
        return torch.cat([rows, functional.pad(more, (0, 0, 0, 1))], dim=1) if more.shape[1] else rows

    def alpha(self, rows: Float[Tensor, "*n t c"], pixels: Pixels, limits: Limits) -> Float[Tensor, "*n t P"]:
        """2^(log2 o - u² - v²), 0 below the cut-off."""
        u, v = forms_at(rows, pixels, triangular=True)
        h = torch.addcmul(rows[..., OPACITY, None], u, u, value=-1)
        return exp2_of(torch.addcmul(h, v, v, value=-1), limits)

    def exact(self, splats: Splats2D, offsets: Float[Tensor, "p c 2"]) -> Float[Tensor, "p c"]:
        """exp(-dᵀ C⁻¹ d / 2)."""
        white = torch.einsum("cij,pcj->pci", whitening(splats), offsets)
        return torch.exp(-0.5 * white.square().sum(dim=2))

    def sums(self, moves: list[Move], colours: Sequence[Float[Tensor, "t P"]], T: Tensor) -> Float[Tensor, "t s_K"]:
        """Per splat, sums over the tile's pixels, from which `from_sums` makes the gradient of its raster row.

        With s the gradient of log alpha: s·u², s·u·v, s·v², s·u, s·v, s, and the compositing weight times the gradient
        of each channel.
        """
        if not torch.compiler.is_compiling():
            sums = _sums_by_products(moves, colours)
            if self.gradient_sums > ALPHA_SUMS:
                terms = [self.further_terms(row, gradient, forms_at(row, pixels)) for row, pixels, _, gradient in moves]
                further = [torch.stack([x.sum(dim=1) for x in of_splat], dim=1) for of_splat in terms]
                sums = torch.cat([sums, torch.stack(further, dim=1)], dim=2)
            return sums.flatten(1)
        sums = []
        for row, pixels, weight, gradient in moves:
            # Both are 0 where T is 0, but the test on T makes the compiler fuse all sums into one loop.
            gradient, weight = (torch.where(T > 0, x, 0.0) for x in (gradient, weight))
            u, v = forms_at(row, pixels, triangular=True)
            su, sv = gradient * u, gradient * v
            sums += [su * u, su * v, sv * v, su, sv, gradient, *(weight * colour for colour in colours)]
            sums += self.further_terms(row, gradient, (u, v))
        return torch.cat([x.sum(dim=1, keepdim=True) for x in sums], dim=1)

    def further_terms(
        self, row: Float[Tensor, "t c"], gradient: Float[Tensor, "t P"], forms: tuple[Tensor, Tensor]
    ) -> list[Float[Tensor, "t P"]]:
        """Terms of further sums: none.  gradient: of log alpha."""
        return []

    def from_sums(
        self, rows: Float[Tensor, "m c"], sums: Float[Tensor, "m s"], kernels: Kernels
    ) -> Float[Tensor, "m c"]:
        """Gradient of the raster rows from the sums."""
        gradient, more = kernels.run(FROM_SUMS, rows[:, :COLUMNS], sums[:, :COMMON_SUMS])[0], sums[:, COMMON_SUMS:]
        return torch.cat([gradient, more], dim=1) if more.shape[1] else gradient


def _point_rows(
    means: Float[Tensor, "m 2"],
    covs: Float[Tensor, "m 3"],
    dets: Float[Tensor, " m"],
    opacities: Float[Tensor, " m"],
    rgb: Float[Tensor, "m 3"],
) -> tuple[Float[Tensor, "m_and_1 10"]]:
    """Raster rows and the padding row."""
    forms = [HALF_LOG2_E**0.5 * form for form in whitening_columns(covs, dets)]
    columns = [*forms, *means.unbind(dim=1), opacities.log2() - LOG2_PADDING, *rgb.unbind(dim=1)]
    return (torch.stack([functional.pad(column, (0, 1)) for column in columns], dim=1),)


def exp2_of(h: Float[Tensor, "*any"], limits: Limits) -> Float[Tensor, "*any"]:
    """2^(LOG2_PADDING + h); 0 below the cut-off.

    Compiled it is a polynomial, because a call in a loop stops vectorization.  Below the cut-off that may be anything,
    and is left out.
    """
    if torch.compiler.is_compiling():
        root = _polynomial(h, ROOT_OF_EXP2).pow(2 ** (SQUARINGS - 1))  # compiled to squarings
        # the last squaring comes after the cut-off, so that 1 - alpha is one instruction with it
        return where_signed(h - (limits.log2_min_alpha - LOG2_PADDING), root, negative=False).square()
    # The exponent is clamped, because subnormal numbers are slow.
    return limits.cut((h + LOG2_PADDING).clamp_(min=LOG2_PADDING).exp2_())


def _polynomial(x: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    *rest, last = coefficients
    value = x * last + rest[-1]
    for coefficient in rest[-2::-1]:
        value = value * x + coefficient
    return value


def _root_of_exp2(squarings: int, degree: int) -> tuple[float, ...]:
    """Coefficients of p with p(h)^(2^squarings) ≈ 2^(LOG2_PADDING + h) for 0 <= h <= -LOG2_PADDING.

    p interpolates at the Chebyshev nodes.
    """
    angles = math.pi * (torch.arange(degree + 1, dtype=torch.float64) + 0.5) / (degree + 1)
    h = -LOG2_PADDING / 2 * (1 + angles.cos())
    values = torch.exp2((LOG2_PADDING + h) / 2**squarings)
    return tuple(torch.linalg.solve(torch.linalg.vander(h), values).tolist())


def _sums_by_products(moves: list[Move], colours: Sequence[Float[Tensor, "t P"]]) -> Float[Tensor, "t K s"]:
    """The same sums, for eager mode: matrix products of moments about the tile's centre, to keep precision."""
    pixels, (rows, weights, gradients) = moves[0].pixels, stacked(moves)
    x, y = pixels.x - TILE / 2, pixels.y - TILE / 2
    monomials = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], dim=1)
    s, sx, sy, sxx, sxy, syy = (gradients @ monomials).unbind(dim=2)
    ux, uy, vx, vy, centre_x, centre_y, *_ = rows.unbind(dim=2)
    dx = pixels.corners[:, 0, None] + TILE / 2 - centre_x
    dy = pixels.corners[:, 1, None] + TILE / 2 - centre_y
    u, v = ((i * dx + j * dy, i, j) for i, j in ((ux, uy), (vx, vy)))  # value at the tile's centre, and slopes
    moments = ((s, sx, sy), (sx, sxx, sxy), (sy, sxy, syy))
    by_u, by_v = ([_dot(form, moment) for moment in moments] for form in (u, v))  # s times the form, times 1, x and y
    squares = [_dot(u, by_u), _dot(v, by_u), _dot(v, by_v)]
    by_colour = torch.bmm(weights, torch.stack([*colours], dim=2)).unbind(dim=2)
    return torch.stack([*squares, by_u[0], by_v[0], s, *by_colour], dim=2)


def _dot(a: Sequence[Tensor], b: Sequence[Tensor]) -> Tensor:
    return sum_of(p * q for p, q in zip(a, b, strict=True))


def _from_sums(rows: Float[Tensor, "m 10"], sums: Float[Tensor, "m 9"]) -> tuple[Float[Tensor, "m 10"]]:
    """Chain rule for log alpha = ln 2 (log2 o - u² - v²).

    The offset (dx, dy) from the splat is linear in u and v, by the inverse of the forms.
    """
    ux, uy, vx, vy, *_ = rows.unbind(dim=1)
    suu, suv, svv, su, sv, s, red, green, blue = sums.unbind(dim=1)
    det = ux * vy - uy * vx
    scale = torch.where(det != 0, -2 * LN_2 / det, 0.0)  # the padding row has none
    forms = []
    for p, q in ((suu, suv), (suv, svv)):
        forms += [scale * (vy * p - uy * q), scale * (ux * q - vx * p)]
    centre = [2 * LN_2 * (ux * su + vx * sv), 2 * LN_2 * (uy * su + vy * sv)]
    return (torch.stack([*forms, *centre, LN_2 * s, red, green, blue], dim=1),)


def _from_sums_example() -> tuple[Tensor, ...]:
    rows = _point_rows(*_point_example())[0]
    return rows, torch.linspace(0.1, 1.0, len(rows) * COMMON_SUMS).view(len(rows), -1)


def _point_example() -> tuple[Tensor, ...]:
    splats = splat_example()
    return *splats, torch.ones(len(splats[0]), 3)


ROOT_OF_EXP2 = _root_of_exp2(SQUARINGS, DEGREE)
POINT_ROWS = Kernel("point-rows", _point_rows, _point_example, ("m",) * 5)
POINT_ROWS_BACKWARD = backward_of(POINT_ROWS, ("m+1",))
FROM_SUMS = Kernel("composite-sums", _from_sums, _from_sums_example, ("m", "m"))
POINT = Point()

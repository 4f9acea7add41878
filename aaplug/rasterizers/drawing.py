"""Drawing rows: what a tile needs to know of a splat, and the alpha that this makes at its pixels.

m: splats; t: tiles of TILE × TILE px; P: pixels a tile; n: rows a tile; c: columns of a drawing row.

Most hold two linear forms u, v of the pixel's position with u² + v² = log2(e)/2 · dᵀ C⁻¹ d, so that alpha at a point is
2^(log2 o − u² − v²).  Forms lose no digits where the expanded quadratic of a needle would.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.interfaces import PixelKernel
from aaplug.kernels import Kernel, Kernels
from aaplug.rasterizers.binning import TILE, splat_example
from aaplug.rasterizers.extents import SURFELS
from aaplug.rasterizers.pixels import CELLS, mean_gaussian, mean_logistic
from aaplug.rasterizers.rules import just_below
from aaplug.rasterizers.surfels import NARROWEST, disc, smoothed_disc
from aaplug.splats import MIN_ALPHA, Splats2D, principal_columns, whitening_columns

# columns of a splat's drawing parameters; the last three only where alpha is a mean over the pixel
UX, UY, VX, VY, X, Y, OPACITY, RED, GREEN, BLUE, HALF_U, HALF_V, SLOPE = range(13)
TILT_X, TILT_Y, LOW_PASS_WIDTH = HALF_U, HALF_V, SLOPE  # of a disc
COLUMNS, MEAN_COLUMNS = 10, 13

PIXELS = TILE * TILE
HALF_LOG2_E = 0.5 * math.log2(math.e)
LOG2_SILENT = -9.0  # log2 of an alpha below 1/255; stops exp2 before it underflows, which is slow
LOG2_MIN_ALPHA = torch.tensor(MIN_ALPHA).log2().item()
BELOW_MIN_ALPHA = just_below(MIN_ALPHA)


def drawing_of(
    splats: Splats2D, kernels: Kernels, pixel: PixelKernel = "point"
) -> Float[Tensor, "m c"]:
    """Linear forms, centre, opacity and colour of each splat, and a last row that draws nothing."""
    assert splats.rgb is not None
    if pixel == "point":
        columns = (splats.means, splats.covs, splats.dets, splats.opacities, splats.rgb)
        (rows,) = kernels.run(DRAWING, *columns)
    elif pixel in SURFELS:
        rows = _disc_rows(splats, splats.rgb)
    else:
        rows = _mean_rows(splats, splats.rgb, square=pixel == "square")
    nothing = rows.new_zeros(1, rows.shape[1])
    nothing[:, OPACITY] = LOG2_SILENT if pixel == "point" else 0.0
    return torch.cat([rows, nothing])


def _drawing_rows(
    means: Float[Tensor, "m 2"],
    covs: Float[Tensor, "m 3"],
    dets: Float[Tensor, " m"],
    opacities: Float[Tensor, " m"],
    rgb: Float[Tensor, "m 3"],
) -> tuple[Float[Tensor, "m 10"]]:
    """Rows for values at points, the opacity as its log2."""
    forms = [HALF_LOG2_E**0.5 * form for form in whitening_columns(covs, dets)]
    columns = [*forms, *means.unbind(dim=1), opacities.log2(), *rgb.unbind(dim=1)]
    return (torch.stack(columns, dim=1),)


def _mean_rows(splats: Splats2D, rgb: Float[Tensor, "m 3"], square: bool) -> Float[Tensor, "m 13"]:
    """Rows for means over pixels: two forms, and the half windows along them, in standard deviations.

    The forms run along the splat's own axes; over a square the second along x or y, whichever the splat is longer in,
    and the first across it, with what it changes over the window along the second.
    """
    window = splats.window
    if square:
        ux, uy, vx, vy = whitening_columns(splats.covs, splats.dets)
        along_x = vx > 0
        across, slope = torch.where(along_x, uy, ux), torch.where(along_x, ux, uy)
        halves = [0.5 * window * across, 0.5 * window * (vx + vy), window * slope]
    else:
        ux, uy, vx, vy = principal_columns(splats.covs, splats.dets)
        halves = [0.5 * window * torch.hypot(x, y) for x, y in ((ux, uy), (vx, vy))]
        halves.append(torch.zeros_like(ux))
    return _rows_of(splats, rgb, [ux, uy, vx, vy], halves)


def _disc_rows(splats: Splats2D, rgb: Float[Tensor, "m 3"]) -> Float[Tensor, "m 13"]:
    """Rows for discs: a whitening, the tilt, and the low-pass filter's width."""
    assert splats.tilts is not None
    width = torch.full_like(splats.opacities, max(splats.window, NARROWEST))
    forms = whitening_columns(splats.covs, splats.dets)
    return _rows_of(splats, rgb, forms, [*splats.tilts.unbind(dim=1), width])


def _rows_of(
    splats: Splats2D, rgb: Float[Tensor, "m 3"], forms: Sequence[Tensor], rest: Sequence[Tensor]
) -> Float[Tensor, "m 13"]:
    columns = [*forms, *splats.means.unbind(dim=1), splats.opacities, *rgb.unbind(dim=1), *rest]
    return torch.stack(columns, dim=1)


class Pixels(NamedTuple):
    """Where the pixels of tiles are: the tiles' corners, and the centres of a tile's pixels from its corner, in px."""

    corners: Float[Tensor, "t 2"]
    x: Float[Tensor, " P"]
    y: Float[Tensor, " P"]


AlphaOf = Callable[[Tensor, Pixels], Tensor]  # of one row or several a tile, at its pixels


def pixel_centres(like: Tensor) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"]]:
    """x and y of a tile's pixel centres, from its corner."""
    offset = torch.arange(TILE, dtype=like.dtype, device=like.device) + 0.5
    y, x = torch.meshgrid(offset, offset, indexing="ij")
    return x.flatten(), y.flatten()


def _at_centre(row: Float[Tensor, "*n t c"], pixels: Pixels) -> Float[Tensor, "*n t P"]:
    """Alpha, before its cap, of splats at the pixels' centres."""
    u, v = forms_at(row, pixels)
    exponent = torch.addcmul(row[..., OPACITY, None], u, u, value=-1)
    return _audible_exp2(torch.addcmul(exponent, v, v, value=-1))


def forms_at(
    row: Float[Tensor, "*n t c"], pixels: Pixels
) -> tuple[Float[Tensor, "*n t P"], Float[Tensor, "*n t P"]]:
    """The two linear forms of splats at the pixels' centres."""
    forms = [(row[..., i], row[..., j]) for i, j in ((UX, UY), (VX, VY))]
    if torch.compiler.is_compiling():
        dx, dy = offsets_at(row, pixels)
        u, v = (torch.addcmul(i[..., None] * dx, j[..., None], dy) for i, j in forms)
    else:  # as a product of matrices, which no operation on every pixel is faster than
        basis = torch.stack([pixels.x, pixels.y, torch.ones_like(pixels.x)])
        x, y = _from_corner(row, pixels)
        u, v = (torch.stack([i, j, -(i * x + j * y)], dim=-1) @ basis for i, j in forms)
    return u, v


def offsets_at(
    row: Float[Tensor, "*n t c"], pixels: Pixels
) -> tuple[Float[Tensor, "*n t P"], Float[Tensor, "*n t P"]]:
    """Of the pixels' centres from splats, in px."""
    x, y = _from_corner(row, pixels)
    return pixels.x - x[..., None], pixels.y - y[..., None]


def _from_corner(
    row: Float[Tensor, "*n t c"], pixels: Pixels
) -> tuple[Float[Tensor, "*n t"], Float[Tensor, "*n t"]]:
    """Centres of splats from the tiles' corners, in px."""
    return row[..., X] - pixels.corners[:, 0], row[..., Y] - pixels.corners[:, 1]


def _over_pixel(
    mean: Callable[[Tensor, Tensor], Tensor], row: Float[Tensor, "*n t c"], pixels: Pixels
) -> Float[Tensor, "*n t P"]:
    """Alpha, before its cap, of splats: opacity times its means over a pixel's width along both axes."""
    alpha = row[..., OPACITY, None]
    for form, half in zip(forms_at(row, pixels), (HALF_U, HALF_V), strict=True):
        alpha = alpha * mean(form, row[..., half, None])
    return torch.threshold(alpha, BELOW_MIN_ALPHA, 0.0)


def _on_disc(
    smoothed: bool, row: Float[Tensor, "*n t c"], pixels: Pixels
) -> Float[Tensor, "*n t P"]:
    """Alpha, before its cap, of discs where the pixels' rays meet them."""
    e = forms_at(row, pixels)
    dx, dy = offsets_at(row, pixels)
    tilts = row[..., TILT_X, None], row[..., TILT_Y, None]
    ahead = 1 - tilts[0] * dx - tilts[1] * dy
    if smoothed:
        forms = tuple(row[..., i, None] for i in (UX, UY, VX, VY))
        value = smoothed_disc(e, ahead, forms, tilts)
    else:
        value = disc(e, ahead, dx * dx + dy * dy, row[..., LOW_PASS_WIDTH, None])
    return torch.threshold(row[..., OPACITY, None] * value, BELOW_MIN_ALPHA, 0.0)


def _over_square(row: Float[Tensor, "*n t c"], pixels: Pixels) -> Float[Tensor, "*n t P"]:
    """Alpha, before its cap, of splats: opacity times its mean over the pixel's own square, in strips."""
    across, along = forms_at(row, pixels)
    half_across, half_along, slope = (row[..., i, None] for i in (HALF_U, HALF_V, SLOPE))
    total = torch.zeros_like(along)
    for cell in range(CELLS):
        from_middle = (cell - (CELLS - 1) / 2) / CELLS
        share = mean_gaussian(along + 2 * from_middle * half_along, half_along / CELLS)
        total = total + share * mean_gaussian(across + from_middle * slope, half_across)
    return torch.threshold(row[..., OPACITY, None] * total / CELLS, BELOW_MIN_ALPHA, 0.0)


def _audible_exp2(exponent: Float[Tensor, "*n P L"]) -> Float[Tensor, "*n P L"]:
    """2^exponent where that is at least 1/255, else 0; compiled as a polynomial, since a loop pays for calls."""
    if torch.compiler.is_compiling():
        root = _polynomial(torch.relu(exponent - LOG2_SILENT), ROOT_OF_EXP2)
        return torch.where(exponent >= LOG2_MIN_ALPHA, _power(root, SQUARINGS), 0.0)
    return torch.threshold(exponent.clamp(min=LOG2_SILENT).exp2_(), BELOW_MIN_ALPHA, 0.0)


def _polynomial(x: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    *rest, last = coefficients
    value = x * last + rest[-1]
    for coefficient in rest[-2::-1]:
        value = value * x + coefficient
    return value


def _power(x: Tensor, squarings: int) -> Tensor:
    for _ in range(squarings):
        x = x * x
    return x


def _root_of_exp2(squarings: int, degree: int) -> tuple[float, ...]:
    """Coefficients of a polynomial in h ≥ 0 that, squared some times, is 2^(LOG2_SILENT + h), for exponents up to 0.

    It goes through the Chebyshev nodes, as good polynomials do, and has no floor, bits or calls in it.
    """
    angles = math.pi * (torch.arange(degree + 1, dtype=torch.float64) + 0.5) / (degree + 1)
    h = -LOG2_SILENT / 2 * (1 + angles.cos())
    values = torch.exp2((LOG2_SILENT + h) / 2**squarings)
    return tuple(torch.linalg.solve(torch.linalg.vander(h), values).tolist())


SQUARINGS = 3
ROOT_OF_EXP2 = _root_of_exp2(SQUARINGS, degree=6)  # relative error of the power: 1e-6 in float32

ALPHA: dict[PixelKernel, AlphaOf] = {
    "point": _at_centre,
    "integral": partial(_over_pixel, mean_gaussian),
    "logistic": partial(_over_pixel, mean_logistic),
    "square": _over_square,
    "surfel": partial(_on_disc, False),
    "surfel-mip": partial(_on_disc, True),
}
WIDTH: dict[PixelKernel, int] = {
    name: COLUMNS if name == "point" else MEAN_COLUMNS for name in ALPHA
}
DRAWING = Kernel(
    "drawing", _drawing_rows, lambda: (*splat_example(), torch.ones(100_000, 3)), ("m",) * 5
)

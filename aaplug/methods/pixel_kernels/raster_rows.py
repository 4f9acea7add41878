"""Raster rows: what a tile needs to know of a splat, one row of numbers each.

m: splats; p: pairs of a splat and a tile; t: tiles of TILE × TILE px; P: pixels per tile; n: rows per tile; K: splats
of a tile in turn; c: columns.

The first columns are the same for every pixel kernel: two linear forms u, v of the pixel's position, which whiten the
splat, its centre, opacity and colour.  Linear forms keep the digits that the expanded quadratic form of a needle loses.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.interfaces import Pixels
from aaplug.core.kernels import EXAMPLE_SIZE, materialized
from aaplug.core.splats import Splats2D

TILE = 8  # px: side of a tile
PIXELS = TILE * TILE

MIN_LONG_LIST = 8  # rows of a tile, from which on the loop over rows, which waits for memory, should do nothing else

UX, UY, VX, VY, X, Y, OPACITY, RED, GREEN, BLUE = range(10)
COLUMNS = 10  # columns from here on are a kernel's own
FORMS = ((UX, UY), (VX, VY))  # columns of the factors of x and y in u and v


def rows_of(splats: Splats2D, forms: Sequence[Tensor], more: Sequence[Tensor]) -> Float[Tensor, "m c"]:
    """Assemble raster rows from the two forms and a kernel's own columns, and the padding row, whose alpha is 0.

    A tile reads it when its splats have run out.
    """
    assert splats.rgb is not None
    centre, colour = splats.means.unbind(dim=1), splats.rgb.unbind(dim=1)
    rows = torch.stack([*forms, *centre, splats.opacities, *colour, *more], dim=1)
    return torch.cat([rows, rows.new_zeros(1, rows.shape[1])])


def tile_centres(like: Tensor) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"]]:
    """x and y of a tile's pixel centres, from its corner, in px."""
    offset = torch.arange(TILE, dtype=like.dtype, device=like.device) + 0.5
    y, x = torch.meshgrid(offset, offset, indexing="ij")
    return x.flatten(), y.flatten()


def forms_at(
    row: Float[Tensor, "*n t c"], pixels: Pixels, triangular: bool = False
) -> tuple[Float[Tensor, "*n t P"], Float[Tensor, "*n t P"]]:
    """The two linear forms of splats at pixel centres.

    triangular: v depends on y alone, as `whitening_columns` makes it.
    """
    at_corners = pixels.at_corners or forms_at_corners(row, pixels.corners)
    forms = [(row[..., i], row[..., j], k) for (i, j), k in zip(FORMS, at_corners, strict=True)]
    if torch.compiler.is_compiling():
        columns = [[x[..., None] for x in form] for form in forms]
        u, v = (torch.addcmul(k, j, pixels.y) for _, j, k in columns)
        u = torch.addcmul(u, columns[0][0], pixels.x)
        v = v if triangular else torch.addcmul(v, columns[1][0], pixels.x)
    else:  # eagerly a matrix product is faster than any operation per pixel
        basis = torch.stack([pixels.x, pixels.y, torch.ones_like(pixels.x)])
        u, v = (torch.stack(form, dim=-1) @ basis for form in forms)
    return u, v


def forms_at_corners(
    row: Float[Tensor, "*n t c"], corners: Float[Tensor, "t _"]
) -> tuple[Float[Tensor, "*n t"], Float[Tensor, "*n t"]]:
    """The two linear forms of splats at their tiles' corners."""
    x, y = _from_corner(row, corners)
    u, v = (-(row[..., i] * x + row[..., j] * y) for i, j in FORMS)
    return u, v


def offsets_at(row: Float[Tensor, "*n t c"], pixels: Pixels) -> tuple[Float[Tensor, "*n t P"], Float[Tensor, "*n t P"]]:
    """Offset of pixel centres from splats, in px."""
    x, y = _from_corner(row, pixels.corners)
    return pixels.x - x[..., None], pixels.y - y[..., None]


def _from_corner(
    row: Float[Tensor, "*n t c"], corners: Float[Tensor, "t _"]
) -> tuple[Float[Tensor, "*n t"], Float[Tensor, "*n t"]]:
    return row[..., X] - corners[:, 0], row[..., Y] - corners[:, 1]


def next_rows(
    rows: Float[Tensor, "m c"], ids: Int[Tensor, " p"], at: Int[Tensor, " t"], ends: Int[Tensor, " t"], count: int
) -> Float[Tensor, "t K c"]:
    """Raster rows of each tile's next `count` splats, from `at`; the padding row where none are left."""
    place = at[:, None] + torch.arange(count, device=at.device)
    owners = torch.where(place < ends[:, None], ids[place.clamp(max=ids.shape[0] - 1)], rows.shape[0] - 1)
    if count >= MIN_LONG_LIST:
        owners = materialized(owners)
    return materialized(rows.index_select(0, owners.flatten()).view(-1, count, rows.shape[1]))


def splat_example() -> tuple[Tensor, ...]:
    """Means, covariances, determinants and opacities to compile for."""
    m = EXAMPLE_SIZE
    means = torch.linspace(0.0, 99.0, 2 * m).view(m, 2)
    return means, torch.tensor([3.0, 1.0, 2.0]).repeat(m, 1), torch.full((m,), 5.0), torch.ones(m)

"""The fast rasterizer: tiles, one depth sort, and compositing as elementwise array code that compiles to one loop.

t: tiles of TILE × TILE px; s: spans, p: pairs of a splat and a tile; K: splats a pass; P: pixels a tile.

1. A splat becomes two linear forms u, v of the pixel's position with u² + v² = log2(e)/2 · dᵀ C⁻¹ d, so that alpha is
   2^(log2 o − u² − v²).  Forms lose no digits where the expanded quadratic of a needle would.
2. Splats are paired, nearest first, with the tiles that their alpha ≥ 1/255 ellipse reaches.  What an ellipse has in a
   row of tiles is convex, so the tiles are a run of columns between its two ends there: a splat becomes spans, a span
   becomes pairs, and one stable sort of the pairs by tile does the rest.
3. Tiles are composited K splats a pass, those with most splats first, so that the ones that are done are the last;
   tiles whose pixels are all saturated leave now and then.

The backward pass is a forward sweep too: with S = Σ g·w·c of a pixel, known from the image, the rest R = S − Σ_{j≤k}
g·w·c gives ∂L/∂alpha_k = T_k g·c_k − R/(1 − alpha_k), so that T at each pass's start is all that is kept.

Bands of tile rows bound the memory: as many as the budget has room for candidate pairs.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from math import log2
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.interfaces import PixelKernel
from aaplug.kernels import EAGER, Kernel, Kernels
from aaplug.rasterizers.blending import blended, table_of
from aaplug.rasterizers.extents import SURFELS, extents_of
from aaplug.rasterizers.pixels import CELLS, mean_gaussian, mean_logistic
from aaplug.rasterizers.rules import MAX_ALPHA, MIN_TRANSMITTANCE, over
from aaplug.rasterizers.surfels import NARROWEST, disc, smoothed_disc
from aaplug.splats import MIN_ALPHA, Render, Splats2D, principal_columns, reach, whitening_columns

TILE = 8  # px
PASS = 8  # splats composited in one pass: more compile slowly, fewer load and store more
CHECK_EVERY = 4  # passes between looks at which tiles are saturated
COMPACT_BELOW = 3 / 4  # share of tiles still going at which the others leave
BLENDED_TILES = 64  # of about equally many splats, blended together
MEMORY = 1e9  # bytes
PAIR_BYTES = 64  # of a candidate pair while a band is binned, measured
HALF_LOG2_E = 0.5 * log2(torch.e)
LN_2 = math.log(2)
LOG2_SILENT = -9.0  # log2 of an alpha below 1/255; stops exp2 before it underflows, which is slow
LOG2_MIN_ALPHA = torch.tensor(MIN_ALPHA).log2().item()
REACH_SLACK = (
    1e-4  # relative, on the squared reach: float32 rounding never drops a pixel that counts
)

# `threshold` keeps what is above its bound; these keep what is at the bound as well.
BELOW_MIN_ALPHA = torch.nextafter(torch.tensor(MIN_ALPHA), torch.tensor(0.0)).item()
BELOW_MIN_TRANSMITTANCE = torch.nextafter(torch.tensor(MIN_TRANSMITTANCE), torch.tensor(0.0)).item()
SURELY = 1e9  # times anything that is not 0 here is over 1


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

# columns of a splat's drawing parameters; the last three only where alpha is a mean over the pixel
UX, UY, VX, VY, X, Y, OPACITY, RED, GREEN, BLUE, HALF_U, HALF_V, SLOPE = range(13)
TILT_X, TILT_Y, LOW_PASS_WIDTH = HALF_U, HALF_V, SLOPE  # of a disc
COLUMNS, MEAN_COLUMNS = 10, 13
BOX = 7  # where the box of tiles begins in a row of the table


@dataclass(frozen=True)
class Tiled:
    """Draws in tiles, in the splats' precision; differentiable.

    kernels: how the elementwise stages run.  memory: bytes that binning may take beside the scene and the image.
    """

    kernels: Kernels = EAGER
    memory: float = MEMORY

    def __call__(
        self,
        splats: Splats2D,
        hw: tuple[int, int],
        background: tuple[float, float, float],
        pixel: PixelKernel = "point",
    ) -> Render:
        """Draw the splats."""
        grid = (-(-hw[0] // TILE), -(-hw[1] // TILE))
        extents = extents_of(splats, pixel) or splats
        paint = self._painter(splats, pixel)
        planes = [
            _untiled(paint(bins), grid[1])[:, : hw[1]]
            for bins in bands(extents, grid, self.kernels, self.memory)
        ]
        image = (planes[0] if len(planes) == 1 else torch.cat(planes))[: hw[0]]
        return over(image[..., :3], image[..., 3], background)

    def _painter(self, splats: Splats2D, pixel: PixelKernel) -> Callable[["Bins"], Tensor]:
        """What paints the tiles of a band."""
        if pixel == "blending":
            return partial(_blend, table_of(splats), splats)
        return partial(
            composite, drawing_of(splats, self.kernels, pixel), kernels=self.kernels, pixel=pixel
        )


def _untiled(tiles: Float[Tensor, "4 t P"], columns: int) -> Float[Tensor, "h w 4"]:
    """Tiles of whole rows put in their places."""
    image = tiles.view(4, -1, columns, TILE, TILE).permute(1, 3, 2, 4, 0)
    return image.reshape(-1, columns * TILE, 4)


@dataclass(frozen=True)
class Bins:
    """Which splats each tile of a band draws: `splats[first[t] : first[t] + counts[t]]`, nearest first.

    splats: with K more at the end, so that a pass may read on.
    origins: the tiles' top left corners, in px.
    """

    splats: Int[Tensor, " p_and_K"]
    first: Int[Tensor, " t"]
    counts: Int[Tensor, " t"]
    origins: Float[Tensor, "t 2"]


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


# --------------------------------------------------------------------------------------------------------- binning


@torch.no_grad()
def bands(
    splats: Splats2D, grid: tuple[int, int], kernels: Kernels, memory: float = MEMORY
) -> Iterator[Bins]:
    """Bins of bands of tile rows, from the top."""
    order = _depth_order(splats.depths)
    table = _table(splats, grid, kernels)
    for rows in _rows(table, grid[0], max(1, int(memory / PAIR_BYTES))):
        yield _bin(table, order, rows, grid[1], kernels)


def _depth_order(depths: Float[Tensor, " m"]) -> Int[Tensor, " m"]:
    """Nearest first, in scene order where equal.  Positive floats sort as their bits, and integers sort faster."""
    keys = depths.contiguous().view(torch.int32) if depths.dtype == torch.float32 else depths
    return torch.sort(keys, stable=True).indices


def _table(splats: Splats2D, grid: tuple[int, int], kernels: Kernels) -> Float[Tensor, "m 11"]:
    """What the spans of each splat are made of, with the box of tiles around its ellipse in the last four columns.

    A box is its first tile in x and y and the ones after its last.
    """
    limit = splats.means.new_tensor([grid[1], grid[0]])
    (table,) = kernels.run(TABLE, splats.means, splats.covs, splats.dets, splats.opacities, limit)
    return table


def _table_rows(
    means: Float[Tensor, "m 2"],
    covs: Float[Tensor, "m 3"],
    dets: Float[Tensor, " m"],
    opacities: Float[Tensor, " m"],
    limit: Float[Tensor, " 2"],
) -> tuple[Float[Tensor, "m 11"]]:
    """Centre; of x given y the slope and the variance; yy; squared reach; height of the rightmost point; box."""
    xx, xy, yy = covs.unbind(dim=1)
    reached = reach(opacities) * (1 + REACH_SLACK)
    reached = torch.where(((xx + yy) / dets).isfinite(), reached, -1.0)  # no width: not drawn
    lows, highs = [], []
    for mean, variance, end in zip(means.unbind(dim=1), (xx, yy), limit.unbind(), strict=True):
        half = (reached.clamp(min=0.0) * variance).sqrt()
        low = torch.minimum(((mean - half) / TILE).floor().clamp(min=0.0), end)
        high = torch.minimum(((mean + half) / TILE).floor().add(1).clamp(min=0.0), end)
        lows.append(low)
        highs.append(torch.maximum(low, high))
    rightmost = xy * (reached.clamp(min=0.0) / xx).sqrt()
    ellipse = [xy / yy, dets / yy, yy, reached, rightmost]
    return (torch.stack([*means.unbind(dim=1), *ellipse, *lows, *highs], dim=1),)


def _rows(table: Float[Tensor, "m 11"], rows: int, budget: int) -> list[tuple[int, int]]:
    """Cut the grid into runs of tile rows of about `budget` candidate pairs, at least a row each."""
    left, top, right, bottom = table[:, BOX:].long().unbind(dim=1)
    change = top.new_zeros(rows + 1)
    change.index_add_(0, top, right - left).index_add_(0, bottom, left - right)
    ends = change.cumsum(0).cumsum(0)[:rows]  # candidates down to each row
    marks = ends.new_tensor(range(budget, int(ends[-1]), budget))
    cuts = [0, *(torch.searchsorted(ends, marks) + 1).tolist(), rows]
    return [(a, b) for a, b in pairwise(dict.fromkeys(cuts)) if b > a]


def _bin(
    table: Float[Tensor, "m 11"],
    order: Int[Tensor, " m"],
    rows: tuple[int, int],
    columns: int,
    kernels: Kernels,
) -> Bins:
    """Pair splats, nearest first, with the tiles that they reach in a band of rows."""
    _, top, _, bottom = table[:, BOX:].unbind(dim=1)
    heights = (bottom.clamp(*rows) - top.clamp(*rows)).long().index_select(0, order)
    ranks = torch.repeat_interleave(heights)
    band = order.new_tensor([rows[0], columns])
    args = (ranks, order, _starts(heights), table, band)
    first, widths, owners = kernels.run(SPANS, *args)
    spans = torch.repeat_interleave(widths)
    tiles, splats = kernels.run(PAIRS, spans, _starts(widths), first, owners)
    size = (rows[1] - rows[0]) * columns
    if size < torch.iinfo(torch.int16).max:
        tiles = tiles.short()  # half the bits sort in half the time
    sorted_tiles, pairs = torch.sort(tiles, stable=True)
    tile = torch.arange(size, device=table.device)
    ends = torch.searchsorted(sorted_tiles, tile.to(tiles), right=True)
    first = torch.cat([ends.new_zeros(1), ends[:-1]])
    origins = torch.stack([tile % columns, tile // columns + rows[0]], dim=1) * TILE
    drawn = torch.cat([splats.index_select(0, pairs), splats.new_zeros(PASS)])
    return Bins(drawn, first, ends - first, origins.to(table.dtype))


def _starts(counts: Int[Tensor, " m"]) -> Int[Tensor, " m"]:
    return counts.cumsum(0) - counts


def _spans(
    ranks: Int[Tensor, " s"],
    order: Int[Tensor, " m"],
    starts: Int[Tensor, " m"],
    table: Float[Tensor, "m 11"],
    band: Int[Tensor, " 2"],
) -> tuple[Int[Tensor, " s"], Int[Tensor, " s"], Int[Tensor, " s"]]:
    """First tile of the band, number of tiles, and splat, of what a splat reaches in one row of tiles.

    At height h over its centre the ellipse goes from slope·h − w to slope·h + w, w² = variance (reach − h²/yy).  Its
    right end grows up to the rightmost point and shrinks after it, so that over the pixel centres of a row it is
    farthest at the height nearest to that point's.
    """
    top_row, columns = band.unbind()
    owners = order[ranks]
    row = table[owners]
    x, y, slope, variance, yy, reached, rightmost, _, low_y, _, _ = row.unbind(dim=1)
    down = (torch.arange(ranks.shape[0], device=ranks.device) - starts[ranks]).to(x)
    tile_y = torch.maximum(low_y, top_row) + down
    top = tile_y * TILE + 0.5 - y
    ends = []
    for sign in (-1, 1):
        h = torch.minimum(torch.maximum(sign * rightmost, top), top + (TILE - 1))
        width = (variance * (reached - h * h / yy).clamp(min=0.0)).sqrt()
        slack = REACH_SLACK * (width + (slope * h).abs())
        ends.append(x + slope * h + sign * (width + slack))
    nearest = torch.minimum(torch.maximum(torch.zeros_like(top), top), top + (TILE - 1))
    reaches = nearest * nearest / yy <= reached
    limit = columns.to(x)
    left = torch.minimum(((ends[0] + 0.5 - TILE) / TILE).ceil().clamp(min=0.0), limit)
    right = torch.minimum(((ends[1] - 0.5) / TILE).floor() + 1, limit)
    width = torch.where(reaches, (right - left).clamp(min=0.0), 0.0)
    return (tile_y.long() - top_row) * columns + left.long(), width.long(), owners.int()


def _pairs(
    spans: Int[Tensor, " p"],
    starts: Int[Tensor, " s"],
    first: Int[Tensor, " s"],
    owners: Int[Tensor, " s"],
) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"]]:
    """Tile and splat of each pair."""
    place = torch.arange(spans.shape[0], device=spans.device)
    return (place + (first - starts)[spans]).int(), owners[spans]


# ----------------------------------------------------------------------------------------------------- compositing


def composite(
    drawing: Float[Tensor, "m c"], bins: Bins, kernels: Kernels, pixel: PixelKernel = "point"
) -> Float[Tensor, "4 t P"]:
    """Premultiplied red, green, blue, and alpha, of every pixel of every tile."""
    if drawing.requires_grad and torch.is_grad_enabled():
        return _Composite.apply(drawing, bins, kernels, pixel)  # pyright: ignore[reportReturnType]
    return _forward(drawing, bins, kernels, pixel)


@dataclass(frozen=True)
class _Turn:
    """What was composited between two looks at which tiles are done.

    splats: first and after last of each tile, from where the turn began.  before: of each pass the transmittance of
    the tiles, the first of `tiles`, that took part.
    """

    tiles: Int[Tensor, " t"]
    splats: tuple[Int[Tensor, " t"], Int[Tensor, " t"]]
    origins: Float[Tensor, "t 2"]
    before: list[Float[Tensor, "n P"]]


def _forward(
    drawing: Float[Tensor, "m c"],
    bins: Bins,
    kernels: Kernels,
    pixel: PixelKernel,
    turns: list[_Turn] | None = None,
) -> Float[Tensor, "4 all P"]:
    """The image; the turns that made it are put into `turns`, in order."""
    image = drawing.new_zeros(4, len(bins.counts), TILE * TILE)
    order = torch.sort(bins.counts, descending=True, stable=True).indices
    order = order[: int((bins.counts > 0).sum())]
    for tiles in order.split(kernels.tiles):
        _composite_block(drawing, bins, tiles, image, kernels, COMPOSITE[pixel], turns)
    return image


def _composite_block(
    drawing: Float[Tensor, "m c"],
    bins: Bins,
    tiles: Int[Tensor, " t"],
    image: Float[Tensor, "4 all P"],
    kernels: Kernels,
    chunk: Kernel,
    turns: list[_Turn] | None,
) -> None:
    """Composite some tiles, longest first, into the image, until they are drawn out or saturated."""
    local = _pixel_centres(drawing)
    state = drawing.new_zeros(5, len(tiles), TILE * TILE)
    state[0] = 1
    start = 0
    while len(tiles):
        columns = [x.index_select(0, tiles) for x in (bins.first, bins.counts, bins.origins)]
        first, counts, origins = columns
        at, ends, ones = first + start, first + counts, torch.ones_like(origins[:, 0])
        going = _going(counts - start)
        kept, before = tiles[:0], []
        if turns is not None:
            turns.append(_Turn(tiles, (at, ends), origins, before))
        for turn, n in enumerate(going):
            if turns is not None:
                before.append(state[0, :n].clone())
            columns = (bins.splats, at[:n] + turn * PASS, ends[:n], origins[:n])
            kernels.run(chunk, drawing, *columns, *state[:, :n].unbind(), *local, ones[:n])
            start += PASS
            if turn % CHECK_EVERY == CHECK_EVERY - 1 and turn + 1 < len(going):
                left = going[turn + 1]
                alive = state[0, :left].amax(dim=1) > 0
                if int(alive.sum()) < COMPACT_BELOW * left:
                    kept = alive.nonzero().squeeze(1)
                    break
        image.index_copy_(1, tiles, state[1:])
        tiles, state = tiles.index_select(0, kept), state.index_select(1, kept)


def _going(counts: Int[Tensor, " t"]) -> list[int]:
    """How many tiles take part in each pass, from their splats, most first."""
    passes = (counts + (PASS - 1)) // PASS
    turns = torch.arange(int(passes[0]), device=counts.device)
    return (len(passes) - torch.searchsorted(passes.flip(0), turns, right=True)).tolist()


def _pixel_centres(like: Tensor) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"]]:
    """x and y of a tile's pixel centres, from its corner."""
    offset = torch.arange(TILE, dtype=like.dtype, device=like.device) + 0.5
    y, x = torch.meshgrid(offset, offset, indexing="ij")
    return x.flatten(), y.flatten()


class _Pixels(NamedTuple):
    """Where the pixels of tiles are: the tiles' corners, and the centres of a tile's pixels from its corner, in px."""

    corners: Float[Tensor, "t 2"]
    x: Float[Tensor, " P"]
    y: Float[Tensor, " P"]


AlphaOf = Callable[[Tensor, _Pixels], Tensor]  # of one row or several a tile, at its pixels


def _chunk(
    alpha_of: AlphaOf,
    drawing: Float[Tensor, "m c"],
    ids: Int[Tensor, " p"],
    at: Int[Tensor, " t"],
    ends: Int[Tensor, " t"],
    origins: Float[Tensor, "t 2"],
    T: Float[Tensor, "t P"],
    red: Float[Tensor, "t P"],
    green: Float[Tensor, "t P"],
    blue: Float[Tensor, "t P"],
    hidden: Float[Tensor, "t P"],
    local_x: Float[Tensor, " P"],
    local_y: Float[Tensor, " P"],
    one: Float[Tensor, " t"],
) -> tuple[()]:
    """Composite splats at to at + K of each tile into its transmittance (0 once a pixel has stopped), colour and alpha.

    one: ones; a column of them in each step keeps the compiler to one loop over tiles.
    """
    pixels = _Pixels(origins, local_x, local_y)
    before = T
    for row, alpha in _splats(alpha_of, drawing, ids, at, ends, pixels):
        after = before * _left(alpha, one[:, None])
        weight = _where_above(BELOW_MIN_TRANSMITTANCE, after, before - after)
        before = after
        red.addcmul_(weight, row[:, RED, None])
        green.addcmul_(weight, row[:, GREEN, None])
        blue.addcmul_(weight, row[:, BLUE, None])
        hidden.add_(weight)
    T.copy_(torch.threshold(before, BELOW_MIN_TRANSMITTANCE, 0.0))
    return ()


def _splats(
    alpha_of: AlphaOf,
    drawing: Float[Tensor, "m c"],
    ids: Int[Tensor, " p"],
    at: Int[Tensor, " t"],
    ends: Int[Tensor, " t"],
    pixels: _Pixels,
) -> Iterator[tuple[Float[Tensor, "t c"], Float[Tensor, "t P"]]]:
    """Row and alpha of K splats of each tile in turn, of the one that draws nothing after the tile's last.

    Array code finds the alphas of all at once, a compiled loop each where it is needed.
    """
    if torch.compiler.is_compiling():
        for k in range(PASS):
            row = drawing[torch.where(at + k < ends, ids[at + k], -1)]
            yield row, alpha_of(row, pixels)
    else:
        place = at + torch.arange(PASS, device=at.device)[:, None]
        rows = drawing[torch.where(place < ends, ids[place], -1)]
        yield from zip(rows.unbind(), alpha_of(rows, pixels).unbind(), strict=True)


def _at_centre(row: Float[Tensor, "*n t c"], pixels: _Pixels) -> Float[Tensor, "*n t P"]:
    """Alpha, before its cap, of splats at the pixels' centres."""
    u, v = _forms(row, pixels)
    exponent = torch.addcmul(row[..., OPACITY, None], u, u, value=-1)
    return _audible_exp2(torch.addcmul(exponent, v, v, value=-1))


def _forms(
    row: Float[Tensor, "*n t c"], pixels: _Pixels
) -> tuple[Float[Tensor, "*n t P"], Float[Tensor, "*n t P"]]:
    """The two linear forms of splats at the pixels' centres."""
    pairs = [(row[..., i], row[..., j]) for i, j in ((UX, UY), (VX, VY))]
    if torch.compiler.is_compiling():
        dx, dy = _offsets(row, pixels)
        u, v = (torch.addcmul(i[..., None] * dx, j[..., None], dy) for i, j in pairs)
    else:  # as a product of matrices, which no operation on every pixel is faster than
        basis = torch.stack([pixels.x, pixels.y, torch.ones_like(pixels.x)])
        x, y = row[..., X] - pixels.corners[:, 0], row[..., Y] - pixels.corners[:, 1]
        u, v = (torch.stack([i, j, -(i * x + j * y)], dim=-1) @ basis for i, j in pairs)
    return u, v


def _offsets(
    row: Float[Tensor, "*n t c"], pixels: _Pixels
) -> tuple[Float[Tensor, "*n t P"], Float[Tensor, "*n t P"]]:
    """Of the pixels' centres from splats, in px."""
    x, y = row[..., X] - pixels.corners[:, 0], row[..., Y] - pixels.corners[:, 1]
    return pixels.x - x[..., None], pixels.y - y[..., None]


def _over_pixel(
    mean: Callable[[Tensor, Tensor], Tensor], row: Float[Tensor, "*n t c"], pixels: _Pixels
) -> Float[Tensor, "*n t P"]:
    """Alpha, before its cap, of splats: opacity times its means over a pixel's width along both axes."""
    alpha = row[..., OPACITY, None]
    for form, half in zip(_forms(row, pixels), (HALF_U, HALF_V), strict=True):
        alpha = alpha * mean(form, row[..., half, None])
    return torch.threshold(alpha, BELOW_MIN_ALPHA, 0.0)


def _on_disc(
    smoothed: bool, row: Float[Tensor, "*n t c"], pixels: _Pixels
) -> Float[Tensor, "*n t P"]:
    """Alpha, before its cap, of discs where the pixels' rays meet them."""
    e = _forms(row, pixels)
    dx, dy = _offsets(row, pixels)
    tilts = row[..., TILT_X, None], row[..., TILT_Y, None]
    ahead = 1 - tilts[0] * dx - tilts[1] * dy
    if smoothed:
        forms = tuple(row[..., i, None] for i in (UX, UY, VX, VY))
        value = smoothed_disc(e, ahead, forms, tilts)
    else:
        value = disc(e, ahead, dx * dx + dy * dy, row[..., LOW_PASS_WIDTH, None])
    return torch.threshold(row[..., OPACITY, None] * value, BELOW_MIN_ALPHA, 0.0)


def _over_square(row: Float[Tensor, "*n t c"], pixels: _Pixels) -> Float[Tensor, "*n t P"]:
    """Alpha, before its cap, of splats: opacity times its mean over the pixel's own square, in strips."""
    across, along = _forms(row, pixels)
    half_across, half_along, slope = (row[..., i, None] for i in (HALF_U, HALF_V, SLOPE))
    total = torch.zeros_like(along)
    for cell in range(CELLS):
        from_middle = (cell - (CELLS - 1) / 2) / CELLS
        share = mean_gaussian(along + 2 * from_middle * half_along, half_along / CELLS)
        total = total + share * mean_gaussian(across + from_middle * slope, half_across)
    return torch.threshold(row[..., OPACITY, None] * total / CELLS, BELOW_MIN_ALPHA, 0.0)


def _left(alpha: Float[Tensor, "t P"], one: Float[Tensor, "t 1"]) -> Float[Tensor, "t P"]:
    """The share of the light that a splat lets through."""
    least = 1 - MAX_ALPHA
    if torch.compiler.is_compiling():
        return torch.relu(MAX_ALPHA * one - alpha) + least
    return (one - alpha).clamp_(min=least)


# Array code pays for every operation and most for choosing; a compiled loop pays for calls, of which exp2 is one, and
# for minima and maxima, which look for NaN.  So these three are written for each.


def _audible_exp2(exponent: Float[Tensor, "*n t P"]) -> Float[Tensor, "*n t P"]:
    """2^exponent where that is at least 1/255, else 0."""
    if torch.compiler.is_compiling():
        root = _polynomial(torch.relu(exponent - LOG2_SILENT), ROOT_OF_EXP2)
        return torch.where(exponent >= LOG2_MIN_ALPHA, _power(root, SQUARINGS), 0.0)
    return torch.threshold(exponent.clamp(min=LOG2_SILENT).exp2_(), BELOW_MIN_ALPHA, 0.0)


def _where_above(bound: float, test: Tensor, value: Tensor) -> Tensor:
    """A value, not negative, where a test is above a bound, itself not negative; else 0."""
    if torch.compiler.is_compiling():
        return torch.where(test > bound, value, 0.0)
    return torch.minimum(torch.threshold(test, bound, 0.0).mul_(SURELY), value)


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


class _Composite(torch.autograd.Function):
    """Compositing with its own backward pass."""

    @staticmethod
    def forward(
        ctx: Any, drawing: Tensor, bins: Bins, kernels: Kernels, pixel: PixelKernel
    ) -> Tensor:
        turns: list[_Turn] = []
        image = _forward(drawing, bins, kernels, pixel, turns)
        ctx.save_for_backward(drawing, image)
        ctx.rest = (bins, turns, kernels, pixel)
        return image

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None]:
        drawing, image = ctx.saved_tensors
        return _backward(drawing, image, grads[0], *ctx.rest), None, None, None


def _backward(
    drawing: Float[Tensor, "m c"],
    image: Float[Tensor, "4 all P"],
    grad: Float[Tensor, "4 all P"],
    bins: Bins,
    turns: list[_Turn],
    kernels: Kernels,
    pixel: PixelKernel,
) -> Float[Tensor, "m c"]:
    """Gradient of the drawing parameters."""
    rest = (image * grad).sum(dim=0)
    local = _pixel_centres(drawing)
    total, monomials = torch.zeros_like(drawing), _monomials(drawing)
    for turn in turns:
        left, grads = rest.index_select(0, turn.tiles), grad.index_select(1, turn.tiles)
        colours = grads[:3].permute(1, 2, 0).contiguous()
        ones = drawing.new_ones(len(turn.tiles))
        for i, before in enumerate(turn.before):
            n = len(before)
            at, ends = turn.splats
            where = (bins.splats, at[:n] + i * PASS, ends[:n])
            pixels = (before, left[:n], *grads[:, :n].unbind(), *local, ones[:n])
            weights, moves = kernels.run(
                CHUNK_BACKWARD[pixel], drawing, *where, turn.origins[:n], *pixels
            )
            splats = (drawing, *where, turn.origins[:n])
            by_colour = torch.bmm(weights, colours[:n])
            if pixel == "point":
                owners, added = kernels.run(CHUNK_SUMS, *splats, moves @ monomials, by_colour)
            else:
                owners, added = _sums_by_autograd(ALPHA[pixel], *splats, moves, by_colour)
            owners = owners.view(-1, 1).expand(-1, drawing.shape[1])
            total.scatter_add_(0, owners, added.reshape(-1, drawing.shape[1]))
        rest.index_copy_(0, turn.tiles, left)
    return total


def _sums_by_autograd(
    alpha_of: AlphaOf,
    drawing: Float[Tensor, "m c"],
    ids: Int[Tensor, " p"],
    at: Int[Tensor, " t"],
    ends: Int[Tensor, " t"],
    origins: Float[Tensor, "t 2"],
    moves: Float[Tensor, "t K P"],
    colours: Float[Tensor, "t K 3"],
) -> tuple[Int[Tensor, "t K"], Float[Tensor, "t K c"]]:
    """What `_chunk_sums` gives, for any kernel: from the gradient of log2 alpha by autograd of alpha."""
    owners = _owners(drawing, ids, at, ends)
    pixels = _Pixels(origins, *_pixel_centres(drawing))
    with torch.enable_grad():
        rows = drawing[owners].detach().requires_grad_()
        alpha = alpha_of(rows.transpose(0, 1), pixels).transpose(0, 1)
        grads = torch.where(alpha > 0, moves / (LN_2 * alpha), 0.0).detach()
        (added,) = torch.autograd.grad(alpha, rows, grads)
    added[..., RED : BLUE + 1] = colours
    return owners, added


def _owners(
    drawing: Float[Tensor, "m c"],
    ids: Int[Tensor, " p"],
    at: Int[Tensor, " t"],
    ends: Int[Tensor, " t"],
) -> Int[Tensor, "t K"]:
    """The splat of each of K places of a tile, or the one that draws nothing."""
    place = at[:, None] + torch.arange(PASS, device=at.device)
    return torch.where(place < ends[:, None], ids[place], drawing.shape[0] - 1).long()


def _monomials(like: Tensor) -> Float[Tensor, "P 6"]:
    """1, x, y, x², xy, y² of a tile's pixel centres from its middle, where no digits are lost."""
    x, y = (centre - TILE / 2 for centre in _pixel_centres(like))
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], dim=1)


def _chunk_backward(
    alpha_of: AlphaOf,
    drawing: Float[Tensor, "m c"],
    ids: Int[Tensor, " p"],
    at: Int[Tensor, " t"],
    ends: Int[Tensor, " t"],
    origins: Float[Tensor, "t 2"],
    T: Float[Tensor, "t P"],
    rest: Float[Tensor, "t P"],
    g_red: Float[Tensor, "t P"],
    g_green: Float[Tensor, "t P"],
    g_blue: Float[Tensor, "t P"],
    g_hidden: Float[Tensor, "t P"],
    local_x: Float[Tensor, " P"],
    local_y: Float[Tensor, " P"],
    one: Float[Tensor, " t"],
) -> tuple[Float[Tensor, "t K P"], Float[Tensor, "t K P"]]:
    """The weight of each of K splats, and the gradient of log2 alpha, at each pixel; takes its share from `rest`."""
    pixels = _Pixels(origins, local_x, local_y)
    weights, gradients = [], []
    behind = rest
    for row, alpha in _splats(alpha_of, drawing, ids, at, ends, pixels):
        left = _left(alpha, one[:, None])
        after = T * left
        weight = _where_above(BELOW_MIN_TRANSMITTANCE, after, T - after)
        colour = row[:, RED, None] * g_red + row[:, GREEN, None] * g_green
        colour = colour + row[:, BLUE, None] * g_blue + g_hidden
        behind = behind - weight * colour
        # d alpha / d log2 alpha = alpha ln 2, where alpha is neither skipped (then it is 0) nor capped nor too late
        moves = _where_above(BELOW_MIN_TRANSMITTANCE, after, LN_2 * alpha)
        moves = _where_above(0.0, MAX_ALPHA - alpha, moves)
        weights.append(weight)
        gradients.append(moves * (T * colour - behind / left))
        T = after
    rest.copy_(behind)
    return torch.stack(weights, dim=1), torch.stack(gradients, dim=1)


def _chunk_sums(
    drawing: Float[Tensor, "m 10"],
    ids: Int[Tensor, " p"],
    at: Int[Tensor, " t"],
    ends: Int[Tensor, " t"],
    origins: Float[Tensor, "t 2"],
    moments: Float[Tensor, "t K 6"],
    colours: Float[Tensor, "t K 3"],
) -> tuple[Int[Tensor, "t K"], Float[Tensor, "t K 10"]]:
    """The splat of each of K places of a tile, and what the tile adds to the gradient of its parameters.

    moments: sums over pixels of the gradient of the exponent, log2 o − u² − v², times the monomials.
    """
    owners = _owners(drawing, ids, at, ends)
    ux, uy, vx, vy, x, y, *_ = drawing[owners].unbind(dim=2)
    dx, dy = origins[:, 0, None] + TILE / 2 - x, origins[:, 1, None] + TILE / 2 - y
    s, sx, sy, sxx, sxy, syy = moments.unbind(dim=2)
    forms = []
    to_x, to_y = torch.zeros_like(s), torch.zeros_like(s)
    for i, j in ((ux, uy), (vx, vy)):
        middle = i * dx + j * dy
        along = middle * s + i * sx + j * sy  # Σ s u
        forms += [dx * along + middle * sx + i * sxx + j * sxy]  # Σ s u dx
        forms += [dy * along + middle * sy + i * sxy + j * syy]
        to_x, to_y = to_x + i * along, to_y + j * along
    shape = [-2 * form for form in forms]
    return owners, torch.stack([*shape, 2 * to_x, 2 * to_y, s, *colours.unbind(dim=2)], dim=2)


def _blend(table: Float[Tensor, "m 12"], splats: Splats2D, bins: Bins) -> Float[Tensor, "4 t P"]:
    """The same by the rule of `blending`, in array code alone."""
    local = _pixel_centres(table)
    order = torch.sort(bins.counts, descending=True, stable=True).indices
    parts = []
    for tiles in order.split(BLENDED_TILES):
        x, y = (bins.origins[tiles, i, None] + local[i] for i in (0, 1))
        lists = (bins.splats, bins.first[tiles], bins.counts[tiles])
        parts.append(blended(table, splats.window, *lists, x, y))
    return torch.cat(parts, dim=1)[:, order.argsort()].to(splats.means)


# --------------------------------------------------------------------------------------------------------- kernels
# Examples are as large as real work: the compiler decides by them which loops run in threads.


def _tile_example(states: int, columns: int = COLUMNS) -> tuple[Tensor, ...]:
    tiles, rows = 1024, 4096
    drawing = torch.linspace(0.01, 0.1, rows * columns).view(rows, columns)
    ids = torch.arange((tiles + 1) * PASS, dtype=torch.int32) % rows
    at = torch.arange(tiles) * PASS
    state = [torch.full((tiles, TILE * TILE), 0.5) for _ in range(states)]
    local = _pixel_centres(torch.zeros(1))
    return drawing, ids, at, at + PASS, torch.ones(tiles, 2), *state, *local, torch.ones(tiles)


def _sums_example() -> tuple[Tensor, ...]:
    *where, _ = _tile_example(0)
    moments, colours = (torch.linspace(0.1, 1.0, 1024 * PASS * n) for n in (6, 3))
    return *where[:5], moments.view(1024, PASS, 6), colours.view(1024, PASS, 3)


def _splat_example() -> tuple[Tensor, ...]:
    m = 100_000
    means = torch.linspace(0.0, 99.0, 2 * m).view(m, 2)
    return means, torch.tensor([3.0, 1.0, 2.0]).repeat(m, 1), torch.full((m,), 5.0), torch.ones(m)


def _spans_example() -> tuple[Tensor, ...]:
    boxes = 50_000
    row = [12.0, 12.0, 0.5, 1.0, 1.0, 9.0, 0.5, 0.0, 0.0, 2.0, 4.0]
    table = torch.tensor(row).repeat(boxes, 1)
    order = torch.arange(boxes)
    return torch.arange(4 * boxes) // 4, order, 4 * order, table, torch.tensor([0, 4])


def _pairs_example() -> tuple[Tensor, ...]:
    spans = torch.arange(50_000)
    return torch.arange(200_000) // 4, 4 * spans, spans % 999, spans.int()


DRAWING = Kernel(
    "drawing", _drawing_rows, lambda: (*_splat_example(), torch.ones(100_000, 3)), ("m",) * 5
)
TABLE = Kernel(
    "table", _table_rows, lambda: (*_splat_example(), torch.full((2,), 9.0)), ("m",) * 4 + (None,)
)
SPANS = Kernel("spans", _spans, _spans_example, ("s", "m", "m", "m", None))
PAIRS = Kernel("pairs", _pairs, _pairs_example, ("p", "s", "s", "s"))
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


def _by_pixel_kernel(
    ending: str, chunk: Callable[..., Any], states: int
) -> dict[PixelKernel, Kernel]:
    """A chunk that has this many states a pixel, with each rule of what alpha is."""
    return {
        name: Kernel(
            f"composite-{name}{ending}",
            partial(chunk, alpha_of),
            partial(_tile_example, states, WIDTH[name]),
            ("m", "p", *(3 + states) * ("t",), None, None, "t"),
        )
        for name, alpha_of in ALPHA.items()
    }


COMPOSITE = _by_pixel_kernel("", _chunk, 5)
CHUNK_BACKWARD = _by_pixel_kernel("-backward", _chunk_backward, 6)
CHUNK_SUMS = Kernel("composite-sums", _chunk_sums, _sums_example, ("m", "p", *5 * ("t",)))

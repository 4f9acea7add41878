"""The fast rasterizer: tiles, one depth sort, and compositing as elementwise array code that compiles to one loop.

t: tiles of TILE × TILE px; p: pairs of a splat and a tile; K: splats a pass; P: pixels a tile.

1. A splat becomes two linear forms u, v of the pixel's position with u² + v² = log2(e)/2 · dᵀ C⁻¹ d, so that alpha is
   2^(log2 o − u² − v²).  Forms lose no digits where the expanded quadratic of a needle would.
2. Splats are paired, nearest first, with the tiles in the box around their alpha ≥ 1/255 ellipse; pairs whose ellipse
   misses the tile go to a bin that nobody draws, and one stable sort by tile does the rest.
3. Tiles are composited K splats a pass, those with most splats first; finished tiles leave.

The backward pass is a forward sweep too: with S = Σ g·w·c of a pixel, known from the image, the rest R = S − Σ_{j≤k}
g·w·c gives ∂L/∂alpha_k = T_k g·c_k − R/(1 − alpha_k), so that T at each pass's start is all that is kept.

Bands of tile rows bound the memory: as many as the budget has room for candidate pairs.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import log2
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.kernels import EAGER, Kernel, Kernels
from aaplug.rasterizers.rules import MAX_ALPHA, MIN_TRANSMITTANCE, over
from aaplug.splats import MIN_ALPHA, Render, Splats2D, reach, whitening_columns

TILE = 8  # px
PASS = 8  # splats composited in one pass: more compile slowly, fewer load and store more
CHECK_EVERY = 2  # passes between looks at which tiles are saturated
COMPACT_BELOW = 7 / 8  # share of tiles still going at which the others leave
MEMORY = 1e9  # bytes
PAIR_BYTES = 64  # of a candidate pair while a band is binned, measured
HALF_LOG2_E = 0.5 * log2(torch.e)
LN_2 = math.log(2)
LOG2_SILENT = (
    -24.0
)  # log2 of an alpha far below 1/255; stops exp2 before it underflows, which is slow
REACH_SLACK = (
    1e-4  # relative, on the squared reach: float32 rounding never drops a pixel that counts
)

# `threshold` keeps what is above its bound; these keep what is at the bound as well.
BELOW_MIN_ALPHA = torch.nextafter(torch.tensor(MIN_ALPHA), torch.tensor(0.0)).item()
BELOW_MIN_TRANSMITTANCE = torch.nextafter(torch.tensor(MIN_TRANSMITTANCE), torch.tensor(0.0)).item()
SURELY = 1e9  # times anything that is not 0 here is over 1

# columns of a splat's drawing parameters
UX, UY, VX, VY, X, Y, LOG2_OPACITY, RED, GREEN, BLUE = range(10)
COLUMNS = 10
LOW_X = 6  # where a box of tiles begins in a row of the table


@dataclass(frozen=True)
class Tiled:
    """Draws in tiles, in the splats' precision; differentiable.

    kernels: how the elementwise stages run.  memory: bytes that binning may take beside the scene and the image.
    """

    kernels: Kernels = EAGER
    memory: float = MEMORY

    def __call__(
        self, splats: Splats2D, hw: tuple[int, int], background: tuple[float, float, float]
    ) -> Render:
        """Draw the splats."""
        grid = (-(-hw[0] // TILE), -(-hw[1] // TILE))
        drawing = drawing_of(splats, self.kernels)
        rgb, alpha = [], []
        for bins in bands(splats, grid, self.kernels, self.memory):
            image = _untiled(composite(drawing, bins, self.kernels), grid[1])[:, : hw[1]]
            part = over(image[..., :3], image[..., 3], background)
            rgb.append(part.rgb)
            alpha.append(part.alpha)
        return Render(torch.cat(rgb)[: hw[0]], torch.cat(alpha)[: hw[0]])


def _untiled(tiles: Float[Tensor, "t P 4"], columns: int) -> Float[Tensor, "h w 4"]:
    """Tiles of whole rows put in their places."""
    image = tiles.unflatten(0, (-1, columns)).unflatten(2, (TILE, TILE)).transpose(1, 2)
    return image.reshape(-1, columns * TILE, 4)


@dataclass(frozen=True)
class Bins:
    """Which splats each tile of a band draws: `splats[first[t] : first[t] + counts[t]]`, nearest first.

    origins: the tiles' top left corners, in px.
    """

    splats: Int[Tensor, " p"]
    first: Int[Tensor, " t"]
    counts: Int[Tensor, " t"]
    origins: Float[Tensor, "t 2"]


def drawing_of(splats: Splats2D, kernels: Kernels) -> Float[Tensor, "m 10"]:
    """Linear forms, centre, log2 opacity and colour of each splat, and a last row that draws nothing."""
    assert splats.rgb is not None
    (rows,) = kernels.run(
        DRAWING, splats.means, splats.covs, splats.dets, splats.opacities, splats.rgb
    )
    nothing = splats.means.new_zeros(1, COLUMNS)
    nothing[:, LOG2_OPACITY] = LOG2_SILENT
    return torch.cat([rows, nothing])


def _drawing_rows(
    means: Float[Tensor, "m 2"],
    covs: Float[Tensor, "m 3"],
    dets: Float[Tensor, " m"],
    opacities: Float[Tensor, " m"],
    rgb: Float[Tensor, "m 3"],
) -> tuple[Float[Tensor, "m 10"]]:
    forms = [HALF_LOG2_E**0.5 * form for form in whitening_columns(covs, dets)]
    columns = [*forms, *means.unbind(dim=1), opacities.log2(), *rgb.unbind(dim=1)]
    return (torch.stack(columns, dim=1),)


# --------------------------------------------------------------------------------------------------------- binning


@torch.no_grad()
def bands(
    splats: Splats2D, grid: tuple[int, int], kernels: Kernels, memory: float = MEMORY
) -> Iterator[Bins]:
    """Bins of bands of tile rows, from the top."""
    order = _depth_order(splats.depths)
    table = _table(splats, grid, kernels).index_select(0, order)
    for rows in _rows(table, grid[0], max(1, int(memory / PAIR_BYTES))):
        yield _bin(table, order, rows, grid[1], kernels)


def _depth_order(depths: Float[Tensor, " m"]) -> Int[Tensor, " m"]:
    """Nearest first, in scene order where equal.  Positive floats sort as their bits, and integers sort faster."""
    keys = depths.contiguous().view(torch.int32) if depths.dtype == torch.float32 else depths
    return torch.sort(keys, stable=True).indices


def _table(splats: Splats2D, grid: tuple[int, int], kernels: Kernels) -> Float[Tensor, "m 10"]:
    """Centre, conic xx, xy, yy, squared reach of each splat, and the box of tiles around its ellipse.

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
) -> tuple[Float[Tensor, "m 10"]]:
    xx, xy, yy = covs.unbind(dim=1)
    reached = reach(opacities)
    lows, highs = [], []
    for mean, variance, end in zip(means.unbind(dim=1), (xx, yy), limit.unbind(), strict=True):
        half = (reached.clamp(min=0.0) * variance).sqrt() * (1 + REACH_SLACK)
        low = torch.minimum(((mean - half) / TILE).floor().clamp(min=0.0), end)
        high = torch.minimum(((mean + half) / TILE).floor().add(1).clamp(min=0.0), end)
        lows.append(low)
        highs.append(torch.maximum(low, high))
    conic = [yy / dets, -xy / dets, xx / dets]
    return (torch.stack([*means.unbind(dim=1), *conic, reached, *lows, *highs], dim=1),)


def _rows(table: Float[Tensor, "m 10"], rows: int, budget: int) -> list[tuple[int, int]]:
    """Cut the grid into runs of tile rows of about `budget` candidate pairs, at least a row each."""
    left, top, right, bottom = table[:, LOW_X:].long().unbind(dim=1)
    change = top.new_zeros(rows + 1)
    change.index_add_(0, top, right - left).index_add_(0, bottom, left - right)
    ends = change.cumsum(0).cumsum(0)[:rows]  # candidates down to each row
    marks = ends.new_tensor(range(budget, int(ends[-1]), budget))
    cuts = [0, *(torch.searchsorted(ends, marks) + 1).tolist(), rows]
    return [(a, b) for a, b in pairwise(dict.fromkeys(cuts)) if b > a]


def _bin(
    table: Float[Tensor, "m 10"],
    order: Int[Tensor, " m"],
    rows: tuple[int, int],
    columns: int,
    kernels: Kernels,
) -> Bins:
    """Pair splats, nearest first, with the tiles that they reach in a band of rows."""
    low, top, high, bottom = table[:, LOW_X:].unbind(dim=1)
    counts = ((high - low) * (bottom.clamp(*rows) - top.clamp(*rows))).long()
    ends = counts.cumsum(0)
    rank = torch.repeat_interleave(counts)
    band = order.new_tensor([rows[0], rows[1], columns])
    (tiles,) = kernels.run(REACH, rank, ends - counts, table, band)
    size = (rows[1] - rows[0]) * columns
    if size < torch.iinfo(torch.int16).max:
        tiles = tiles.short()  # half the bits sort in half the time
    pairs = torch.sort(tiles, stable=True).indices
    drawn = torch.bincount(tiles, minlength=size + 1)[:size]
    ends = drawn.cumsum(0)
    tile = torch.arange(size, device=table.device)
    origins = torch.stack([tile % columns, tile // columns + rows[0]], dim=1) * TILE
    kept = order.index_select(0, rank.index_select(0, pairs[: int(ends[-1])]))
    return Bins(kept, ends - drawn, drawn, origins.to(table.dtype))


def _reach(
    rank: Int[Tensor, " p"],
    starts: Int[Tensor, " m"],
    table: Float[Tensor, "m 10"],
    band: Int[Tensor, " 3"],
) -> tuple[Int[Tensor, " p"]]:
    """Tile of each candidate pair; the tile after the last where alpha < 1/255 all over the tile.

    The quadratic is convex, so over a box of pixel centres that does not hold the splat's centre its minimum lies on
    a side that faces the centre; both facing sides are tried.
    """
    first, last, columns = band.unbind()
    row = table[rank]
    x, y, xx, xy, yy, reached, low_x, low_y, high_x, _ = row.unbind(dim=1)
    low_y = torch.maximum(low_y, first)
    place = (torch.arange(rank.shape[0], device=rank.device) - starts[rank]).double()
    width = (high_x - low_x).double()
    down = ((place + 0.5) / width).floor()  # exact, and faster than to divide integers
    tile_x = (place - down * width).to(x) + low_x
    tile_y = down.to(x) + low_y
    left, top = tile_x * TILE + 0.5 - x, tile_y * TILE + 0.5 - y
    right, bottom = left + (TILE - 1), top + (TILE - 1)
    zero = torch.zeros_like(x)
    side_x = torch.minimum(torch.maximum(zero, left), right)
    side_y = torch.minimum(torch.maximum(zero, top), bottom)
    on_x = torch.minimum(torch.maximum(-xy / yy * side_x, top), bottom)
    on_y = torch.minimum(torch.maximum(-xy / xx * side_y, left), right)
    distance = torch.minimum(
        xx * side_x * side_x + 2 * xy * side_x * on_x + yy * on_x * on_x,
        xx * on_y * on_y + 2 * xy * on_y * side_y + yy * side_y * side_y,
    )
    slack = REACH_SLACK * (1 + xx * side_x * side_x + yy * side_y * side_y)
    tile = (tile_y.int() - first) * columns + tile_x.int()
    nowhere = (last - first) * columns
    return (torch.where(distance <= reached + slack, tile, nowhere).int(),)


# ----------------------------------------------------------------------------------------------------- compositing


def composite(
    drawing: Float[Tensor, "m 10"], bins: Bins, kernels: Kernels
) -> Float[Tensor, "t P 4"]:
    """Premultiplied colour and alpha of every pixel of every tile."""
    if drawing.requires_grad and torch.is_grad_enabled():
        return _Composite.apply(drawing, bins, kernels)  # pyright: ignore[reportReturnType]
    image, _ = _forward(drawing, bins, kernels, keep=False)
    return image


@dataclass(frozen=True)
class _Pass:
    """What a pass composited: K splats for each of some tiles, from transmittance `before`."""

    tiles: Int[Tensor, " t"]
    splats: Int[Tensor, "t K"]
    before: Float[Tensor, "t P"]


def _forward(
    drawing: Float[Tensor, "m 10"], bins: Bins, kernels: Kernels, keep: bool
) -> tuple[Float[Tensor, "all P 4"], list[_Pass]]:
    """The image, and with `keep` the passes that made it, in order."""
    image = drawing.new_zeros(len(bins.counts), TILE * TILE, 4)
    passes: list[_Pass] = []
    order = torch.sort(bins.counts, descending=True, stable=True).indices
    order = order[: int((bins.counts > 0).sum())]
    for tiles in order.split(kernels.tiles):
        _composite_block(drawing, bins, tiles, image, kernels, passes if keep else None)
    return image, passes


def _composite_block(
    drawing: Float[Tensor, "m 10"],
    bins: Bins,
    tiles: Int[Tensor, " t"],
    image: Float[Tensor, "all P 4"],
    kernels: Kernels,
    passes: list[_Pass] | None,
) -> None:
    """Composite some tiles, longest first, into the image; tiles leave when they are saturated or drawn out."""
    local = _pixel_centres(drawing)
    step = torch.arange(PASS, device=tiles.device)
    columns = (tiles, *(x.index_select(0, tiles) for x in (bins.first, bins.counts, bins.origins)))
    ones = drawing.new_ones(len(tiles))
    state = (
        drawing.new_ones(len(tiles), TILE * TILE),
        *drawing.new_zeros(4, len(tiles), TILE * TILE),
    )
    start = 0
    while len(columns[0]):
        tiles, first, counts, origins = columns
        place = start + step
        pair = (first[:, None] + place).clamp_(max=len(bins.splats) - 1)
        splats = bins.splats.index_select(0, pair.flatten()).view(-1, PASS)
        splats.masked_fill_(place >= counts[:, None], len(drawing) - 1)
        if passes is not None:
            passes.append(_Pass(tiles, splats, state[0]))
        state = kernels.run(COMPOSITE, drawing, splats, origins, *state, *local, ones[: len(tiles)])
        start += PASS
        live = counts > start
        if start // PASS % CHECK_EVERY == 0:
            live &= state[0].amax(dim=1) > 0
        remaining = int(live.sum())
        if remaining == 0 or remaining < COMPACT_BELOW * len(tiles):
            done = (~live).nonzero().squeeze(1)
            finished = [column.index_select(0, done) for column in state[1:]]
            image.index_copy_(0, tiles.index_select(0, done), torch.stack(finished, dim=-1))
            kept = live.nonzero().squeeze(1)
            columns = tuple(column.index_select(0, kept) for column in columns)
            state = tuple(column.index_select(0, kept) for column in state)


def _pixel_centres(like: Tensor) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"]]:
    """x and y of a tile's pixel centres, from its corner."""
    offset = torch.arange(TILE, dtype=like.dtype, device=like.device) + 0.5
    y, x = torch.meshgrid(offset, offset, indexing="ij")
    return x.flatten(), y.flatten()


def _chunk(
    drawing: Float[Tensor, "m 10"],
    splats: Int[Tensor, "t K"],
    origins: Float[Tensor, "t 2"],
    T: Float[Tensor, "t P"],
    red: Float[Tensor, "t P"],
    green: Float[Tensor, "t P"],
    blue: Float[Tensor, "t P"],
    hidden: Float[Tensor, "t P"],
    local_x: Float[Tensor, " P"],
    local_y: Float[Tensor, " P"],
    one: Float[Tensor, " t"],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Composite K splats: transmittance (0 where the pixel has stopped), colour and alpha.

    one: ones; a column of them in each step keeps the compiler to one loop over tiles.
    """
    x, y = origins[:, 0, None] + local_x, origins[:, 1, None] + local_y
    for k in range(PASS):
        row = drawing[splats[:, k]]
        _, _, _, _, alpha = _alpha(row, x, y)
        weight, T = _step(alpha, T, one)
        red = red + weight * row[:, RED, None]
        green = green + weight * row[:, GREEN, None]
        blue = blue + weight * row[:, BLUE, None]
        hidden = hidden + weight
    return T, red, green, blue, hidden


def _alpha(
    row: Float[Tensor, "t 10"], x: Float[Tensor, "t P"], y: Float[Tensor, "t P"]
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Offset from the centre in px, the two forms, and alpha, of one splat a tile."""
    dx, dy = x - row[:, X, None], y - row[:, Y, None]
    u = row[:, UX, None] * dx + row[:, UY, None] * dy
    v = row[:, VX, None] * dx + row[:, VY, None] * dy
    exponent = row[:, LOG2_OPACITY, None] - u * u - v * v
    alpha = torch.exp2(exponent.clamp(min=LOG2_SILENT)).clamp(max=MAX_ALPHA)
    return dx, dy, u, v, torch.threshold(alpha, BELOW_MIN_ALPHA, 0.0)


def _step(
    alpha: Float[Tensor, "t P"], T: Float[Tensor, "t P"], one: Float[Tensor, " t"]
) -> tuple[Tensor, Tensor]:
    """The weight of a splat, and the transmittance after it: both 0 where it would end the pixel.

    Comparing and choosing is slow in eager array code; thresholds and minima are not.
    """
    after = torch.threshold(T * (one[:, None] - alpha), BELOW_MIN_TRANSMITTANCE, 0.0)
    return torch.minimum(alpha * T, after * SURELY), after


class _Composite(torch.autograd.Function):
    """Compositing with its own backward pass."""

    @staticmethod
    def forward(ctx: Any, drawing: Tensor, bins: Bins, kernels: Kernels) -> Tensor:
        image, ctx.passes = _forward(drawing, bins, kernels, keep=True)
        ctx.save_for_backward(drawing, image)
        ctx.bins, ctx.kernels = bins, kernels
        return image

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        drawing, image = ctx.saved_tensors
        return _backward(drawing, image, grads[0], ctx.bins, ctx.passes, ctx.kernels), None, None


def _backward(
    drawing: Float[Tensor, "m 10"],
    image: Float[Tensor, "all P 4"],
    grad: Float[Tensor, "all P 4"],
    bins: Bins,
    passes: list[_Pass],
    kernels: Kernels,
) -> Float[Tensor, "m 10"]:
    """Gradient of the drawing parameters."""
    rest = (image * grad).sum(dim=2)
    columns = [column.contiguous() for column in grad.unbind(dim=2)]
    local = _pixel_centres(drawing)
    total = torch.zeros_like(drawing)
    for part in passes:
        tiles = part.tiles
        *sums, left = kernels.run(
            COMPOSITE_BACKWARD,
            drawing,
            part.splats,
            bins.origins.index_select(0, tiles),
            part.before,
            rest.index_select(0, tiles),
            *(column.index_select(0, tiles) for column in columns),
            *local,
            drawing.new_ones(len(tiles)),
        )
        rest.index_copy_(0, tiles, left)
        moments = torch.stack(sums, dim=-1).view(-1, COLUMNS)
        owners = part.splats.flatten()
        total.scatter_add_(0, owners[:, None].expand(-1, COLUMNS), moments)
    return _from_moments(drawing, total)


def _from_moments(
    drawing: Float[Tensor, "m 10"], moments: Float[Tensor, "m 10"]
) -> Float[Tensor, "m 10"]:
    """Gradients of the parameters from sums over pixels of s·(u dx, u dy, v dx, v dy, u, v, 1) and of the colours'."""
    udx, udy, vdx, vdy, u, v, s, red, green, blue = moments.unbind(dim=1)
    ux, uy, vx, vy = drawing[:, UX : VY + 1].unbind(dim=1)
    x, y = 2 * (u * ux + v * vx), 2 * (u * uy + v * vy)
    return torch.stack([-2 * udx, -2 * udy, -2 * vdx, -2 * vdy, x, y, s, red, green, blue], dim=1)


def _chunk_backward(
    drawing: Float[Tensor, "m 10"],
    splats: Int[Tensor, "t K"],
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
) -> tuple[Tensor, ...]:
    """Sums over a tile's pixels for each of K splats, ten columns [t, K], and what is left of `rest`."""
    x, y = origins[:, 0, None] + local_x, origins[:, 1, None] + local_y
    sums: list[list[Tensor]] = []
    for k in range(PASS):
        row = drawing[splats[:, k]]
        dx, dy, u, v, alpha = _alpha(row, x, y)
        weight, after = _step(alpha, T, one)
        colour = row[:, RED, None] * g_red + row[:, GREEN, None] * g_green
        colour = colour + row[:, BLUE, None] * g_blue + g_hidden
        rest = rest - weight * colour
        # d alpha / d exponent = alpha ln 2, where alpha is neither skipped (then it is 0) nor capped nor too late
        smooth = torch.minimum(after, MAX_ALPHA - alpha).mul(SURELY).clamp(max=1.0)
        s = LN_2 * alpha * smooth * (T * colour - rest / (1 - alpha))
        T = after
        su, sv = s * u, s * v
        terms = (su * dx, su * dy, sv * dx, sv * dy, su, sv, s)
        colours = (weight * g_red, weight * g_green, weight * g_blue)
        sums.append([term.sum(dim=1) for term in (*terms, *colours)])
    return *(torch.stack(column, dim=1) for column in zip(*sums, strict=True)), rest


# --------------------------------------------------------------------------------------------------------- kernels
# Examples are as large as real work: the compiler decides by them which loops run in threads.


def _tile_example(states: int) -> tuple[Tensor, ...]:
    tiles, rows = 1024, 4096
    drawing = torch.linspace(0.01, 0.1, rows * COLUMNS).view(rows, COLUMNS)
    splats = torch.arange(tiles * PASS).view(tiles, PASS) % rows
    state = torch.full((states, tiles, TILE * TILE), 0.5).unbind()
    local = _pixel_centres(torch.zeros(1))
    return drawing, splats, torch.ones(tiles, 2), *state, *local, torch.ones(tiles)


def _splat_example() -> tuple[Tensor, ...]:
    m = 100_000
    means = torch.linspace(0.0, 99.0, 2 * m).view(m, 2)
    return means, torch.tensor([3.0, 1.0, 2.0]).repeat(m, 1), torch.full((m,), 5.0), torch.ones(m)


def _reach_example() -> tuple[Tensor, ...]:
    boxes = 20_000
    row = [12.0, 12.0, 1.0, 0.5, 1.0, 9.0, 0.0, 0.0, 2.0, 4.0]
    table = torch.tensor(row).repeat(boxes, 1)
    return torch.arange(8 * boxes) // 8, 8 * torch.arange(boxes), table, torch.tensor([0, 4, 4])


DRAWING = Kernel(
    "drawing", _drawing_rows, lambda: (*_splat_example(), torch.ones(100_000, 3)), ("m",) * 5
)
TABLE = Kernel(
    "table", _table_rows, lambda: (*_splat_example(), torch.full((2,), 9.0)), ("m",) * 4 + (None,)
)
REACH = Kernel("reach", _reach, _reach_example, ("p", "m", "m", None))
COMPOSITE = Kernel(
    "composite",
    _chunk,
    lambda: _tile_example(5),
    ("m", *7 * ("t",), None, None, "t"),
)
COMPOSITE_BACKWARD = Kernel(
    "composite-backward",
    _chunk_backward,
    lambda: _tile_example(6),
    ("m", *8 * ("t",), None, None, "t"),
)

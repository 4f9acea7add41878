"""Binning: which splats each tile of TILE × TILE px draws, nearest first.

m: splats; s: spans; p: pairs of a splat and a tile; t: tiles.

Each splat, nearest first, is paired with the tiles that its cut-off ellipse overlaps.  An ellipse is convex, so in one
row of tiles it covers a run of columns.  A splat becomes one span per row, a span becomes pairs, and a stable sort of
the pairs by tile does the rest.

Bands of whole tile rows bound the memory: each exceeds the budget of candidate pairs by at most its last row.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.ellipses import squared_cutoff
from aaplug.core.kernels import Kernel, Kernels
from aaplug.core.rules import RULES_3DGS, Rules, variant
from aaplug.core.splats import Splats2D
from aaplug.methods.pixel_kernels.raster_rows import TILE, splat_example

LONGEST_PASS = 16  # most splats per pass: more compile slowly, fewer reload the pixels' state more often
MEMORY = 1e9  # bytes
PAIR_BYTES = 64  # bytes per candidate pair while a band is binned, measured
CUTOFF_SLACK = 1e-4  # relative margin of the squared cut-off, so that float32 rounding never drops a pixel above it
BOX = 7  # index of the table's first tile box column


@dataclass(frozen=True)
class Bins:
    """Tile t of a band draws the splats `splats[first[t] : first[t] + counts[t]]`, nearest first.

    splats: padded by LONGEST_PASS, so that a pass may read past the end.
    origins: the tiles' top left corners, in px.
    """

    splats: Int[Tensor, " p_and_K"]
    first: Int[Tensor, " t"]
    counts: Int[Tensor, " t"]
    origins: Float[Tensor, "t 2"]


@torch.no_grad()
def bands(
    splats: Splats2D, grid: tuple[int, int], kernels: Kernels, memory: float = MEMORY, rules: Rules = RULES_3DGS
) -> Iterator[Bins]:
    """Bins of bands of tile rows, from the top."""
    order = _depth_order(splats.depths)
    table = _table(splats, grid, kernels, rules)
    for rows in _rows(table, grid[0], max(1, int(memory / PAIR_BYTES))):
        yield _bin(table, order, rows, grid[1], kernels)


def _depth_order(depths: Float[Tensor, " m"]) -> Int[Tensor, " m"]:
    """Indices, nearest first; equal depths keep the given order.

    The bits of positive floats sort like the floats, and integers sort faster.
    """
    keys = depths.contiguous().view(torch.int32) if depths.dtype == torch.float32 else depths
    return torch.sort(keys, stable=True).indices


def _table(splats: Splats2D, grid: tuple[int, int], kernels: Kernels, rules: Rules) -> Float[Tensor, "m 11"]:
    """Per splat, what its spans are computed from; see `_table_rows`.

    The last four columns are its tile box: first tile in x and y, then one past the last in x and y.
    """
    limit = splats.means.new_tensor([grid[1], grid[0]])
    columns = (splats.means, splats.covs, splats.dets, splats.opacities)
    (table,) = kernels.run(table_kernel(rules.min_alpha), *columns, limit)
    return table


def _table_rows(
    min_alpha: float,
    means: Float[Tensor, "m 2"],
    covs: Float[Tensor, "m 3"],
    dets: Float[Tensor, " m"],
    opacities: Float[Tensor, " m"],
    limit: Float[Tensor, " 2"],
) -> tuple[Float[Tensor, "m 11"]]:
    """Columns: x, y; slope xy/yy and variance det/yy of x given y; yy; squared cut-off; rightmost point's dy; box."""
    xx, xy, yy = covs.unbind(dim=1)
    cutoff = squared_cutoff(opacities, min_alpha) * (1 + CUTOFF_SLACK)
    cutoff = torch.where(((xx + yy) / dets).isfinite(), cutoff, -1.0)  # no width: never drawn
    lows, highs = [], []
    for mean, variance, end in zip(means.unbind(dim=1), (xx, yy), limit.unbind(), strict=True):
        half = (cutoff.clamp(min=0.0) * variance).sqrt()
        low = torch.minimum(((mean - half) / TILE).floor().clamp(min=0.0), end)
        high = torch.minimum(((mean + half) / TILE).floor().add(1).clamp(min=0.0), end)
        lows.append(low)
        highs.append(torch.maximum(low, high))
    rightmost = xy * (cutoff.clamp(min=0.0) / xx).sqrt()
    ellipse = [xy / yy, dets / yy, yy, cutoff, rightmost]
    return (torch.stack([*means.unbind(dim=1), *ellipse, *lows, *highs], dim=1),)


def _rows(table: Float[Tensor, "m 11"], rows: int, budget: int) -> list[tuple[int, int]]:
    """Cut the grid into bands of whole tile rows with about `budget` candidate pairs each."""
    left, top, right, bottom = table[:, BOX:].long().unbind(dim=1)
    change = top.new_zeros(rows + 1)
    change.index_add_(0, top, right - left).index_add_(0, bottom, left - right)
    ends = change.cumsum(0).cumsum(0)[:rows]  # candidates down to each row
    marks = ends.new_tensor(range(budget, int(ends[-1]), budget))
    cuts = [0, *(torch.searchsorted(ends, marks) + 1).tolist(), rows]
    return [(a, b) for a, b in pairwise(dict.fromkeys(cuts)) if b > a]


def _bin(
    table: Float[Tensor, "m 11"], order: Int[Tensor, " m"], rows: tuple[int, int], columns: int, kernels: Kernels
) -> Bins:
    """Pair splats, nearest first, with the tiles that they overlap in a band of rows."""
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
        tiles = tiles.short()  # half as many bits sort in half the time
    sorted_tiles, pairs = torch.sort(tiles, stable=True)
    tile = torch.arange(size, device=table.device)
    ends = torch.searchsorted(sorted_tiles, tile.to(tiles), right=True)
    first = torch.cat([ends.new_zeros(1), ends[:-1]])
    origins = torch.stack([tile % columns, tile // columns + rows[0]], dim=1) * TILE
    drawn = torch.cat([splats.index_select(0, pairs), splats.new_zeros(LONGEST_PASS)])
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
    """Per span: its first tile in the band, its number of tiles, its splat.  A span is one splat in one row of tiles.

    At dy = h px below its centre the ellipse covers dx = slope·h ± w, with w² = variance (cutoff - h²/yy).  Its right
    edge is farthest at the rightmost point and recedes monotonically on both sides.  Among a row's pixel centres,
    the one nearest to that point's dy therefore bounds the span; the left edge is symmetric.
    """
    top_row, columns = band.unbind()
    owners = order[ranks]
    row = table[owners]
    x, y, slope, variance, yy, cutoff, rightmost, _, low_y, _, _ = row.unbind(dim=1)
    down = (torch.arange(ranks.shape[0], device=ranks.device) - starts[ranks]).to(x)
    tile_y = torch.maximum(low_y, top_row) + down
    top = tile_y * TILE + 0.5 - y
    ends = []
    for sign in (-1, 1):
        h = torch.minimum(torch.maximum(sign * rightmost, top), top + (TILE - 1))
        width = (variance * (cutoff - h * h / yy).clamp(min=0.0)).sqrt()
        slack = CUTOFF_SLACK * (width + (slope * h).abs())
        ends.append(x + slope * h + sign * (width + slack))
    nearest = torch.minimum(torch.maximum(torch.zeros_like(top), top), top + (TILE - 1))
    reaches = nearest * nearest / yy <= cutoff
    limit = columns.to(x)
    left = torch.minimum(((ends[0] + 0.5 - TILE) / TILE).ceil().clamp(min=0.0), limit)
    right = torch.minimum(((ends[1] - 0.5) / TILE).floor() + 1, limit)
    width = torch.where(reaches, (right - left).clamp(min=0.0), 0.0)
    return (tile_y.long() - top_row) * columns + left.long(), width.long(), owners.int()


def _pairs(
    spans: Int[Tensor, " p"], starts: Int[Tensor, " s"], first: Int[Tensor, " s"], owners: Int[Tensor, " s"]
) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"]]:
    """Tile and splat of each pair."""
    place = torch.arange(spans.shape[0], device=spans.device)
    return (place + (first - starts)[spans]).int(), owners[spans]


# --------------------------------------------------------------------------------------------------------- kernels


def _spans_example() -> tuple[Tensor, ...]:
    boxes = 50_000
    row = [12.0, 12.0, 0.5, 1.0, 1.0, 9.0, 0.5, 0.0, 0.0, 2.0, 4.0]
    table = torch.tensor(row).repeat(boxes, 1)
    order = torch.arange(boxes)
    return torch.arange(4 * boxes) // 4, order, 4 * order, table, torch.tensor([0, 4])


def _pairs_example() -> tuple[Tensor, ...]:
    spans = torch.arange(50_000)
    return torch.arange(200_000) // 4, 4 * spans, spans % 999, spans.int()


@cache
def table_kernel(min_alpha: float = RULES_3DGS.min_alpha) -> Kernel:
    """The table for one cut-off."""
    return Kernel(
        "table" + variant((min_alpha,), (RULES_3DGS.min_alpha,)),
        partial(_table_rows, min_alpha),
        lambda: (*splat_example(), torch.full((2,), 9.0)),
        ("m",) * 4 + (None,),
        gathers=True,
    )


SPANS = Kernel("spans", _spans, _spans_example, ("s", "m", "m", "m", None))
PAIRS = Kernel("pairs", _pairs, _pairs_example, ("p", "s", "s", "s"))

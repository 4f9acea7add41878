"""Binning: which splats each tile of TILE × TILE px draws, nearest first.

m: splats; s: spans; p: pairs of a splat and a tile; t: tiles.

Each splat, nearest first, is paired with the tiles that its cut-off ellipse overlaps.  An ellipse is convex, so in one
row of tiles it covers a run of columns.  A splat becomes one span per row, a span becomes pairs, and a stable sort of
the pairs by tile does the rest.  Each tile's list is padded, so that a pass reads whole runs of it.

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
MOST_PAIRS = 1 << 30  # in a band, so that their places are 32 bit integers
SHORT = torch.iinfo(torch.int16).max  # tiles in a band, so that they are sorted by few bits
CUTOFF_SLACK = 1e-4  # relative margin of the squared cut-off, so that float32 rounding never drops a pixel above it
BOX = 7  # index of the table's first tile box column


@dataclass(frozen=True)
class Pairs:
    """The pairs of a band, those of one splat together and nearest splats first: the order of sums over tiles.

    nearest: all splats, nearest first.  spans: the first span of each of them.  starts: the first pair of each span.
    sorted: the pairs by tile.  places: where each of these stands in `Bins.splats`.
    """

    nearest: Int[Tensor, " m"]
    spans: Int[Tensor, " m"]
    starts: Int[Tensor, " s"]
    sorted: Int[Tensor, " p"]
    places: Int[Tensor, " p"]

    def of_splats(self) -> tuple[Int[Tensor, " p"], Int[Tensor, " m"]]:
        """Places of all pairs, in the pairs' order, and the first of each splat of `nearest`."""
        places = torch.empty_like(self.places)
        places[self.sorted] = self.places
        starts = torch.cat([self.starts, self.starts.new_full((1,), len(places))])
        return places, starts.index_select(0, self.spans)


@dataclass(frozen=True)
class Bins:
    """Tile t of a band draws the splats `splats[first[t] : first[t] + counts[t]]`, nearest first.

    splats: each tile's list is padded to a multiple of LONGEST_PASS, and as many follow them all; padding names the
        raster row behind the last splat's.
    origins: the tiles' top left corners, in px.
    pairs: for gradients.
    """

    splats: Int[Tensor, " padded_p"]
    first: Int[Tensor, " t"]
    counts: Int[Tensor, " t"]
    origins: Float[Tensor, "t 2"]
    pairs: Pairs | None

    @property
    def padding(self) -> int:
        """Where only padding follows."""
        return len(self.splats) - LONGEST_PASS


@torch.no_grad()
def bands(
    splats: Splats2D,
    grid: tuple[int, int],
    kernels: Kernels,
    memory: float = MEMORY,
    rules: Rules = RULES_3DGS,
    gradients: bool = False,
) -> Iterator[Bins]:
    """Bins of bands of tile rows, from the top; with `pairs` if `gradients`."""
    order = _depth_order(splats.depths)
    table = _table(splats, grid, kernels, rules).index_select(0, order)
    for rows in _rows(table, grid, min(MOST_PAIRS, max(1, int(memory / PAIR_BYTES)))):
        yield _bin(table, order, rows, grid[1], kernels, gradients)


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


def _rows(table: Float[Tensor, "m 11"], grid: tuple[int, int], budget: int) -> list[tuple[int, int]]:
    """Cut the grid into bands of whole tile rows with about `budget` candidate pairs and at most `SHORT` tiles each."""
    left, top, right, bottom = table[:, BOX:].unbind(dim=1)
    most, wide = max(1, SHORT // grid[1]), right - left
    cuts = [*range(0, grid[0], most), grid[0]]
    if (wide * (bottom - top)).sum(dtype=torch.float64) > budget:
        change = torch.zeros(grid[0] + 1, dtype=torch.long, device=table.device)
        change.index_add_(0, top.long(), wide.long()).index_add_(0, bottom.long(), -wide.long())
        ends = change.cumsum(0).cumsum(0)[: grid[0]]  # candidates down to each row
        marks = ends.new_tensor(range(budget, int(ends[-1]), budget))
        cuts = sorted({*cuts, *(torch.searchsorted(ends, marks) + 1).tolist()})
    return list(pairwise(cuts))


def _bin(
    table: Float[Tensor, "m 11"],
    order: Int[Tensor, " m"],
    rows: tuple[int, int],
    columns: int,
    kernels: Kernels,
    gradients: bool,
) -> Bins:
    """Pair splats, nearest first, with the tiles that they overlap in a band of rows.  table: nearest first."""
    _, top, _, bottom = table[:, BOX:].unbind(dim=1)
    heights = (bottom.clamp(*rows) - top.clamp(*rows)).int()
    down, band = _starts(heights), order.new_tensor([rows[0], columns])
    first, widths, owners = kernels.run(SPANS, torch.repeat_interleave(heights), order, down, table, band)
    size = (rows[1] - rows[0]) * columns
    first = first.short() if size <= SHORT else first  # half as many bits sort in half the time
    starts = _starts(widths)
    tiles, splats = kernels.run(PAIRS, torch.repeat_interleave(widths), starts, first, owners)
    by_tile, pairs = torch.sort(tiles, stable=True)
    tile = torch.arange(size, device=table.device)
    ends = torch.searchsorted(by_tile, tile.to(tiles), right=True)
    counts = torch.diff(ends, prepend=ends.new_zeros(1))
    lengths = (counts + (LONGEST_PASS - 1)) // LONGEST_PASS * LONGEST_PASS
    begins = _starts(lengths)
    drawn = splats.new_full((int(lengths.sum()) + LONGEST_PASS,), len(table))
    (places,) = kernels.run(PLACES, drawn, by_tile, (begins + counts - ends).int(), pairs, splats)
    origins = torch.stack([tile % columns, tile // columns + rows[0]], dim=1) * TILE
    kept = Pairs(order, down, starts, pairs, places) if gradients else None
    return Bins(drawn, begins, counts, origins.to(table.dtype), kept)


def _starts(counts: Int[Tensor, " m"]) -> Int[Tensor, " m"]:
    return counts.cumsum(0, dtype=counts.dtype) - counts


def _spans(
    ranks: Int[Tensor, " s"],
    order: Int[Tensor, " m"],
    starts: Int[Tensor, " m"],
    table: Float[Tensor, "m 11"],
    band: Int[Tensor, " 2"],
) -> tuple[Int[Tensor, " s"], Int[Tensor, " s"], Int[Tensor, " s"]]:
    """Per span: its first tile in the band, its number of tiles, its splat.  A span is one splat in one row of tiles.

    ranks: the splat's place in `order` and in the table.

    At dy = h px below its centre the ellipse covers dx = slope·h ± w, with w² = variance (cutoff - h²/yy).  Its right
    edge is farthest at the rightmost point and recedes monotonically on both sides.  Among a row's pixel centres,
    the one nearest to that point's dy therefore bounds the span; the left edge is symmetric.
    """
    top_row, columns = band.unbind()
    row = table[ranks]
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
    return ((tile_y.long() - top_row) * columns + left.long()).int(), width.int(), order[ranks].int()


def _pairs(
    spans: Int[Tensor, " p"], starts: Int[Tensor, " s"], first: Int[Tensor, " s"], owners: Int[Tensor, " s"]
) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"]]:
    """Tile and splat of each pair."""
    place = torch.arange(spans.shape[0], dtype=torch.int32, device=spans.device)
    return (place + (first - starts)[spans]).to(first.dtype), owners[spans]


def _places(
    drawn: Int[Tensor, " padded_p"],
    tiles: Int[Tensor, " p"],
    shifts: Int[Tensor, " t"],
    pairs: Int[Tensor, " p"],
    splats: Int[Tensor, " p"],
) -> tuple[Int[Tensor, " p"]]:
    """Write the splats, sorted by tile, into the padded lists; returns where each came to stand.

    tiles: sorted.  shifts: how far padding moves each tile's list.
    """
    places = torch.arange(tiles.shape[0], dtype=torch.int32, device=tiles.device) + shifts[tiles.int()]
    drawn.index_put_((places,), splats[pairs])
    return (places,)


# --------------------------------------------------------------------------------------------------------- kernels


def _spans_example() -> tuple[Tensor, ...]:
    boxes = 50_000
    row = [12.0, 12.0, 0.5, 1.0, 1.0, 9.0, 0.5, 0.0, 0.0, 2.0, 4.0]
    table = torch.tensor(row).repeat(boxes, 1)
    order = torch.arange(boxes)
    ranks = torch.arange(4 * boxes, dtype=torch.int32) // 4
    return ranks, order, 4 * order.int(), table, torch.tensor([0, 4])


def _pairs_example() -> tuple[Tensor, ...]:
    spans = torch.arange(50_000, dtype=torch.int32)
    return torch.arange(200_000, dtype=torch.int32) // 4, 4 * spans, (spans % 999).short(), spans


def _places_example() -> tuple[Tensor, ...]:
    tiles, each = 10_000, 20
    pairs = torch.arange(tiles * each)
    shifts = (LONGEST_PASS - each % LONGEST_PASS) * torch.arange(tiles, dtype=torch.int32)
    drawn = torch.zeros(tiles * 2 * LONGEST_PASS, dtype=torch.int32)
    return drawn, (pairs // each).short(), shifts, pairs.flip(0), pairs.int()


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
PLACES = Kernel("places", _places, _places_example, ("padded_p", "p", "t", "p", "p"))

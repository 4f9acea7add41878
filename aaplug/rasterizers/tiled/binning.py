"""Binning: which splats each tile of TILE × TILE px draws, nearest first.

m: splats; s: spans; p: pairs of a splat and a tile; t: tiles.

Each splat, nearest first, is paired with the tiles that its cut-off ellipse overlaps.  An ellipse is convex, so in one
row of tiles it covers a run of columns.  A splat becomes one span per row, a span becomes pairs, and a stable sort of
the pairs by tile does the rest.  Where splats have ray slopes, the pairs are first sorted by their depth along the ray
of their tile's middle.

Bands of whole tile rows bound the memory: each exceeds the budget of candidate pairs by at most its last row.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.ellipses import squared_cutoff
from aaplug.core.kernels import Kernel, Kernels, materialized
from aaplug.core.rules import RULES_3DGS, Rules
from aaplug.core.runs import runs_of, starts_of
from aaplug.core.splats import Splats2D, ordering_depths
from aaplug.methods.pixel_kernels.raster_rows import TILE, splat_example

MEMORY_BYTES = 1e9
PAIR_BYTES = 64  # bytes per candidate pair while a band is binned, measured
MAX_PAIRS = 1 << 30  # in a band, so that they are counted by 32 bit integers
MAX_SHORT_TILES = torch.iinfo(torch.int16).max  # tiles in a band, so that they are sorted by few bits
SORTED_BY_DIGITS = 1 << 15  # integers from which torch sorts by their digits, and not by comparing them
MIN_PADDED = 1 << 13  # integers from which it pays to pad them to as many
HAS_DIGITS = "fbgemm" in torch.backends.quantized.supported_engines  # the library that sorts so
CUTOFF_SLACK = 1e-4  # relative margin of the squared cut-off, so that float32 rounding never drops a pixel above it


@dataclass(frozen=True, eq=False)
class Pairs:
    """The pairs of a band, those of one splat together and nearest splats first: the order of sums over tiles.

    nearest: all splats, nearest first.  starts: the first pair of each of them.
    sorted: the pairs by tile.  tiles: the tile of each of these.
    """

    nearest: Int[Tensor, " m"]
    starts: Int[Tensor, " m"]
    sorted: Int[Tensor, " p"]
    tiles: Int[Tensor, " p"]


@dataclass(frozen=True, eq=False)
class Bins:
    """Tile t of a band draws the splats `splats[first[t] : first[t] + counts[t]]`, nearest first.

    splats: at least one entry, though there may be no splats.
    origins: the tiles' top left corners, in px.  columns: tiles in a row.
    pairs: for gradients.
    """

    splats: Int[Tensor, " p"]
    first: Int[Tensor, " t"]
    counts: Int[Tensor, " t"]
    origins: Float[Tensor, "t 2"]
    columns: int
    pairs: Pairs | None

    def by_length(self) -> Int[Tensor, " t"]:
        """The tiles by the length of their lists, the longest first."""
        return stably_sorted(-self.counts.int())[1]


@dataclass(frozen=True, eq=False)
class TileBoxes:
    """The tiles that each splat may reach.

    table: the columns that its spans are computed from; see `_table_rows`.
    top, bottom: its first row of tiles, and the one past its last.  wide: columns of tiles of its box.
    """

    table: Float[Tensor, "m 8"]
    top: Int[Tensor, " m"]
    bottom: Int[Tensor, " m"]
    wide: Int[Tensor, " m"]


@torch.no_grad()
def bands(
    splats: Splats2D,
    grid: tuple[int, int],
    kernels: Kernels,
    memory: float = MEMORY_BYTES,
    rules: Rules = RULES_3DGS,
    gradients: bool = False,
) -> Iterator[Bins]:
    """Bins of bands of tile rows, from the top; with `pairs` if `gradients`.  Equal depths keep the given order."""
    order = _sorted(splats.depths)
    columns = (splats.means, splats.covs, splats.dets, splats.opacities)
    limits = splats.means.new_tensor([grid[1], grid[0], rules.min_alpha])
    boxes = TileBoxes(*kernels.run(TABLE, *columns, limits))
    for rows in _rows(boxes, grid, min(MAX_PAIRS, max(1, int(memory / PAIR_BYTES)))):
        yield _bin(splats, boxes, order, rows, grid[1], kernels, gradients)


def _sorted(depths: Float[Tensor, " m"]) -> Int[Tensor, " m"]:
    """The order of depths; the bits of positive floats sort like the floats, and integers sort faster."""
    if depths.dtype == torch.float32:
        return stably_sorted(depths.contiguous().view(torch.int32))[1]
    return torch.sort(depths, stable=True).indices


def stably_sorted(keys: Int[Tensor, " m"]) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
    """Integers in ascending order, and where each stood; equal ones keep their order.

    The largest integer pads what torch would sort by comparing: 30,000 are sorted in a fifth of the time.
    """
    count, padded = len(keys), keys
    if HAS_DIGITS and MIN_PADDED <= count < SORTED_BY_DIGITS:
        padded = keys.new_full((SORTED_BY_DIGITS,), torch.iinfo(keys.dtype).max)
        padded[:count] = keys
    values, order = torch.sort(padded, stable=True)
    return values[:count], order[:count]


def _table_rows(
    means: Float[Tensor, "m 2"],
    covs: Float[Tensor, "m 3"],
    dets: Float[Tensor, " m"],
    opacities: Float[Tensor, " m"],
    limits: Float[Tensor, " 3"],
) -> tuple[Float[Tensor, "m 8"], Int[Tensor, " m"], Int[Tensor, " m"], Int[Tensor, " m"]]:
    """The columns of `TileBoxes`.

    The table's: x, y; slope xy/yy and variance det/yy of x given y; yy; squared cut-off; rightmost point's dy; first
    row of tiles.
    limits: columns and rows of tiles, and the least alpha.
    """
    *sides, min_alpha = limits.unbind()
    xx, xy, yy = covs.unbind(dim=1)
    cutoff = squared_cutoff(opacities, min_alpha) * (1 + CUTOFF_SLACK)
    cutoff = torch.where(((xx + yy) / dets).isfinite(), cutoff, -1.0)  # no width: never drawn
    lows, highs = [], []
    for mean, variance, end in zip(means.unbind(dim=1), (xx, yy), sides, strict=True):
        half = (cutoff.clamp(min=0.0) * variance).sqrt()
        low = torch.minimum(((mean - half) / TILE).floor().clamp(min=0.0), end)
        high = torch.minimum(((mean + half) / TILE).floor().add(1).clamp(min=0.0), end)
        lows.append(low)
        highs.append(torch.maximum(low, high))
    rightmost = xy * (cutoff.clamp(min=0.0) / xx).sqrt()
    (left, top), (right, bottom) = lows, highs
    table = torch.stack([*means.unbind(dim=1), xy / yy, dets / yy, yy, cutoff, rightmost, top], dim=1)
    return table, top.int(), bottom.int(), (right - left).int()


def _rows(boxes: TileBoxes, grid: tuple[int, int], budget: int) -> list[tuple[int, int]]:
    """Bands of whole tile rows, each of about `budget` candidate pairs and at most `MAX_SHORT_TILES` tiles."""
    most = max(1, MAX_SHORT_TILES // grid[1])
    cuts = [*range(0, grid[0], most), grid[0]]
    if int((boxes.wide * (boxes.bottom - boxes.top)).sum()) > budget:
        wide = boxes.wide.long()
        change = wide.new_zeros(grid[0] + 1)
        change.index_add_(0, boxes.top, wide).index_add_(0, boxes.bottom, -wide)
        ends = change.cumsum(0).cumsum(0)[: grid[0]]  # candidates down to each row
        marks = ends.new_tensor(range(budget, int(ends[-1]), budget))
        cuts = sorted({*cuts, *(torch.searchsorted(ends, marks) + 1).tolist()})
    return list(pairwise(cuts))


def _bin(
    drawn: Splats2D,
    boxes: TileBoxes,
    order: Int[Tensor, " m"],
    rows: tuple[int, int],
    columns: int,
    kernels: Kernels,
    gradients: bool,
) -> Bins:
    """Pair splats, nearest first, with the tiles that they overlap in a band of rows."""
    heights = (boxes.bottom.clamp(*rows) - boxes.top.clamp(*rows)).index_select(0, order)
    down, band = starts_of(heights), order.new_tensor([rows[0], columns])
    first, widths, owners = kernels.run(SPANS, runs_of(down, heights), order, down, boxes.table, band)
    size = (rows[1] - rows[0]) * columns
    first = first.short() if size <= MAX_SHORT_TILES else first  # half as many bits sort in half the time
    starts = starts_of(widths)
    tiles, splats = kernels.run(PAIRS, runs_of(starts, widths), starts, first, owners)
    tile = torch.arange(size, device=order.device)
    origins = (torch.stack([tile % columns, tile // columns + rows[0]], dim=1) * TILE).to(boxes.table)
    by_ray = _by_ray(drawn, splats, origins, tiles)
    by_tile, pairs = stably_sorted(tiles if by_ray is None else tiles.index_select(0, by_ray))
    pairs = pairs if by_ray is None else by_ray.index_select(0, pairs)
    lists = splats.index_select(0, pairs) if len(pairs) else splats.new_zeros(1)
    ends = torch.searchsorted(by_tile, tile.to(tiles), right=True)
    counts = torch.diff(ends, prepend=ends.new_zeros(1))
    by_splat = None
    if gradients:
        ahead = torch.cat([starts, starts.new_full((1,), len(pairs))])
        by_splat = Pairs(order, ahead.index_select(0, down), pairs, by_tile)
    return Bins(lists, ends - counts, counts, origins, columns, by_splat)


def _by_ray(
    drawn: Splats2D, splats: Int[Tensor, " p"], origins: Float[Tensor, "t 2"], tiles: Int[Tensor, " p"]
) -> Int[Tensor, " p"] | None:
    """The order of pairs by the depth of their splats along the rays of their tiles' middles; None without slopes."""
    if drawn.ray_slopes is None:
        return None
    columns = [*(drawn.means - TILE / 2).unbind(dim=1), *drawn.ray_slopes.unbind(dim=1), drawn.depths]
    x, y, right, down, depths = (column.index_select(0, splats) for column in columns)
    left, top = (column.index_select(0, tiles.int()) for column in origins.unbind(dim=1))
    return _sorted(ordering_depths(depths, (right * (left - x)).addcmul_(down, top - y)))


def _spans(
    ranks: Int[Tensor, " s"],
    order: Int[Tensor, " m"],
    starts: Int[Tensor, " m"],
    table: Float[Tensor, "m 8"],
    band: Int[Tensor, " 2"],
) -> tuple[Int[Tensor, " s"], Int[Tensor, " s"], Int[Tensor, " s"]]:
    """Per span: its first tile in the band, its number of tiles, its splat.  A span is one splat in one row of tiles.

    ranks: the splat's place in `order` and in `starts`.

    At dy = h px below its centre the ellipse covers dx = slope·h ± w, with w² = variance (cutoff - h²/yy).  Its right
    edge is farthest at the rightmost point and recedes monotonically on both sides.  Among a row's pixel centres,
    the one nearest to that point's dy therefore bounds the span; the left edge is symmetric.
    """
    top_row, columns = band.unbind()
    by_depth = materialized(table.index_select(0, order))
    x, y, slope, variance, yy, cutoff, rightmost, low_y = by_depth[ranks].unbind(dim=1)
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


# --------------------------------------------------------------------------------------------------------- kernels


def _spans_example() -> tuple[Tensor, ...]:
    boxes = 50_000
    row = [12.0, 12.0, 0.5, 1.0, 1.0, 9.0, 0.5, 0.0]
    table = torch.tensor(row).repeat(boxes, 1)
    order = torch.arange(boxes)
    ranks = torch.arange(4 * boxes, dtype=torch.int32) // 4
    return ranks, order, 4 * order.int(), table, torch.tensor([0, 4])


def _pairs_example() -> tuple[Tensor, ...]:
    spans = torch.arange(50_000, dtype=torch.int32)
    return torch.arange(200_000, dtype=torch.int32) // 4, 4 * spans, (spans % 999).short(), spans


def _table_example() -> tuple[Tensor, ...]:
    return *splat_example(), torch.tensor([9.0, 9.0, RULES_3DGS.min_alpha])


TABLE = Kernel("table", _table_rows, _table_example, ("m",) * 4 + (None,), gathers=True)
SPANS = Kernel("spans", _spans, _spans_example, ("s", "m", "m", "m", None))
PAIRS = Kernel("pairs", _pairs, _pairs_example, ("p", "s", "s", "s"))

"""The fast rasterizer: tiles, one depth sort, and compositing as vectorized array code.

t: tiles of TILE × TILE px; p: pairs of a splat and a tile that it reaches; K: splats a pass; P: pixels a tile.

1. A splat becomes two linear forms u, v of the pixel's position with u² + v² = log2(e)/2 · dᵀ C⁻¹ d, so that alpha is
   2^(log2 o − u² − v²).  Forms lose no digits where the expanded quadratic of a needle would.
2. Splats are sorted by depth, paired with the tiles that their alpha ≥ 1/255 ellipse reaches, and the pairs sorted
   stably by tile.
3. Tiles of like length go through compositing together, K splats a pass; finished tiles leave.

Each operation on a pass is small enough that torch runs it in one thread: operations split over threads wait for the
slowest at every step, and on cores shared with other work that wait was measured to cost forty times the work itself.
Not differentiable; the reference is.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import log2

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.rasterizers.rules import MAX_ALPHA, MIN_TRANSMITTANCE, over
from aaplug.splats import MIN_ALPHA, Render, Splats2D, half_sizes, reach, whitening

TILE = 8  # px
PASS = 16  # splats composited in one pass, at least
BLOCK = 32  # tiles in one pass, at most: PASS·BLOCK·TILE² = 32768 elements stay in the L2 cache and in one thread
PAIR_BUDGET = 8_000_000  # candidate pairs expanded at once
HALF_LOG2_E = 0.5 * log2(torch.e)
LOG2_SILENT = (
    -24.0
)  # log2 of an alpha far below 1/255; stops exp2 before it underflows, which is slow
REACH_SLACK = (
    1e-4  # relative, on the squared reach: float32 rounding never drops a pixel that counts
)

# `threshold` keeps what is above its bound; these keep what is at the bound as well.
BELOW_MIN_ALPHA = torch.nextafter(torch.tensor(MIN_ALPHA), torch.tensor(0.0)).item()
BELOW_MIN_TRANSMITTANCE = torch.nextafter(torch.tensor(MIN_TRANSMITTANCE), torch.tensor(0.0)).item()

# columns of a splat's drawing parameters
UX, UY, VX, VY, X, Y, LOG2_OPACITY, RGB = 0, 1, 2, 3, 4, 5, 6, slice(7, 10)


@dataclass(frozen=True)
class Bins:
    """Which splats each tile draws: `splats[first[t] : first[t] + counts[t]]`, nearest first."""

    splats: Int[Tensor, " p"]
    first: Int[Tensor, " t"]
    counts: Int[Tensor, " t"]


@torch.no_grad()
def rasterize(
    splats: Splats2D, hw: tuple[int, int], background: tuple[float, float, float]
) -> Render:
    """Draw the splats in float32."""
    splats = splats.to(torch.float32)
    splats = splats[torch.sort(splats.depths, stable=True).indices]
    grid = (-(-hw[0] // TILE), -(-hw[1] // TILE))
    image = _composite(_drawing(splats), _bin(splats, grid), grid)
    image = image.unflatten(1, (TILE, TILE)).unflatten(0, grid).transpose(1, 2)
    image = image.reshape(grid[0] * TILE, grid[1] * TILE, 4)[: hw[0], : hw[1]]
    return over(image[..., :3], image[..., 3], background)


def _drawing(splats: Splats2D) -> Float[Tensor, "m 10"]:
    """Linear forms, centre, log2 opacity and colour of each splat, and a last row that draws nothing."""
    assert splats.rgb is not None
    forms = HALF_LOG2_E**0.5 * whitening(splats).flatten(1)
    columns = [forms, splats.means, splats.opacities.log2()[:, None], splats.rgb]
    nothing = splats.means.new_zeros(1, 10)
    nothing[:, LOG2_OPACITY] = LOG2_SILENT
    return torch.cat([torch.cat(columns, dim=1), nothing])


def _bin(splats: Splats2D, grid: tuple[int, int]) -> Bins:
    """Pair splats, already in depth order, with the tiles they reach."""
    low, size = _tile_boxes(splats, grid)
    ends = size.prod(dim=1).cumsum(0)
    pairs = [_pairs(splats, low, size, part, grid[1]) for part in _parts(ends)]
    owners = torch.cat([owner for owner, _ in pairs]) if pairs else ends.new_zeros(0)
    tiles = torch.cat([tile for _, tile in pairs]) if pairs else ends.new_zeros(0).int()
    tiles, order = torch.sort(tiles, stable=True)
    counts = torch.bincount(tiles, minlength=grid[0] * grid[1])
    return Bins(owners[order], counts.cumsum(0) - counts, counts)


def _tile_boxes(
    splats: Splats2D, grid: tuple[int, int]
) -> tuple[Int[Tensor, "m 2"], Int[Tensor, "m 2"]]:
    """First tile and number of tiles, in x and y, of the box around each splat's ellipse."""
    half = half_sizes(splats) * (1 + REACH_SLACK)
    limit = splats.means.new_tensor([grid[1], grid[0]])
    low = ((splats.means - half) / TILE).floor().clamp(min=0.0).minimum(limit)
    high = ((splats.means + half) / TILE).floor().add(1).clamp(min=0.0).minimum(limit)
    return low.long(), (high - low).clamp(min=0.0).long()


def _parts(ends: Int[Tensor, " m"]) -> list[slice]:
    """Cut the splats into runs of at most about PAIR_BUDGET candidate pairs."""
    total = int(ends[-1]) if len(ends) else 0
    marks = torch.arange(PAIR_BUDGET, total + PAIR_BUDGET, PAIR_BUDGET, device=ends.device)
    cuts = [0, *dict.fromkeys(torch.searchsorted(ends, marks).clamp(max=len(ends)).tolist())]
    cuts = [*cuts, len(ends)] if cuts[-1] != len(ends) else cuts
    return [slice(a, b) for a, b in pairwise(cuts) if b > a]


def _pairs(
    splats: Splats2D,
    low: Int[Tensor, "m 2"],
    size: Int[Tensor, "m 2"],
    part: slice,
    columns: int,
) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"]]:
    """Owners and tiles of the pairs whose ellipse reaches a pixel centre's box of the tile."""
    low, size = low[part], size[part]
    counts = size.prod(dim=1)
    owner = torch.repeat_interleave(counts)
    place = torch.arange(len(owner), device=owner.device) - (counts.cumsum(0) - counts)[owner]
    width = size[:, 0][owner]
    row = place // width
    tile_x = place - row * width + low[:, 0][owner]
    tile_y = row + low[:, 1][owner]
    reached = _reaches(splats[part], owner, tile_x, tile_y)
    tiles = (tile_y * columns + tile_x)[reached].int()
    return owner[reached] + part.start, tiles


def _reaches(
    splats: Splats2D, owner: Int[Tensor, " p"], tile_x: Int[Tensor, " p"], tile_y: Int[Tensor, " p"]
) -> Tensor:
    """Whether alpha ≥ 1/255 anywhere in the box of the tile's pixel centres.

    The quadratic is convex, so over a box that does not hold the centre its minimum lies on a side that faces the
    centre; both facing sides are tried.
    """
    x, y = splats.means[owner].unbind(dim=1)
    left, top = tile_x * TILE + 0.5 - x, tile_y * TILE + 0.5 - y
    right, bottom = left + (TILE - 1), top + (TILE - 1)
    side_x = torch.zeros_like(x).clamp(left, right)
    side_y = torch.zeros_like(y).clamp(top, bottom)
    xx, xy, yy = (splats.covs / splats.dets[:, None])[owner].unbind(dim=1)  # conic is (yy, −xy, xx)
    on_x = (xy / xx * side_x).clamp(top, bottom)
    on_y = (xy / yy * side_y).clamp(left, right)
    distance = torch.minimum(
        yy * side_x * side_x - 2 * xy * side_x * on_x + xx * on_x * on_x,
        yy * on_y * on_y - 2 * xy * on_y * side_y + xx * side_y * side_y,
    )
    slack = REACH_SLACK * (1 + yy * side_x * side_x + xx * side_y * side_y)
    return distance <= reach(splats)[owner] + slack


def _composite(
    drawing: Float[Tensor, "m 10"], bins: Bins, grid: tuple[int, int]
) -> Float[Tensor, "all P 4"]:
    """Premultiplied colour and alpha of every pixel of every tile."""
    image = drawing.new_zeros(grid[0] * grid[1], TILE * TILE, 4)
    order = torch.sort(bins.counts, descending=True).indices[: int((bins.counts > 0).sum())]
    for tiles in order.split(BLOCK):
        _composite_block(drawing, bins, tiles, grid[1], image)
    return image


def _composite_block(
    drawing: Float[Tensor, "m 10"],
    bins: Bins,
    tiles: Int[Tensor, " t"],
    columns: int,
    image: Float[Tensor, "all P 4"],
) -> None:
    """Composite some tiles, longest first, into the image; tiles leave when they are saturated or drawn out."""
    first, counts = bins.first[tiles], bins.counts[tiles]
    centre = torch.stack([tiles % columns, tiles // columns], dim=1) * TILE + TILE / 2
    local = _local_positions(drawing)
    transmittance = drawing.new_ones(len(tiles), TILE * TILE)
    total = drawing.new_zeros(len(tiles), TILE * TILE, 4)
    start = 0
    while len(tiles):
        step = PASS * max(1, BLOCK // len(tiles))  # few tiles take more splats at once
        place = start + torch.arange(step, device=tiles.device)[:, None]
        pair = torch.where(place < counts, first + place, 0)
        splat = torch.where(place < counts, bins.splats[pair], len(drawing) - 1)
        transmittance = _pass(drawing[splat], centre, local, transmittance, total)
        start += step
        live = (transmittance.amax(dim=1) > 0) & (counts > start)
        if not live.all():
            image[tiles[~live]] = total[~live]
            tiles, first, counts, centre = tiles[live], first[live], counts[live], centre[live]
            transmittance, total = transmittance[live], total[live]


def _local_positions(like: Tensor) -> Float[Tensor, "3 P"]:
    """Rows 1, x, y of a tile's pixel centres, from the tile's centre."""
    offset = torch.arange(TILE, dtype=like.dtype, device=like.device) + 0.5 - TILE / 2
    y, x = torch.meshgrid(offset, offset, indexing="ij")
    return torch.stack([torch.ones_like(x), x, y]).flatten(1)


def _pass(
    splats: Float[Tensor, "K t 10"],
    centre: Float[Tensor, "t 2"],
    local: Float[Tensor, "3 P"],
    transmittance: Float[Tensor, "t P"],
    total: Float[Tensor, "t P 4"],
) -> Float[Tensor, "t P"]:
    """Composite K splats a tile onto `total` in place; returns the transmittance, 0 where the pixel has stopped."""
    alpha = _alphas(splats, centre, local)
    steps = alpha.new_empty(len(splats) + 1, *transmittance.shape)
    steps[0] = transmittance
    views = steps.unbind()
    for before, after, kept in zip(views, views[1:], (1 - alpha).unbind(), strict=False):
        torch.mul(before, kept, out=after)
    after = torch.threshold_(steps[1:], BELOW_MIN_TRANSMITTANCE, 0.0)
    weight = alpha.mul_(steps[:-1]).mul_(after > 0)
    colour = torch.nn.functional.pad(splats[..., RGB], (0, 1), value=1.0)
    total.baddbmm_(weight.permute(1, 2, 0), colour.transpose(0, 1))
    return after[-1]


def _alphas(
    splats: Float[Tensor, "K t 10"], centre: Float[Tensor, "t 2"], local: Float[Tensor, "3 P"]
) -> Float[Tensor, "K t P"]:
    dx, dy = (centre - splats[..., X : Y + 1]).unbind(dim=-1)
    ux, uy, vx, vy = splats[..., UX : VY + 1].unbind(dim=-1)
    u = torch.stack([ux * dx + uy * dy, ux, uy], dim=-1).flatten(0, 1) @ local
    v = torch.stack([vx * dx + vy * dy, vx, vy], dim=-1).flatten(0, 1) @ local
    exponent = u.square_().addcmul_(v, v).neg_().add_(splats[..., LOG2_OPACITY].reshape(-1, 1))
    alpha = exponent.clamp_(min=LOG2_SILENT).exp2_()
    alpha = torch.threshold_(alpha, BELOW_MIN_ALPHA, 0.0).clamp_(max=MAX_ALPHA)
    return alpha.view(*splats.shape[:2], -1)

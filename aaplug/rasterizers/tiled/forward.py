"""Compositing, forward: the splats of every tile over each other, as elementwise array code that compiles to one loop.

t: tiles; K: splats per pass or step; P: pixels per tile; c: columns of a raster row.

A pass composites a few splats of every tile.  Tiles with the most splats come first, so that those that finish are the
last ones; from time to time tiles whose pixels are all saturated are dropped.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.interfaces import PixelKernel, Pixels
from aaplug.core.kernels import Kernel, Kernels
from aaplug.core.rules import Rules
from aaplug.methods.pixel_kernels.raster_rows import BLUE, COLUMNS, GREEN, PIXELS, RED, tile_centres
from aaplug.rasterizers.tiled.binning import LONGEST_PASS, Bins

STEP = 4  # splats per backward step; transmittance is kept before each one.  More, and the compiler splits the loop
CHECK_EVERY = 2  # passes between checks for saturated tiles
COMPACT_BELOW = 3 / 4  # share of unsaturated tiles below which the others are dropped
SURELY = 1e9  # anything that is not 0 here, times this, is above 1
EXAMPLE_TILES, EXAMPLE_SPLATS = (1024, 4096)  # as large as real work: inductor chooses by them which loops use threads


@dataclass(frozen=True)
class Compositing:
    """What stays the same for every tile of a frame.  kernels: run its stages."""

    pixel: PixelKernel
    rules: Rules
    kernels: Kernels

    @property
    def kernel(self) -> Kernel:
        """One pass."""
        return pass_kernel(self.pixel, self.rules)


@dataclass(frozen=True)
class Turn:
    """What was composited between two checks for saturated tiles.

    splats: first, and one past the last, of each tile, from where the turn began.
    before: per step, the transmittance of the tiles that took part; these are the first of `tiles`.
    """

    tiles: Int[Tensor, " t"]
    splats: tuple[Int[Tensor, " t"], Int[Tensor, " t"]]
    origins: Float[Tensor, "t 2"]
    before: list[Float[Tensor, "n P"]]


def composite_forward(
    rows: Float[Tensor, "m c"], bins: Bins, how: Compositing, turns: list[Turn] | None = None
) -> tuple[Float[Tensor, "3 all P"], Float[Tensor, "all P"]]:
    """Premultiplied colour, and alpha, of every pixel of every tile; appends to `turns` what backward needs.

    rows: raster rows; the last one draws nothing.
    """
    local = tile_centres(rows)
    image = rows.new_zeros(4, len(bins.counts), PIXELS)
    order = torch.sort(bins.counts, descending=True, stable=True).indices
    order = order[: int((bins.counts > 0).sum())]
    for tiles in order.split(how.kernels.tiles):
        _composite_block(rows, bins, tiles, image, local, how, turns)
    return image[:3], image[3]


def _composite_block(
    rows: Float[Tensor, "m c"],
    bins: Bins,
    tiles: Int[Tensor, " t"],
    image: Float[Tensor, "4 all P"],
    local: tuple[Float[Tensor, " P"], Float[Tensor, " P"]],
    how: Compositing,
    turns: list[Turn] | None,
) -> None:
    """Composite some tiles, longest first, into the image, until they run out of splats or saturate."""
    T = rows.new_ones(len(tiles), PIXELS)
    planes = rows.new_zeros(4, len(tiles), PIXELS)
    start, splats = 0, how.pixel.splats_per_pass
    while len(tiles):
        columns = [x.index_select(0, tiles) for x in (bins.first, bins.counts, bins.origins)]
        first, counts, origins = columns
        at, ends, ones = first + start, first + counts, torch.ones_like(origins[:, 0])
        going, rest = _going(counts - start, splats), tiles[:0]
        before, steps = [], [] if turns is None else _going(counts - start, STEP)
        if turns is not None:
            turns.append(Turn(tiles, (at, ends), origins, before))
        for turn, n in enumerate(going):
            where = (bins.splats, at[:n] + turn * splats, ends[:n], origins[:n])
            pixels = (T[:n], *planes[:, :n].unbind(), *local, ones[:n])
            *within, after = how.kernels.run(how.kernel, rows, *where, *pixels)
            here = steps[turn * splats // STEP :]
            before += [x[:m] for x, m in zip((T, *within), here, strict=False)]
            T = after
            start += splats
            if turn % CHECK_EVERY == CHECK_EVERY - 1 and turn + 1 < len(going):
                alive = T[: going[turn + 1]].amax(dim=1) > 0
                if int(alive.sum()) < COMPACT_BELOW * len(alive):
                    rest = alive.nonzero().squeeze(1)
                    break
        image.index_copy_(1, tiles, planes)
        tiles, T = tiles.index_select(0, rest), T.index_select(0, rest)
        planes = planes.index_select(1, rest)


def _going(counts: Int[Tensor, " t"], at_once: int) -> list[int]:
    """Number of tiles in each pass of `at_once` splats, from the tiles' splat counts in falling order."""
    passes = (counts + (at_once - 1)) // at_once
    turns = torch.arange(int(passes[0]), device=counts.device)
    return (len(passes) - torch.searchsorted(passes.flip(0), turns, right=True)).tolist()


def _pass(
    pixel: PixelKernel,
    rules: Rules,
    rows: Float[Tensor, "m c"],
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
) -> tuple[Float[Tensor, "t P"], ...]:
    """Composite the splats from `at` of each tile into its colour and alpha, as many as a pass has.

    Returns the transmittance after each STEP of them, 0 once a pixel has stopped.
    one: ones; a column of them in each step keeps the compiler to one loop over tiles.
    """
    one, splats = one[:, None], pixel.splats_per_pass
    before, seen = T, []
    pixels = Pixels(origins, local_x, local_y)
    if torch.compiler.is_compiling():  # each row is loaded where it is needed
        drawn = (rows[torch.where(at + k < ends, ids[at + k], -1)] for k in range(splats))
    else:
        (owners,) = owners_of(rows, ids, at, ends, splats)
        drawn = rows_at(rows, owners.T)
    for row, alpha in in_turn(pixel, rules, drawn, pixels):
        after = before * transmitted(alpha, one, rules)
        weight = where_above(rules.below_min_transmittance, after, less(before, after, one))
        before = after
        red.addcmul_(weight, row[:, RED, None])
        green.addcmul_(weight, row[:, GREEN, None])
        blue.addcmul_(weight, row[:, BLUE, None])
        hidden.add_(weight)
        seen.append(before)
    bound = rules.below_min_transmittance
    return tuple(torch.threshold(one * x, bound, 0.0) for x in seen[STEP - 1 :: STEP])


def in_turn(
    pixel: PixelKernel, rules: Rules, rows: Float[Tensor, "K t c"] | Iterator[Tensor], pixels: Pixels
) -> Iterator[tuple[Float[Tensor, "t c"], Float[Tensor, "t P"]]]:
    """Row and alpha of K splats of each tile, one after the other.

    Eager code computes all alphas at once, a compiled loop each one where it is needed.
    """
    if isinstance(rows, Tensor) and not torch.compiler.is_compiling():
        yield from zip(rows.unbind(), pixel.alpha(rows, pixels, rules).unbind(), strict=True)
    else:
        for row in rows:
            yield row, pixel.alpha(row, pixels, rules)


# Eager code pays per operation, and most for `where`.  A compiled loop pays for calls and for minima and maxima, which
# test for NaN.  So these three are written for each.


def transmitted(alpha: Float[Tensor, "t P"], one: Float[Tensor, "t 1"], rules: Rules) -> Float[Tensor, "t P"]:
    """The share of the light that a splat lets through."""
    least = 1 - rules.max_alpha
    if torch.compiler.is_compiling():
        return torch.relu(rules.max_alpha * one - alpha) + least
    return (one - alpha).clamp_(min=least)


def less(x: Float[Tensor, "t P"], y: Float[Tensor, "t P"], one: Float[Tensor, "t 1"]) -> Float[Tensor, "t P"]:
    """x − y."""
    return one * x - y if torch.compiler.is_compiling() else x - y


def where_above(bound: float, test: Tensor, value: Tensor) -> Tensor:
    """`value` where `test` is above `bound`, else 0; none of them is negative."""
    if torch.compiler.is_compiling():
        return torch.where(test > bound, value, 0.0)
    return torch.minimum(torch.threshold(test, bound, 0.0).mul_(SURELY), value)


def owners_of(
    rows: Float[Tensor, "m c"],
    ids: Int[Tensor, " p"],
    at: Int[Tensor, " t"],
    ends: Int[Tensor, " t"],
    count: int = STEP,
) -> tuple[Int[Tensor, "t K"]]:
    """The splats `at` to `at + count` of each tile; past its last one, the row that draws nothing."""
    place = at[:, None] + torch.arange(count, device=at.device)
    return (torch.where(place < ends[:, None], ids[place], rows.shape[0] - 1),)


def rows_at(rows: Float[Tensor, "m c"], owners: Int[Tensor, "*n"]) -> Float[Tensor, "*n c"]:
    """Raster rows of splats."""
    return rows.index_select(0, owners.flatten()).view(*owners.shape, -1)


def _pass_example(columns: int) -> tuple[Tensor, ...]:
    rows, origins, *pixels = rows_example(5, columns)
    _, *where = _owners_example()
    return rows.flatten(0, 1)[:EXAMPLE_SPLATS], *where, origins, *pixels


def rows_example(planes: int, columns: int) -> tuple[Tensor, ...]:
    """Raster rows of a step, tile corners and planes of pixels to compile for."""
    tiles = EXAMPLE_TILES
    rows = torch.linspace(0.012, 0.1, tiles * STEP * columns).view(tiles, STEP, columns)
    pixels = [torch.full((tiles, PIXELS), 0.5) for _ in range(planes)]
    return rows, torch.ones(tiles, 2), *pixels, *tile_centres(rows), torch.ones(tiles)


def _owners_example() -> tuple[Tensor, ...]:
    ids = torch.arange((EXAMPLE_TILES + 1) * LONGEST_PASS, dtype=torch.int32) % EXAMPLE_SPLATS
    at = torch.arange(EXAMPLE_TILES) * LONGEST_PASS
    return torch.ones(EXAMPLE_SPLATS, COLUMNS), ids, at, at + LONGEST_PASS


@cache
def pass_kernel(pixel: PixelKernel, rules: Rules) -> Kernel:
    """A pass of one pixel kernel by the given rules."""
    return Kernel(
        f"composite-{pixel.name}{rules.tag}",
        partial(_pass, pixel, rules),
        partial(_pass_example, pixel.columns),
        ("m", "p", *8 * ("t",), None, None, "t"),
        evaluations=pixel.splats_per_pass,
    )


OWNERS = Kernel("owners", owners_of, _owners_example, ("m", "p", "t", "t"))

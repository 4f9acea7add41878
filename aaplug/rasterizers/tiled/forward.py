"""Compositing, forward: front-to-back alpha compositing of all tiles at once, as array code that is compiled.

Compiled, a pass gathers its raster rows in one loop, evaluates their forms at the tiles' corners in a second, and
composites in one loop over tiles and pixels.

t: tiles of a block; n: the first of t; P: pixels per tile; K: splats per pass or step; d: channels;
m: raster rows; p: entries of `Bins.splats`; c: columns of a raster row.

A pass composites the next splats of every tile.  Tiles are sorted by falling splat count, so tiles with splats left
are always a prefix.  From time to time, tiles whose pixels are all saturated are dropped (compaction).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from aaplug.core.colours import BLACK, Colour
from aaplug.core.interfaces import Limits, PixelKernel, Pixels, ReadsRays
from aaplug.core.kernels import EAGER, Kernel, Kernels, materialized, where_signed
from aaplug.core.rules import RULES_3DGS, Rules
from aaplug.core.splats import Splats2D
from aaplug.methods.pixel_kernels.raster_rows import PIXELS, RED, forms_at_corners, next_rows, tile_centres
from aaplug.rasterizers.tiled.binning import Bins
from aaplug.rasterizers.tiled.layout import placed

STEP = 4  # splats per backward step; transmittance is stored before each step.  With 8 the sums leave the registers
CHECK_PASSES, CHECK_TILES = 2, 1000  # least passes, and tiles in them, between checks for saturated tiles
COMPACT_BELOW = 3 / 4  # saturated tiles are dropped once the share of unsaturated ones is below this
MIN_TILES = 2  # tiles in a pass: compiled kernels take no fewer, and a tile without splats left stays as it is
MASK_GAIN = 1e9  # lifts any nonzero output of `threshold` above 1: the smaller of that and a value is 0 or the value
EXAMPLE_TILES, EXAMPLE_SPLATS = 1024, 4096  # as large as real work: inductor chooses by them which loops use threads
EXAMPLE_LIST = 16  # splats of each tile


@dataclass(frozen=True)
class Compositing:
    """Settings of one frame's compositing.

    kernels: run its stages.  channels: of a splat's colour.  rays: of places in px, if the pixel kernel reads them.
    background: which the colours in raster rows are differences from.
    """

    pixel: PixelKernel
    rules: Rules
    kernels: Kernels
    channels: int = 3
    rays: Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]] | None = None
    background: Colour = BLACK

    def rays_of(self, origins: Float[Tensor, "t 2"]) -> list[Float[Tensor, "t P"]]:
        """x, y and z of the rays of these tiles' pixels; none if the pixel kernel reads places."""
        if self.rays is None:
            return []
        x, y = (origins[:, i, None] + along for i, along in enumerate(tile_centres(origins)))
        return [*self.rays(x, y)]

    def centres(self, like: Tensor) -> tuple[Float[Tensor, " P"], ...]:
        """x and y of a tile's pixel centres, from its corner, in px; none if the pixel kernel reads rays."""
        return tile_centres(like) if self.rays is None else ()


@dataclass(frozen=True, eq=False)
class Segment:
    """The passes between two compactions of the list of tiles; kept for the backward pass.

    tiles: tiles that were composited, those with the most splats first.
    start: how many splats of each were composited before; a multiple of STEP.
    lists: per tile, where its splats of this segment begin and where all end in `Bins.splats`.
    corners: per tile, x and y of its top left corner in px, and 1.
    before: per backward step, transmittance before it, for the first n of `tiles`: those that had splats left.
    """

    tiles: Int[Tensor, " t"]
    start: int
    lists: Int[Tensor, "t 2"]
    corners: Float[Tensor, "t 3"]
    before: list[Float[Tensor, "n P"]]


def composite_forward(
    rows: Float[Tensor, "m c"], bins: Bins, how: Compositing, segments: list[Segment] | None = None
) -> tuple[Float[Tensor, "d h w"], Float[Tensor, "h w"]]:
    """Colour over the background, and alpha, of every pixel; appends what the backward pass needs to `segments`.

    rows: raster rows; the last one is the padding row.

    Over the background b, Σ w c + (1 - Σ w) b equals b + Σ w (c - b): compositing begins with b, at no cost.
    """
    local = how.centres(rows)
    order = bins.by_length()
    filled = max(MIN_TILES, int((bins.counts > 0).sum()))
    planes = rows.new_zeros(how.channels + 1, min(filled + 1, len(order)), PIXELS)  # all empty tiles share the last
    for plane, value in zip(planes[:-1], how.background, strict=False):
        plane.fill_(value)
    tiles = order[:filled].tensor_split(-(-filled // how.kernels.tiles)) if len(order) else ()
    done = 0
    for block in tiles:
        _composite_block(rows, bins, block, planes[:, done : done + len(block)], local, how, segments)
        done += len(block)
    image = placed(planes, order, bins.columns, how.kernels)
    return image[:-1], image[-1]


def _composite_block(
    rows: Float[Tensor, "m c"],
    bins: Bins,
    tiles: Int[Tensor, " t"],
    image: Float[Tensor, "d_and_1 t P"],
    local: tuple[Float[Tensor, " P"], ...],
    how: Compositing,
    segments: list[Segment] | None,
) -> None:
    """Composite one block of tiles into `image`, until their splats run out or every pixel is saturated."""
    T, kernel = rows.new_ones(len(tiles), PIXELS), pass_kernel(how.pixel, how.channels, segments is not None)
    rays = how.rays_of(bins.origins.index_select(0, tiles))
    if rays:
        T.mul_(rays[0].square().addcmul(rays[1], rays[1]).addcmul(rays[2], rays[2]) > 0)  # else nothing is seen
    planes, places = image, None  # of the tiles that are left, and where they lie in the image
    start, splats, limits = 0, how.pixel.splats_per_pass, rows.new_tensor(Limits.by(how.rules))
    while len(tiles):
        first, counts, origins = (x.index_select(0, tiles) for x in (bins.first, bins.counts, bins.origins))
        lists = torch.stack([first + start, first + counts], dim=1)
        corners = functional.pad(origins, (0, 1), value=1.0)
        going, rest = tiles_left(counts - start, splats), tiles[:0]
        before, steps = [], [] if segments is None else tiles_left(counts - start, STEP)
        if segments is not None:
            segments.append(Segment(tiles, start, lists, corners, before))
        part = whole = [lists, corners, T, *planes.unbind(), *rays]
        passes, passed, run = 0, 0, None
        for i, (n, ahead) in enumerate(zip(going, shifts_of(len(going), splats, rows), strict=True)):
            if n < len(T):
                part = [x.narrow(0, 0, n) for x in (*whole[:2], T, *whole[3:])]
                T = part[2]
            args = (rows, bins.splats, *part, *local, limits, ahead)
            run = run or how.kernels.runner(kernel, args)
            states = run(*args)
            if segments is not None:
                before += [x[:m] for x, m in zip((T, *states[:-1]), steps[i * splats // STEP :], strict=False)]
                T = part[2] = states[-1]
            start += splats
            passes, passed = passes + 1, passed + n
            if passes >= CHECK_PASSES and passed >= CHECK_TILES and i + 1 < len(going):
                passes, passed = 0, 0
                alive = T[: going[i + 1]].amax(dim=1) > 0
                count = int(alive.sum())
                if count < COMPACT_BELOW * len(alive):
                    if 0 < count < MIN_TILES:
                        alive[:MIN_TILES] = True
                    rest = alive.nonzero().squeeze(1)
                    break
        if places is not None:
            image.index_copy_(1, places, planes)
        places = rest if places is None else places.index_select(0, rest)
        tiles, T = tiles.index_select(0, rest), T.index_select(0, rest)
        planes, rays = planes.index_select(1, rest), [x.index_select(0, rest) for x in rays]


def tiles_left(counts: Int[Tensor, " t"], at_once: int) -> list[int]:
    """The number of tiles in each pass of `at_once` splats.  counts: splats left per tile, falling."""
    passes = ((counts + (at_once - 1)) // at_once).int()
    turns = torch.arange(1, int(passes[0]) + 1, dtype=torch.int32, device=counts.device)
    going = torch.searchsorted(-passes, -turns, right=True).clamp(min=min(MIN_TILES, len(passes)))
    return going.tolist()


def shifts_of(passes: int, splats: int, like: Tensor) -> Sequence[Int[Tensor, ""]]:
    """How far each pass is from the first, in splats."""
    return torch.arange(0, passes * splats, splats, device=like.device).unbind()


def _pass(
    pixel: PixelKernel,
    keeps: bool,
    rows: Float[Tensor, "m c"],
    ids: Int[Tensor, " p"],
    lists: Int[Tensor, "t 2"],
    corners: Float[Tensor, "t 3"],
    T: Float[Tensor, "t P"],
    *planes_and_rest: Tensor,
) -> tuple[Float[Tensor, "t P"], ...]:
    """Composite the next `splats_per_pass` splats of each tile into d colours and alpha, in place.

    keeps: return the transmittance after every STEP of them, 0 where a pixel has stopped; else update T in place.
    corners: the last column is 1; multiplying by it makes the compiler keep one loop over tiles.
    planes_and_rest: d colours and alpha, [t, P]; x and y of a tile's pixel centres, [P], or x, y and z of rays, [t, P];
        `Limits`; the first splat's place after the beginning of the list.
    """
    *planes, values, ahead = planes_and_rest
    coordinates = coordinates_of(pixel)
    *colours, hidden = planes[:-coordinates]
    limits, one = Limits.of(values), corners[:, 2:]
    before, left = T, []
    x, y, *z = planes[-coordinates:]
    pixels = Pixels(corners, x, y, z[0] if z else None)
    nearest = next_rows(rows, ids, lists[:, 0] + ahead, lists[:, 1], pixel.splats_per_pass)
    for row, _, alpha in in_turn(pixel, limits, nearest, pixels):
        after = before * transmitted(alpha, one, limits)
        weight = where_above(limits.below_min_transmittance, after, less(before, after, one))
        before = after
        for i, colour in enumerate(colours, start=RED):
            colour.addcmul_(weight, row[:, i, None])
        hidden.add_(weight)
        left.append(before)
    if keeps:
        return tuple(where_above(limits.below_min_transmittance, one * x, x) for x in left[STEP - 1 :: STEP])
    T.copy_(where_above(limits.below_min_transmittance, one * before, before))
    return ()


def coordinates_of(pixel: PixelKernel) -> int:
    """Number of a pixel's coordinates that a pixel kernel reads: those of its ray, or of its place."""
    return 3 if isinstance(pixel, ReadsRays) else 2


def in_turn(
    pixel: PixelKernel, limits: Limits, rows: Float[Tensor, "t K c"], pixels: Pixels
) -> Iterator[tuple[Float[Tensor, "t c"], Pixels, Float[Tensor, "t P"]]]:
    """Raster row, pixels and alpha of each tile's k-th splat, for k = 0 … K - 1.

    Eager code computes all alphas at once, a compiled loop each one where it is needed.
    """
    if torch.compiler.is_compiling():
        at_corners = [materialized(form.T) for form in forms_at_corners(rows.transpose(0, 1), pixels.corners)]
        for row, u, v in zip(*(x.unbind(dim=1) for x in (rows, *at_corners)), strict=True):
            seen = Pixels(pixels.corners, pixels.x, pixels.y, pixels.z, (u, v))  # torch 2.6 does not trace `_replace`
            yield row, seen, pixel.alpha(row, seen, limits)
    else:
        alphas = pixel.alpha(rows.transpose(0, 1), pixels, limits)
        yield from ((row, pixels, alpha) for row, alpha in zip(rows.unbind(dim=1), alphas.unbind(), strict=True))


# Eager code costs one pass over memory per operation, and `where` costs most.  In a compiled loop, function calls and
# min/max are slow, because min/max propagate NaN.  So the next three functions have one form for each.


def transmitted(alpha: Float[Tensor, "t P"], one: Float[Tensor, "t 1"], limits: Limits) -> Float[Tensor, "t P"]:
    """1 - alpha, with alpha capped."""
    if isinstance(limits.max_alpha, Tensor):
        return (limits.max_alpha * one - alpha).relu() + (1 - limits.max_alpha)
    return (one - alpha).clamp_(min=1 - limits.max_alpha)


def less(x: Float[Tensor, "t P"], y: Float[Tensor, "t P"], one: Float[Tensor, "t 1"]) -> Float[Tensor, "t P"]:
    """x − y."""
    return one * x - y if torch.compiler.is_compiling() else x - y


def where_above(bound: float | Tensor, test: Tensor, value: Tensor) -> Tensor:
    """`value` where `test` > `bound`, else 0; needs bound >= 0 and 0 <= value <= 1."""
    if isinstance(bound, Tensor) or torch.compiler.is_compiling():
        return where_signed(bound - test, value, negative=True)
    return torch.minimum(torch.threshold(test, bound, 0.0).mul_(MASK_GAIN), value)


def rows_example(pixel: PixelKernel, channels: int) -> Float[Tensor, "m c"]:
    """Raster rows of splats that every pixel of `tiles_example` sees."""
    ramp = torch.linspace(0.0, 1.0, EXAMPLE_SPLATS)
    means = torch.stack([3 + 4 * ramp, 7 - 4 * ramp], dim=1)
    covs = torch.stack([20 + ramp, ramp, 20 - ramp], dim=1)
    dets = covs[:, 0] * covs[:, 2] - covs[:, 1].square()
    shape = (means, covs, dets, 1 + ramp, 0.1 + 0.1 * ramp, torch.arange(EXAMPLE_SPLATS))
    splats = Splats2D(*shape, torch.stack([ramp, 1 - ramp, ramp, ramp][:channels], dim=1), torch.zeros_like(means))
    return pixel.raster_rows(splats, EAGER)


def tiles_example(pixel: PixelKernel, channels: int, planes: int) -> tuple[Tensor, ...]:
    """The arguments of `_pass`, with as many planes of pixels, to compile for."""
    tiles, rows = EXAMPLE_TILES, rows_example(pixel, channels)
    ids = torch.arange(tiles * EXAMPLE_LIST, dtype=torch.int32) % EXAMPLE_SPLATS
    at = torch.arange(tiles) * EXAMPLE_LIST
    lists = torch.stack([at, at + EXAMPLE_LIST], dim=1)
    pixels = [torch.full((tiles, PIXELS), 0.5) for _ in range(planes)]
    limits, x, y = torch.tensor(Limits.by(RULES_3DGS)), *tile_centres(rows)
    if isinstance(pixel, ReadsRays):
        x, y, z = (along.expand(tiles, PIXELS).contiguous() for along in (x, y, torch.ones_like(x)))
        pixels, x, y = [*pixels, x], y, z
    return rows, ids, lists, torch.ones(tiles, 3), *pixels, x, y, limits, torch.tensor(0)


def name_of(pixel: PixelKernel, channels: int) -> str:
    """The name of a pixel kernel's passes."""
    return f"composite-{pixel.name}" if channels == 3 else f"composite-{pixel.name}-{channels}"


def coordinate_sizes(pixel: PixelKernel) -> tuple[str | None, ...]:
    """Leading sizes of the pixels' coordinates."""
    return ("t",) * 3 if isinstance(pixel, ReadsRays) else (None, None)


@cache
def pass_kernel(pixel: PixelKernel, channels: int = 3, keeps: bool = False) -> Kernel:
    """A pass of one pixel kernel.  keeps: what gradients need, see `_pass`."""
    planes = range(4, 6 + channels)  # transmittance, colours and alpha
    return Kernel(
        name_of(pixel, channels) + ("-kept" if keeps else ""),
        partial(_pass, pixel, keeps),
        partial(tiles_example, pixel, channels, len(planes)),
        ("m", "p", "t", "t", *("t" for _ in planes), *coordinate_sizes(pixel), None, None),
        updates=tuple(planes)[keeps:],
        evaluations=pixel.splats_per_pass,
    )

"""Compositing: the splats of every tile over each other, as elementwise array code that compiles to one loop.

t: tiles; K: splats a pass or a step; P: pixels a tile; c: columns of a drawing row.

Tiles are composited some splats a pass, those with most splats first, so that the ones that are done are the last;
tiles whose pixels are all saturated leave now and then.

The backward pass goes from the last splats to the first, in steps of STEP.  With B the light from behind a splat, were
the pixel clear down to there, ∂L/∂alpha_k = T_k (g·c_k − B_k) and B_{k−1} = B_k + alpha_k (g·c_k − B_k).  T at each
step's start is all that is kept.  (Carrying what is left of Σ g·w·c from the front would need a division by 1 − alpha,
and loses digits where that is small.)
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from aaplug.interfaces import PixelKernel
from aaplug.kernels import Kernel, Kernels
from aaplug.rasterizers.binning import PASS, TILE, Bins
from aaplug.rasterizers.drawing import (
    ALPHA,
    BLUE,
    COLUMNS,
    GREEN,
    PIXELS,
    RED,
    WIDTH,
    AlphaOf,
    Pixels,
    forms_at,
    offsets_at,
    pixel_centres,
)
from aaplug.rasterizers.rules import MAX_ALPHA, MIN_TRANSMITTANCE, just_below

STEP = 4  # splats that gradients go through at once: of more sums the compiler makes several loops
SHORT_PASS = 8  # where alpha is much to compile, and much work beside what a pass loads and stores
CHECK_EVERY = 2  # passes between looks at which tiles are saturated
STEPS_TOGETHER = 8  # looked up at once
COMPACT_BELOW = 3 / 4  # share of tiles still going at which the others leave
PARTS_AT_ONCE = 1 << 18  # more than a step has; or two a splat, if that is more
LN_2 = math.log(2)
BELOW_MIN_TRANSMITTANCE = just_below(MIN_TRANSMITTANCE)
SURELY = 1e9  # times anything that is not 0 here is over 1


def composite(
    drawing: Float[Tensor, "m c"], bins: Bins, kernels: Kernels, pixel: PixelKernel = "point"
) -> tuple[Float[Tensor, "3 t P"], Float[Tensor, "t P"]]:
    """Premultiplied colour, and alpha, of every pixel of every tile.

    drawing: parameters by column; its last row draws nothing.
    """
    if drawing.requires_grad and torch.is_grad_enabled():
        return _Composite.apply(drawing, bins, kernels, pixel)  # pyright: ignore[reportReturnType]
    return _forward(drawing, bins, kernels, pixel)


class Pass(NamedTuple):
    """Some splats of every tile composited at once.  splats: a multiple of STEP, at most `binning.PASS`."""

    splats: int
    kernel: Kernel


@dataclass(frozen=True)
class _Turn:
    """What was composited between two looks at which tiles are done.

    splats: first and after last of each tile, from where the turn began.  before: of each step the transmittance of
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
) -> tuple[Float[Tensor, "3 all P"], Float[Tensor, "all P"]]:
    """Colour and alpha; the turns that made it are put into `turns`, in order."""
    local = pixel_centres(drawing)
    image = drawing.new_zeros(4, len(bins.counts), PIXELS)
    order = torch.sort(bins.counts, descending=True, stable=True).indices
    order = order[: int((bins.counts > 0).sum())]
    for tiles in order.split(kernels.tiles):
        _composite_block(drawing, bins, tiles, image, local, kernels, PASSES[pixel], turns)
    return image[:3], image[3]


def _composite_block(
    drawing: Float[Tensor, "m c"],
    bins: Bins,
    tiles: Int[Tensor, " t"],
    image: Float[Tensor, "4 all P"],
    local: tuple[Float[Tensor, " P"], Float[Tensor, " P"]],
    kernels: Kernels,
    one_pass: Pass,
    turns: list[_Turn] | None,
) -> None:
    """Composite some tiles, longest first, into the image, until they are drawn out or saturated."""
    T = drawing.new_ones(len(tiles), PIXELS)
    planes = drawing.new_zeros(4, len(tiles), PIXELS)
    start = 0
    while len(tiles):
        columns = [x.index_select(0, tiles) for x in (bins.first, bins.counts, bins.origins)]
        first, counts, origins = columns
        at, ends, ones = first + start, first + counts, torch.ones_like(origins[:, 0])
        going, left = _going(counts - start, one_pass.splats), tiles[:0]
        before, steps = [], [] if turns is None else _going(counts - start, STEP)
        if turns is not None:
            turns.append(_Turn(tiles, (at, ends), origins, before))
        for turn, n in enumerate(going):
            where = (bins.splats, at[:n] + turn * one_pass.splats, ends[:n], origins[:n])
            pixels = (T[:n], *planes[:, :n].unbind(), *local, ones[:n])
            *within, after = kernels.run(one_pass.kernel, drawing, *where, *pixels)
            here = steps[turn * one_pass.splats // STEP :]
            before += [x[:m] for x, m in zip((T, *within), here, strict=False)]
            T = after
            start += one_pass.splats
            if turn % CHECK_EVERY == CHECK_EVERY - 1 and turn + 1 < len(going):
                alive = T[: going[turn + 1]].amax(dim=1) > 0
                if int(alive.sum()) < COMPACT_BELOW * len(alive):
                    left = alive.nonzero().squeeze(1)
                    break
        image.index_copy_(1, tiles, planes)
        tiles, T = tiles.index_select(0, left), T.index_select(0, left)
        planes = planes.index_select(1, left)


def _going(counts: Int[Tensor, " t"], at_once: int) -> list[int]:
    """How many tiles take part in each pass of some splats at once, from their splats, most first."""
    passes = (counts + (at_once - 1)) // at_once
    turns = torch.arange(int(passes[0]), device=counts.device)
    return (len(passes) - torch.searchsorted(passes.flip(0), turns, right=True)).tolist()


def _chunk(
    alpha_of: AlphaOf,
    splats: int,
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
) -> tuple[Float[Tensor, "t P"], ...]:
    """Composite splats at to at + `splats` of each tile into its colour and alpha.

    Returns its transmittance after each STEP of them; 0 once a pixel has stopped.
    one: ones; a column of them in each step keeps the compiler to one loop over tiles.
    """
    one = one[:, None]
    before, seen = T, []
    pixels = Pixels(origins, local_x, local_y)
    if torch.compiler.is_compiling():  # each row too is loaded where it is needed
        rows = (drawing[torch.where(at + k < ends, ids[at + k], -1)] for k in range(splats))
    else:
        (owners,) = _owners(drawing, ids, at, ends, splats)
        rows = _rows(drawing, owners.T)
    for row, alpha in _splats(alpha_of, rows, pixels):
        after = before * _left(alpha, one)
        weight = _where_above(BELOW_MIN_TRANSMITTANCE, after, _less(before, after, one))
        before = after
        red.addcmul_(weight, row[:, RED, None])
        green.addcmul_(weight, row[:, GREEN, None])
        blue.addcmul_(weight, row[:, BLUE, None])
        hidden.add_(weight)
        seen.append(before)
    return tuple(
        torch.threshold(one * x, BELOW_MIN_TRANSMITTANCE, 0.0) for x in seen[STEP - 1 :: STEP]
    )


def _splats(
    alpha_of: AlphaOf, rows: Float[Tensor, "K t c"] | Iterator[Tensor], pixels: Pixels
) -> Iterator[tuple[Float[Tensor, "t c"], Float[Tensor, "t P"]]]:
    """Row and alpha of K splats of each tile in turn.

    Array code finds the alphas of all at once, a compiled loop each where it is needed.
    """
    if isinstance(rows, Tensor) and not torch.compiler.is_compiling():
        yield from zip(rows.unbind(), alpha_of(rows, pixels).unbind(), strict=True)
    else:
        for row in rows:
            yield row, alpha_of(row, pixels)


# Array code pays for every operation and most for choosing; a compiled loop pays for calls, of which exp2 is one, and
# for minima and maxima, which look for NaN.  So these are written for each.


def _left(alpha: Float[Tensor, "t P"], one: Float[Tensor, "t 1"]) -> Float[Tensor, "t P"]:
    """The share of the light that a splat lets through."""
    least = 1 - MAX_ALPHA
    if torch.compiler.is_compiling():
        return torch.relu(MAX_ALPHA * one - alpha) + least
    return (one - alpha).clamp_(min=least)


def _less(
    x: Float[Tensor, "t P"], y: Float[Tensor, "t P"], one: Float[Tensor, "t 1"]
) -> Float[Tensor, "t P"]:
    """x − y."""
    return one * x - y if torch.compiler.is_compiling() else x - y


def _where_above(bound: float, test: Tensor, value: Tensor) -> Tensor:
    """A value, not negative, where a test is above a bound, itself not negative; else 0."""
    if torch.compiler.is_compiling():
        return torch.where(test > bound, value, 0.0)
    return torch.minimum(torch.threshold(test, bound, 0.0).mul_(SURELY), value)


# -------------------------------------------------------------------------------------------------------- backward


class _Composite(torch.autograd.Function):
    """Compositing with its own backward pass."""

    @staticmethod
    def forward(
        ctx: Any, drawing: Tensor, bins: Bins, kernels: Kernels, pixel: PixelKernel
    ) -> tuple[Tensor, Tensor]:
        turns: list[_Turn] = []
        colour, alpha = _forward(drawing, bins, kernels, pixel, turns)
        ctx.save_for_backward(drawing)
        ctx.rest = (bins, turns, kernels, pixel)
        return colour, alpha

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None]:
        (drawing,) = ctx.saved_tensors
        colour, alpha = (grad.contiguous() for grad in grads)
        return _backward(drawing, colour, alpha, *ctx.rest), None, None, None


def _backward(
    drawing: Float[Tensor, "m c"],
    g_colour: Float[Tensor, "3 all P"],
    g_alpha: Float[Tensor, "all P"],
    bins: Bins,
    turns: list[_Turn],
    kernels: Kernels,
    pixel: PixelKernel,
) -> Float[Tensor, "m c"]:
    """Gradient of the drawing parameters."""
    local = pixel_centres(drawing)
    parts = _Parts(torch.zeros_like(drawing))
    light = torch.zeros_like(g_alpha)
    for turn in reversed(turns):
        behind, hidden = (plane.index_select(0, turn.tiles) for plane in (light, g_alpha))
        colours = g_colour.index_select(1, turn.tiles)
        ones = torch.ones_like(turn.origins[:, 0])
        for owners, rows, before in _steps(drawing, bins, turn, kernels):
            n = len(before)
            grads = (*colours[:, :n].unbind(), hidden[:n])
            pixels = (before, behind[:n], *grads, *local, ones[:n])
            (sums,) = kernels.run(CHUNK_BACKWARD[pixel], rows, turn.origins[:n], *pixels)
            parts.add(owners, sums)
        light.index_copy_(0, turn.tiles, behind)
    total = parts.total()
    return kernels.run(FROM_SUMS, drawing, total)[0] if pixel == "point" else total


def _steps(
    drawing: Float[Tensor, "m c"], bins: Bins, turn: _Turn, kernels: Kernels
) -> Iterator[tuple[Int[Tensor, "n K"], Float[Tensor, "n K c"], Float[Tensor, "n P"]]]:
    """Owners, rows and transmittance of each step of a turn, from the last; some are looked up together."""
    at, ends = turn.splats
    for start in reversed(range(0, len(turn.before), STEPS_TOGETHER)):
        together = turn.before[start : start + STEPS_TOGETHER]
        sizes = [len(before) for before in together]
        places = torch.cat([at[:n] + (start + i) * STEP for i, n in enumerate(sizes)])
        last = torch.cat([ends[:n] for n in sizes])
        (owners,) = kernels.run(OWNERS, drawing, bins.splats, places, last)
        rows = _rows(drawing, owners)
        steps = zip(owners.split(sizes), rows.split(sizes), together, strict=True)
        yield from reversed(list(steps))


def _owners(
    drawing: Float[Tensor, "m c"],
    ids: Int[Tensor, " p"],
    at: Int[Tensor, " t"],
    ends: Int[Tensor, " t"],
    count: int = STEP,
) -> tuple[Int[Tensor, "t K"]]:
    """The splats at to at + count of each tile; after its last the one that draws nothing."""
    place = at[:, None] + torch.arange(count, device=at.device)
    return (torch.where(place < ends[:, None], ids[place], drawing.shape[0] - 1),)


def _rows(drawing: Float[Tensor, "m c"], owners: Int[Tensor, "*n"]) -> Float[Tensor, "*n c"]:
    """Parameters of splats."""
    return drawing.index_select(0, owners.flatten()).view(*owners.shape, -1)


class _Parts:
    """Adds up what tiles add to the sums of splats.

    Parts are gathered and sorted by splat, which is several times as fast as adding each where it belongs.
    """

    def __init__(self, total: Float[Tensor, "m c"]):
        room = max(PARTS_AT_ONCE, 2 * len(total))
        self._total, self._count = total, 0
        few = len(total) < torch.iinfo(torch.int16).max  # half the bits sort in half the time
        self._owners = total.new_empty(room, dtype=torch.int16 if few else torch.int32)
        self._parts = total.new_empty(room, total.shape[1])

    def add(self, owners: Int[Tensor, "t K"], parts: Float[Tensor, "t c_K"]) -> None:
        """Add those of a step, which are fewer than there is room for."""
        end = self._count + owners.numel()
        if end > len(self._owners):
            self._sum()
            end = owners.numel()
        self._owners[self._count : end] = owners.flatten()
        self._parts[self._count : end] = parts.view(-1, self._parts.shape[1])
        self._count = end

    def total(self) -> Float[Tensor, "m c"]:
        """All that was added."""
        if self._count:
            self._sum()
        return self._total

    def _sum(self) -> None:
        owners = self._owners[: self._count]
        order = torch.sort(owners, stable=True).indices
        counts = torch.bincount(owners, minlength=len(self._total))
        first = counts.cumsum(0) - counts
        parts = self._parts[: self._count]
        self._total += functional.embedding_bag(order, parts, first, mode="sum")
        self._count = 0


class _Move(NamedTuple):
    """Of a splat of each tile: its row, its weight in each pixel, and the gradient of log alpha there."""

    row: Float[Tensor, "t c"]
    weight: Float[Tensor, "t P"]
    gradient: Float[Tensor, "t P"]


SumsOf = Callable[[list[_Move], tuple[Tensor, Tensor, Tensor], Tensor, Pixels], Tensor]


def _chunk_backward(
    alpha_of: AlphaOf,
    sums_of: SumsOf,
    rows: Float[Tensor, "t K c"],
    origins: Float[Tensor, "t 2"],
    T: Float[Tensor, "t P"],
    behind: Float[Tensor, "t P"],
    g_red: Float[Tensor, "t P"],
    g_green: Float[Tensor, "t P"],
    g_blue: Float[Tensor, "t P"],
    g_hidden: Float[Tensor, "t P"],
    local_x: Float[Tensor, " P"],
    local_y: Float[Tensor, " P"],
    one: Float[Tensor, " t"],
) -> tuple[Float[Tensor, "t c_STEP"]]:
    """What tiles add to the sums of K splats, one splat after the other; puts these into `behind`."""
    one = one[:, None]
    before, drawn = T, []
    pixels = Pixels(origins, local_x, local_y)
    for row, alpha in _splats(alpha_of, rows.transpose(0, 1), pixels):
        left = _left(alpha, one)
        after = before * left
        hides = _where_above(BELOW_MIN_TRANSMITTANCE, after, one - left)
        drawn.append((row, alpha, hides, before))
        before = after
    moves, light = [], behind
    for row, alpha, hides, reaching in reversed(drawn):
        weight = reaching * hides
        colour = torch.addcmul(g_hidden, row[:, RED, None], g_red)
        colour = torch.addcmul(colour, row[:, GREEN, None], g_green)
        colour = torch.addcmul(colour, row[:, BLUE, None], g_blue)
        ahead = _less(colour, light, one)
        # where alpha is skipped or comes too late its weight is 0, and where it is capped it does not move
        move = _where_above(0.0, MAX_ALPHA * one - alpha, weight) * ahead
        moves.append(_Move(row, weight, move))
        light = light + hides * ahead
    light = one * light
    sums = sums_of(moves[::-1], (g_red, g_green, g_blue), T, pixels)
    behind.copy_(light)
    return (sums,)


def _sums_at_centre(
    moves: list[_Move], colours: tuple[Tensor, Tensor, Tensor], T: Tensor, pixels: Pixels
) -> Float[Tensor, "t c_K"]:
    """Sums over pixels that the gradient of values at points is made of, ten a splat.

    With s the gradient of log alpha: of s u and s v times the offset in x and y; s u; s v; s; and of the weight times
    the gradients of the colours.  Array code finds them as products of matrices, a compiled loop adds them up.
    """
    if not torch.compiler.is_compiling():
        return _sums_by_products(moves, colours, pixels)
    sums = []
    for row, weight, gradient in moves:
        dx, dy = offsets_at(row, pixels)
        su, sv = (gradient * form for form in forms_at(row, pixels))
        red, green, blue = (weight * colour for colour in colours)
        # where T is 0 these are 0: that they look at it shows the compiler that all sums share enough for one loop
        gradient, red = (torch.where(T > 0, x, 0.0) for x in (gradient, red))
        sums += [su * dx, su * dy, sv * dx, sv * dy, su, sv, gradient, red, green, blue]
    return torch.cat([x.sum(dim=1, keepdim=True) for x in sums], dim=1)


def _sums_by_products(
    moves: list[_Move], colours: tuple[Tensor, Tensor, Tensor], pixels: Pixels
) -> Float[Tensor, "t c_K"]:
    """What `_sums_at_centre` gives: from moments about the tile's middle, where no digits are lost."""
    rows, weights, gradients = (torch.stack(x, dim=1) for x in zip(*moves, strict=True))
    x, y = pixels.x - TILE / 2, pixels.y - TILE / 2
    monomials = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], dim=1)
    s, sx, sy, sxx, sxy, syy = (gradients @ monomials).unbind(dim=2)
    ux, uy, vx, vy, centre_x, centre_y, *_ = rows.unbind(dim=2)
    dx = pixels.corners[:, 0, None] + TILE / 2 - centre_x
    dy = pixels.corners[:, 1, None] + TILE / 2 - centre_y
    by_offset, by_form = [], []
    for i, j in ((ux, uy), (vx, vy)):
        middle = i * dx + j * dy
        along = middle * s + i * sx + j * sy
        by_form += [along]
        by_offset += [dx * along + middle * sx + i * sxx + j * sxy]
        by_offset += [dy * along + middle * sy + i * sxy + j * syy]
    by_colour = torch.bmm(weights, torch.stack(colours, dim=2)).unbind(dim=2)
    return torch.stack([*by_offset, *by_form, s, *by_colour], dim=2).flatten(1)


def _from_sums(
    drawing: Float[Tensor, "m 10"], sums: Float[Tensor, "m 10"]
) -> tuple[Float[Tensor, "m 10"]]:
    """The gradient of splats' parameters from their sums, log alpha being ln 2 (log2 o − u² − v²)."""
    ux, uy, vx, vy, *_ = drawing.unbind(dim=1)
    *by_offset, su, sv, s, red, green, blue = sums.unbind(dim=1)
    forms = [-2 * LN_2 * form for form in by_offset]
    centre = [2 * LN_2 * (ux * su + vx * sv), 2 * LN_2 * (uy * su + vy * sv)]
    return (torch.stack([*forms, *centre, LN_2 * s, red, green, blue], dim=1),)


def _sums_by_autograd(
    alpha_of: AlphaOf,
    moves: list[_Move],
    colours: tuple[Tensor, Tensor, Tensor],
    T: Tensor,
    pixels: Pixels,
) -> Float[Tensor, "t c_K"]:
    """For any kernel, what tiles add to the gradient itself: from the gradient of log alpha by autograd of alpha."""
    rows, weights, gradients = (torch.stack(x, dim=1) for x in zip(*moves, strict=True))
    with torch.enable_grad():
        rows = rows.detach().requires_grad_()
        alpha = alpha_of(rows.transpose(0, 1), pixels).transpose(0, 1)
        grads = torch.where(alpha > 0, gradients / alpha, 0.0).detach()
        (added,) = torch.autograd.grad(alpha, rows, grads)
    added[..., RED : BLUE + 1] = torch.bmm(weights, torch.stack(colours, dim=2))
    return added.flatten(1)


# --------------------------------------------------------------------------------------------------------- kernels
# Examples are as large as real work: the compiler decides by them which loops run in threads.

EXAMPLE_TILES, EXAMPLE_SPLATS = 1024, 4096


def _chunk_example(columns: int) -> tuple[Tensor, ...]:
    rows, origins, *pixels = _rows_example(5, columns)
    _, *where = _owners_example()
    return rows.flatten(0, 1)[:EXAMPLE_SPLATS], *where, origins, *pixels


def _rows_example(planes: int, columns: int) -> tuple[Tensor, ...]:
    tiles = EXAMPLE_TILES
    rows = torch.linspace(0.012, 0.1, tiles * STEP * columns).view(tiles, STEP, columns)
    pixels = [torch.full((tiles, PIXELS), 0.5) for _ in range(planes)]
    return rows, torch.ones(tiles, 2), *pixels, *pixel_centres(rows), torch.ones(tiles)


def _owners_example() -> tuple[Tensor, ...]:
    ids = torch.arange((EXAMPLE_TILES + 1) * PASS, dtype=torch.int32) % EXAMPLE_SPLATS
    at = torch.arange(EXAMPLE_TILES) * PASS
    return torch.ones(EXAMPLE_SPLATS, COLUMNS), ids, at, at + PASS


def _from_sums_example() -> tuple[Tensor, ...]:
    m = 100_000
    return tuple(torch.linspace(0.1, 1.0, m * COLUMNS).view(m, -1) for _ in range(2))


OWNERS = Kernel("owners", _owners, _owners_example, ("m", "p", "t", "t"))
PASSES: dict[PixelKernel, Pass] = {
    name: Pass(
        splats,
        Kernel(
            f"composite-{name}",
            partial(_chunk, alpha_of, splats),
            partial(_chunk_example, WIDTH[name]),
            ("m", "p", *8 * ("t",), None, None, "t"),
        ),
    )
    for name, alpha_of in ALPHA.items()
    for splats in [PASS if name == "point" else SHORT_PASS]
}
CHUNK_BACKWARD: dict[PixelKernel, Kernel] = {
    name: Kernel(
        f"composite-{name}-backward",
        partial(_chunk_backward, alpha_of, sums_of),
        partial(_rows_example, 6, WIDTH[name]),
        (*8 * ("t",), None, None, "t"),
    )
    for name, alpha_of in ALPHA.items()
    for sums_of in [_sums_at_centre if name == "point" else partial(_sums_by_autograd, alpha_of)]
}
FROM_SUMS = Kernel("composite-sums", _from_sums, _from_sums_example, ("m", "m"))

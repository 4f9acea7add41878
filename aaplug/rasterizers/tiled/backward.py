"""Compositing, backward: from the last splats of each tile to the first, in steps of STEP.

t: tiles; K: splats per step; P: pixels per tile; c: columns of a raster row.

g: the loss's gradient in the pixel's premultiplied colour and alpha.  c_k: colour of splat k, extended by a 1 for
alpha.  T_k: transmittance in front of it.  B_k: g · (what the splats behind k composite to, with nothing in front).

    ∂L/∂alpha_k = T_k (g·c_k - B_k),    B_(k-1) = B_k + alpha_k (g·c_k - B_k)

The forward pass stores T only at the start of each step; within a step T is recomputed front to back.  Walking front
to back with the remaining Σ g·w·c instead would divide by 1 - alpha, which loses digits where alpha is near 1.
"""

from collections.abc import Iterator
from functools import cache, partial
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from aaplug.core.interfaces import PixelKernel, Pixels
from aaplug.core.kernels import Kernel, Kernels
from aaplug.core.rules import Rules
from aaplug.methods.pixel_kernels.gradients import Move, SumsGradients, sums_by_autograd
from aaplug.methods.pixel_kernels.raster_rows import BLUE, GREEN, RED, tile_centres
from aaplug.rasterizers.tiled.binning import Bins
from aaplug.rasterizers.tiled.forward import (
    ALONE,
    OWNERS,
    STEP,
    Compositing,
    Segment,
    composite_forward,
    in_turn,
    less,
    rows_at,
    rows_example,
    transmitted,
    where_above,
)

STEPS_TOGETHER = 8  # backward steps whose raster rows are gathered at once
BUFFERED = 1 << 18  # contributions that are buffered before a sum; at least two per splat


def composite(
    rows: Float[Tensor, "m c"], bins: Bins, how: Compositing
) -> tuple[Float[Tensor, "3 t P"], Float[Tensor, "t P"]]:
    """Premultiplied colour, and alpha, of every pixel of every tile; differentiable in the raster rows.

    rows: the last one is the padding row.
    """
    if rows.requires_grad and torch.is_grad_enabled():
        return _Composite.apply(rows, bins, how)  # pyright: ignore[reportReturnType]
    return composite_forward(rows, bins, how)


class _Composite(torch.autograd.Function):
    """Compositing with its own backward pass."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, bins: Bins, how: Compositing) -> tuple[Tensor, Tensor]:
        segments: list[Segment] = []
        colour, alpha = composite_forward(rows, bins, how, segments)
        ctx.save_for_backward(rows)
        ctx.rest = (bins, segments, how)
        return colour, alpha

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        (rows,) = ctx.saved_tensors
        colour, alpha = (grad.contiguous() for grad in grads)
        return _backward(rows, colour, alpha, *ctx.rest), None, None


def _backward(
    rows: Float[Tensor, "m c"],
    g_colour: Float[Tensor, "3 all P"],
    g_alpha: Float[Tensor, "all P"],
    bins: Bins,
    segments: list[Segment],
    how: Compositing,
) -> Float[Tensor, "m c"]:
    """Gradient of the raster rows."""
    local, kernel = tile_centres(rows), step_kernel(how.pixel, how.rules)
    sums_of_splats = _Scatter(torch.zeros_like(rows))
    light = torch.zeros_like(g_alpha)
    for segment in reversed(segments):
        behind, hidden = (plane.index_select(0, segment.tiles) for plane in (light, g_alpha))
        colours = g_colour.index_select(1, segment.tiles)
        ones = torch.ones_like(segment.origins[:, 0])
        for owners, drawn, before in _steps(rows, bins, segment, how.kernels):
            n = len(before)
            grads = (*colours[:, :n].unbind(), hidden[:n])
            pixels = (before, behind[:n], *grads, *local, ones[:n])
            (sums,) = how.kernels.run(kernel, drawn, segment.origins[:n], *pixels)
            sums_of_splats.add(owners, sums)
        light.index_copy_(0, segment.tiles, behind)
    total = sums_of_splats.total()
    if isinstance(how.pixel, SumsGradients):
        return how.pixel.from_sums(rows, total, how.kernels)
    return total


def _steps(
    rows: Float[Tensor, "m c"], bins: Bins, segment: Segment, kernels: Kernels
) -> Iterator[tuple[Int[Tensor, "n K"], Float[Tensor, "n K c"], Float[Tensor, "n P"]]]:
    """Owners, raster rows and transmittance of each step of a segment, from the last; several are looked up at once."""
    at, ends = segment.splats
    for start in reversed(range(0, len(segment.before), STEPS_TOGETHER)):
        together = segment.before[start : start + STEPS_TOGETHER]
        sizes = [len(before) for before in together]
        places = torch.cat([at[:n] + (start + i) * STEP for i, n in enumerate(sizes)])
        last = torch.cat([ends[:n] for n in sizes])
        (owners,) = kernels.run(OWNERS, rows, bins.splats, torch.minimum(places, last), last)
        drawn = rows_at(rows, owners)
        steps = zip(owners.split(sizes), drawn.split(sizes), together, strict=True)
        yield from reversed(list(steps))


class _Scatter:
    """Accumulates per-tile gradient contributions per splat.

    Contributions are buffered and sorted by splat, which is several times as fast as adding each one in place.
    """

    def __init__(self, total: Float[Tensor, "m c"]):
        room = max(BUFFERED, 2 * len(total))
        self._total, self._count = total, 0
        few = len(total) < torch.iinfo(torch.int16).max  # half the bits sort in half the time
        self._owners = total.new_empty(room, dtype=torch.int16 if few else torch.int32)
        self._parts = total.new_empty(room, total.shape[1])

    def add(self, owners: Int[Tensor, "t K"], parts: Float[Tensor, "t c_K"]) -> None:
        """Add the contributions of a step; the buffer has room for a whole one."""
        end = self._count + owners.numel()
        if end > len(self._owners):
            self._sum()
            end = owners.numel()
        self._owners[self._count : end] = owners.flatten()
        self._parts[self._count : end] = parts.view(-1, self._parts.shape[1])
        self._count = end

    def total(self) -> Float[Tensor, "m c"]:
        """Add up what is buffered and return the sum per splat."""
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


def _step(
    pixel: PixelKernel,
    rules: Rules,
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
    """Each tile's contributions to the gradients of K splats; updates `behind`, B_k in the module's docstring."""
    one = one[:, None]
    before, drawn = T, []
    pixels = Pixels(origins, local_x, local_y)
    for row, alpha in in_turn(pixel, rules, rows.transpose(0, 1), pixels):
        through = transmitted(alpha, one, rules)
        after = before * through
        hides = where_above(rules.below_min_transmittance, after, one - through)
        drawn.append((row, alpha, hides, before))
        before = after
    moves, light = [], behind
    for row, alpha, hides, reaching in reversed(drawn):
        weight = reaching * hides
        colour = torch.addcmul(g_hidden, row[:, RED, None], g_red)
        colour = torch.addcmul(colour, row[:, GREEN, None], g_green)
        colour = torch.addcmul(colour, row[:, BLUE, None], g_blue)
        ahead = less(colour, light, one)
        # weight is 0 below the cut-off and after the stop; at the cap alpha has no gradient
        move = where_above(0.0, rules.max_alpha * one - alpha, weight) * ahead
        moves.append(Move(row, weight, move))
        light = light + hides * ahead
    light = one * light
    colours = (g_red, g_green, g_blue)
    if isinstance(pixel, SumsGradients):
        sums = pixel.sums(moves[::-1], colours, T, pixels)
    else:
        sums = sums_by_autograd(pixel, rules, moves[::-1], colours, pixels)
    behind.copy_(light)
    return (sums,)


@cache
def step_kernel(pixel: PixelKernel, rules: Rules) -> Kernel:
    """A backward step of one pixel kernel by the given rules."""
    return Kernel(
        f"composite-{pixel.name}{rules.tag}-backward",
        partial(_step, pixel, rules),
        partial(rows_example, 6, pixel.columns),
        (*8 * ("t",), None, None, "t"),
        alone=ALONE,
    )

"""Compositing, backward: from the last splats of each tile to the first, in steps of STEP.

t: tiles; K: splats per step; P: pixels per tile; m: raster rows; c: columns of a raster row.

g: the loss's gradient in the pixel's premultiplied colour and alpha.  c_k: colour of splat k, extended by a 1 for
alpha.  T_k: transmittance in front of it.  B_k: g · (what the splats behind k composite to, with nothing in front).

    ∂L/∂alpha_k = T_k (g·c_k - B_k),    B_(k-1) = B_k + alpha_k (g·c_k - B_k)

The forward pass stores T only at the start of each step; within a step T is recomputed front to back.  Walking front
to back with the remaining Σ g·w·c instead would divide by 1 - alpha, which loses digits where alpha is near 1.
"""

from functools import cache, partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from aaplug.core.interfaces import PixelKernel, Pixels
from aaplug.core.kernels import Kernel
from aaplug.core.rules import Rules
from aaplug.methods.pixel_kernels.gradients import Move, SumsGradients, sums_by_autograd
from aaplug.methods.pixel_kernels.raster_rows import BLUE, GREEN, RED, tile_centres
from aaplug.rasterizers.tiled.binning import LONGEST_PASS, Bins
from aaplug.rasterizers.tiled.forward import (
    ALONE,
    STEP,
    Compositing,
    Segment,
    composite_forward,
    in_turn,
    less,
    places,
    rows_at,
    tiles_example,
    transmitted,
    where_above,
)


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
    """Gradient of the raster rows.

    What splats contribute in a tile is kept step by step, and summed over tiles at the end.
    """
    assert bins.pairs is not None
    local, kernel = tile_centres(rows), step_kernel(how.pixel, how.rules)
    steps = bins.splats.view(-1, STEP)
    count = sum(len(before) for segment in segments for before in segment.before)
    parts = rows.new_empty(count + 1, STEP * rows.shape[1])
    parts[count] = 0
    turns = torch.arange(count, dtype=torch.int32, device=rows.device)
    part_of = torch.full_like(steps[:, 0], count)  # steps behind saturated pixels contribute nothing
    light, done = torch.zeros_like(g_alpha), 0
    for segment in reversed(segments):
        behind, hidden = (plane.index_select(0, segment.tiles) for plane in (light, g_alpha))
        colours = g_colour.index_select(1, segment.tiles)
        ones = torch.ones_like(segment.origins[:, 0])
        for step, before in reversed([*enumerate(segment.before)]):
            n = len(before)
            at = places(segment.at[:n], step * STEP, segment.ends[:n], bins) // STEP
            drawn = rows_at(rows, steps.index_select(0, at))
            pixels = (before, behind[:n], *colours[:, :n].unbind(), hidden[:n], *local, ones[:n])
            (parts[done : done + n],) = how.kernels.run(kernel, drawn, segment.origins[:n], *pixels)
            part_of.index_copy_(0, at, turns[done : done + n])
            done += n
        light.index_copy_(0, segment.tiles, behind)
    stand, starts = bins.pairs.of_splats()
    stand = part_of.index_select(0, stand // STEP) * STEP + stand % STEP
    total = torch.zeros_like(rows)
    sums = functional.embedding_bag(stand, parts.view(-1, rows.shape[1]), starts, mode="sum")
    total.index_copy_(0, bins.pairs.nearest, sums)
    if isinstance(how.pixel, SumsGradients):
        return how.pixel.from_sums(rows, total, how.kernels)
    return total


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
    before, passed = T, []
    pixels = Pixels(origins, local_x, local_y)
    for row, alpha in in_turn(pixel, rules, rows.transpose(0, 1), pixels):
        through = transmitted(alpha, one, rules)
        after = before * through
        hides = where_above(rules.below_min_transmittance, after, one - through)
        passed.append((row, alpha, hides, before))
        before = after
    moves, light = [], behind
    for row, alpha, hides, reaching in reversed(passed):
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


def _step_example(columns: int) -> tuple[Tensor, ...]:
    rows, ids, _, *rest = tiles_example(6, columns)
    return rows_at(rows, ids.view(-1, LONGEST_PASS)[:-1, :STEP]), *rest


@cache
def step_kernel(pixel: PixelKernel, rules: Rules) -> Kernel:
    """A backward step of one pixel kernel by the given rules."""
    return Kernel(
        f"composite-{pixel.name}{rules.tag}-backward",
        partial(_step, pixel, rules),
        partial(_step_example, pixel.columns),
        (*8 * ("t",), None, None, "t"),
        alone=ALONE,
    )

"""Compositing, backward: from the last splats of each tile to the first, in steps of STEP.

t: tiles; K: splats per step; P: pixels per tile; m: raster rows; c: columns of a raster row; p: pairs of a splat and
a tile; s: steps of all tiles.

g: the loss's gradient in the pixel's premultiplied colour and alpha.  c_k: colour of splat k, extended by a 1 for
alpha.  T_k: transmittance in front of it.  B_k: g · (what the splats behind k composite to, with nothing in front).

    ∂L/∂alpha_k = T_k (g·c_k - B_k),    B_(k-1) = B_k + alpha_k (g·c_k - B_k)

The forward pass stores T only at the start of each step; within a step T is recomputed front to back.  Walking front
to back with the remaining Σ g·w·c instead would divide by 1 - alpha, which loses digits where alpha is near 1.
"""

from functools import cache, partial
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from aaplug.core.interfaces import Limits, PixelKernel, Pixels
from aaplug.core.kernels import Kernel, once_differentiable
from aaplug.core.runs import starts_of
from aaplug.core.splats import Render
from aaplug.methods.pixel_kernels.gradients import Move, SumsGradients, sums_by_autograd, sums_per_splat
from aaplug.methods.pixel_kernels.raster_rows import PIXELS, RED, next_rows
from aaplug.rasterizers.tiled.binning import Bins
from aaplug.rasterizers.tiled.forward import (
    EXAMPLE_TILES,
    MIN_TILES,
    STEP,
    Compositing,
    Segment,
    composite_forward,
    coordinate_sizes,
    coordinates_of,
    in_turn,
    less,
    name_of,
    shifts_of,
    tiles_example,
    transmitted,
    where_above,
)
from aaplug.rasterizers.tiled.layout import tiles_of
from aaplug.system.cores import on_free_cores


def composite(rows: Float[Tensor, "m c"], bins: Bins, how: Compositing) -> Render:
    """Colour over the background, and alpha, of every pixel; differentiable in the raster rows.

    rows: the last one is the padding row.
    """
    if rows.requires_grad and torch.is_grad_enabled():
        rgb, alpha = _Composite.apply(rows, bins, how)  # pyright: ignore[reportGeneralTypeIssues]
    else:
        rgb, alpha = composite_forward(rows, bins, how)
    return Render(rgb.permute(1, 2, 0), alpha)


class _Composite(torch.autograd.Function):
    """Compositing with its own backward pass."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, bins: Bins, how: Compositing) -> tuple[Tensor, Tensor]:
        segments: list[Segment] = []
        image = composite_forward(rows, bins, how, segments)
        ctx.save_for_backward(rows)
        ctx.rest = (bins, segments, how)
        return image

    @staticmethod
    @once_differentiable
    @on_free_cores()
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Gradient of the raster rows.

        What splats contribute in a tile is kept step by step, and summed over tiles at the end.
        """
        (rows,), (bins, segments, how) = ctx.saved_tensors, ctx.rest
        count = sum(len(before) for segment in segments for before in segment.before)
        rgb, alpha = (grad.contiguous() for grad in grads)  # once: they are gathered for each segment
        zero = all(bound == 0 for grad in (rgb, alpha) for bound in grad.aminmax())  # as of channels that no loss reads
        if zero or not count:
            return torch.zeros_like(rows), None, None
        local, kernel = how.centres(rows), step_kernel(how.pixel, how.channels)
        columns, limits = sums_per_splat(how.pixel, how.channels), rows.new_tensor(Limits.by(how.rules))
        parts = rows.new_empty(count + 1, STEP * columns)
        parts[count] = 0
        steps = (bins.counts + (STEP - 1)) // STEP
        first, total = starts_of(steps), int(steps.sum())
        light, steps_done, done = rows.new_zeros(len(steps), PIXELS), [], 0
        for segment in reversed(segments):
            behind = light.index_select(0, segment.tiles)
            lights = whole_lights = [behind, behind.clone()]  # a step reads the first and writes the second
            colours = tiles_of([*rgb, alpha], segment.tiles, bins.columns, how.kernels)
            step_of = first.index_select(0, segment.tiles) + segment.start // STEP
            rays = how.rays_of(segment.corners[:, :2])
            part = whole = [step_of, segment.lists, segment.corners, *colours, *rays]
            run, shifts = None, shifts_of(len(segment.before), STEP, rows)
            for step, before in reversed([*enumerate(segment.before)]):
                n = len(before)
                if n != len(part[0]):
                    part, lights = ([x.narrow(0, 0, n) for x in of_all] for of_all in (whole, whole_lights))
                mine, lists, corners, *pixels = part
                behind, left = lights
                args = (rows, bins.splats, lists, corners, before, behind, *pixels, *local, limits, shifts[step])
                args = (*args, parts.narrow(0, done, n), left)
                run = run or how.kernels.runner(kernel, args)
                run(*args)
                lights, whole_lights = lights[::-1], whole_lights[::-1]
                # Among the fewest tiles one may have no splats left: its step is none of the list.
                these = mine + step
                if n <= MIN_TILES:
                    these = torch.where(lists[:, 0] < lists[:, 1] - step * STEP, these, total)
                steps_done.append(these)
                done += n
            light.index_copy_(0, segment.tiles, whole_lights[0])
        # `part_of` tells where each step's contributions stand.  Steps behind saturated pixels contribute nothing.
        part_of = torch.full((total + 1,), count, dtype=torch.int32, device=rows.device)
        part_of.index_copy_(0, torch.cat(steps_done), torch.arange(count, dtype=torch.int32, device=rows.device))
        pairs = bins.pairs
        shifts = (first * STEP - bins.first).int()
        slots = part_of.new_empty(len(pairs.sorted))
        how.kernels.run(SLOTS, slots, pairs.tiles, shifts, part_of, pairs.sorted)
        summed = rows.new_zeros(len(rows), columns)
        sums = functional.embedding_bag(slots, parts.view(-1, columns), pairs.starts, mode="sum")
        summed.index_copy_(0, pairs.nearest, sums)
        if isinstance(how.pixel, SumsGradients):
            summed = how.pixel.from_sums(rows, summed, how.kernels)
        return summed, None, None


def _slots(
    slots: Int[Tensor, " p"],
    tiles: Int[Tensor, " p"],
    shifts: Int[Tensor, " t"],
    part_of: Int[Tensor, " s"],
    pairs: Int[Tensor, " p"],
) -> tuple[()]:
    """Write into `slots` where each pair's contribution stands among those of all splats of all steps.

    tiles: sorted; pairs: their pairs.  shifts: how far a tile's list moves when each is padded to whole steps.
    part_of: where each step's contributions stand among all steps.
    """
    place = torch.arange(tiles.shape[0], dtype=torch.int32, device=tiles.device) + shifts[tiles.int()]
    slots.index_put_((pairs,), part_of[place // STEP] * STEP + place % STEP)
    return ()


def _step(
    pixel: PixelKernel,
    rows: Float[Tensor, "m c"],
    ids: Int[Tensor, " p"],
    lists: Int[Tensor, "t 2"],
    corners: Float[Tensor, "t 3"],
    T: Float[Tensor, "t P"],
    behind: Float[Tensor, "t P"],
    *gradients_and_rest: Tensor,
) -> tuple[()]:
    """Write each tile's contributions to the gradients of K splats into `parts`, the last argument but one: [t, sums].

    behind: B_k of the module's docstring behind these splats; what is behind those before them is written into the last
    argument; torch 2.8 compiles no kernel that updates it in place.
    gradients_and_rest: of d colours and alpha, [t, P]; then as in `forward._pass`.
    """
    *planes, values, ahead_of_list, parts, left = gradients_and_rest
    coordinates = coordinates_of(pixel)
    *colours, g_hidden = planes[:-coordinates]
    limits, one = Limits.of(values), corners[:, 2:]
    before, passed = T, []
    x, y, *z = planes[-coordinates:]
    pixels = Pixels(corners, x, y, z[0] if z else None)
    nearest = next_rows(rows, ids, lists[:, 0] + ahead_of_list, lists[:, 1], STEP)
    for row, seen, alpha in in_turn(pixel, limits, nearest, pixels):
        through = transmitted(alpha, one, limits)
        after = before * through
        hides = where_above(limits.below_min_transmittance, after, one - through)
        passed.append((row, seen, alpha, hides, before))
        before = after
    moves, light = [], behind
    for row, seen, alpha, hides, reaching in reversed(passed):
        weight = reaching * hides
        colour = g_hidden
        for i, gradient in enumerate(colours, start=RED):
            colour = torch.addcmul(colour, row[:, i, None], gradient)
        ahead = less(colour, light, one)
        # The weight is 0 below the cut-off and after the stop.  At the cap alpha has no gradient.
        move = where_above(0.0, limits.max_alpha * one - alpha, weight) * ahead
        moves.append(Move(row, seen, weight, move))
        light = light + hides * ahead
    light = one * light
    if isinstance(pixel, SumsGradients):
        sums = pixel.sums(moves[::-1], colours, T)
    else:
        sums = sums_by_autograd(pixel, limits, moves[::-1], colours)
    left.copy_(light)
    parts.copy_(sums)
    return ()


def _slots_example() -> tuple[Tensor, ...]:
    tiles, each = 10_000, 5 * STEP - 1
    pairs = torch.arange(tiles * each)
    shifts = torch.arange(tiles, dtype=torch.int32)  # each list moves by one more
    steps = torch.arange(5 * tiles, dtype=torch.int32)
    return pairs.int(), (pairs // each).short(), shifts, steps, pairs.flip(0)


@cache
def step_kernel(pixel: PixelKernel, channels: int = 3) -> Kernel:
    """A backward step of one pixel kernel."""
    planes = range(4, 7 + channels)  # transmittance, B_k, and the gradients of colours and alpha
    widths = STEP * sums_per_splat(pixel, channels), PIXELS  # of the last two arguments
    return Kernel(
        name_of(pixel, channels) + "-backward",
        partial(_step, pixel),
        lambda: (*tiles_example(pixel, channels, len(planes)), *(torch.zeros(EXAMPLE_TILES, n) for n in widths)),
        ("m", "p", "t", "t", *("t" for _ in planes), *coordinate_sizes(pixel), None, None, "t", "t"),
        keeps_sums=True,
        updates=(last := planes[-1] + 3 + coordinates_of(pixel), last + 1),
    )


SLOTS = Kernel("slots", _slots, _slots_example, ("p", "p", "t", "s", "p"), updates=(0,))

"""Rules of compositing worked by hand, and the tiled rasterizer against the reference, which test_golden.py tests.

At a cut-off (alpha at 1/255, transmittance at 1e-4) float32 and float64 may decide differently.  `near_a_cutoff` finds
the pixels where that can happen: all others must agree tightly, and those that differ are counted.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import pytest
import torch

from aaplug import PixelKernel, UsageError
from aaplug.core.ellipses import cull, squared_cutoff
from aaplug.core.kernels import EAGER, Kernels
from aaplug.core.projection import project
from aaplug.core.rules import RULES_3DGS, RULES_GSPLAT, Rules
from aaplug.core.splats import NEARER, Render, Splats2D
from aaplug.evaluation.laws.base import make_camera, make_scene, make_splats
from aaplug.lab.integral import INTEGRAL
from aaplug.methods import COMPOSITORS, PIXEL_KERNELS
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.methods.pixel_kernels.raster_rows import TILE
from aaplug.rasterizers import reference
from aaplug.rasterizers.reference import Reference
from aaplug.rasterizers.tiled import Tiled, binning, forward, rasterizer
from aaplug.rasterizers.tiled.packages import CompiledKernels
from aaplug.system.executors import torch_threads
from tests.conftest import ALL_RASTERIZERS, COMPILED, each, memory_taken, needs_peak_memory, splats_of

F64 = torch.float64
BLACK, WHITE, SKY = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.25, 0.5, 1.0)
RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
TOLERANCE = 1e-5
FLIPS = 1e-4  # share of pixels that may fall on the other side of a cut-off
UNIT = (4.0, 0.0, 4.0)
TILED, REFERENCE = Tiled(), Reference()


def stack(*layers: tuple[float, tuple[float, float, float]]) -> Splats2D:
    """Layers of (opacity, colour), nearest first, all centred on pixel (4, 4)."""
    rows = [((4.5, 4.5), UNIT, 1.0 + i, opacity, rgb) for i, (opacity, rgb) in enumerate(layers)]
    return splats_of(*rows)


def close(image: torch.Tensor, expected, atol: float = 1e-6) -> None:
    torch.testing.assert_close(image.double(), torch.as_tensor(expected, dtype=F64), rtol=0, atol=atol)


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0], [1, 2, 0]])
def test_splats_of_equal_depth_are_drawn_in_scene_order(rasterize, order):
    splats = stack((0.5, RED), (0.5, GREEN), (0.5, BLUE))[torch.tensor(order)]
    image = rasterize(replace(splats, depths=torch.ones(3, dtype=F64)), (9, 9), BLACK)
    expected = torch.zeros(3)
    expected[torch.tensor(order)] = torch.tensor([0.5, 0.25, 0.125])
    close(image.rgb[4, 4], expected)


def test_each_tile_sorts_its_splats_by_their_depth_along_its_middle(rasterize):
    # what counts of the red splat's depth falls by 0.1 a px: it is green's until x = 13, and tiles change at 16
    splats = splats_of(((8.0, 4.0), (1e9, 0.0, 1e9), 2.0, 0.5, RED), ((8.0, 4.0), (1e9, 0.0, 1e9), 1.5, 0.5, GREEN))
    splats = replace(splats, ray_slopes=torch.tensor([[-0.1 / NEARER, 0.0], [0.0, 0.0]], dtype=F64))
    image = rasterize(splats, (8, 24), BLACK)
    close(image.rgb[4, :16], torch.tensor([[0.25, 0.5, 0.0]]).expand(16, 3))
    close(image.rgb[4, 16:], torch.tensor([[0.5, 0.25, 0.0]]).expand(8, 3))


def gradients(draw: Callable[..., Render], splats: Splats2D, hw: tuple[int, int]) -> tuple[torch.Tensor, ...]:
    leaves = {name: getattr(splats, name).detach().requires_grad_() for name in ("means", "opacities", "rgb")}
    image = draw(replace(splats, **leaves), hw, SKY)
    weights = torch.linspace(0.5, 1.5, image.alpha.numel(), dtype=F64).view(hw)
    loss = (image.rgb.square().sum(dim=2) * weights + image.alpha * weights.flip(0)).sum()
    return torch.autograd.grad(loss, [*leaves.values()])


def require_gradients(splats: Splats2D, hw: tuple[int, int], tiled: Tiled = TILED, rules: Rules = RULES_3DGS) -> None:
    """Raise AssertionError unless they are those of the reference."""
    found, expected = (gradients(partial(draw, rules=rules), splats, hw) for draw in (tiled, REFERENCE))
    for fast, slow in zip(found, expected, strict=True):
        assert slow.abs().amax(dim=-1).max() > 0
        torch.testing.assert_close(fast, slow, rtol=1e-9, atol=1e-12)


def test_gradients_are_those_of_the_order_by_tile():
    splats = make_splats(80, (17, 26), seed=4).to(F64)
    require_gradients(replace(splats, ray_slopes=2.0 * (splats.means / 7).sin()), (17, 26))


@pytest.mark.parametrize(("alpha", "drawn"), [(1.001 / 255, True), (0.999 / 255, False)])
def test_alphas_below_1_255_are_skipped(rasterize, alpha, drawn):
    variance = 2.0**2 / (2 * math.log(0.5 / alpha))  # alpha two pixels from the centre
    splats = splats_of(((4.5, 4.5), (variance, 0.0, variance), 1.0, 0.5, RED))
    image = rasterize(splats, (9, 9), BLACK)
    for row, column in ((4, 6), (4, 2), (6, 4), (2, 4)):
        close(image.alpha[row, column], alpha if drawn else 0.0, atol=1e-8)
    close(rasterize(stack((alpha, RED)), (9, 9), BLACK).alpha[4, 4], alpha if drawn else 0.0)


@pytest.mark.parametrize(
    ("layers", "rgb", "alpha"),
    [
        # transmittances 0.1, 0.01, 0.001, then 5e-5: not drawn, nor is the faint green one that would leave 9.9e-4
        ([(0.9, RED)] * 3 + [(0.95, BLUE), (0.01, GREEN)], [0.999, 0.0, 0.0], 0.999),
        # 1.1e-4 is left by blue, 8.8e-5 by green
        ([(0.9, RED)] * 3 + [(0.89, BLUE), (0.2, GREEN)], [0.999, 0.0, 0.00089], 1 - 1.1e-4),
        # 0.01 · 0.01 is a hair under 1e-4 in 3DGS's float32; gsplat stops at 1e-4 as well
        ([(1.0, RED), (1.0, GREEN), (0.5, BLUE)], [0.99, 0.0, 0.0], 0.99),
    ],
    ids=["below", "above", "two capped ones"],
)
def test_a_pixel_stops_before_its_transmittance_would_fall_below_1e_4(rasterize, layers, rgb, alpha):
    image = rasterize(stack(*layers), (9, 9), BLACK)
    close(image.rgb[4, 4], rgb, atol=5e-7)
    close(image.alpha[4, 4], alpha, atol=5e-7)


def test_strips_and_chunks_of_the_reference_change_nothing(monkeypatch):
    hw = (12, 17)
    splats = make_splats(120, hw, 5, (0.0, 2.5)).to(F64)
    splats = replace(splats, opacities=splats.opacities * 0.98)
    whole = REFERENCE(splats, hw, SKY)
    assert (whole.alpha > 0.999).any(), "some pixels should stop inside a chunk"
    monkeypatch.setattr(reference, "STRIP_PIXELS", 50)
    monkeypatch.setattr(reference, "CHUNK_SPLATS", 7)
    parts = REFERENCE(splats, hw, SKY)
    close(parts.rgb, whole.rgb, atol=1e-12)
    close(parts.alpha, whole.alpha, atol=1e-12)


def needles(m: int, hw: tuple[int, int], seed: int, long: float, thin: float) -> Splats2D:
    """Splats of `long` × `thin` px in random directions, exact to float64."""
    splats = make_splats(m, hw, seed).to(F64)
    angle = torch.rand(m, generator=torch.Generator().manual_seed(seed), dtype=F64) * math.pi
    cos, sin = angle.cos(), angle.sin()
    xx = (cos * long).square() + (sin * thin).square()
    yy = (sin * long).square() + (cos * thin).square()
    covs = torch.stack([xx, cos * sin * (long**2 - thin**2), yy], dim=1)
    return replace(splats, covs=covs, dets=torch.full((m,), (long * thin) ** 2, dtype=F64))


def dense(m: int, hw: tuple[int, int], seed: int) -> Splats2D:
    """Many layers of nearly opaque splats, below the cap: two capped splats lie on the edge of the stopping rule."""
    splats = make_splats(m, hw, seed, (1.0, 2.0))
    return replace(splats, opacities=0.8 + 0.18 * splats.opacities)


REGIMES: dict[str, tuple[tuple[int, int], Callable[[tuple[int, int]], Splats2D]]] = {
    "sub-pixel": ((40, 56), lambda hw: make_splats(500, hw, 1, (-2.0, -0.7))),
    "medium": ((61, 83), lambda hw: make_splats(300, hw, 2, (-1.0, 2.0))),
    "huge": ((50, 101), lambda hw: make_splats(150, hw, 3, (3.0, 5.0))),
    "larger than the image": ((31, 33), lambda hw: make_splats(60, hw, 4, (6.0, 9.0))),
    "needles": ((65, 63), lambda hw: needles(150, hw, 5, 40.0, 0.6)),
    "long needles": ((63, 100), lambda hw: needles(100, hw, 6, 300.0, 0.6)),
    "dense": ((47, 56), lambda hw: dense(500, hw, 7)),
    "faint": ((40, 41), lambda hw: replace(m := make_splats(300, hw, 8), opacities=m.opacities / 9)),
    "one row": ((1, 130), lambda hw: make_splats(80, hw, 9, (0.0, 2.0))),
    "one column": ((130, 1), lambda hw: make_splats(80, hw, 10, (0.0, 2.0))),
    "one pixel": ((1, 1), lambda hw: make_splats(20, hw, 11, (-1.0, 1.0))),
    "one tile": ((8, 8), lambda hw: make_splats(60, hw, 12, (-1.0, 1.0))),
    "one more than a tile": ((9, 9), lambda hw: make_splats(60, hw, 13, (-1.0, 1.0))),
    "one less than a tile": ((7, 7), lambda hw: make_splats(60, hw, 14, (-1.0, 1.0))),
}


@cache
def compared(regime: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Largest difference of the two rasterizers at each pixel, and where a cut-off may explain it."""
    hw, make = REGIMES[regime]
    splats = make(hw).to(F64)
    tiled, exact = TILED(splats.to(torch.float32), hw, SKY), REFERENCE(splats, hw, SKY)
    difference = (tiled.rgb - exact.rgb).abs().amax(dim=2)
    difference = torch.maximum(difference, (tiled.alpha - exact.alpha).abs())
    return difference, near_a_cutoff(splats, hw)


def near_a_cutoff(splats: Splats2D, hw: tuple[int, int], band: float = 1e-3) -> torch.Tensor:
    """Pixels where some alpha is within a share of `band` of 1/255, or some transmittance of 1e-4."""
    splats = splats[splats.depths.argsort(stable=True)]
    row, column = torch.meshgrid(*(torch.arange(side) + 0.5 for side in hw), indexing="ij")
    dx, dy = column[..., None] - splats.means[:, 0], row[..., None] - splats.means[:, 1]
    xx, xy, yy = splats.covs.T
    power = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / splats.dets
    alpha = splats.opacities * torch.exp(-0.5 * power)
    at_alpha = (alpha * 255 - 1).abs() < band
    left = (1 - torch.where(alpha >= 1 / 255, alpha.clamp(max=0.99), 0)).cumprod(dim=2)
    at_end = (left * 1e4 - 1).abs() < band
    return (at_alpha | at_end).any(dim=2)


@pytest.mark.parametrize("regime", REGIMES)
def test_tiled_equals_the_reference_away_from_cutoffs(regime):
    difference, excused = compared(regime)
    assert difference[~excused].max() < TOLERANCE


def test_few_pixels_flip_at_a_cutoff():
    differences = torch.cat([compared(regime)[0].flatten() for regime in REGIMES])
    assert (differences > TOLERANCE).double().mean() < FLIPS


def test_an_image_of_one_tile_has_as_many_tiles_as_compiled_kernels_take(monkeypatch):
    grids = []
    monkeypatch.setattr(rasterizer, "bands", lambda *args: grids.append(args[1]) or binning.bands(*args))
    image = Tiled()(make_splats(20, (6, 6), 13), (6, 6), (0.0, 0.0, 0.0))
    assert image.rgb.shape == (6, 6, 3)
    assert grids == [(1, forward.MIN_TILES)]


@pytest.mark.parametrize("way", [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1)])
@pytest.mark.parametrize("alpha", [1.0001 / 255, 2 / 255])
def test_a_splat_reaches_the_first_pixel_of_the_next_tile(way, alpha):
    # the middle tile reaches from 8 to 16; its neighbours' nearest pixel centres are at 7.5 and 16.5
    mean = [12.0 + 2.0 * step if step else 12.5 for step in way]
    first = [12.0 + 4.5 * step if step else 12.5 for step in way]
    variance = math.dist(mean, first) ** 2 / (2 * math.log(0.9 / alpha))
    splats = splats_of((tuple(mean), (variance, 0.0, variance), 1.0, 0.9, RED))
    image = TILED(splats, (24, 24), BLACK)
    close(image.alpha[int(first[1]), int(first[0])], alpha)
    close(image.alpha, REFERENCE(splats, (24, 24), BLACK).alpha)


def test_no_pass_has_a_single_tile():
    """Compiled kernels take no fewer than two, and eager ones are many times as slow."""
    deep = make_splats(600, (8, 8), 3, (-1.0, 0.0)).to(F64)  # in one corner of the image
    deep = replace(deep, opacities=torch.full((600,), 0.02, dtype=F64))
    evaluations: list[int] = []
    image = Tiled().counting(evaluations.append)(deep, (40, 40), SKY)
    assert min(evaluations) >= 2 * POINT.splats_per_pass * TILE**2
    assert len(evaluations) > 600 / POINT.splats_per_pass / 2
    assert (image.rgb - REFERENCE(deep, (40, 40), SKY).rgb).abs().median() < TOLERANCE


def test_a_smaller_memory_budget_changes_nothing():
    hw = (40, 50)
    splats = make_splats(100, hw, 6, (0.0, 3.0))
    leaf = splats.means.requires_grad_()

    def drawn_by(rasterizer: Tiled) -> tuple[torch.Tensor, ...]:
        image = rasterizer(splats, hw, SKY)
        return *image, *torch.autograd.grad(image.rgb[:, :30].square().sum(), leaf)

    whole = drawn_by(TILED)
    assert whole[2].abs().sum() > 0
    for pairs in (1, 30, 500):
        parts = drawn_by(Tiled(memory=float(pairs * binning.PAIR_BYTES)))
        assert parts[0].equal(whole[0])
        assert parts[1].equal(whole[1])
        torch.testing.assert_close(parts[2], whole[2], rtol=1e-5, atol=1e-5)


FRAME_MEMORY = 45e6  # bytes; measured: 32e6, in one band 59e6; the image is 17e6
FRAME = """
from aaplug.rasterizers.tiled import Tiled
from aaplug.evaluation.laws.base import make_splats
splats, draw = make_splats(800, (1024, 1024), 7, (0.0, 5.0)), Tiled(memory=1e6)
draw(splats, (64, 64), (0.0, 0.0, 0.0))
"""


@pytest.mark.parametrize("grid", [(1, 40_000), (3, 20_000)])
def test_tiles_of_a_wide_image_are_told_apart_by_longer_numbers_or_by_bands(grid):
    height, shift = grid[0] * TILE, (grid[1] - 8) * TILE
    splats = make_splats(30, (height, 8 * TILE), 5, (0.0, 2.5)).to(F64)
    moved = replace(splats, means=splats.means + splats.means.new_tensor([shift, 0.0]))
    draw = Tiled()
    wide = draw(moved, (height, grid[1] * TILE), (0.1, 0.2, 0.3)).rgb
    torch.testing.assert_close(wide[:, shift:], draw(splats, (height, 8 * TILE), (0.1, 0.2, 0.3)).rgb)
    assert len(list(binning.bands(moved, grid, EAGER))) == grid[0]


@needs_peak_memory
def test_a_frame_of_several_bands_needs_little_memory_beside_its_image():
    [taken] = memory_taken(FRAME, "draw(splats, (1024, 1024), (0.0, 0.0, 0.0))")
    assert taken < FRAME_MEMORY


def test_splats_are_paired_with_exactly_the_tiles_that_their_ellipses_reach():
    grid = (9, 11)
    splats = make_splats(120, (9 * TILE, 11 * TILE), 5, (-2.0, 3.5)).to(F64)
    bins = next(binning.bands(splats, grid, EAGER))
    listed = torch.zeros(120, grid[0] * grid[1], dtype=torch.bool)
    for tile, (first, count) in enumerate(zip(bins.first, bins.counts, strict=True)):
        mine = bins.splats[first : first + count].long()
        assert splats.depths[mine].diff().min() >= 0 if count > 1 else True
        listed[mine, tile] = True
    # the least of dᵀ C⁻¹ d over the box of each tile's pixel centres, by projected steps along each side in turn
    steps = torch.linspace(0, 1, 2001, dtype=F64)
    xx, xy, yy = (column[:, None] for column in splats.covs.unbind(dim=1))
    conic = yy / splats.dets[:, None], -xy / splats.dets[:, None], xx / splats.dets[:, None]
    for tile in range(grid[0] * grid[1]):
        corner = torch.tensor([tile % grid[1], tile // grid[1]]) * TILE + 0.5
        least = torch.full((120,), math.inf, dtype=F64)
        low = corner - splats.means
        high = low + TILE - 1
        inside = ((low <= 0) & (high >= 0)).all(dim=1)
        for fixed in (0, 1):
            for side in (low, high):
                along = low[:, 1 - fixed, None] + (TILE - 1) * steps
                across = side[:, fixed, None].expand_as(along)
                dx, dy = (across, along) if fixed == 0 else (along, across)
                distance = conic[0] * dx * dx + 2 * conic[1] * dx * dy + conic[2] * dy * dy
                least = torch.minimum(least, distance.amin(dim=1))
        least[inside] = 0
        reached = squared_cutoff(splats.opacities)
        assert listed[least <= reached, tile].all()
        surely_missed = least > reached * 1.001 + 0.01
        assert not listed[surely_missed, tile].any()


class TwoTilesAtOnce(Kernels):
    """Eager kernels that composite two tiles a call."""

    tiles = 2


def in_tiles(*counts: int) -> Splats2D:
    """A row of tiles with so many faint splats each, all inside their tile."""
    tile = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))
    splats = make_splats(sum(counts), (TILE, TILE), 4, (-2.0, -1.0)).to(F64)
    means = 2.5 + (splats.means / TILE).clamp(0, 1) * (TILE - 5)
    means[:, 0] += TILE * tile
    covs = torch.tensor([0.3, 0.05, 0.2], dtype=F64).repeat(len(tile), 1)
    dets = torch.full_like(splats.dets, 0.3 * 0.2 - 0.05**2)
    return replace(splats, means=means, covs=covs, dets=dets, opacities=0.05 + 0.1 * splats.opacities)


@pytest.mark.parametrize("kernels", [EAGER, TwoTilesAtOnce()], ids=["all tiles at once", "two at once"])
@pytest.mark.parametrize(
    "counts", [(7,), (7, 0), (0, 7), (0, 7, 0), (20, 3), (3, 20), (40, 1, 1), (1, 1, 40, 0), (5, 70, 2, 9, 33)], ids=str
)
def test_gradients_where_few_tiles_have_splats(counts, kernels):
    require_gradients(in_tiles(*counts), (TILE, TILE * len(counts)), Tiled(kernels))


def test_gradients_of_what_is_not_drawn_are_0():
    splats = in_tiles(3)
    outside = replace(splats, means=splats.means * 0 + splats.means.new_tensor((-50.0, 4.0)))
    for grad in gradients(Tiled(), outside, (TILE, TILE)):
        assert grad.eq(0).all()


def test_gradients_have_the_same_bits_for_every_number_of_threads():
    splats = make_splats(3000, (96, 96), 6, (0.0, 2.0)).to(F64)
    found = []
    for threads in (1, 2, 3):
        with torch_threads(threads):
            found.append(gradients(Tiled(), splats, (96, 96)))
    assert found[0][0].abs().sum() > 0
    for others in found[1:]:
        assert all(a.equal(b) for a, b in zip(found[0], others, strict=True))


def test_when_saturated_tiles_are_dropped_changes_no_bit(monkeypatch):
    splats = make_splats(2000, (64, 64), 6, (1.0, 3.0))
    splats = replace(splats, opacities=splats.opacities.clamp(min=0.5))

    def drawn(passes: int, tiles: int) -> tuple[torch.Tensor, ...]:
        monkeypatch.setattr(forward, "CHECK_PASSES", passes)
        monkeypatch.setattr(forward, "CHECK_TILES", tiles)
        evaluations: list[int] = []
        image = Tiled().counting(evaluations.append)(splats, (64, 64), SKY)
        return *image, torch.tensor(sum(evaluations))

    often, never = drawn(1, 0), drawn(10_000, 0)
    assert often[2] < 0.9 * never[2]
    assert often[0].equal(never[0])
    assert often[1].equal(never[1])


@pytest.mark.parametrize("rows", [[], [4], [5, 0, 3], list(range(9))], ids=str)
def test_chosen_splats_are_those_of_the_rows_in_order_and_pass_gradients_on(rows):
    splats = make_splats(9, (20, 20), 3, (0.0, 1.0)).to(F64)
    splats = replace(splats, depth_slopes=torch.ones(9, 2, dtype=F64), means=splats.means.requires_grad_())
    index = torch.tensor(rows, dtype=torch.long)
    found, mask = splats.selected(index), torch.zeros(9, dtype=torch.bool).index_fill(0, index, True)
    for choice, part in ((index, found), *((at, splats[at]) for at in (index.repeat(2), slice(2, 5), mask))):
        for name, column in splats._columns().items():
            assert getattr(part, name).equal(column[choice]), name
    (grad,) = torch.autograd.grad(found.means.sum() + 0 * splats.means.sum(), splats.means)
    assert grad.equal(torch.zeros(9, 2, dtype=F64).index_fill(0, index, 1.0))


@pytest.mark.parametrize("dtype", [torch.int16, torch.int32], ids=str)
@pytest.mark.parametrize("count", [0, 1, binning.MIN_PADDED - 1, binning.MIN_PADDED, binning.SORTED_BY_DIGITS - 1])
def test_lists_that_are_padded_sort_as_those_that_are_not(count, dtype):
    keys = torch.randint(-50, 50, (count,), generator=torch.Generator().manual_seed(0)).to(dtype)
    keys[::7] = torch.iinfo(dtype).max  # as the padding
    values, order = binning.stably_sorted(keys)
    expected = torch.sort(keys, stable=True)
    assert torch.equal(values, expected.values)
    assert torch.equal(order, expected.indices)


OTHERS = {
    "gsplat": RULES_GSPLAT,
    "low cap": Rules(max_alpha=0.6),
    "high cut-off": Rules(min_alpha=0.05),
    "low cut-off": Rules(min_alpha=1 / 400),
    "early stop": Rules(min_transmittance=0.05),
    "all": Rules(max_alpha=0.9, min_alpha=0.02, min_transmittance=0.01),
}
HW = (20, 27)
rules = each(OTHERS)


def opaque_splats():
    """Splats of which many reach every cap, cut-off and stop."""
    splats = make_splats(150, HW, 4, (0.0, 2.0)).to(F64)
    slopes = torch.zeros(150, 2, dtype=F64)
    return replace(splats, opacities=(1.1 * splats.opacities.sqrt()).clamp(max=1), depth_slopes=slopes)


@cache
def usual(pixel: PixelKernel) -> Render:
    return Reference()(opaque_splats(), HW, SKY, pixel)


@pytest.mark.parametrize("pixel", PIXEL_KERNELS.values(), ids=PIXEL_KERNELS)
def test_tiled_equals_the_reference_under_other_rules(pixel, rules):
    splats = opaque_splats()
    tiled, exact = (draw(splats, HW, SKY, pixel, None, rules) for draw in (Tiled(), Reference()))
    torch.testing.assert_close(tiled.rgb, exact.rgb, rtol=0, atol=1e-6)
    assert (exact.rgb - usual(pixel).rgb).abs().max() > 1e-5, "these rules should matter here"


@pytest.mark.parametrize("compositor", COMPOSITORS.values(), ids=COMPOSITORS)
def test_compositors_equal_their_exact_twins_under_other_rules(compositor, rules):
    splats = opaque_splats()
    tiled, exact = (draw(splats, HW, SKY, INTEGRAL, compositor, rules) for draw in (Tiled(), Reference()))
    difference = (tiled.rgb - exact.rgb).abs().amax(dim=2)
    assert (difference > 2e-5).double().mean() < 1e-3


def test_gradients_follow_the_rules(rules):
    require_gradients(opaque_splats(), HW, rules=rules)


def test_any_number_of_channels_is_composited_as_three_are():
    splats, images = opaque_splats(), []
    more = torch.stack([*splats.rgb.unbind(1), splats.depths, splats.opacities], dim=1)
    for draw in (TILED, REFERENCE):
        features = more.clone().requires_grad_()
        image = draw(replace(splats, rgb=features), HW, SKY, POINT)
        images.append((image.rgb, image.alpha, *torch.autograd.grad(image.rgb.square().sum(), features)))
    torch.testing.assert_close(*images, rtol=1e-9, atol=1e-9)
    assert images[0][0].shape == (*HW, 5)
    torch.testing.assert_close(images[1][0][..., :3], usual(POINT).rgb)


@pytest.mark.parametrize("rasterizer", ALL_RASTERIZERS.values(), ids=ALL_RASTERIZERS)
def test_rules_worked_by_hand(rasterizer):
    def centre(*opacities: float, rules: Rules) -> float:
        splats = stack(*((opacity, RED) for opacity in opacities)).to(torch.float32)
        return rasterizer(splats, (16, 16), BLACK, POINT, None, rules).alpha[4, 4].item()

    assert centre(1.0, rules=RULES_GSPLAT) == pytest.approx(0.999, abs=1e-6)
    assert centre(1.0, rules=RULES_3DGS) == pytest.approx(0.99, abs=1e-6)
    assert centre(0.04, rules=Rules(min_alpha=0.05)) == 0
    assert centre(0.06, rules=Rules(min_alpha=0.05)) == pytest.approx(0.06, abs=1e-6)
    assert centre(0.003, rules=Rules(min_alpha=1 / 400)) == pytest.approx(0.003, abs=1e-6)
    stop = Rules(min_transmittance=0.05)
    assert centre(0.9, 0.6, 0.4, rules=stop) == pytest.approx(0.9, abs=1e-6)  # not down to 0.04
    assert centre(0.9, 0.4, 0.4, rules=stop) == pytest.approx(0.94, abs=1e-6)


def test_a_lower_cutoff_keeps_splats_and_pixels_that_a_higher_one_drops():
    # 0.5 exp(-d²/8) falls to 1/255 at 6.2 px and to 1/400 at 6.5 px
    for x, opacity in ((4.5, 0.003), (-6.35, 0.5)):
        splats = splats_of(((x, 4.5), (4.0, 0.0, 4.0), 1.0, opacity, RED))
        assert [len(cull(splats, (9, 9), rules=rules)) for rules in (RULES_3DGS, Rules(min_alpha=1 / 400))] == [0, 1]


@pytest.mark.skipif(COMPILED is None, reason="the kernels are not compiled here (aaplug warmup)")
def test_compiled_kernels_follow_the_rules_without_being_built_anew(rules, monkeypatch):
    """One kernel serves all rules: nothing falls back to eager code, and the image is the reference's."""
    splats, eager = opaque_splats().to(torch.float32), []
    run = CompiledKernels.runner

    def watched(kernels, kernel, args):
        runner = run(kernels, kernel, args)
        eager.extend([kernel.name] if runner is kernel.function else [])
        return runner

    monkeypatch.setattr(CompiledKernels, "runner", watched)
    fast, exact = (draw(splats, HW, SKY, POINT, None, rules) for draw in (Tiled(COMPILED), Reference()))
    assert not eager
    torch.testing.assert_close(fast.rgb.double(), exact.rgb, rtol=0, atol=2e-5)
    seen = cull(project(make_scene(200), make_camera(), COMPILED, rules), (64, 64), kernels=COMPILED, rules=rules)
    assert seen.sources.equal(cull(project(make_scene(200), make_camera(), rules=rules), (64, 64), rules=rules).sources)
    assert not eager


WRONG = {"max_alpha": (1.0, math.nan), "min_alpha": (0.0, 1 / 600, 0.995), "min_transmittance": (0.0, 1.0)}


@pytest.mark.parametrize("name", [*WRONG, "near"])
def test_wrong_rules_are_refused(name):
    for value in WRONG.get(name, (0.0, -1.0)):
        with pytest.raises(UsageError, match=": expected"):
            Rules(**{name: value})

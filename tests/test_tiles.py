"""Tiles: their lists, the lines that they are made of, and gradients where few of them have splats."""

from dataclasses import replace

import pytest
import torch

from aaplug.core.kernels import EAGER, Kernels
from aaplug.core.splats import Splats2D
from aaplug.methods.pixel_kernels.raster_rows import TILE
from aaplug.rasterizers.reference import Reference
from aaplug.rasterizers.tiled import Tiled, binning, forward
from aaplug.system.executors import torch_threads
from tests.conftest import make_splats

F64 = torch.float64
SKY = (0.25, 0.5, 1.0)


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


def gradients(draw, splats: Splats2D, hw: tuple[int, int]) -> tuple[torch.Tensor, ...]:
    assert splats.rgb is not None
    leaves = [x.detach().requires_grad_() for x in (splats.means, splats.opacities, splats.rgb)]
    means, opacities, rgb = leaves
    image = draw(replace(splats, means=means, opacities=opacities, rgb=rgb), hw, SKY)
    weights = torch.linspace(0.5, 1.5, image.alpha.numel(), dtype=F64).view(hw)
    return torch.autograd.grad((image.rgb.sum(dim=2) * weights + image.alpha * weights.flip(0)).sum(), leaves)


@pytest.mark.parametrize("kernels", [EAGER, TwoTilesAtOnce()], ids=["all tiles at once", "two at once"])
@pytest.mark.parametrize(
    "counts", [(7,), (7, 0), (0, 7), (0, 7, 0), (20, 3), (3, 20), (40, 1, 1), (1, 1, 40, 0), (5, 70, 2, 9, 33)], ids=str
)
def test_gradients_where_few_tiles_have_splats(counts, kernels):
    splats, hw = in_tiles(*counts), (TILE, TILE * len(counts))
    found, expected = (gradients(draw, splats, hw) for draw in (Tiled(kernels), Reference()))
    for fast, slow in zip(found, expected, strict=True):
        assert slow.abs().amin(dim=-1).max() > 0
        torch.testing.assert_close(fast, slow, rtol=1e-9, atol=1e-12)


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
def test_selected_splats_are_those_of_the_rows_and_pass_gradients_on(rows):
    splats = make_splats(9, (20, 20), 3, (0.0, 1.0)).to(F64)
    splats = replace(splats, depth_slopes=torch.ones(9, 2, dtype=F64), means=splats.means.requires_grad_())
    index = torch.tensor(rows, dtype=torch.long)
    found = splats.selected(index)
    for name, column in splats._columns().items():
        assert getattr(found, name).equal(column[index])
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

"""Codebooks by k-means (Lloyd 1982): few values that stand for many numbers, few rows that stand for many rows.

n: numbers or rows.  c: columns of a row.  p: entries.  Nothing is random: the same input gives the same codebook.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.system.executors import torch_threads

VALUE_STEPS, ROW_STEPS = 30, 6  # of Lloyd's algorithm
COARSE, MIN_GROUP = 256, 64  # groups of rows, each of which gets a codebook of its own; rows of a group
BLOCK = 1 << 24  # distances computed at once: 64 MB
BLOCK_ROWS = 1 << 16  # rows held in float64 at once: 24 MB of harmonics of degree 3


def codebook(values: Float[Tensor, " n"], entries: int) -> Float[Tensor, " entries"]:
    """Increasing values such that the mean squared distance of at least one number to the nearest is small.

    Where so many values are enough, each number is one of them.
    """
    ordered = torch.from_numpy(np.sort(values.numpy())).double()  # several times faster than torch's
    distinct = ordered.unique_consecutive()
    if len(distinct) <= entries:
        return torch.cat([distinct, distinct[-1:].expand(entries - len(distinct))]).to(values.dtype)
    sums = torch.cat([ordered.new_zeros(1), ordered.cumsum(0)])
    # between equal shares of the numbers, which serve the crowd, and equal steps, which serve the ends
    shares = torch.linspace(0, 1, entries, dtype=torch.float64)
    quantiles = ordered[(shares * (len(ordered) - 1)).round().long()]
    levels = 0.5 * (quantiles + torch.lerp(ordered[0], ordered[-1], shares))
    for _ in range(VALUE_STEPS):
        ends = torch.searchsorted(ordered, 0.5 * (levels[1:] + levels[:-1]))
        ends = torch.cat([ends.new_zeros(1), ends, ends.new_tensor([len(ordered)])])
        counts = ends.diff()
        levels = torch.where(counts > 0, sums[ends].diff() / counts.clamp(min=1), levels)
    return levels.to(values.dtype)


def nearest_value(values: Float[Tensor, "*n"], levels: Float[Tensor, " p"]) -> Int[Tensor, "*n"]:
    """Index of the nearest of increasing levels."""
    return torch.searchsorted(0.5 * (levels[1:] + levels[:-1]), values.contiguous())


@torch_threads(1)
def palette(rows: Float[Tensor, "n c"], entries: int) -> tuple[Float[Tensor, "p c"], Int[Tensor, " n"]]:
    """At most `entries` rows that stand for all, and the index of each row's.  In one thread: the groups are small.

    Groups are halved at the median of their main direction until few rows are in each, so that the time does not grow
    with n·p; each group gets entries by the square root of its size times its squared error.
    """
    if len(rows) <= entries:
        return rows, torch.arange(len(rows))
    groups = [torch.arange(len(rows))]
    while len(groups) < COARSE and len(groups[0]) > MIN_GROUP:
        groups = [half for each in groups for half in each[_along(rows[each])].tensor_split((len(each) // 2,))]
    sizes = torch.tensor([len(each) for each in groups])
    spread = torch.stack([(rows[each] - rows[each].mean(dim=0)).square().sum() for each in groups])
    weight = (spread.double() * sizes).sqrt()
    shares = (weight / weight.sum().clamp(min=1e-300) * (entries - len(groups))).long() + 1
    labels, centres = torch.empty(len(rows), dtype=torch.long), list[Tensor]()
    for each, share in zip(groups, shares.minimum(sizes).tolist(), strict=True):
        found, own = _lloyd(rows[each], share)
        labels[each] = own + sum(map(len, centres))
        centres.append(found)
    return torch.cat(centres), labels


def _along(rows: Float[Tensor, "n c"]) -> Int[Tensor, " n"]:
    """The order of rows along the direction in which they differ most."""
    mean, blocks = rows.mean(dim=0), rows.split(BLOCK_ROWS)
    scatter = torch.stack([(centred := (block - mean).double()).T @ centred for block in blocks]).sum(dim=0)
    main = torch.linalg.eigh(scatter).eigenvectors[:, -1]
    return torch.cat([(block - mean).double() @ main for block in blocks]).argsort(stable=True)


def _lloyd(rows: Float[Tensor, "n c"], entries: int) -> tuple[Float[Tensor, "p c"], Int[Tensor, " n"]]:
    """k-means of rows that begins at evenly spaced ones along their main direction."""
    if len(rows) <= entries:
        return rows, torch.arange(len(rows))
    centres = rows[_along(rows)[torch.linspace(0, len(rows) - 1, entries).round().long()]]
    labels = nearest_row(rows, centres)
    for _ in range(ROW_STEPS):
        counts = torch.bincount(labels, minlength=entries)
        sums = torch.zeros_like(centres).index_add_(0, labels, rows)
        centres = torch.where(counts[:, None] > 0, sums / counts.clamp(min=1)[:, None], centres)
        labels = nearest_row(rows, centres)
    return centres, labels


def nearest_row(rows: Float[Tensor, "n c"], centres: Float[Tensor, "p c"]) -> Int[Tensor, " n"]:
    """Index of the centre nearest to each row."""
    offset = centres.square().sum(dim=1)
    blocks = rows.split(max(1, BLOCK // len(centres)))
    return torch.cat([torch.addmm(offset, block, centres.T, alpha=-2).argmin(dim=1) for block in blocks])

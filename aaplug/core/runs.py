"""Runs of places, one after another.

m: runs; p: places.
"""

import torch
from jaxtyping import Int
from torch import Tensor


def starts_of(counts: Int[Tensor, " m"]) -> Int[Tensor, " m"]:
    """The first place of each run, of these lengths."""
    return counts.cumsum(0, dtype=counts.dtype) - counts


def runs_of(starts: Int[Tensor, " m"], counts: Int[Tensor, " m"]) -> Int[Tensor, " p"]:
    """The run of each place, where run i begins at `starts[i]` and has `counts[i]` places, perhaps none.

    It is several times faster than `repeat_interleave`.
    """
    total = int(counts.sum())
    beginnings = starts.new_zeros(total + 1)  # runs that begin at each place; empty runs at the end begin at `total`
    beginnings.index_add_(0, starts, torch.ones_like(starts))
    beginnings[0] -= 1
    return beginnings[:total].cumsum(0, dtype=beginnings.dtype)

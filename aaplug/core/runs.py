"""Runs that follow one another, each of so many places.

m: runs; p: places.
"""

import torch
from jaxtyping import Int
from torch import Tensor


def starts_of(counts: Int[Tensor, " m"]) -> Int[Tensor, " m"]:
    """Where each of several runs begins that follow one another."""
    return counts.cumsum(0, dtype=counts.dtype) - counts


def runs_of(starts: Int[Tensor, " m"], counts: Int[Tensor, " m"]) -> Int[Tensor, " p"]:
    """Which run each place belongs to, where run i begins at `starts[i]` and holds `counts[i]`, perhaps none.

    Several times faster than `repeat_interleave`.
    """
    total = int(counts.sum())
    begun = starts.new_zeros(total + 1)  # runs that begin here; none at the end begin at `total`
    begun.index_add_(0, starts, torch.ones_like(starts))
    begun[0] -= 1
    return begun[:total].cumsum(0, dtype=begun.dtype)

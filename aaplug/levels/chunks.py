"""Chunks: parts of space with about as many Gaussians each, whose levels are chosen one by one.

They are the leaves of an octree, read off codes along a space-filling curve.  Each coordinate is squeezed by itself, so
a leaf is a box whose sides follow the axes, and a weighted mean of places in a chunk lies in it too.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.levels.pairing import BITS, curve

LARGEST = 1024  # Gaussians of a chunk


def chunks_of(means: Float[Tensor, "n 3"], largest: int = LARGEST) -> Int[Tensor, " n"]:
    """The chunk of each Gaussian, numbered along the curve; none has more than `largest` unless they coincide."""
    codes, order = torch.sort(curve(means.double()), stable=True)
    first = torch.ones(len(codes), dtype=torch.bool)  # whether a chunk begins at a place
    if len(codes):
        first[1:] = False
    open_ = torch.ones_like(first)  # whether the place's chunk has too many
    for depth in range(1, BITS + 1):
        _, places, counts = torch.unique_consecutive(
            torch.stack([first.cumsum(0), open_.long()]), dim=1, return_inverse=True, return_counts=True
        )
        open_ = counts[places] > largest
        if not open_.any():
            break
        cells = codes >> 3 * (BITS - depth)
        first[1:] |= open_[1:] & (cells[1:] != cells[:-1])
    numbers = torch.empty_like(codes)
    numbers[order] = first.cumsum(0) - 1
    return numbers

"""Chunks: parts of space with about as many Gaussians each, whose levels are chosen one by one.

They are the leaves of an octree, read off codes along a space-filling curve.  Each coordinate is squeezed by itself, so
a leaf is a box whose sides follow the axes, and a weighted mean of places in a chunk lies in it too.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

MAX_CHUNK_GAUSSIANS = 1024
BITS = 21  # of a coordinate along the curve
SPREADS = ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
           (2, 0x1249249249249249))  # fmt: skip


def chunks_of(means: Float[Tensor, "n 3"], largest: int = MAX_CHUNK_GAUSSIANS) -> Int[Tensor, " n"]:
    """The chunk of each Gaussian, numbered along the curve; none has more than `largest` unless they coincide."""
    codes, order = torch.sort(curve(squeezed(means.double())), stable=True)
    first = torch.ones(len(codes), dtype=torch.bool)  # whether a chunk begins at a place
    if len(codes):
        first[1:] = False
    for depth in range(1, BITS + 1):
        places = first.cumsum(0) - 1
        open_ = torch.bincount(places)[places] > largest
        if not open_.any():
            break
        cells = codes >> 3 * (BITS - depth)
        first[1:] |= open_[1:] & (cells[1:] != cells[:-1])
    numbers = torch.empty_like(codes)
    numbers[order] = first.cumsum(0) - 1
    return numbers


def squeezed(means: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Each mean in space that is squeezed far from the middle, to lie between -1 and 1."""
    offsets = means - means.median(dim=0).values
    size = offsets.abs().median().clamp(min=torch.finfo(means.dtype).tiny)
    return offsets / (size + offsets.abs())


def curve(places: Float[Tensor, "n 3"], shift: float = 0.0) -> Int[Tensor, " n"]:
    """Order of places in squeezed space along a Morton curve (Morton 1966)."""
    cells = ((0.25 * (places + 1) + shift) * (2**BITS - 1)).long()
    for by, mask in SPREADS:
        cells |= cells << by
        cells &= mask
    return cells[:, 0] | cells[:, 1] << 1 | cells[:, 2] << 2

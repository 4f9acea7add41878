"""Shared by the compressed formats: bounded decompression, packed quaternions, and axes.

n: rows.  Arrays are numpy's, as they come from files.

Functions raise FormatError for a file that breaks its format.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.gaussians import Gaussians
from aaplug.io.limits import limit
from aaplug.io.scenes.scene import logit_of
from aaplug.system.errors import FormatError

MAX_BYTE = 255


def check_growth(path: Path, inflated: int, compressed: int) -> None:
    """Refuse compressed bytes that announce a larger size than a real scene would have."""
    if inflated > limit("INFLATE") * compressed + limit("SLACK"):
        many = f"announce {inflated:,}, more than {limit('INFLATE'):g} times as many"
        bomb = "it is damaged or a decompression bomb (AAPLUG_INFLATE raises the limit)"
        raise FormatError(path, f"its {compressed:,} compressed bytes {many}; {bomb}")


def largest_last(rest: Float[Tensor, "n 3"], largest: Tensor) -> Float[Tensor, "n 4"]:
    """Unit quaternions from three components in order, and the index of the largest, which is not stored."""
    missing = (1 - rest.square().sum(dim=1)).clamp(min=0).sqrt()
    order = torch.tensor([[3, 0, 1, 2], [0, 3, 1, 2], [0, 1, 3, 2], [0, 1, 2, 3]])
    return torch.cat([rest, missing[:, None]], dim=1).gather(1, order[largest.long()])


def byte_opacities(alpha: np.ndarray) -> Float[Tensor, " n"]:
    """Logits of opacities stored as bytes."""
    return logit_of(floats(alpha) / MAX_BYTE)


def floats(values: np.ndarray) -> Tensor:
    """A copy as a float32 tensor."""
    return torch.from_numpy(values.astype(np.float32))


def half_turn_about_x(scene: Gaussians) -> Gaussians:
    """The scene with y and z negated: from OpenGL's axes to OpenCV's, or back.

    A harmonic of degree l and order m is multiplied by (−1)^(m < 0) for y and by (−1)^(l − |m|) for z.
    """
    orders = [(d, m) for d in range(scene.sh_degree + 1) for m in range(-d, d + 1)]
    signs = torch.tensor([(-1.0) ** ((m < 0) + d - abs(m)) for d, m in orders])
    return replace(
        scene,
        means=scene.means * torch.tensor([1.0, -1.0, -1.0]),
        quats=scene.quats * torch.tensor([1.0, 1.0, -1.0, -1.0]),
        sh=scene.sh * signs[:, None],
    )

"""Covariances in the world, and their projections along each of its axes.

n: Gaussians.  A covariance is packed as (xx, xy, xz, yy, yz, zz), in squared world units.  From far along an axis, a
Gaussian is a 2D one whose covariance is a minor of the packed one, so every integral below has a closed form.
"""

import math
from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.gaussians import Gaussians
from aaplug.core.projection import rotation_matrices

PLACES = ((0, 1, 2), (1, 3, 4), (2, 4, 5))  # of a matrix's elements in the packed form
DIAGONAL = tuple(PLACES[i][i] for i in range(3))
PLANES = ((0, 1), (1, 2), (2, 0))  # axes of the planes across z, x and y

Packed = Float[Tensor, "n 6"]


def covariances(scene: Gaussians) -> Packed:
    """Covariance of each Gaussian as its file stores it."""
    factors = rotation_matrices(scene.unit_quats) * scene.scales[:, None, :]
    return pack(factors @ factors.mT)


def pack(matrices: Float[Tensor, "n 3 3"]) -> Packed:
    """The upper triangle of symmetric matrices."""
    return torch.stack([matrices[:, i, j] for i in range(3) for j in range(i, 3)], dim=1)


def unpack(covs: Packed) -> Float[Tensor, "n 3 3"]:
    """The symmetric matrices again."""
    return covs[:, torch.tensor(PLACES)]


def outer(offsets: Float[Tensor, "n 3"]) -> Packed:
    """d dᵀ of each offset."""
    return torch.stack([offsets[:, i] * offsets[:, j] for i in range(3) for j in range(i, 3)], dim=1)


def blur(covs: Packed, variance: Float[Tensor, " n"]) -> Packed:
    """Covariances after an isotropic blur; a negative variance takes one out."""
    wider = covs.clone()
    for place in DIAGONAL:
        wider[:, place] += variance
    return wider


def _minors(covs: Packed) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    for i, j in PLANES:
        yield covs[:, PLACES[i][i]], covs[:, PLACES[i][j]], covs[:, PLACES[j][j]]


def areas(covs: Packed) -> Float[Tensor, "n 3"]:
    """∫ of a Gaussian of height 1 over the plane across each axis: 2π √det, in squared world units."""
    dets = [a * c - b * b for a, b, c in _minors(covs)]
    return 2 * math.pi * torch.stack(dets, dim=1).clamp(min=0).sqrt()


def area(covs: Packed) -> Float[Tensor, " n"]:
    """Mean of `areas`."""
    return areas(covs).mean(dim=1)


def overlaps(total: Packed, offsets: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """∫ g h over the plane across each axis, of Gaussians g and h that integrate to 1.

    total: the sum of their covariances.  offsets: between their means.
    """
    found = list[Tensor]()
    for (i, j), (a, b, c) in zip(PLANES, _minors(total), strict=True):
        x, y = offsets[:, i], offsets[:, j]
        det = (a * c - b * b).clamp(min=torch.finfo(a.dtype).tiny)
        power = -0.5 * (c * x * x - 2 * b * x * y + a * y * y) / det
        found.append(det.rsqrt() / (2 * math.pi) * torch.exp(power))
    return torch.stack(found, dim=1)

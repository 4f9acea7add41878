"""Functions that gsplat computes on CUDA alone: relocation, covariances for its noise, selective Adam, and harmonics.

n: Gaussians; b: leading dimensions.  3DGS-MCMC is Kheradmand et al. 2024, arXiv 2404.09591; Taming 3DGS is Mallick et
al. 2024, arXiv 2406.15643.
"""

import math
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from aaplug.core.projection import rotation_matrices
from aaplug.core.spherical_harmonics import COLOUR_OFFSET, sh_colour
from aaplug.system.contracts import Range, contract
from aaplug.system.errors import UsageError

MAX_OPACITY = 1 - torch.finfo(torch.float32).eps  # nearer to 1 the sum of `compute_relocation` loses digits


@contract
def compute_relocation(
    opacities: Float[Tensor, " n"] | Float[Tensor, "n 1"],
    scales: Float[Tensor, "n 3"],
    ratios: Int[Tensor, " n"],
    binoms: Float[Tensor, "most most"],
) -> tuple[Float[Tensor, " n"] | Float[Tensor, "n 1"], Float[Tensor, "n 3"]]:
    """Opacities and scales with which N copies of a Gaussian look like one of it (3DGS-MCMC, eq. 9).

    With o' = 1 - (1 - o)^(1/N), scales are multiplied by o / Σ_j C(N, j) (-1)^(j-1) o'^j / √j, j = 1 … N.  This is the
    paper's double sum, by Σ_i C(i-1, j-1) = C(N, j).

    opacities: also a column, as nerfstudio's parameters are.  ratios: N, taken as 1 … `most`.  binoms: gsplat's table;
    only its side is read.
    """
    counts, orders = ratios.clamp(1, len(binoms)), range(1, len(binoms) + 1)
    old = opacities.double().flatten().clamp(max=MAX_OPACITY)
    choices, j = old.new_tensor([[math.comb(n, k) for k in orders] for n in orders]), old.new_tensor(orders)
    new = 1 - (1 - old) ** (1 / counts.double())
    factors = old / -((choices / j.sqrt())[counts - 1] * (-new[:, None]) ** j).sum(dim=1)
    return new.to(opacities).view_as(opacities), scales * factors[:, None].to(scales)


@contract
def quat_scale_to_covar_preci(
    quats: Float[Tensor, "*b 4"],
    scales: Float[Tensor, "*b 3"],
    compute_covar: bool = True,
    compute_preci: bool = True,
    triu: bool = False,
) -> tuple[Float[Tensor, "..."] | None, Float[Tensor, "..."] | None]:
    """Covariances of Gaussians and their inverses, [*b, 3, 3], each None if not asked for.

    quats: wxyz, of any length but zero.  triu: the upper triangles xx, xy, xz, yy, yz, zz, [*b, 6], instead.
    """
    axes = rotation_matrices(functional.normalize(quats, dim=-1).reshape(-1, 4)).view(*scales.shape, 3)
    rows, columns = torch.triu_indices(3, 3)

    def of(scales: Tensor) -> Tensor:
        factor = axes * scales[..., None, :]
        matrices = factor @ factor.mT
        return matrices[..., rows, columns] if triu else matrices

    return of(scales) if compute_covar else None, of(1 / scales) if compute_preci else None


@contract
@torch.no_grad()
def adam(
    param: Float[Tensor, "n ..."],
    param_grad: Float[Tensor, "n ..."],
    exp_avg: Float[Tensor, "n ..."],
    exp_avg_sq: Float[Tensor, "n ..."],
    valid: Bool[Tensor, " n"],
    lr: float,
    b1: float,
    b2: float,
    eps: float,
) -> None:
    """A step of Adam in place, without its correction of bias, for the Gaussians that `valid` marks (Taming 3DGS)."""
    for average, rate, value in ((exp_avg, b1, param_grad), (exp_avg_sq, b2, param_grad.square())):
        average[valid] = average[valid].lerp(value[valid], 1 - rate)
    param[valid] -= lr * exp_avg[valid] / (exp_avg_sq[valid].sqrt() + eps)


@contract
def spherical_harmonics(
    degrees_to_use: Annotated[int, Range(0, 4)],
    dirs: Float[Tensor, "*b 3"],
    coeffs: Float[Tensor, "*b k 3"],
    masks: Bool[Tensor, "*b"] | None = None,
) -> Float[Tensor, "*b 3"]:
    """Sums of real spherical harmonics, [*b, 3], without 3DGS's offset of 0.5.

    k: coefficients per channel, of which the first (degree + 1)² are read.  dirs: of any length but zero.
    masks: where False, the sum is 0.

    Raises UsageError if shapes do not fit each other, or there are too few coefficients.
    """
    count, given = (degrees_to_use + 1) ** 2, coeffs.shape[-2]
    if count > given:
        raise UsageError("degrees_to_use", f"{degrees_to_use} needs {count} coefficients, coeffs has {given}")
    directions = functional.normalize(dirs.reshape(-1, 3), dim=1)
    sums = (sh_colour(coeffs[..., :count, :].reshape(-1, count, 3), directions) - COLOUR_OFFSET).view_as(dirs)
    return sums if masks is None else sums.where(masks[..., None], 0.0)

"""Convolution of Gaussians in the world, fused into scales and opacities.

n: Gaussians; k: 1, or 3 for one value per axis.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.gaussians import Fusion, Gaussians, scale_opacities
from aaplug.system.contracts import contract
from aaplug.system.errors import UsageError


@contract
def smoothed_by(scene: Gaussians, log_sigma: Float[Tensor, "n k"], volume: bool) -> Gaussians:
    """Convolve each Gaussian with one of standard deviation e^log_sigma; -inf changes nothing.

    log_sigma: one for all axes of a Gaussian, or one per axis; discs are smoothed within their planes only (AA-2DGS's
        world-space flat kernel).  volume: scale opacities by the volume factor, of a disc that of its face.
    """
    if log_sigma.shape not in ((len(scene), 1), (len(scene), 3)):
        raise UsageError("log_sigma", f"expected [{len(scene)}, 1] or [{len(scene)}, 3], got {[*log_sigma.shape]}")
    if scene.flat:
        log_sigma = torch.cat([log_sigma.expand(-1, 3)[:, :2], torch.full_like(log_sigma[:, :1], -torch.inf)], dim=1)
    log_scales = 0.5 * torch.logaddexp(2 * scene.log_scales, 2 * log_sigma)
    smoothed = replace(scene, log_scales=log_scales)
    if not volume:
        return smoothed
    factor = volume_log_factor(scene.log_scales, log_sigma)
    return replace(smoothed, logit_opacities=scale_opacities(scene.logit_opacities, factor))


def volume_log_factor(log_scales: Float[Tensor, "n 3"], log_sigma: Float[Tensor, "n k"]) -> Float[Tensor, " n"]:
    """ln ∏ s/√(s² + f²) = −½ Σ ln(1 + f²/s²)."""
    return _axis_log_factors(log_scales, log_sigma).sum(dim=1)


def face_log_factor(log_scales: Float[Tensor, "n 3"], log_sigma: Float[Tensor, "n k"]) -> Float[Tensor, " n"]:
    """The same over the two longest axes, which span the broadest face."""
    return _axis_log_factors(log_scales, log_sigma).topk(2, dim=1).values.sum(dim=1)


def _axis_log_factors(log_scales: Float[Tensor, "n 3"], log_sigma: Float[Tensor, "n k"]) -> Float[Tensor, "n 3"]:
    log_ratio = torch.where(log_sigma == -torch.inf, -torch.inf, 2 * (log_sigma - log_scales))  # also where both are
    return -0.5 * torch.logaddexp(log_ratio, torch.zeros_like(log_ratio))


def fuse_stored(scene: Gaussians) -> Gaussians:
    """The same scene with its stored 3D filter fused; unchanged if it has none (Mip-Splatting, fused export)."""
    if scene.filter_3d is None:
        return scene
    smoothed = smoothed_by(scene, scene.filter_3d.log()[:, None], volume=True)
    return replace(smoothed, filter_3d=None, fused=(*scene.fused, Fusion("filter_3D")))

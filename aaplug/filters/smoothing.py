"""3D smoothing: convolve every Gaussian with an isotropic one, in the world (Mip-Splatting, section 5.1).

A variance added to every axis commutes with the rotation, so fusing it into the scales is exact:
s' = √(s² + f²).  With the volume factor the Gaussian keeps its integral: o' = o·∏ s/s' (Mip-Splatting's choice), taken
in log space, where scales of 1e-12 and below are exact and have gradients.
"""

from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.gaussians import Fusion, Gaussians, scale_opacities
from aaplug.interfaces import Training

NYQUIST_VARIANCE = (
    0.2  # px² at the highest rate: Mip-Splatting's published constant (its eq. 9 omits a square)
)


@dataclass(frozen=True)
class Smoothing3D:
    """Smooth by `variance` / ν², ν the highest rate at which any training camera sampled the Gaussian.

    variance: px² at that rate.  opacity: "volume" keeps the integral, "kept" leaves opacity alone.
    Gaussians that no camera saw get the coarsest rate found.
    """

    variance: float = NYQUIST_VARIANCE
    opacity: Literal["volume", "kept"] = "volume"

    def __call__(self, scene: Gaussians, training: Training) -> Gaussians:
        """Fuse the smoothing into scales and opacities."""
        sigma = self.variance**0.5 / training.bounds.highest_or_coarsest
        smoothed = smooth(scene, sigma.log(), self.opacity == "volume")
        settings = {"variance": f"{self.variance:g}", "opacity": self.opacity}
        return replace(smoothed, fused=(*scene.fused, Fusion("smoothing3d", settings)))


@dataclass(frozen=True)
class StoredSmoothing:
    """Fuse the `filter_3D` column of a Mip-Splatting checkpoint; a scene without one stays as it is."""

    def __call__(self, scene: Gaussians, training: Training) -> Gaussians:
        """Fuse the stored standard deviations into scales and opacities, and forget them."""
        return fuse_stored(scene)


def fuse_stored(scene: Gaussians) -> Gaussians:
    """The same scene with its stored 3D filter fused; unchanged if it has none (Mip-Splatting, fused export)."""
    if scene.filter_3d is None:
        return scene
    smoothed = smooth(scene, scene.filter_3d.log(), volume=True)
    return replace(smoothed, filter_3d=None, fused=(*scene.fused, Fusion("filter_3D")))


def smooth(scene: Gaussians, log_sigma: Float[Tensor, " n"], volume: bool) -> Gaussians:
    """Convolve each Gaussian with an isotropic one of standard deviation e^log_sigma; −inf changes nothing."""
    log_scales = 0.5 * torch.logaddexp(2 * scene.log_scales, 2 * log_sigma[:, None])
    smoothed = replace(scene, log_scales=log_scales)
    if not volume:
        return smoothed
    factor = volume_log_factor(scene.log_scales, log_sigma)
    return replace(smoothed, logit_opacities=scale_opacities(scene.logit_opacities, factor))


def volume_log_factor(
    log_scales: Float[Tensor, "n 3"], log_sigma: Float[Tensor, " n"]
) -> Float[Tensor, " n"]:
    """ln ∏ s/√(s² + f²) = −½ Σ ln(1 + f²/s²)."""
    log_ratio = 2 * (log_sigma[:, None] - log_scales)
    return -0.5 * torch.logaddexp(log_ratio, torch.zeros_like(log_ratio)).sum(dim=1)

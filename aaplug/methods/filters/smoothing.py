"""3D smoothing: convolve every Gaussian with another one, in the world (Mip-Splatting, section 5.1).

A variance added to every axis commutes with the rotation, so fusing it into the scales is exact: s' = √(s² + f²).  The
volume factor o' = o·∏ s/s' keeps the Gaussian's integral (Mip-Splatting's choice).  It is computed in log space, where
scales of 1e-12 and less are exact and have gradients.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch

from aaplug.core.convolution import face_log_factor, smoothed_by
from aaplug.core.gaussians import Fusion, Gaussians, scale_opacities
from aaplug.core.projection import rotation_matrices
from aaplug.core.sampling import view_information
from aaplug.core.training import TrainingViews

# px² at the highest rate: Mip-Splatting's published constant (its eq. 9 omits a square)
NYQUIST_VARIANCE = 0.2
LEAST_SHARE = 1 / 16  # of the highest rate squared: no axis is smoothed more than 4 times as wide
BALANCE_FLOOR = 0.5  # of an opacity: balancing dims no Gaussian further


@dataclass(frozen=True)
class Smoothing3D:
    """Smooth by `variance` / ν², ν the highest rate at which any training camera sampled the Gaussian.

    variance: px² at that rate.
    opacity: "volume" keeps the integral, "kept" keeps the opacity.  "balanced" keeps the integral over the broadest
        face, but at least half of the opacity, because a surfel's volume says little about what it hides.  It is
        aaplug's own; AA-Splat's opacity balancing (arXiv 2603.29394) has no published formula.
    focal: "own" pairs each camera's depth with its own focal length, as Mip-Splatting's equation 7 does; "largest"
        pairs every depth with the largest of all, as its published code does.
    A Gaussian that no camera saw gets the coarsest rate of all.
    """

    variance: float = NYQUIST_VARIANCE
    opacity: Literal["volume", "balanced", "kept"] = "volume"
    focal: Literal["own", "largest"] = "own"

    def __call__(self, scene: Gaussians, training: TrainingViews) -> Gaussians:
        """Fuse the smoothing into scales and opacities."""
        bounds = training.bounds
        if self.focal == "largest":
            largest = max(camera.focal for camera in training.cameras)
            bounds = replace(bounds, highest=torch.where(bounds.seen, largest / bounds.nearest, 0.0))
        log_sigma = (self.variance**0.5 / bounds.highest_or_coarsest).log()[:, None]
        smoothed = smoothed_by(scene, log_sigma, self.opacity == "volume")
        if self.opacity == "balanced":
            factor = face_log_factor(scene.log_scales, log_sigma).clamp(min=math.log(BALANCE_FLOOR))
            logits = scale_opacities(scene.logit_opacities, factor)
            smoothed = replace(smoothed, logit_opacities=logits)
        settings = {"variance": f"{self.variance:g}", "opacity": self.opacity}
        if self.focal != "own":
            settings["focal"] = self.focal
        return replace(smoothed, fused=(*scene.fused, Fusion("smoothing3d", settings)))


@dataclass(frozen=True)
class AnisotropicSmoothing:
    """Smooth each axis of a Gaussian by how finely the views sample along it; no view samples along its own ray.

    With J = Σ ν² (I - d dᵀ), the rate along an axis u is ν_u² = ν² uᵀ J u / Σ ν², where ν is the highest rate of any
    training camera.  One view gives ν across its ray and 0 along it; views from all sides give ν √⅔ everywhere.  The
    variance along u is `variance` / ν_u², with ν_u at least ν √`LEAST_SHARE`.  Terms that would turn a Gaussian's axes
    are dropped.  aaplug's own; the volume factor is Mip-Splatting's.
    """

    variance: float = NYQUIST_VARIANCE

    def __call__(self, scene: Gaussians, training: TrainingViews) -> Gaussians:
        """Fuse the smoothing into scales and opacities."""
        information = view_information(scene.means, training.cameras)
        axes = rotation_matrices(scene.unit_quats)
        along = (axes * (information @ axes)).sum(dim=1)
        across = 0.5 * information.diagonal(dim1=1, dim2=2).sum(dim=1, keepdim=True)
        seen = across > 0
        share = torch.where(seen, along / across.where(seen, 1.0), 1.0).clamp(LEAST_SHARE, 1.0)
        log_sigma = (self.variance**0.5 / training.bounds.highest_or_coarsest).log()
        smoothed = smoothed_by(scene, log_sigma[:, None] - 0.5 * share.log(), volume=True)
        fusion = Fusion("anisotropic smoothing", {"variance": f"{self.variance:g}"})
        return replace(smoothed, fused=(*scene.fused, fusion))


@dataclass(frozen=True)
class FlatSmoothing:
    """Smooth discs within their own planes and keep their integral (AA-2DGS's world-space flat kernel).

    A disc lies across a Gaussian's thinnest axis.  variance: px² at the highest rate of any training camera.
    """

    variance: float = NYQUIST_VARIANCE

    def __call__(self, scene: Gaussians, training: TrainingViews) -> Gaussians:
        """Fuse the smoothing into scales and opacities."""
        log_sigma = (self.variance**0.5 / training.bounds.highest_or_coarsest).log()[:, None]
        smoothed = smoothed_by(scene, log_sigma, volume=False)
        thin = torch.zeros_like(scene.log_scales, dtype=torch.bool)
        thin.scatter_(1, scene.log_scales.argmin(dim=1, keepdim=True), True)
        logits = scale_opacities(scene.logit_opacities, face_log_factor(scene.log_scales, log_sigma))
        return replace(
            smoothed,
            log_scales=torch.where(thin, scene.log_scales, smoothed.log_scales),
            logit_opacities=logits,
            fused=(*scene.fused, Fusion("flat smoothing", {"variance": f"{self.variance:g}"})),
        )


def fuse_stored(scene: Gaussians) -> Gaussians:
    """The same scene with its stored 3D filter fused; unchanged if it has none (Mip-Splatting, fused export)."""
    if scene.filter_3d is None:
        return scene
    smoothed = smoothed_by(scene, scene.filter_3d.log()[:, None], volume=True)
    return replace(smoothed, filter_3d=None, fused=(*scene.fused, Fusion("filter_3D")))

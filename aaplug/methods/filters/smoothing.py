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
from aaplug.core.training import TrainingViews

# Its unit is px² at the highest rate.  It is Mip-Splatting's published constant (its eq. 9 omits a square).
NYQUIST_VARIANCE = 0.2
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


BY_VOLUME = Smoothing3D()

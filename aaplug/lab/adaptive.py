"""AAA-Gaussians' adaptive 3D filter (ICCV 2025, arXiv 2504.12811), at test time.

A Gaussian is widened in the world by F = max(0.3 / ν², 0.3 (z/f)²), the finest training pixel or this view's pixel,
whichever is larger.  It is dimmed by the change of its area across the ray.  Both act on the screen: F projects to
F J Jᵀ, and the ratio of areas is the ratio of determinants.  Gaussians that no camera saw are widened by this view's
pixel alone, as in the published code.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.projection import slope_limits
from aaplug.core.splats import Splats2D
from aaplug.core.training import TrainingViews

ADAPTIVE_VARIANCE = 0.3  # px² of either pixel: AAA-Gaussians' published constant


@dataclass(frozen=True)
class Adaptive:
    """Widen by the finest training pixel or this view's pixel, whichever is larger, and keep the projected energy."""

    variance: float = ADAPTIVE_VARIANCE

    def __call__(self, splats: Splats2D, camera: Camera, training: TrainingViews) -> Splats2D:
        """Filter the splats of one view."""
        bounds = training.bounds[splats.sources]
        finest = bounds.highest.to(splats.depths).where(bounds.seen, 1.0)
        magnified = torch.where(bounds.seen, camera.focal / splats.depths / finest, 1.0).clamp(min=1.0)
        variance = self.variance * magnified * magnified
        return splats.convolved(variance[:, None] * _sphere(splats, camera), compensate=True)


def _sphere(splats: Splats2D, camera: Camera) -> Float[Tensor, "m 3"]:
    """Projected covariance of a sphere whose standard deviation is 1 px on the optical axis: (z/f)² J Jᵀ."""
    centre = splats.means.new_tensor([camera.cx, camera.cy])
    focal = splats.means.new_tensor([camera.fx, camera.fy])
    slopes = ((splats.means - centre) / focal).unbind(dim=1)
    x, y = (s.clamp(*ends) for s, ends in zip(slopes, slope_limits(camera), strict=True))
    fx, fy = (focal / camera.focal).unbind()
    return torch.stack([fx * fx * (1 + x * x), fx * fy * x * y, fy * fy * (1 + y * y)], dim=1)

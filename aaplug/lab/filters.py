"""Filters for comparison, as the registries name them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.convolution import smoothed_by
from aaplug.core.gaussians import Fusion, Gaussians
from aaplug.core.projection import rotation_matrices, slope_limits
from aaplug.core.sampling import mean_position, rates_in_chunks
from aaplug.core.splats import Splats2D
from aaplug.core.training import TrainingViews
from aaplug.methods.filters.matched import Matched
from aaplug.methods.filters.smoothing import NYQUIST_VARIANCE, Smoothing3D

LEAST_SHARE = 1 / 16  # of the highest rate squared: no axis is smoothed more than 4 times as wide
ADAPTIVE_VARIANCE = 0.3  # px² of either pixel: AAA-Gaussians' published constant


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
        sampled = across > 0
        share = torch.where(sampled, along / across.where(sampled, 1.0), 1.0).clamp(LEAST_SHARE, 1.0)
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
        log_sigma = (self.variance**0.5 / training.bounds.highest_or_coarsest).log()[:, None].repeat(1, 3)
        log_sigma.scatter_(1, scene.log_scales.argmin(dim=1, keepdim=True), -torch.inf)
        smoothed = smoothed_by(scene, log_sigma, volume=True)
        fusion = Fusion("flat smoothing", {"variance": f"{self.variance:g}"})
        return replace(smoothed, fused=(*scene.fused, fusion))


def view_information(means: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> Float[Tensor, "n 3 3"]:
    """Directional sampling density of each Gaussian: Σ ν² (I - d dᵀ) over the cameras that see it, in px² per unit².

    Along u, uᵀ M u is the summed squared rate; a camera adds nothing along its own ray d.  0 if no camera sees it.
    """
    origin = mean_position(cameras).to(means.device)
    eyes = torch.stack([camera.centre.to(origin) - origin for camera in cameras]).to(means)
    information = means.new_zeros(len(means), 3, 3)
    for part, near, rates in rates_in_chunks(means, cameras):
        local = (means[part].double() - origin).to(means)
        rays = torch.nn.functional.normalize(local[:, None] - eyes[near], dim=2) * rates[:, :, None]
        total = rates.square().sum(dim=1)[:, None, None] * torch.eye(3).to(means)
        information[part] = total - rays.mT @ rays
    return information


@dataclass(frozen=True)
class Adaptive:
    """AAA-Gaussians' adaptive 3D filter (ICCV 2025, arXiv 2504.12811), at test time.

    A Gaussian is widened in the world by F = max(0.3 / ν², 0.3 (z/f)²), the finest training pixel or this view's pixel,
    whichever is larger.  It is dimmed by the change of its area across the ray.  Both act on the screen: F projects to
    F J Jᵀ, and the ratio of areas is the ratio of determinants.  Gaussians that no camera saw are widened by this
    view's pixel alone, as in the published code.
    """

    variance: float = ADAPTIVE_VARIANCE

    def __call__(self, splats: Splats2D, camera: Camera, training: TrainingViews) -> Splats2D:
        """Filter the splats of one view."""
        bounds = training.bounds[splats.sources]
        finest = bounds.highest.to(splats.depths).where(bounds.seen, 1.0)
        now = camera.focal / splats.depths if splats.rates is None else splats.rates
        magnified = torch.where(bounds.seen, now / finest, 1.0).clamp(min=1.0)
        variance = self.variance * magnified * magnified
        return splats.convolved(variance[:, None] * _sphere(splats, camera), compensate=True)


def _sphere(splats: Splats2D, camera: Camera) -> Float[Tensor, "m 3"]:
    """Projected covariance of a sphere whose standard deviation is 1 px at the view's rate: a pinhole's (z/f)² J Jᵀ."""
    zero, one = torch.zeros_like(splats.depths), torch.ones_like(splats.depths)
    if not camera.lens.flat:
        return torch.stack([one, zero, one], dim=1)
    focal, centre = (splats.means.new_tensor(pair) for pair in ((camera.fx, camera.fy), (camera.cx, camera.cy)))
    fx, fy = (focal / camera.focal).unbind()
    if camera.lens.projection == "ortho":
        return torch.stack([fx * fx * one, zero, fy * fy * one], dim=1)
    places = splats.means - centre if splats.planes is None else -splats.planes[:, :2, 2]
    x, y = (s.clamp(*ends) for s, ends in zip((places / focal).unbind(dim=1), slope_limits(camera), strict=True))
    return torch.stack([fx * fx * (1 + x * x), fx * fy * x * y, fy * fy * (1 + y * y)], dim=1)


LARGEST_FOCAL = Smoothing3D(focal="largest")
BALANCED = Smoothing3D(opacity="balanced")
ANISOTROPIC = AnisotropicSmoothing()
FLAT = FlatSmoothing()
ADAPTIVE = Adaptive()
SCALE_ADAPTIVE = Matched("global", pixel_variance=0.0)  # SA-GS's

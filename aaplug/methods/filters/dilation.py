"""Dilation by a constant: the screen filter of 3DGS, its --antialiasing, gsplat and Mip-Splatting."""

from dataclasses import dataclass

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Convention
from aaplug.core.splats import Splats2D
from aaplug.core.training import TrainingViews


@dataclass(frozen=True)
class Dilation:
    """Add `variance` px² to the covariance at every sampling rate; with `compensated`, preserve the splat's energy.

    0.3 uncompensated is 3DGS (Kerbl et al. 2023); 0.3 compensated is EWA splatting as in 3DGS --antialiasing and
    gsplat "antialiased"; 0.1 compensated is the 2D Mip filter (Mip-Splatting, eq. 10).
    """

    variance: float
    compensated: bool

    @classmethod
    def of(cls, convention: Convention) -> "Dilation":
        """What a convention adds."""
        return cls(convention.kernel, convention.compensated)

    def __call__(self, splats: Splats2D, camera: Camera, training: TrainingViews) -> Splats2D:
        """Filter the splats of one view."""
        return splats.blurred(self.variance, self.compensated)

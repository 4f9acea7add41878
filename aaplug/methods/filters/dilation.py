"""Screen filters of constant width: the dilation of 3DGS, gsplat and Mip-Splatting, and 2DGS's low-pass filter."""

from dataclasses import dataclass, replace

from aaplug.core.cameras import Camera
from aaplug.core.conventions import ANTIALIASED, CLASSIC, MIP, PLAYCANVAS, PLAYCANVAS_CLASSIC, Convention
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
        """The dilation of a convention."""
        return cls(convention.kernel, convention.compensated)

    def __call__(self, splats: Splats2D, camera: Camera, training: TrainingViews) -> Splats2D:
        """Filter the splats of one view."""
        return splats.blurred(self.variance, self.compensated)


@dataclass(frozen=True)
class LowPass:
    """Set the width of a disc's low-pass filter: √½ px of the image or, with `matched`, √½ px of training's image."""

    matched: bool = False

    def __call__(self, splats: Splats2D, camera: Camera, training: TrainingViews) -> Splats2D:
        """Set the width; covariances and opacities do not change."""
        return replace(splats, window=training.relative_rate(camera) if self.matched else 1.0)


OF_CLASSIC, OF_ANTIALIASED, OF_MIP = map(Dilation.of, (CLASSIC, ANTIALIASED, MIP))
OF_PLAYCANVAS, OF_PLAYCANVAS_CLASSIC = map(Dilation.of, (PLAYCANVAS, PLAYCANVAS_CLASSIC))
NONE = Dilation(0.0, compensated=False)

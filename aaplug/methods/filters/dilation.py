"""Screen filters of constant width: the dilation of 3DGS, gsplat and Mip-Splatting, and 2DGS's low-pass filter."""

from dataclasses import dataclass, replace

import torch

from aaplug.core.cameras import Camera
from aaplug.core.conventions import ANTIALIASED, CLASSIC, MIP, PLAYCANVAS, PLAYCANVAS_CLASSIC, Convention
from aaplug.core.splats import Splats2D
from aaplug.core.training import TrainingViews

TINY = 1e-12  # px⁴


@dataclass(frozen=True)
class Dilation:
    """Add `variance` px² to the covariance at every sampling rate; with `compensated`, preserve the splat's energy.

    0.3 uncompensated is 3DGS (Kerbl et al. 2023); 0.3 compensated is EWA splatting as in 3DGS --antialiasing and
    gsplat "antialiased"; 0.1 compensated is the 2D Mip filter (Mip-Splatting, eq. 10).

    smallest, apart: see `limited`.
    """

    variance: float
    compensated: bool
    smallest: float = 0.0
    apart: float = 0.0

    @classmethod
    def of(cls, convention: Convention) -> "Dilation":
        """The dilation of a convention."""
        return cls(convention.kernel, convention.compensated)

    def __call__(self, splats: Splats2D, camera: Camera, training: TrainingViews) -> Splats2D:
        """Filter the splats of one view."""
        return limited(splats.blurred(self.variance, self.compensated), self.smallest, self.apart)


def limited(splats: Splats2D, smallest: float = 0.0, apart: float = 0.0) -> Splats2D:
    """The splats as viewers with limits on a splat's size draw them.

    splats: with what the viewer adds.
    smallest: px²; a splat whose variance along its longer axis is less is not drawn.
    apart: px²; half the difference of the variances along a splat's two axes is at least this.  A rounder splat is
        stretched along u = (xy, apart - (xx - yy) / 2), as GaussianSplats3D does it, and is not drawn if its variance
        across u is not positive.
    """
    if not (smallest or apart):
        return splats
    xx, xy, yy = splats.covs.unbind(dim=1)
    mean, slant = (xx + yy) / 2, (xx - yy) / 2
    radius = (slant * slant + xy * xy).clamp(min=max(apart**2, TINY)).sqrt()
    drawn = (mean + radius >= smallest) & (radius < mean)
    columns = {"opacities": splats.opacities * drawn}
    if apart:
        along = radius - slant
        norm = (xy * xy + along * along).clamp(min=TINY)
        cosine, sine = radius * (xy * xy - along * along) / norm, radius * 2 * xy * along / norm
        covs = torch.stack((mean + cosine, sine, mean - cosine), dim=1)
        columns["covs"] = torch.where(drawn[:, None], covs, splats.covs)
        columns["dets"] = torch.where(drawn, mean * mean - radius * radius, splats.dets)
    return splats.with_columns(columns)


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

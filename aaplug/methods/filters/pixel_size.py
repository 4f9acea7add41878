"""Multi-Scale 3DGS' selection by pixel size (Yan et al., CVPR 2024, arXiv 2311.17089), at test time.

Its checkpoints contain every surface several times, as Gaussians of finer and coarser levels, and store the sizes at
which training drew each Gaussian.  A view draws the Gaussians that it sees at about these sizes.  The size of a
Gaussian is its half-width where alpha falls to 1/255, S = min(√(L/A), √(L/C)), with the diagonal A, C of the inverse
covariance before any dilation and L = 2 ln(255 o), as in the published code.  It is not drawn if it is
    too small: S < 2 px and S below half of the smallest size, or
    too large: S above twice the largest size.
Gaussians of the coarsest level are always drawn, and an unknown size excludes nothing.

Written from the method's description.  No checkpoint trained by it was available, so the columns are tested on
synthetic scenes and on those of `levels.multi_scale` only.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.ellipses import squared_cutoff
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.splats import Splats2D

SMALL = 2.0  # px: larger splats are never too small.  These three are Multi-Scale 3DGS's published constants
LEAST_SHARE = 0.5  # of the smallest size
MOST_SHARE = 2.0  # of the largest
MISSING = "the scene lacks Multi-Scale 3DGS' columns max_pixel_sizes, min_pixel_sizes and base_mask"


@dataclass(frozen=True)
class ByPixelSize:
    """Draw the Gaussians whose size in the view is one at which training drew them."""

    def lacks(self, scene: Gaussians) -> str | None:
        """The columns with these sizes, if the scene does not have them."""
        return MISSING if scene.pixel_sizes is None else None

    def __call__(self, splats: Splats2D, scene: Gaussians) -> Splats2D:
        """Leave out the splats that are too small or too large.

        Raises:
            UsageError: the scene has no recorded sizes.
        """
        if scene.pixel_sizes is None:
            raise UsageError("recipe multi-scale", MISSING)
        recorded = scene.pixel_sizes[splats.sources]
        size = pixel_size(splats)
        small = (size < LEAST_SHARE * recorded.smallest) & (size < SMALL)
        large = (recorded.largest > 0) & (size > MOST_SHARE * recorded.largest)
        return splats[recorded.base | ~(small | large)]


@torch.no_grad()
def pixel_size(splats: Splats2D) -> Float[Tensor, " m"]:
    """Half-width of each splat across its longer side, where alpha falls to 1/255, in px."""
    wider = torch.maximum(splats.covs[:, 0], splats.covs[:, 2])
    return (squared_cutoff(splats.opacities).clamp(min=0.0) * (splats.dets / wider)).sqrt()

"""Multi-Scale 3DGS' selection by pixel size (Yan et al., CVPR 2024, arXiv 2311.17089), at test time.

Its checkpoints hold every surface several times, in Gaussians of finer and coarser levels, and of each Gaussian the
sizes at which training drew it.  A view draws those that it sees at about these sizes.  The size of a Gaussian is its
half-width where alpha falls to 1/255, S = min(√(L/A), √(L/C)) with the diagonal A, C of the inverse covariance before
any dilation and L = 2 ln(255 o), as in the published code.  Left out are
    too small: S < 2 px and S below half of the smallest size,
    too large: S above twice the largest,
but never those of the coarsest level, nor by a size that is unknown.

Written from the method's description; no checkpoint of its own was at hand, so that the columns' use is verified on
made-up scenes alone.  A scene trained otherwise does not have them.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.ellipses import squared_cutoff
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.splats import Splats2D

SMALL = 2.0  # px: what is larger is never too small.  These three are Multi-Scale 3DGS' published constants
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

"""Multi-Scale 3DGS' selection by pixel size (Yan et al., CVPR 2024, arXiv 2311.17089), at test time.

Its checkpoints contain every surface several times, as Gaussians of finer and coarser levels, and store the sizes at
which training drew each Gaussian.  A view draws the Gaussians that it sees at about these sizes.  The size of a
Gaussian is its half-width where alpha falls to 1/255, S = min(√(L/A), √(L/C)), with the diagonal A, C of the inverse
covariance before any dilation and L = 2 ln(255 o), as in the published code.  It is not drawn if it is
    too small: S < 2 px and S below half of the smallest size, or
    too large: S above twice the largest size.
Gaussians of the coarsest level are always drawn, and an unknown size excludes nothing.

Written from the method's description.  No checkpoint trained by it was available, so the columns are tested on
synthetic scenes and on those of `lab.multi_scale` only.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from aaplug.core.ellipses import squared_cutoff
from aaplug.core.gaussians import Gaussians
from aaplug.core.splats import Splats2D
from aaplug.system.errors import UsageError

MAX_SMALL_SIZE = 2.0  # px: larger splats are never too small.  These three are Multi-Scale 3DGS's published constants
LEAST_SHARE = 0.5  # of the smallest size
MOST_SHARE = 2.0  # of the largest
COLUMNS = ("min_pixel_sizes", "max_pixel_sizes", "base_mask")
MISSING_COLUMNS = "the scene lacks Multi-Scale 3DGS' columns max_pixel_sizes, min_pixel_sizes and base_mask"


@dataclass(frozen=True, eq=False)
class PixelSizes:
    """The sizes at which training drew each Gaussian, as Multi-Scale 3DGS (Yan et al. 2024) stores them.

    smallest, largest: px, in images of the Gaussian's level; not above 0 where unknown.
    base: True where it belongs to the coarsest level.
    """

    smallest: Float[Tensor, " n"]
    largest: Float[Tensor, " n"]
    base: Bool[Tensor, " n"]

    @classmethod
    def of(cls, scene: Gaussians) -> "PixelSizes | None":
        """The sizes that a scene stores; None if it has none."""
        if any(name not in scene.extras for name in COLUMNS):
            return None
        smallest, largest, base = (scene.extras[name] for name in COLUMNS)
        return cls(smallest, largest, base > 0)

    @property
    def extras(self) -> dict[str, Tensor]:
        """The columns that store them."""
        return dict(zip(COLUMNS, (self.smallest, self.largest, self.base.float()), strict=True))


@dataclass(frozen=True)
class ByPixelSize:
    """Draw the Gaussians whose size in the view is one at which training drew them."""

    def lacks(self, scene: Gaussians) -> str | None:
        """The columns with these sizes, if the scene does not have them."""
        return MISSING_COLUMNS if PixelSizes.of(scene) is None else None

    def __call__(self, splats: Splats2D, scene: Gaussians) -> Splats2D:
        """Leave out the splats that are too small or too large.

        Raises:
            UsageError: the scene has no recorded sizes.
        """
        sizes = PixelSizes.of(scene)
        if sizes is None:
            raise UsageError("recipe multi-scale", MISSING_COLUMNS)
        smallest, largest, base = (column[splats.sources] for column in vars(sizes).values())
        size = pixel_size(splats)
        small = (size < LEAST_SHARE * smallest) & (size < MAX_SMALL_SIZE)
        large = (largest > 0) & (size > MOST_SHARE * largest)
        return splats[base | ~(small | large)]


@torch.no_grad()
def pixel_size(splats: Splats2D) -> Float[Tensor, " m"]:
    """Half-width of each splat across its longer side, where alpha falls to 1/255, in px."""
    wider = torch.maximum(splats.covs[:, 0], splats.covs[:, 2])
    return (squared_cutoff(splats.opacities).clamp(min=0.0) * (splats.dets / wider)).sqrt()


BY_PIXEL_SIZE = ByPixelSize()

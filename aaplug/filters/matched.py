"""The matched screen filter: what training saw, carried to the rate being rendered, then the rest of the pixel.

A classic checkpoint was fitted with +0.3 px² of dilation, so its look lives in C + 0.3 I at the training rate, and in
C + 0.3 r² I at r times that rate.  Step one restores that look, with the training's own compensation if it had any.
Where the rate is below training's (r < 1) a pixel is larger than training's pixel, and step two adds the part of the
pixel's own filter, 0.07 (1 − r²) px², that training's pixel did not hold, compensating this step alone.  At r = 1 the
result is the training's renderer itself.  Each of several samples a pixel is filtered by the same rule, as a pixel of
the larger image that it belongs to.  The design and its measurements are aaplug's own; the first step with one global
rate is SA-GS's filter (Song et al., arXiv 2403.19615).
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.cameras import Camera
from aaplug.interfaces import Training
from aaplug.splats import Splats2D

# px²: one pixel seen as a Gaussian.  A box has 1/12 and Mip-Splatting takes 0.1; opaque splats side by side hide less
# than their energies together should, and a narrower filter makes up for some of it (examples/guides/methods.md).
PIXEL_VARIANCE = 0.07

# times: how much finer than its own start the rate may come to be that a receding view is compared with; and at a pose
# of the data set, the share of that start at which it is so (examples/guides/methods.md)
SHARPER = 1.2
SHARPEST_AT = 1 / 4

RateChoice = Literal["pose", "global", "sharpest", "interval"]


@dataclass(frozen=True)
class Matched:
    """Match training's dilation at the new rate, then integrate over what is left of the pixel.

    rate: what a Gaussian's rate is compared with.
        "pose": as "global" at a pose of the data set, as "interval" for a free camera, whose distance no training
            view had, but that the blur of far views, which came of their own pixels, gives way to that of nearer
            ones as a view samples less finely: as its rate falls, the one compared with rises, up to the highest
            that any training view had and by no more than `SHARPER`.  For a free camera, which starts from the lowest
            of training's rates, it rises as fast as the other falls; at a pose of the data set, which starts from its
            own, only so that it has risen by `SHARPER` at `SHARPEST_AT`.
        "global" (A): the view's own training size; equals training's renderer at every training view.
        "sharpest" (B): the highest rate any training view had; one world-space blur for all views, the one that can
            be fused, thinner than what most views were trained with.
        "interval" (C): the range of rates the training views had, widened by this pose's own at the training size
            if it is a pose of the data set; equals training's renderer inside the range and adapts outside, for
            cameras that move nearer or farther.
    pixel_variance: of the whole pixel's filter, in px²; 0 is the match alone.
    windowed: integrate over a window instead, for pixel kernels that do: as wide as makes its variance and that of
        training's pixel one pixel's, √(1 − r²) px, and no wider than a point where r is not below 1.
    """

    rate: RateChoice = "pose"
    pixel_variance: float = PIXEL_VARIANCE
    windowed: bool = False

    def __call__(self, splats: Splats2D, camera: Camera, training: Training) -> Splats2D:
        """Filter the splats of one view."""
        rate = self.rates(splats, camera, training)
        trained = training.convention
        matched = splats.blurred(trained.kernel * rate * rate, trained.compensated)
        if self.windowed:
            return replace(matched, window=max(0.0, 1 - training.rate(camera) ** 2) ** 0.5)
        rest = self.pixel_variance * (1 - rate * rate).clamp(min=0.0)
        return matched.blurred(rest, compensate=True)

    def rates(self, splats: Splats2D, camera: Camera, training: Training) -> Float[Tensor, " m"]:
        """Rate of each splat against the one that training saw; the view's own for Gaussians no camera saw."""
        view = torch.full_like(splats.depths, training.rate(camera))
        if self.rate == "global":
            return view
        seen = training.bounds.seen[splats.sources]
        # where no camera saw a Gaussian any number but 0 will do: it is not chosen, and divides no gradient by 0
        highest = training.bounds.highest[splats.sources].to(splats.depths).where(seen, 1.0)
        now = camera.focal / splats.depths
        if self.rate == "sharpest":
            return torch.where(seen, now / highest, view)
        lowest = training.bounds.lowest[splats.sources].to(splats.depths).where(seen, 1.0)
        own = None if camera.trained_focal is None else camera.trained_focal / splats.depths
        if own is not None:
            lowest, highest = torch.minimum(lowest, own), torch.maximum(highest, own)
        if self.rate == "interval":
            nearest = torch.minimum(torch.maximum(now, lowest), highest)
            return torch.where(seen, now / nearest, view)
        low, high = (lowest, highest) if own is None else (own, own)
        speed = 1.0 if own is None else math.log(SHARPER) / -math.log(SHARPEST_AT)
        rise = (low / now).pow(speed).clamp(max=SHARPER)
        below = torch.minimum(low * rise, highest)
        nearest = torch.where(now < low, below, torch.minimum(now, high))
        return torch.where(seen, now / nearest, view)

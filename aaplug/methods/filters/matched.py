"""The matched screen filter: training's dilation at the new sampling rate, then the rest of the pixel's own filter.

A classic checkpoint was fitted with 0.3 px² of dilation: in px of the training image it looks like C + 0.3 I.  At r
times that sampling rate, where the projected covariance is C' = r² C, the same look is C' + 0.3 r² I.  Step one
restores it, with training's compensation if it had one.  Below the training rate (r < 1) a pixel covers more of the
scene than training's did.  Step two adds the part of its filter that training's pixel did not contain, 0.07 (1 - r²)
px², and compensates for this step alone.  At r = 1 the result is training's own renderer.  With several samples per
pixel, each sample is filtered as a pixel of the supersampled image.

Design and measurements are aaplug's own.  Step one with one global rate is SA-GS's filter (Song et al., arXiv
2403.19615).
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.splats import Splats2D
from aaplug.core.training import TrainingViews
from aaplug.methods import RateReference

# px²: variance of a pixel's own filter, as a Gaussian.  A box has 1/12, Mip-Splatting takes 0.1.  Opaque splats side by
# side hide less than their energies add up to, and a narrower filter offsets some of that (examples/guides/methods.md).
PIXEL_VARIANCE = 0.07

MAX_RISE = 1.2  # largest factor by which "pose" raises the reference of a coarser view (examples/guides/methods.md)
FULL_RISE_AT = 1 / 4  # relative rate at which the factor reaches MAX_RISE, at a pose of the data set
RISE_SPEED = math.log(MAX_RISE, 1 / FULL_RISE_AT)  # there the factor is (1 / relative rate) ** RISE_SPEED


@dataclass(frozen=True)
class Matched:
    """Rescale training's dilation to the new rate, then filter by the part of the pixel that training's did not cover.

    reference: the training rate that a splat's current rate is divided by, to give r.
        "global": this view's rate at its training size.  Equals training's renderer at every training view.
        "sharpest": the Gaussian's highest training rate.  The blur is then the same in the world for every view, so
            it could be fused; it is thinner than what most views were trained with.
        "interval": the current rate clamped to the Gaussian's range of training rates (at a data-set pose, the range
            includes that pose's training rate).  Equals training's renderer inside the range.
        "pose": "global" at a data-set pose, "interval" for a free camera.  Where a view samples more coarsely than
            that, the reference is raised, by a factor of up to `MAX_RISE` and at most to the highest rate: training's
            far views blurred in their own, larger pixels, and only their smallest blur belongs to the Gaussian.  For
            a free camera the factor is (lowest rate / current rate); at a data-set pose it grows more slowly and
            reaches `MAX_RISE` at `FULL_RISE_AT` of the training rate.
    pixel_variance: variance of a pixel's filter, in px²; 0 rescales the dilation only.
    windowed: for pixel kernels that average: instead of step two's blur, set `Splats2D.window` to √(1 - r²) px, with
        r the view's own relative rate.  Its variance and that of training's pixel add up to one pixel's.  0 if r >= 1.
    """

    reference: RateReference = "pose"
    pixel_variance: float = PIXEL_VARIANCE
    windowed: bool = False

    def __call__(self, splats: Splats2D, camera: Camera, training: TrainingViews) -> Splats2D:
        """Filter the splats of one view."""
        rate = self.rates(splats, camera, training)
        trained = training.convention
        matched = splats.blurred(trained.kernel * rate * rate, trained.compensated)
        if self.windowed:
            window = max(0.0, 1 - training.relative_rate(camera) ** 2) ** 0.5
            return replace(matched, window=window)
        rest = self.pixel_variance * (1 - rate * rate).clamp(min=0.0)
        return matched.blurred(rest, compensate=True)

    def rates(self, splats: Splats2D, camera: Camera, training: TrainingViews) -> Float[Tensor, " m"]:
        """Relative sampling rate r of each splat; the view's own r for Gaussians that no training camera saw."""
        view, at_pose = training.relative_rate(camera), camera.trained_focal is not None
        now = camera.focal / splats.depths
        if splats.rates is not None:  # through a lens, which samples directions differently
            view, now = view * splats.rates / now, splats.rates
        if self.reference == "global" or (self.reference == "pose" and at_pose and training.relative_rate(camera) >= 1):
            return torch.ones_like(splats.depths) * view
        in_training = now / view  # at this pose's training size
        if self.reference == "pose" and at_pose:
            highest = training.bounds.highest.index_select(0, splats.sources).to(now)  # 0 if no training camera saw it
            rise = min(training.relative_rate(camera) ** -RISE_SPEED, MAX_RISE)
            return view * in_training / torch.minimum(rise * in_training, torch.maximum(highest, in_training))
        bounds = training.bounds[splats.sources]
        lowest, highest = (rate.to(now).where(bounds.seen, 1.0) for rate in (bounds.lowest, bounds.highest))
        if self.reference == "sharpest":
            against = highest
        elif self.reference == "interval":
            if at_pose:
                lowest, highest = torch.minimum(lowest, in_training), torch.maximum(highest, in_training)
            against = torch.minimum(torch.maximum(now, lowest), highest)
        else:  # "pose" for a free camera: clamped to training's rates, and raised where it is lower
            raised = torch.minimum(lowest * (lowest / now).clamp(max=MAX_RISE), highest)
            against = torch.where(now < lowest, raised, torch.minimum(now, highest))
        return torch.where(bounds.seen, now / against, view)


BY_POSE, BY_GLOBAL_RATE = Matched(), Matched("global")
BY_SHARPEST_RATE, BY_INTERVAL = Matched("sharpest"), Matched("interval")

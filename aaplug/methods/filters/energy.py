"""Matched energy: converts a scene, in closed form, for a viewer whose rule differs from training's.

A splat's energy is its opacity times √det of its covariance.  A viewer that adds K px² and compensates shows
o'·√det C', whatever K is; one that does not compensate shows o'·√det(C' + K I).  Training showed o·√det(C + 0.3 I) at
the training rate, times its compensation if it had one.  So every Gaussian is widened in the world by the variance
`variance` / ν², with ν its median training rate (px per world unit).  Its opacity is then multiplied by the ratio of
the two energies, as a geometric mean over at most FIT_VIEWS training views.

With a variance of 0.2, a Mip viewer (K = 0.1) shows every splat with the energy that `matched` gives it with one
sample, except where opacity is capped or the ratio varies between views.  A negative variance narrows the Gaussians,
for a viewer that blurs more than training did.  The method is aaplug's own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera, spread
from aaplug.core.conventions import MIP, Convention
from aaplug.core.convolution import smoothed_by
from aaplug.core.gaussians import Fusion, Gaussians, scale_opacities
from aaplug.core.projection import project
from aaplug.core.sampling import median_rates, sampling_bounds
from aaplug.core.training import TrainingViews

MATCHED_VARIANCE = 0.2  # px² at the median training rate: 3DGS's 0.3 minus the Mip viewer's 0.1
MAX_FUSED_OPACITY = 0.9999  # cap: matching energy can demand an opacity above 1
# px² at the median training rate: thinning stops here.  Below it no image changes visibly.
MIN_THINNED_VARIANCE = 0.01
PROJECTED_AT_ONCE = 1 << 16  # Gaussians, which bounds memory and fits caches
FIT_VIEWS = 25  # evenly spread training views over which the opacity factor is averaged


@dataclass(frozen=True)
class MatchedEnergy:
    """Widen the Gaussians and set opacities so that a viewer shows the energy that training showed.

    variance: px² at the median training rate.  shown: the convention that the viewer draws by.
    """

    variance: float = MATCHED_VARIANCE
    shown: Convention = MIP

    def __call__(self, scene: Gaussians, training: TrainingViews) -> Gaussians:
        """Fuse into scales and opacities.  A Gaussian that none of the fitted views sees keeps its opacity."""
        views = spread(training.cameras, FIT_VIEWS)
        rates = median_rates(scene.means, training.cameras)
        widened = _widened(scene, rates, self.variance)
        factor = _mean_log_factor(scene, widened, views, training, self.shown)
        logits = scale_opacities(scene.logit_opacities, factor, MAX_FUSED_OPACITY)
        settings = {"variance": f"{self.variance:g}", "views": str(len(views)), "from": training.convention.name}
        fusion = Fusion("matched-energy", settings)
        return replace(widened, logit_opacities=logits, convention=self.shown, fused=(*scene.fused, fusion))


def _widened(scene: Gaussians, rates: Float[Tensor, " n"], variance: float) -> Gaussians:
    """Add `variance` px² to every axis; a negative one thins axes down to `MIN_THINNED_VARIANCE`, never below."""
    if variance >= 0:
        log_sigma = 0.5 * torch.tensor(variance).log() - rates.log()
        return smoothed_by(scene, log_sigma.where(rates > 0, -torch.inf)[:, None], volume=False)
    px2 = (2 * (scene.log_scales + rates.log()[:, None])).exp()
    least = px2.clamp(max=MIN_THINNED_VARIANCE)
    share = torch.maximum(px2 + variance, least) / px2
    change = (0.5 * share.log()).where(rates[:, None] > 0, 0.0)
    return replace(scene, log_scales=scene.log_scales + change)


def _mean_log_factor(
    scene: Gaussians, widened: Gaussians, views: Sequence[Camera], training: TrainingViews, shown: Convention
) -> Float[Tensor, " n"]:
    """ln of (energy in training / energy in the viewer at unchanged opacity), averaged over the views that see it."""
    blur, rules = 0.0 if shown.compensated else shown.kernel, training.convention.rules
    total = torch.zeros_like(scene.logit_opacities, dtype=torch.float64)
    count = torch.zeros_like(total)
    for start, camera in product(range(0, len(scene), PROJECTED_AT_ONCE), views):
        part = slice(start, start + PROJECTED_AT_ONCE)
        raw, wide = (project(gaussians[part], camera, rules=rules) for gaussians in (scene, widened))
        trained = raw.blurred(training.convention.kernel, training.convention.compensated)
        wide = wide.blurred(blur, compensate=False)
        factor = 0.5 * (trained.dets / wide.dets).log() + (trained.opacities / raw.opacities).log()
        places = start + raw.sources
        fitted = sampling_bounds(scene.means[places], [camera]).seen & factor.isfinite()
        total.index_add_(0, places[fitted], factor[fitted].double())
        count.index_add_(0, places[fitted], torch.ones_like(factor[fitted], dtype=torch.float64))
    return (total / count.clamp(min=1)).to(scene.logit_opacities)


MATCHED_ENERGY = MatchedEnergy()

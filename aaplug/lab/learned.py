"""Filters learned for each Gaussian by sampling rate, after LOD-GS (arXiv 2507.00554), on a scene that is trained.

LOD-GS adds to each Gaussian's scale and opacity a weighted sum of 20 functions of its sampling rate, then filters as
EWA does, and trains scene and weights together, at several sizes.  Here the scene stays, and `matched` filters.  The
functions are tents over t = log2(training's rate / rate): φ_k(t) = max(0, 1 - |t - k|) for k = 1 to 4, the last one
constant beyond 4, with t = 0 at training's rates and above.  So a Gaussian is multiplied in size by exp(Σ a_k φ_k), and
b_k φ_k are added to its opacity's logit: eight columns of the file, 0 before training.  At the training size, and in
programs that ignore the columns, nothing changes.

m: splats.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.splats import Splats2D
from aaplug.core.training import TrainingViews
from aaplug.finetuning.settings import LEARNED_COLUMNS, Method, Settings
from aaplug.methods.filters.matched import Matched
from aaplug.methods.viewers import FAST

OCTAVES = 4  # below training's rate, each with a function
MAX_CHANGE = 3.0  # of ln size and of the logit, either way
LEARNING_RATE = 0.06  # measured: 0.02 ends 0.9 dB lower at 1/8
NAMES = tuple(f"filter_{what}_{k}" for what in ("scale", "opacity") for k in range(1, OCTAVES + 1))


@dataclass(frozen=True)
class Learned(Matched):
    """Change each splat's size and opacity by its learned columns, then filter by `matched`.

    values: of the columns, by name, for each splat; see `core.interfaces.ReadsColumns`.  A column that lacks is 0.
    """

    values: Mapping[str, Float[Tensor, " m"]] = field(default_factory=dict, hash=False)
    columns: tuple[str, ...] = NAMES

    def reading(self, values: Mapping[str, Float[Tensor, " m"]]) -> "Learned":
        """The filter of splats with these values."""
        return replace(self, values=values)

    def __call__(self, splats: Splats2D, camera: Camera, training: TrainingViews) -> Splats2D:
        """Filter the splats of one view."""
        weights = tents(self.rates(splats, camera, training))
        zeros = torch.zeros_like(splats.dets)
        columns = torch.stack([self.values.get(name, zeros) for name in self.columns], dim=1).to(weights)
        added = columns.nan_to_num().unflatten(1, (2, OCTAVES)) * weights[:, None]
        size, logit = added.sum(dim=2).clamp(-MAX_CHANGE, MAX_CHANGE).exp().unbind(dim=1)
        opacities = splats.opacities * logit / (1 + splats.opacities * (logit - 1))  # exact where nothing is added
        covs, dets = splats.covs * size.square()[:, None], splats.dets * size**4
        return super().__call__(
            splats.with_columns({"covs": covs, "dets": dets, "opacities": opacities}), camera, training
        )


def tents(rates: Float[Tensor, " m"]) -> Float[Tensor, "m octaves"]:
    """φ_1 to φ_4 at relative sampling rates; all are 0 from training's rate on."""
    t = -rates.log2().clamp(-OCTAVES, 0)
    return (1 - (t[:, None] - torch.arange(1, OCTAVES + 1).to(t)).abs()).clamp(min=0.0)


def learned_filters(scales: Sequence[float], move: Sequence[str] = (), anchor: float = 0.0) -> Settings:
    """1000 steps of L2, each at 1/2, 1/4, 1/8 or 1/16 or another of the scales; the columns alone move."""
    weights = dict.fromkeys(sorted({*scales, *(0.5**k for k in range(1, OCTAVES + 1))}, reverse=True), 1.0)
    return Settings("learned-filters", 1000, weights, {LEARNED_COLUMNS: LEARNING_RATE}, decay=0.03)


LEARNED = Learned()
LEARNED_FILTERS = Method(learned_filters, replace(FAST, name="learned", settings="--recipe learned", recipe="learned"))

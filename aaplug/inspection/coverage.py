"""How a scene's Gaussians sit against their sampling bounds, and at which scale each begins to alias.

A Gaussian is held to be sampled well where its standard deviation along its middle axis (surfaces are flat, and the
thin axis alone shows only edge-on) is at least √0.2 px at the highest rate of any training view: Mip-Splatting's
bound.  What training drew is that Gaussian widened by the convention's kernel.  Its variance is r²(σ²ν² + kernel) px²
in an image r times as finely sampled, so that it meets the bound at r = √(0.2 / (σ²ν² + kernel)) and aliases below.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.gaussians import MAX_LOG_SCALE, Gaussians
from aaplug.core.sampling import SamplingBounds
from aaplug.core.training import TrainingViews
from aaplug.methods.filters import NYQUIST_VARIANCE

BINS = 48
LOWEST, HIGHEST = (
    -7.0,
    5.0,
)  # log2 of the multiple of the bound that the histogram shows; the rest is in its ends


@dataclass(frozen=True)
class Coverage:
    """How Gaussians that any camera sees sit against their bounds; JSON-ready but for its name.

    edges, counts: histogram of the extent over its bound at the highest training rate, edges as log2.
    under: share below the bound.  begins: the scale under which half of the Gaussians, as training drew them, alias.
    aliased: by scale, the share of Gaussians, as training drew them, that are below the bound there.
    """

    gaussians: int
    seen: int
    edges: tuple[float, ...]
    counts: tuple[int, ...]
    under: float | None
    begins: float | None
    aliased: tuple[tuple[float, float], ...]

    def as_json(self) -> dict[str, Any]:
        """One JSON-ready object."""
        return {
            "gaussians": self.gaussians,
            "seen": self.seen,
            "under_sampling_bound_share": self.under,
            "aliasing_begins_at_scale": self.begins,
            "aliased_share_at_scale": {f"{scale:g}": share for scale, share in self.aliased},
            "histogram": {
                "of": "log2 of extent over sampling bound",
                "edges": list(self.edges),
                "counts": list(self.counts),
            },
        }


def middle_log_scales(scene: Gaussians) -> Float[Tensor, " n"]:
    """ln of the standard deviation along the middle axis; of a disc's two the smaller."""
    return scene.log_scales.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE).median(dim=1).values


def log_multiples(scene: Gaussians, bounds: SamplingBounds) -> Float[Tensor, " seen"]:
    """ln of the extent over its bound at the highest training rate, of the Gaussians that any camera sees."""
    extents = middle_log_scales(scene)[bounds.seen].double() + bounds.highest[bounds.seen].log()
    return extents - 0.5 * math.log(NYQUIST_VARIANCE)


def under(multiples: Float[Tensor, " seen"]) -> int:
    """How many of these, as `log_multiples` gives them, are below their bound."""
    return int((multiples < 0).sum())


def aliasing_begins(multiple: float, kernel: float) -> float:
    """The scale below which a Gaussian of `multiple` times its bound, as training drew it, aliases."""
    return (NYQUIST_VARIANCE / (NYQUIST_VARIANCE * multiple**2 + kernel)) ** 0.5


def coverage(scene: Gaussians, training: TrainingViews, scales: Sequence[float]) -> Coverage:
    """How the scene sits against its bounds, at the training size and at `scales`."""
    found = log_multiples(scene, training.bounds)
    extents = found.exp()
    logs = (found / math.log(2)).clamp(LOWEST, HIGHEST)
    edges = torch.linspace(LOWEST, HIGHEST, BINS + 1, dtype=torch.float64)
    counts = torch.histogram(logs.cpu(), edges).hist
    kernel = training.convention.kernel
    drawn = (extents.square() + kernel / NYQUIST_VARIANCE).sqrt()
    some = len(extents) > 0
    return Coverage(
        len(scene),
        len(extents),
        tuple(edges.tolist()),
        tuple(int(count) for count in counts),
        under(found) / len(found) if some else None,
        aliasing_begins(float(extents.median()), kernel) if some else None,
        tuple((s, float((drawn * s < 1).double().mean())) for s in scales) if some else (),
    )

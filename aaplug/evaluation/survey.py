"""Statistics of a whole scene, gathered part by part in bounded memory."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.sampling import check_frame, sampling_bounds
from aaplug.evaluation.coverage import log_multiples
from aaplug.io.scenes.scene import Scene
from aaplug.system.monitor import Tell

PROBE_ROWS = 64  # Gaussians read at each place of the file
BINS = 4096  # of a histogram
NEEDLE_RATIO = 10.0  # longest axis over the middle one, from which a Gaussian is a needle


class Histogram:
    """Counts of values between two ends; the first and the last bin also count what lies outside."""

    def __init__(self, low: float, high: float) -> None:
        self.low, self.high = low, high
        self.counts = torch.zeros(BINS, dtype=torch.int64)

    def add(self, values: Float[Tensor, " n"]) -> None:
        """Count values."""
        self.counts += torch.histc(values.double().clamp(self.low, self.high), BINS, self.low, self.high).long()

    def quantile(self, share: float) -> float | None:
        """Middle of the bin that holds this quantile; None without values."""
        if not (total := int(self.counts.sum())):
            return None
        place = int(torch.searchsorted(self.counts.cumsum(0), max(1, math.ceil(share * total))))
        return self.low + (place + 0.5) * (self.high - self.low) / BINS

    def share_below(self, value: float) -> float | None:
        """Share of the values in bins below that of a value; None without values."""
        place = min(BINS, max(0, round((value - self.low) / (self.high - self.low) * BINS)))
        return int(self.counts[:place].sum()) / total if (total := int(self.counts.sum())) else None


@dataclass(eq=False)
class Survey:
    """Counts over a scene.  Rates and multiples are natural logarithms.

    seen, under: Gaussians that a camera sees, and those of them below their sampling bound.
    needles: Gaussians more than `NEEDLE_RATIO` times as long as broad.
    above_zero: Gaussians with three log-scales above 0.  activated: with an opacity logit in [0, 1].
    rates: highest sampling rate in training.  multiples: extent over the sampling bound.
    largest: log-scale.  filtered: true if a 3D filter is stored.  faults: unusable rows by their fault.
    """

    count: int = 0
    seen: int = 0
    under: int = 0
    needles: int = 0
    above_zero: int = 0
    activated: int = 0
    low: Float[Tensor, "3"] = field(default_factory=lambda: torch.full((3,), torch.inf))
    high: Float[Tensor, "3"] = field(default_factory=lambda: torch.full((3,), -torch.inf))
    rates: Histogram = field(default_factory=lambda: Histogram(-35.0, 35.0))
    multiples: Histogram = field(default_factory=lambda: Histogram(-20.0, 20.0))
    largest: float = -math.inf
    filtered: bool = False
    faults: Counter[str] = field(default_factory=Counter)


def survey(opened: Scene, cameras: Sequence[Camera] = (), tell: Tell = lambda done, total: None) -> Survey:
    """Survey a scene; unusable rows are counted and left out.  `tell` is called with Gaussians done and in all."""
    found = Survey()
    tell(0, opened.count)  # parts differ in size, so the rate counts from here
    for part in opened.parts(faults=found.faults):
        found.filtered |= part.filter_3d is not None
        if not len(part):
            continue
        found.count += len(part)
        low, high = part.means.aminmax(dim=0)
        found.low, found.high = torch.minimum(found.low, low), torch.maximum(found.high, high)
        found.largest = max(found.largest, part.log_scales.max().item())
        _, broad, long = part.log_scales.sort(dim=1).values.unbind(dim=1)
        found.needles += int((long - broad > math.log(NEEDLE_RATIO)).sum())
        found.above_zero += int((part.log_scales > 0).all(dim=1).sum())
        found.activated += int(((part.logit_opacities >= 0) & (part.logit_opacities <= 1)).sum())
        if cameras:
            bounds = sampling_bounds(part.means, cameras)
            found.seen += int(bounds.seen.sum())
            found.rates.add(bounds.highest[bounds.seen].log())
            multiples = log_multiples(part, bounds)
            found.multiples.add(multiples)
            found.under += int((multiples < 0).sum())
        tell(found.count, opened.count)
    return found


def check_frame_of(opened: Scene, cameras: Sequence[Camera], min_seen: float) -> float:
    """`sampling.check_frame` on Gaussians from evenly spaced places of the file."""
    return check_frame(opened.sample(PROBE_ROWS).means, cameras, opened.name, min_seen)

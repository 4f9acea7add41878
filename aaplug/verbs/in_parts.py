"""Scenes larger than memory, part by part: conversion and a survey, with the results that the whole would give.

What a world filter does to a Gaussian depends on the cameras alone, so parts can be read, filtered and written one
after the other.  The one thing that it needs of all others, the coarsest rate found, is looked for beforehand.
"""

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import WorldFilter
from aaplug.core.kernels import one_thread
from aaplug.core.sampling import SamplingBounds, check_frame, sampling_bounds
from aaplug.core.training import TrainingViews
from aaplug.inspection.coverage import log_multiples, middle_log_scales, under
from aaplug.io.scenes.scene_file import PART, SceneFile
from aaplug.methods.filters import MatchedEnergy
from aaplug.methods.viewers import convert

LARGE = (
    1_000_000  # Gaussians: more are converted in parts; a million takes 0.3 GB, and more at work
)
PROBES = 512  # places in the file, evenly spread, from which the sample for the frame check is read
PROBE_ROWS = 64  # Gaussians read at each
HISTOGRAM = 4096  # bins of a survey's medians

Tell = Callable[[int, int], None]


def convert_parts(
    opened: SceneFile,
    cameras: Sequence[Camera],
    form: WorldFilter,
    guard: float = math.inf,
    drop_bad: bool = False,
    tell: Tell = lambda done, total: None,
    size: int = PART,
    threads: int = 1,
) -> Iterator[Gaussians]:
    """The parts of the scene, each converted; together what `conversion.convert` makes of the whole.

    cameras: none where the scene stores its filter.  threads: how many parts are worked on side by side.

    Raises:
        UsageError, FormatError: see `conversion.convert` and `SceneFile.parts`.
    """
    coarsest = None
    if cameras and not isinstance(form, MatchedEnergy):
        coarsest = _coarsest(opened, cameras, drop_bad, size)

    def converted(part: Gaussians) -> Gaussians:
        training = None
        if cameras:
            training = TrainingViews(
                part.convention, cameras, _bounds(part, cameras, coarsest), guard
            )
        return convert(part, training, form)

    done = 0
    for part in _side_by_side(converted, opened.parts(drop_bad, size), threads):
        yield part
        done += len(part)
        tell(min(done, opened.count), opened.count)


def _side_by_side(
    work: Callable[[Gaussians], Gaussians], parts: Iterator[Gaussians], threads: int
) -> Iterator[Gaussians]:
    """Results in order, from threads of one processor each; never more than one part a thread is waiting."""
    waiting: deque[Future[Gaussians]] = deque()
    start = torch.set_num_threads
    with one_thread(), ThreadPoolExecutor(threads, initializer=start, initargs=(1,)) as pool:
        try:
            for part in parts:
                waiting.append(pool.submit(work, part))
                if len(waiting) > threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def check_frame_of(opened: SceneFile, cameras: Sequence[Camera], min_share: float) -> float:
    """`sampling.check_frame` on Gaussians from evenly spread places of the file.

    Raises:
        FrameError: see there.
    """
    return check_frame(_sample(opened), cameras, str(opened.path), min_share)


def _sample(opened: SceneFile) -> Float[Tensor, "n 3"]:
    step = max(PROBE_ROWS, opened.count // PROBES)
    starts = range(0, opened.count, step)
    means = [opened.load(a, min(a + PROBE_ROWS, opened.count)).means for a in starts]
    sample = torch.cat(means) if means else torch.zeros(0, 3)
    return sample[sample.isfinite().all(dim=1)]


def _bounds(part: Gaussians, cameras: Sequence[Camera], coarsest: float | None) -> SamplingBounds:
    """The part's bounds, its unseen Gaussians at the coarsest rate; a matched-energy fit asks for none."""
    if coarsest is None:
        none = torch.zeros(len(part))
        return SamplingBounds(none, none, none, torch.zeros(len(part), dtype=torch.int32))
    bounds = sampling_bounds(part.means, cameras)
    highest = torch.where(bounds.seen, bounds.highest, coarsest)
    return replace(bounds, highest=highest, views=bounds.views.clamp(min=1))


def _coarsest(opened: SceneFile, cameras: Sequence[Camera], drop_bad: bool, size: int) -> float:
    coarsest = math.inf
    for part in opened.parts(drop_bad, size):
        bounds = sampling_bounds(part.means, cameras)
        if bounds.seen.any():
            coarsest = min(coarsest, bounds.highest[bounds.seen].min().item())
    return coarsest


class Survey:
    """Figures over all Gaussians of a scene, gathered part by part in bounded memory.

    Medians come from histograms: opacities in [0, 1], scales, rates and multiples of the sampling bound by their
    logarithms, right to a bin.
    """

    def __init__(self, cameras: Sequence[Camera] = ()) -> None:
        self.cameras = cameras
        self.count = self.seen = self.under = self.above_zero = self.activated = 0
        self.low, self.high = torch.full((3,), torch.inf), torch.full((3,), -torch.inf)
        self.opacities = Histogram(0.0, 1.0)
        self.scales = Histogram(-35.0, 35.0)
        self.rates = Histogram(-35.0, 35.0)
        self.multiples = Histogram(-20.0, 20.0)
        self.largest = -math.inf
        self.filtered = False
        self.faults: dict[str, int] = {}

    def add(self, part: Gaussians) -> None:
        """Take in a part."""
        self.filtered |= part.filter_3d is not None
        if not len(part):
            return
        self.count += len(part)
        low, high = part.means.aminmax(dim=0)
        self.low, self.high = torch.minimum(self.low, low), torch.maximum(self.high, high)
        self.opacities.add(part.opacities)
        self.scales.add(middle_log_scales(part))
        self.largest = max(self.largest, part.log_scales.max().item())
        self.above_zero += int((part.log_scales > 0).all(dim=1).sum())
        logits = part.logit_opacities
        self.activated += int(((logits >= 0) & (logits <= 1)).sum())
        if self.cameras:
            self._add_rates(part)

    def _add_rates(self, part: Gaussians) -> None:
        bounds = sampling_bounds(part.means, self.cameras)
        seen = bounds.seen
        self.seen += int(seen.sum())
        self.rates.add(bounds.highest[seen].log())
        multiples = log_multiples(part, bounds)
        self.multiples.add(multiples)
        self.under += under(multiples)


@dataclass
class Histogram:
    """Counts of values between two ends; what lies outside counts in the first or the last bin."""

    low: float
    high: float

    def __post_init__(self) -> None:
        self.counts = torch.zeros(HISTOGRAM, dtype=torch.int64)

    def add(self, values: Float[Tensor, " n"]) -> None:
        """Count values."""
        share = (values.double() - self.low) / (self.high - self.low)
        bins = (share * HISTOGRAM).clamp(0, HISTOGRAM - 1).long()
        self.counts += torch.bincount(bins, minlength=HISTOGRAM)

    def quantile(self, share: float) -> float | None:
        """The middle of the bin below which lies this share of the values; None without any."""
        total = int(self.counts.sum())
        if not total:
            return None
        place = int(torch.searchsorted(self.counts.cumsum(0), max(1, math.ceil(share * total))))
        return self.low + (place + 0.5) * (self.high - self.low) / HISTOGRAM


def survey(
    opened: SceneFile,
    cameras: Sequence[Camera] = (),
    tell: Tell = lambda done, total: None,
) -> Survey:
    """Gather the figures of a scene, its unusable rows left out and counted; see `Survey`."""
    found = Survey(cameras)
    for part in opened.parts(drop_bad=True, found=found.faults):
        found.add(part)
        tell(found.count, max(1, opened.count))
    return found

"""The sampling rates of a scene's Gaussians in training, and the scale at which each begins to alias.

A Gaussian is sampled well where its standard deviation along its middle axis is at least √0.2 px at the highest
sampling rate of any training view: Mip-Splatting's bound (arXiv 2311.16493).  The middle axis is the one that counts
on surfaces, whose thin axis shows only edge-on.  Training drew that Gaussian widened by the convention's dilation.  At
relative rate r its variance is r²(σ²ν² + dilation) px², which meets the bound at r = √(0.2 / (σ²ν² + dilation)): below
that scale it aliases.

The share of the splats' energy above the Nyquist rate (`core.spectra`) takes all axes, opacities and the recipe in too.
A survey gathers the same of a file, with other statistics, part by part in bounded memory.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera, spread
from aaplug.core.gaussians import MAX_LOG_SCALE, Gaussians
from aaplug.core.sampling import SamplingBounds, check_frame, sampling_bounds
from aaplug.core.spectra import energies
from aaplug.core.training import TrainingViews
from aaplug.io.scenes.scene import Scene
from aaplug.methods.filters.smoothing import NYQUIST_VARIANCE
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.rendering.renderer import Renderer
from aaplug.system.errors import counted
from aaplug.system.monitor import Tell

BINS = 48
SPECTRUM_VIEWS = 3  # from which the energy above the Nyquist rate is taken
LOWEST_LOG2, HIGHEST_LOG2 = -7.0, 5.0  # of extent over bound; the end bins of the histogram count what lies outside
PROBE_ROWS = 64  # Gaussians read at each place of the file
SURVEY_BINS = 4096  # of a histogram
USUAL_LOG_SCALE = 20.0  # larger ones are taken for scales
MIN_JUDGED = 10  # Gaussians: of fewer, all values may lie as activated ones do
MIN_STEPS = 1e4  # of float32 across the scene's extent: with fewer, positions are coarse
ULP = 2.0**-23  # of float32, relative
NEEDLE_RATIO = 10.0  # longest axis over the middle one, from which a Gaussian is a needle


@dataclass(frozen=True)
class Coverage:
    """The extents of the Gaussians that any training camera sees against their sampling bounds.

    gaussians, seen: numbers of all, and of those that a camera sees.
    edges, counts: histogram of extent over bound at the highest training rate; edges as log2.
    under: share below the bound.  begins: the scale below which half of the Gaussians, as training drew them, alias.
    aliased: (scale, share of the Gaussians, as training drew them, that are below the bound at that scale).
    above_nyquist: share of the splats' energy by recipe and scale.
    """

    gaussians: int
    seen: int
    edges: tuple[float, ...]
    counts: tuple[int, ...]
    under: float | None
    begins: float | None
    aliased: tuple[tuple[float, float], ...]
    above_nyquist: Mapping[tuple[str, float], float | None] = field(default_factory=dict)


def log_multiples(scene: Gaussians, bounds: SamplingBounds) -> Float[Tensor, " seen"]:
    """ln of extent over bound at the highest training rate, of the Gaussians that any training camera sees.

    The extent is that along the middle axis; of a disc, the smaller of its two.
    """
    middle = scene.log_scales.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE).median(dim=1).values
    extents = middle[bounds.seen].double() + bounds.highest[bounds.seen].log()
    return extents - 0.5 * math.log(NYQUIST_VARIANCE)


def aliasing_begins(multiple: float, dilation: float) -> float:
    """The scale below which a Gaussian of `multiple` times its bound, drawn with `dilation` in px², aliases."""
    return (NYQUIST_VARIANCE / (NYQUIST_VARIANCE * multiple**2 + dilation)) ** 0.5


@torch.no_grad()
def above_nyquist(renderer: Renderer, views: Sequence[Camera], scale: float) -> float | None:
    """Share of the energy of a few views' splats above the Nyquist rate of their samples, at a scale.

    Splats that others hide count as all do.  None if a sample is not a point, or nothing is seen.
    """
    if renderer.recipe.pixel != POINT:
        return None
    total = above = 0.0
    for view in spread(views, SPECTRUM_VIEWS):
        splats = renderer.splats(*renderer.sampled(view.scaled(scale)))
        energy, share = (column.double() for column in energies(splats))
        total, above = total + float(energy.sum()), above + float(energy @ share)
    return above / total if total else None


def coverage(scene: Gaussians, training: TrainingViews, scales: Sequence[float]) -> Coverage:
    """Compare the scene's extents with their bounds, at the training size and at `scales`."""
    multiples = log_multiples(scene, training.bounds)
    logs = (multiples / math.log(2)).clamp(LOWEST_LOG2, HIGHEST_LOG2)
    histogram = torch.histogram(logs.cpu(), torch.linspace(LOWEST_LOG2, HIGHEST_LOG2, BINS + 1, dtype=torch.float64))
    counts = len(scene), len(multiples), tuple(histogram.bin_edges.tolist()), tuple(map(int, histogram.hist))
    if not len(multiples):
        return Coverage(*counts, None, None, ())
    extents, dilation = multiples.exp(), training.convention.kernel
    dilated = (extents.square() + dilation / NYQUIST_VARIANCE).sqrt()
    under = int((multiples < 0).sum()) / len(multiples)
    begins = aliasing_begins(float(extents.median()), dilation)
    return Coverage(*counts, under, begins, tuple((s, float((dilated * s < 1).double().mean())) for s in scales))


class Histogram:
    """Counts of values between two ends; the first and the last bin also count what lies outside."""

    def __init__(self, low: float, high: float) -> None:
        self.low, self.high = low, high
        self.counts = torch.zeros(SURVEY_BINS, dtype=torch.int64)

    def add(self, values: Float[Tensor, " n"]) -> None:
        """Count values."""
        self.counts += torch.histc(values.double().clamp(self.low, self.high), SURVEY_BINS, self.low, self.high).long()

    def quantile(self, share: float) -> float | None:
        """Middle of the bin that holds this quantile; None without values."""
        if not (total := int(self.counts.sum())):
            return None
        place = int(torch.searchsorted(self.counts.cumsum(0), max(1, math.ceil(share * total))))
        return self.low + (place + 0.5) * (self.high - self.low) / SURVEY_BINS

    def share_below(self, value: float) -> float | None:
        """Share of the values in bins below that of a value; None without values."""
        place = min(SURVEY_BINS, max(0, round((value - self.low) / (self.high - self.low) * SURVEY_BINS)))
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


def problems(scene: Scene, statistics: Survey) -> Iterator[str]:
    """Yield what is odd about the scene, each with what to do."""
    for text, number in statistics.faults.items():
        yield f"{counted(number, 'Gaussian')} with {text}: --drop-bad leaves such out"
    if not scene.count:
        yield "the scene is empty: check that it is the right file"
    if not statistics.count:
        return
    judged = max(statistics.count, MIN_JUDGED)
    if statistics.largest > USUAL_LOG_SCALE or statistics.above_zero == judged:
        yield "scales look already exponentiated (they should be logarithms): export the scene again"
    elif statistics.activated == judged:
        yield "opacities look already activated, all in [0, 1] (they should be logits): export the scene again"
    if statistics.filtered:
        yield "its filter_3D is not fused, and viewers ignore it: `aaplug convert` fuses it"
    if scene.flat:
        yield "2D Gaussians: recipe auto draws them as discs, as 2DGS does; no viewer of `aaplug viewers` does"
    farthest = max(statistics.low.abs().max().item(), statistics.high.abs().max().item())
    extent = (statistics.high - statistics.low).max().item()
    if 0 < extent < MIN_STEPS * ULP * farthest:
        yield f"lies {farthest:.3g} from the origin, where float32 is coarse: centre it before training"


def check_frame_of(opened: Scene, cameras: Sequence[Camera], min_seen: float) -> float:
    """`sampling.check_frame` on Gaussians from evenly spaced places of the file."""
    return check_frame(opened.sample(PROBE_ROWS).means, cameras, opened.name, min_seen)
